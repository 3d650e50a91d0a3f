"""The data of a problem as numbers: values, means and moments by quadrature.

f, g, u_D, α and κ are known by their values at quadrature points (`Problem.quadrature_degree`), and
where they are numbers exactly.
"""

from __future__ import annotations

from functools import cached_property
from weakref import WeakKeyDictionary, proxy

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx.mesh import Mesh
from mpi4py import MPI
from ufl.core.expr import Expr

from . import compat
from .cells import Cells
from .problem import Forms, number
from .ranges import Range, range_of
from .space import facet_quadrature

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]


class Rule:
    """Quadrature on cells.

    Attributes:
        weights: Weights, which add up to 1, shape (q,).
        hats: λ_i at the points, shape (d + 1, q).
        bumps: b_i = 4 λ_j λ_k, i, j, k different, at the points, shape (d + 1, q); for d = 2.
    """

    def __init__(self, forms: Forms):
        """Take the rule that the problem's loads are integrated with."""
        degree = forms.problem.quadrature_degree
        self.points, weights = basix.make_quadrature(forms.mesh.basix_cell(), degree)
        self.weights = weights / weights.sum()
        self.hats = np.vstack([1.0 - self.points.sum(axis=1), self.points.T])
        self.bumps = np.stack(
            [4.0 * np.delete(self.hats, i, axis=0).prod(axis=0) for i in range(len(self.hats))]
        )


class Volume:
    """Values of an expression in cells.

    Args:
        expression: A scalar.
        forms: The problem's.
        rule: Where to evaluate.
    """

    def __init__(self, expression: Expr, forms: Forms, rule: Rule):
        """Compile the expression, unless it is a number."""
        self.number, self.rule, self.expression = number(expression), rule, expression
        self._values = None
        if self.number is None:
            self._values = compat.compile_expression(expression, rule.points, forms.mesh)

    def at(self, cells: Cells) -> FloatArray:
        """Values at the quadrature points of owned cells, shape (cells, q)."""
        assert self._values is not None
        which = np.arange(cells.number, dtype=np.int32)
        return self._values.eval(cells.domain.mesh, which).reshape(
            cells.number, len(self.rule.weights)
        )


class Coefficient:
    """κ on each cell.

    Attributes:
        mean: κ_T, shape (cells,), or () where κ is a number.
        low: Lower bound of κ, same shape.
        high: Upper bound of κ, same shape.
        values: κ at the quadrature points, shape (q, cells); None where it is constant on
            each cell of all ranks.
        smallest: Lower bound of κ over all ranks.
        reason: Why there are no bounds, if there are none.
    """

    def __init__(self, kappa: Volume, cells: Cells):
        """Evaluate κ; collective."""
        self.rule = kappa.rule
        self.values: FloatArray | None = None
        self.reason: str | None = None
        if kappa.number is not None:
            self.mean = self.low = self.high = np.array(kappa.number)
        else:
            found: Range | None = range_of(kappa.expression, cells)
            values = kappa.at(cells)
            self.mean = values @ self.rule.weights
            if found is None:
                self.reason = "the coefficient has no computable upper and lower bound"
                self.low = self.high = self.mean
            else:
                self.low, self.high = (np.broadcast_to(x, self.mean.shape) for x in found)
            varies = bool((np.ptp(values, axis=1) > 1e-14 * np.abs(self.mean)).any())
            if cells.comm.allreduce(varies, op=MPI.LOR):  # or the bound would depend on the ranks
                self.values = np.ascontiguousarray(values.T)
        # The same way on all ranks
        smallest = float(self.low.min(initial=np.inf)) if self.low.ndim else float(self.low)
        self.smallest = min(cells.comm.allgather(smallest))
        reasons = [reason for reason in cells.comm.allgather(self.reason) if reason]
        self.reason = reasons[0] if reasons else None
        if self.reason is None and not self.smallest > 0:
            self.reason = "the coefficient's computable lower bound is not positive"


class Trace:
    """Values of an expression on boundary facets.

    Attributes:
        points: Quadrature points on the reference facet, shape (q, d - 1).
        weights: Their weights, which add up to 1.
        hats: Barycentric coordinates of the points, shape (q, d).
    """

    def __init__(self, expression: Expr, forms: Forms):
        """Compile the expression, unless it is a number."""
        self._expression, self._mesh = expression, forms.mesh
        facet = basix.cell.subentity_types(forms.mesh.basix_cell())[-2][0]
        corners = basix.geometry(facet)
        self.points, self.weights = facet_quadrature(forms.mesh, forms.problem.quadrature_degree)
        self.hats = np.column_stack([1.0 - self.points.sum(axis=1), self.points])
        self._corners = len(corners)
        self._constant = number(expression)
        if self._constant is None:
            at = np.vstack([corners, corners.mean(axis=0), self.points])
            self._values = compat.FacetExpression(expression, at, forms.mesh)

    @property
    def vanishes(self) -> bool:
        """Whether it is the number 0."""
        return self._constant == 0.0

    def at(self, mesh: Mesh, entities: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values at the vertices, the midpoint and the quadrature points of facets.

        Args:
            mesh: Where.
            entities: Pairs (cell, facet's number in the cell), shape (n, 2).

        Returns:
            Arrays of shapes (d, n), (n,) and (q, n); vertices in the order of the cell's closure.
        """
        n, k = len(entities), self._corners
        if self._constant is not None:
            count = len(self.weights)
            return tuple(np.full(s, self._constant) for s in ((k, n), n, (count, n)))  # type: ignore
        values = np.ascontiguousarray(self._values.at(mesh, entities)[:, :, 0].T)
        return values[:k], values[k], values[k + 1 :]

    def slopes(self, mesh: Mesh, entities: IntArray) -> FloatArray:
        """Gradients at the quadrature points, shape (q, n, gdim); collective.

        Args:
            mesh: Where.
            entities: As for `at`.
        """
        if self._gradient is None:
            return np.zeros((1, len(entities), mesh.geometry.dim))
        return self._gradient.at(mesh, entities).transpose(1, 0, 2)

    @cached_property
    def _gradient(self) -> compat.FacetExpression | None:
        """Compiled when it is first asked for, as only the certificate does; None if it is 0."""
        gradient = None if self._constant is not None else ufl.grad(self._expression)
        if gradient is None or isinstance(gradient, ufl.constantvalue.Zero):
            return None
        return compat.FacetExpression(gradient, self.points, self._mesh)


class Sampled:
    """The data of a problem for evaluation, each compiled when first asked for; collective."""

    def __init__(self, forms: Forms):
        """Note whose data, weakly: `of` keeps this as long as the forms are there."""
        self._forms: Forms = proxy(forms)
        self._rule = Rule(forms)

    @cached_property
    def f(self) -> Volume:
        """Volume load."""
        return Volume(self._forms.f, self._forms, self._rule)

    @cached_property
    def kappa(self) -> Volume | None:
        """Coefficient; None if it isn't a scalar."""
        kappa = self._forms.kappa
        return None if ufl.shape(kappa) else Volume(kappa, self._forms, self._rule)

    @cached_property
    def u_D(self) -> Trace:
        """Values on Γ0."""
        return Trace(self._forms.dirichlet, self._forms)

    @cached_property
    def alpha(self) -> Trace:
        """Obstacle."""
        return Trace(self._forms.obstacle, self._forms)

    @cached_property
    def g(self) -> Trace:
        """Flux on Γg."""
        return Trace(self._forms.g, self._forms)

    @classmethod
    def of(cls, forms: Forms) -> Sampled:
        """The data of these forms, one object for all who ask."""
        if forms not in _SAMPLED:
            _SAMPLED[forms] = cls(forms)
        return _SAMPLED[forms]


_SAMPLED: WeakKeyDictionary[Forms, Sampled] = WeakKeyDictionary()
