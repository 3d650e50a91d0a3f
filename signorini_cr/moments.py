"""The data of a problem as the certificate sees them: means and moments by quadrature.

f, g, u_D, α and κ are known by their values at quadrature points (`Problem.quadrature_degree`), and
where they are numbers exactly.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import basix
import numpy as np
import numpy.typing as npt
import ufl

from . import compat
from .cells import Cells, Side
from .problem import Forms, number
from .ranges import Range, range_of
from .space import facet_quadrature

FloatArray = npt.NDArray[np.float64]


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

    def __init__(self, expression: ufl.core.expr.Expr, forms: Forms, rule: Rule):
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
        values: κ at the quadrature points, shape (q, cells); None where it is constant on cells.
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
            if (np.ptp(values, axis=1) > 1e-14 * np.abs(self.mean)).any():
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

    def __init__(self, expression: Any, forms: Forms, degree: int, slopes: bool = True):
        """Compile the expression, and its gradient if ``slopes`` are wanted."""
        cell = forms.mesh.basix_cell()
        facet = basix.cell.subentity_types(cell)[-2][0]
        corners = basix.geometry(facet)
        self.points, self.weights = facet_quadrature(forms.mesh, degree)
        self.hats = np.column_stack([1.0 - self.points.sum(axis=1), self.points])
        self._corners, self._gdim = len(corners), forms.mesh.geometry.dim
        self._constant = number(expression)
        if self._constant is not None:
            return
        at = np.vstack([corners, corners.mean(axis=0), self.points])
        self._values = compat.FacetExpression(expression, at, forms.mesh)
        gradient = ufl.grad(expression) if slopes else None
        self._slopes = None
        if gradient is not None and not isinstance(gradient, ufl.constantvalue.Zero):
            self._slopes = compat.FacetExpression(gradient, self.points, forms.mesh)

    @property
    def vanishes(self) -> bool:
        """Whether it is the number 0."""
        return self._constant == 0.0

    def at(self, cells: Cells, side: Side) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values at the vertices, the midpoint and the quadrature points of facets.

        Returns:
            Arrays of shapes (d, n), (n,) and (q, n).
        """
        n, k = len(side.cells), self._corners
        if self._constant is not None:
            count = len(self.weights)
            return tuple(np.full(s, self._constant) for s in ((k, n), n, (count, n)))  # type: ignore
        values = self._values.at(cells.domain.mesh, side.entities)
        values = np.ascontiguousarray(values[:, :, 0].T)
        return values[:k], values[k], values[k + 1 :]

    def slopes(self, cells: Cells, side: Side) -> FloatArray:
        """Gradients at the quadrature points, shape (q, n, gdim)."""
        n = len(side.cells)
        if self._constant is not None or self._slopes is None:
            return np.zeros((1, n, self._gdim))
        return self._slopes.at(cells.domain.mesh, side.entities).transpose(1, 0, 2)


class Data:
    """The data of a problem, compiled for evaluation.

    Attributes:
        f: Volume load.
        kappa: Coefficient; None if it isn't a scalar.
        u_D: Values on Γ0.
        alpha: Obstacle.
        g: Flux on Γg.
    """

    def __init__(self, forms: Forms):
        """Compile what isn't a number."""
        degree = forms.problem.quadrature_degree
        rule = Rule(forms)
        self.f = Volume(forms.f, forms, rule)
        self.kappa = Volume(forms.kappa, forms, rule) if not ufl.shape(forms.kappa) else None
        self.u_D = Trace(forms.dirichlet, forms, degree)
        self.alpha = Trace(forms.obstacle, forms, degree)
        self.g = Trace(forms.g, forms, degree, slopes=False)

    @classmethod
    def of(cls, forms: Forms) -> Data:
        """The data of these forms, compiled once."""
        if forms not in _DATA:
            _DATA[forms] = cls(forms)
        return _DATA[forms]


_DATA: WeakKeyDictionary[Forms, Data] = WeakKeyDictionary()
