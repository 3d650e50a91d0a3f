"""The problem on one mesh: its data, each sampled once while they are kept, for all who ask."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

from .. import compat
from ..arrays import FloatArray, IndexArray, Int32Array
from ..errors import InputError
from ..fem.cells import Cells, measures, vertex_rows
from ..fem.conditions import Condition, as_number, is_by_cells
from ..fem.physics import Imposed, OnMesh, Words
from ..fem.problem import Kernel
from ..fem.space import facet_corners, function_space, vertex_values
from ..mesh.domain import Domain, facet_entities
from .admissible import check_symmetry
from .loads import NeumannMoments, VolumeMoments, bounds_on_facets, chi
from .quadrature import Compiled, OnFacets, Tensor, Trace, Volume
from .ranges import range_of

FINE = (12, 16)
"""Degrees of rules that tell a net force from none."""

ONE = np.array(1.0)
"""A rate that changes nothing."""


@dataclass(frozen=True, eq=False)
class Moments:
    """A mesh as arrays and the loads integrated on it: large, and each made when first asked for.

    They live as long as a mesh is worked on. χ asks for them first and the certificate last; then
    the mesh is tidied, by a solution after its certificate and by the hierarchy before the next
    mesh, and there is a new, empty object in this one's place.

    Attributes:
        compiled: The data, whatever the mesh.
        domain: Mesh and boundary parts.
        V: The discrete space.
        source: A function of CR by dof that f has beside what the problem says, ghosts included;
            None for nothing.
        rate: What it is multiplied by on owned cells, shape (cells,) or ().
        earlier: The same problem with other source and rate, which keeps what cannot have changed
            since; None if there is no such.
    """

    compiled: Compiled
    domain: Domain
    V: fem.FunctionSpace
    source: FloatArray | None
    rate: FloatArray
    earlier: DiffusionOnMesh | None

    @cached_property
    def cells(self) -> Cells:
        """The mesh as arrays, for the Crouzeix-Raviart element."""
        if self.earlier is not None:
            return self.earlier.cells
        kappa = self.compiled.kappa
        stretch = kappa.stretch(self.domain) if isinstance(kappa, Tensor) else None
        cells = Cells(self.domain, self.V, self.compiled.forms.gamma_0, stretch=stretch)
        cells.drain(self._sinks(cells))
        return cells

    @cached_property
    def of_f(self) -> VolumeMoments:
        """Moments of f."""
        if self.earlier is not None and not self.compiled.may_change(self.compiled.forms.f):
            return self.earlier.of_f
        return VolumeMoments.of(self.compiled.f, self.cells)

    @cached_property
    def load(self) -> VolumeMoments:
        """Moments of f and what it has beside."""
        return self.with_source(self.of_f)

    @cached_property
    def reaction(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of a reaction c that varies within cells, shape (cells,); infinite for none."""
        n, found = self.cells.number, range_of(self.compiled.forms.reaction, self.cells)
        return (np.full(n, -np.inf), np.full(n, np.inf)) if found is None else found

    def with_source(self, load: VolumeMoments) -> VolumeMoments:
        """Return moments of f, as given, and what it has beside."""
        if self.source is None:
            return load
        return load.less(-self.rate, vertex_rows(self.source, self.cells))

    @cached_property
    def edges(self) -> tuple[NeumannMoments, ...]:
        """Moments of the fluxes that are known, one for each condition."""
        natural = self.compiled.forms.natural
        changing = self.compiled.may_change
        if self.earlier is not None and not any(changing(each.flux) for each in natural):
            return self.earlier.edges
        sampled = (
            OnFacets.of(each, self.compiled.trace(each.flux), self.domain) for each in natural
        )
        return tuple(
            NeumannMoments(on_facets, self.cells, *self._loss(on_facets.condition, self.cells))
            for on_facets in sampled
        )

    def _sinks(self, cells: Cells) -> dict[int, FloatArray]:
        """Find the parts whose b is above 0, and a lower bound on their facets; collective."""
        conditions = self.compiled.forms.conditions
        found = {c.number: self._loss(c, cells)[0] for c in conditions if c.loss is not None}
        return {
            part: loss
            for part, loss in found.items()
            if self.domain.mesh.comm.allreduce(bool((loss > 0.0).all()), op=MPI.LAND)
        }

    def _loss(self, condition: Condition, cells: Cells) -> tuple[FloatArray, FloatArray]:
        """Bound b on facets of owned cells, in the order of `Cells.sides`, shape (n,) or ().

        Both are one object where b is constant on each facet, and infinite where nothing is known.
        """
        datum = ufl.as_ufl(condition.loss or 0.0)
        if not is_by_cells(datum):
            return bounds_on_facets(datum, cells, cells.sides[condition.number])
        b = _by_cells(self.compiled, self.domain, datum)
        if b.ndim:
            facets = self.domain.all_facets[condition.number]
            at = facet_entities(self.domain.mesh, facets)[:, 0]
            b = b[at[at < len(b)]]
        return b, b


def _by_cells(compiled: Compiled, domain: Domain, datum: Expr) -> FloatArray:
    """Evaluate what is constant on owned cells, shape (cells,), or () for a number."""
    known = as_number(datum)
    if known is not None:
        return np.array(known)
    expression, mesh = compiled.by_cells(datum), domain.mesh
    which = np.arange(mesh.topology.index_map(mesh.topology.dim).size_local, dtype=np.int32)
    values = compat.bound(expression, domain.own).eval(mesh, which)
    return np.asarray(values, dtype=np.float64).reshape(len(which))


class DiffusionOnMesh:
    """A problem's data on one mesh, each sampled when first asked for, and kept.

    Attributes:
        compiled: The data, whatever the mesh.
        forms: Their forms.
        domain: Mesh and boundary parts.
        V: The discrete space.
        moments: What is large, and kept for a while only.
    """

    words = Words(
        load="f, g or coefficient",
        positive="the coefficient must be finite and above 0 everywhere, reactions and coefficients"
        " of parts finite",
        held="no Dirichlet facet, no loss of heat, no reaction",
    )

    def __init__(
        self,
        compiled: Compiled,
        domain: Domain,
        source: FloatArray | None = None,
        rate: FloatArray = ONE,
        earlier: DiffusionOnMesh | None = None,
    ):
        """Make the space, where there is none yet; collective.

        Args:
            compiled: The data, whatever the mesh.
            domain: Mesh and boundary parts.
            source: As `Moments` has it.
            rate: As `Moments` has it.
            earlier: As `Moments` has it.

        Raises:
            InputError: Data are not to be had there, or κ is not symmetric at a quadrature point.
        """
        self.compiled, self.forms, self.domain = compiled, compiled.forms, domain
        self.V: fem.FunctionSpace
        if earlier is None:
            self.forms.carry_data(domain)
            if self.forms.problem.form is None and isinstance(compiled.kappa, Tensor):
                check_symmetry(compiled.kappa, domain)
            self.V = function_space(domain.mesh, self.forms.element)
        else:
            self.V = earlier.V
        self._earlier = earlier
        self._ends: tuple[Int32Array, Int32Array, IndexArray] | None = None
        self.moments = Moments(compiled, domain, self.V, source, rate, earlier)

    def renewed(self, source: FloatArray | None, rate: FloatArray) -> DiffusionOnMesh:
        """Return the same with data as they are now; a_h must be what it was.

        Data that hold neither Constants nor Functions are what they were, and not sampled anew.

        Args:
            source: A function of CR by dof that f has beside what the problem says, ghosts
                included; None for nothing.
            rate: What it is multiplied by on owned cells, shape (cells,) or ().
        """
        return DiffusionOnMesh(self.compiled, self.domain, source, rate, self._earlier or self)

    def tidy(self) -> None:
        """Make room: what is large is sampled again, should anybody ask for it later."""
        self.moments = replace(self.moments)

    @property
    def cells(self) -> Cells:
        """The mesh as arrays, for the Crouzeix-Raviart element."""
        return self.moments.cells

    @property
    def of_f(self) -> VolumeMoments:
        """Moments of f."""
        return self.moments.of_f

    @property
    def load(self) -> VolumeMoments:
        """Moments of f and what it has beside."""
        return self.moments.load

    @property
    def edges(self) -> tuple[NeumannMoments, ...]:
        """Moments of the fluxes that are known, one for each condition."""
        return self.moments.edges

    @property
    def reaction(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of the reaction c on owned cells, shape (cells,), or () where it is a number."""
        if not is_by_cells(self.forms.reaction):
            return self.moments.reaction
        c = _by_cells(self.compiled, self.domain, self.forms.reaction)
        return c, c

    def reacting(self, w: FloatArray) -> tuple[Volume, Volume]:
        """Return f − c u_h and c u_h², from u_h at the cells' vertices, shape (d + 1, cells).

        They hold until the next call of this or of `losing`: all are formulas in one function,
        which then becomes another.
        """
        self._put(w)
        return self.compiled.with_reaction

    def losing(
        self, w: FloatArray
    ) -> tuple[tuple[NeumannMoments, ...], tuple[NeumannMoments, ...]]:
        """Return `edges`, with g − b u_h for g where b varies within facets, and b u_h² there.

        As of `reacting`, they hold until the next call of either.

        Args:
            w: u_h at the cells' vertices, shape (d + 1, cells).
        """
        found, squares = list(self.edges), []
        for i, edge in enumerate(self.edges):
            if edge.varies:
                self._put(w)
                condition = self.forms.natural[i]
                g, b_u2 = (
                    OnFacets.of(condition, trace, self.domain)
                    for trace in self.compiled.with_loss(condition)
                )
                found[i] = NeumannMoments(g, self.cells, edge.loss, edge.most)
                squares.append(NeumannMoments(b_u2, self.cells, np.array(0.0)))
        return tuple(found), tuple(squares)

    def _put(self, w: FloatArray) -> None:
        """Let the stand-in be u_h."""
        u = self.domain.instead(self.compiled.stand_in)
        u.x.array[u.function_space.dofmap.list[: w.shape[1]]] = w.T

    @cached_property
    def u_D(self) -> tuple[OnFacets, ...]:
        """The values of u on Γ0, one for each condition."""
        data = [(condition, 1, condition.fixed) for condition in self.forms.fixed]
        return self._sampled(data, lambda earlier: earlier.u_D)

    @cached_property
    def alpha(self) -> tuple[OnFacets, ...]:
        """The bounds that s u must not be below on Γ1, one for each condition's each bound."""
        data = [(each, sign, datum) for each in self.forms.bounded for sign, datum in each.bounds]
        return self._sampled(data, lambda earlier: earlier.alpha)

    def _sampled(
        self,
        data: Sequence[tuple[Condition, int, object]],
        before: Callable[[DiffusionOnMesh], tuple[OnFacets, ...]],
    ) -> tuple[OnFacets, ...]:
        """Sample data on facets, with their signs, unless they are what they were."""
        changing = self.compiled.may_change
        if self._earlier is not None and not any(changing(datum) for *_, datum in data):
            return before(self._earlier)
        return tuple(
            OnFacets.of(condition, self.compiled.trace(datum), self.domain, sign)
            for condition, sign, datum in data
        )

    # what the system asks for

    @cached_property
    def a(self) -> fem.Form:
        """a_h."""
        if self._earlier is not None:
            return self._earlier.a
        return self.forms.a.on(self.domain, [self.V, self.V])

    @cached_property
    def fixed(self) -> tuple[Imposed, ...]:
        """u_D on Γ0; the same object as before where that is what it was."""
        if self._earlier is not None and self.u_D is self._earlier.u_D:
            return self._earlier.fixed
        return tuple(on_facets.imposed for on_facets in self.u_D)

    @cached_property
    def bounds(self) -> tuple[Imposed, ...]:
        """α and −β on Γ1; the same object as before where that is what it was."""
        if self._earlier is not None and self.alpha is self._earlier.alpha:
            return self._earlier.bounds
        return tuple(on_facets.imposed for on_facets in self.alpha)

    def chi(self) -> FloatArray:
        """Compute χ (1.10) by dof, this rank's cells' share."""
        moments = self.moments
        if self.forms.element == "CR" and (self.forms.loaded or moments.source is not None):
            found = chi(self.of_f, self.edges, self.cells)
            if moments.source is not None:
                found += moments.source * self.cells.masses(moments.rate)
        else:
            found = self._assembled(self.forms.chi)
        if self.forms.own_load is not None:
            found += self._assembled(self.forms.own_load)
        return found

    def inflow(self) -> FloatArray | None:
        """Compute ∫ f + ∫ g over each owned cell by two fine rules; None if the load has more."""
        if self.forms.own_load is not None or self.moments.source is not None:
            return None
        cells = self.cells
        found = np.empty((len(FINE), cells.number))
        for row, degree in zip(found, FINE, strict=True):
            f = self.compiled.f.exact_for(degree)
            row[:] = VolumeMoments.of(f, cells).mean * cells.volume
            for condition in self.forms.natural:
                trace = Trace(condition.flux, self.forms.mesh, degree)
                g = OnFacets.of(condition, trace, self.domain).seen_from(cells)
                side = g.side(cells)
                np.add.at(row, side.cells, measures(cells, side) * g.means)
        return found

    def of_constants(self) -> FloatArray | None:
        """Compute a_h(1, ·) by dof, this rank's cells' share; None where it vanishes."""
        return None if self.forms.of_one is None else self._assembled(self.forms.of_one)

    def conforming(self, cells: Int32Array, index_map: Any) -> tuple[fem.Form, float]:
        """Return a form whose matrix, times a number, is the P1 operator on this mesh.

        The function of CR that belongs to the facet opposite vertex i has −d times the gradient of
        the hat function at i. So where nothing but gradients counts the kernel of a_h in CR, at
        work on the dofs of P1, makes d² times the matrix of P1: no form is compiled.
        """
        mesh, forms = self.domain.mesh, self.forms
        if forms.of_one is None:
            W = compat.with_dofs(self.V, cells, index_map)
            return forms.a.on(self.domain, [W, W]), 1.0 / mesh.topology.dim**2
        W = compat.with_dofs(function_space(mesh, "P1"), cells, index_map)
        return forms.a_p1.on(self.domain, [W, W]), 1.0

    def at_vertices(self, u: fem.Function, facets: Int32Array) -> FloatArray:
        """Evaluate u_h at the vertices of boundary facets, seen from their cells, shape (n, d)."""
        if self._earlier is not None:
            return self._earlier.at_vertices(u, facets)
        if self._ends is None or self._ends[0] is not facets:
            cells, local = facet_entities(self.domain.mesh, facets).T
            self._ends = facets, cells, facet_corners(self.domain.mesh)[local]
        _, cells, corners = self._ends
        return np.take_along_axis(vertex_values(u, cells), corners, axis=1)

    def squared_energy_norm(self, u: fem.Function) -> float:
        """Compute a_h(u, u), this rank's cells' share."""
        if self._earlier is None:
            form = self.forms.a_of_w.on(self.domain, (), [u])
        else:
            w, form = self._earlier._a_of_w
            w.x.array[:] = u.x.array
        return float(fem.assemble_scalar(form))

    @cached_property
    def _a_of_w(self) -> tuple[fem.Function, fem.Form]:
        """A function w and a_h(w, w), for those who ask again and again."""
        w = fem.Function(self.V)
        return w, self.forms.a_of_w.on(self.domain, (), [w])

    def _assembled(self, kernel: Kernel | None) -> FloatArray:
        nodes, block = self.V.dofmap.index_map, self.V.dofmap.index_map_bs
        values: FloatArray = np.zeros(block * (nodes.size_local + nodes.num_ghosts))
        if kernel is not None:
            fem.assemble_vector(values, kernel.on(self.domain, [self.V]))
        return values


def diffusion(data: OnMesh) -> DiffusionOnMesh:
    """Narrow to the physics that the certificate is proved for.

    Raises:
        InputError: It is another one.
    """
    if not isinstance(data, DiffusionOnMesh):
        raise InputError(
            "certificates, forces, fluxes and means in intervals are those of diffusion"
        )
    return data
