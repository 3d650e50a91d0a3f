"""The variational inequality (1.8) as PETSc has it: matrix, vector and bounds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from mpi4py import MPI
from petsc4py import PETSc
from scipy.linalg.blas import dasum

from ..arrays import FloatArray, IndexArray, Int32Array, summed
from ..errors import InputError, raise_together
from ..fem.layout import Layout
from ..fem.physics import OnMesh
from ..fem.space import facet_measures, ghosted_vector
from ..fem.walk import Walk
from ..garbage import release
from ..multigrid.constrained import ConstrainedMatrix, with_entries
from ..multigrid.pattern import empty_matrix
from ..options import MATRICES, defaults
from .boundary import Boundary, extent, require_finite
from .stopping import windows

LEAST_SCALE = 1e-5
"""Least scale, in parts of what it would be from zero: A u is not known to all digits of u."""

TINY = 1e-130
"""Loads that are smaller count as 0: their squares are multiplied with small numbers, and are lost.
A bound of the error counts them, and what it can't count, see `estimate.certificate.UNDERFLOW`."""

NOTHING = 1e-100
"""Largest change of u by such a load: one that does more does so as κ is as small."""

BESIDE = 1e-16
"""The same in parts of the bounds, beside which it would be lost in rounding."""

DRIFT = 100.0
"""So many times as far from 0 as loads may bend u is where c and b alone hold it, if they are weak.
"""

DATUM = 2.0 * 2.0**-53
"""Rounding of a mean of data over a facet, or of a load, in parts of it."""


@dataclass(frozen=True, eq=False)
class Vectors:
    """The complementarity problem's vectors.

    Attributes:
        b: Right-hand side, with the Dirichlet values in their rows.
        lower: Lower bound of each dof, `PETSc.NINFINITY` where there is none.
        upper: Upper bound of each dof, `PETSc.INFINITY` where there is none.
        x: For the solver the start on entry, with the Dirichlet values in place, and the solution
            on exit.
        residual: On exit A x − b.
    """

    b: PETSc.Vec
    lower: PETSc.Vec
    upper: PETSc.Vec
    x: PETSc.Vec
    residual: PETSc.Vec


@dataclass(frozen=True, eq=False)
class ContactFacets:
    """Places of the owned facets of Γ1, whatever holds there.

    Attributes:
        vertices: Their vertices' coordinates, shape (n, d, 3).
        measure: Their length, shape (n,).
        share: What part of Γ1 is a dof's with a bound, by its measure, shape (dofs,).
        walk: Their order.
    """

    vertices: FloatArray
    measure: FloatArray
    share: FloatArray
    walk: Walk

    @classmethod
    def of(cls, system: System) -> ContactFacets:
        """Look at a system's mesh; collective."""
        V, dofs = system.u_D.function_space, system.contact_dofs
        vertices, measure = system.measured
        share: FloatArray = np.zeros(len(system.u_D.x.array))
        np.add.at(share, dofs, (measure / dofs.shape[1])[:, None])
        share = Layout.of_space(V).shared_sum(share)[system.bounded]
        walk = Walk.of(V.mesh, system.bounded_facets, vertices, measure)
        return cls(vertices, measure, share, walk)


class System:
    """The variational inequality (1.8) as matrix, vector and bounds.

    Where all values of u_D, or of α where there is no Γ0, lie far from 0 and close together, the
    unknown is u less their middle, the offset, and b, bounds and u_D are those of this unknown: a_h
    sees differences, which would have lost the digits that u spends on the offset. So it is where
    nothing but weak c and b hold u: the offset is the constant that the loads are in balance with.

    Attributes:
        offset: What is to be added to the solution to have u; 0 in most cases.
        drifts: Whether that is the constant that c and b hold against the loads.
        words: The physics' words, for messages.
        operator: A as the solver uses it.
        A: Matrix of a_h with the rows and columns of Γ0's dofs replaced by the identity's.
        b: χ less the Dirichlet values' share by dof, the values themselves in their rows, ghosts up
            to date, shape (dofs,).
        chi: χ alone, likewise.
        lower: α on Γ1, `PETSc.NINFINITY` where there is none, ghosts up to date, shape (dofs,).
        upper: β on Γ1, `PETSc.INFINITY` where there is none, likewise.
        dirichlet: Local dofs on Γ0, ghosts included.
        bounded: Owned local dofs with a bound, ascending, shape (n,).
        bounds: These bounds.
        u_D: Function with the Dirichlet values, 0 elsewhere.
        bounded_facets: Owned facets of Γ1, ascending, shape (n,).
        contact_dofs: The dofs with a bound that each of them has, shape (n, 1) or (n, d).
        obstacles_at_vertices: α and β at the vertices of the contact facets, shape (2, n, d).
        residual_scale: Norm of the residual at the most trivial start, which all residuals are
            measured against: the number in the middle of the values u_D takes, raised to α on Γ1
            where that is larger, u_D on Γ0. A constant added to u_D and α makes no difference
            unless it is so large that differences drown in it.
    """

    def __init__(self, data: OnMesh, like: System | None = None):
        """Assemble it; collective.

        Args:
            data: The physics on the mesh.
            like: A system on the same mesh and parts whose matrix is the same, and is taken.

        Raises:
            InputError: Data are not finite, or κ is not above 0.
        """
        self._data, self._like, self.words, V = data, like, data.words, data.V
        comm, layout = V.mesh.comm, Layout.of_space(V)
        read = None if like is None else like._boundary_for(data)
        if read is None:
            read = Boundary.of(data)
        self._read: Boundary = read
        self.u_D: fem.Function = read.u_D
        self.dirichlet: Int32Array = read.dirichlet
        self.bounded: Int32Array = read.bounded
        self.bounded_facets: Int32Array = read.facets
        self.contact_dofs: Int32Array = read.dofs
        self.obstacles_at_vertices: FloatArray = read.obstacles
        if like is None:
            self.A = _assembled(data.a, self._bc(self.u_D), layout)
            self.operator = ConstrainedMatrix(self.A, self.bounded)
            positive = bool((self.operator.whole_diagonal > 0.0).all())
            raise_together(comm, None if positive else f"data: {self.words.positive}")
        else:
            self.A, self.operator = like.A, like.operator
        self.chi = layout.shared_sum(data.chi().copy())
        self.offset, self.drifts = self._choose_offset(read)
        boundary = read if self.offset == read.offset else read.with_offset(self.offset)
        self.lower, self.upper, self.bounds = boundary.lower, boundary.upper, boundary.bounds
        # What A does to the same values is known
        known = like is not None and like._read is read and like.offset == self.offset
        same = like if known else None
        self.b = self.chi + (self._lifting() if same is None else same._known_lifting)
        self.b[self.dirichlet] = self.u_D.x.array[self.dirichlet]
        require_finite(comm, self.words.load, self.b)
        trivial = self._trivial() if same is None else same._known_trivial
        self.residual_scale = self._scale(trivial)
        if self.is_trivial:  # as far as numbers go
            self.b[: len(trivial[0])], self.b[len(trivial[0]) :] = trivial[0], 0.0
            layout.shared_sum(self.b)

    def _boundary_for(self, data: OnMesh) -> Boundary | None:
        """Return the values and bounds that this was made of if other data have the same."""
        same = data.fixed is self._data.fixed and data.bounds is self._data.bounds
        return self._read if same else None

    def with_offset(self, less: fem.Function) -> fem.Function:
        """Return u_h.

        Args:
            less: u_h less the offset, ghosts up to date; the same function where that is 0.
        """
        if not self.offset:
            return less
        u = fem.Function(less.function_space)
        u.x.array[:] = less.x.array + self.offset
        return u

    def _choose_offset(self, read: Boundary) -> tuple[float, bool]:
        """Choose the constant u with a_h(u, 1) = χ(1) for the offset if u is near it; collective.

        With c ≪ κ, u is f/c but for a part of f/κ. Rounding of A u would hide the loads. It would,
        too, beside c α or b α for an α that is far away, which is no offset then.

        Args:
            read: The boundary with the offset that it has by itself.

        Returns:
            `offset` and `drifts`.
        """
        comm, as_it_is = self._data.V.mesh.comm, (read.offset, False)
        held = comm.allreduce(len(read.dirichlet) > 0, op=MPI.LOR)
        if held or (of_constants := self._of_constants()) is None:
            return as_it_is
        owned = self.A.getLocalSize()[0]
        of_one, chi = of_constants[:owned], self.chi[:owned]
        lost, net, loads = summed(comm, np.array([of_one.sum(), chi.sum(), np.abs(chi).sum()]))
        diagonal = self.operator.whole_diagonal
        softest = comm.allreduce(float(diagonal.min(initial=np.inf)), op=MPI.MIN)
        with np.errstate(all="ignore"):
            constant, bend = net / lost, loads / softest
        drifts = bool(DRIFT * bend < abs(constant) < np.inf)
        if not drifts and not abs(constant) < abs(constant - read.offset):
            return as_it_is
        lowest, highest = read.lower + read.offset, read.upper + read.offset
        inside = bool((lowest <= constant).all() and (constant <= highest).all())
        if not comm.allreduce(inside, op=MPI.LAND):
            return as_it_is  # a bound holds u
        return (float(constant), True) if drifts else (0.0, False)

    def _lifting(self) -> FloatArray:
        """Sum what u_D and the offset add to b, ghosts up to date, shape (dofs,); collective."""
        found: FloatArray = np.zeros(len(self.u_D.x.array))
        if self.offset and (of_constants := self._data.of_constants()) is not None:
            found -= self.offset * of_constants
        fem.apply_lifting(found, [self._data.a], [[self._bc(self.u_D)]])
        return Layout.of_space(self._data.V).shared_sum(found)

    @cached_property
    def _known_lifting(self) -> FloatArray:
        """The same for those who have the same values, and ask again and again."""
        return self._lifting()

    @cached_property
    def contact_facets(self) -> ContactFacets:
        """The facets of Γ1; found when first asked for, collectively."""
        return ContactFacets.of(self) if self._like is None else self._like.contact_facets

    @cached_property
    def measured(self) -> tuple[FloatArray, FloatArray]:
        """Vertices' coordinates and measures of the facets of Γ1, as `facet_measures` has them."""
        return facet_measures(self.u_D.function_space.mesh, self.bounded_facets)

    def facets_by_dof(self) -> IndexArray:
        """Find the place in `bounded_facets` of each dof's own facet, shape (n,); CR only."""
        return np.argsort(self.contact_dofs[:, 0])

    @cached_property
    def windows(self) -> IndexArray:
        """The places of the bounded dofs on Γ1, from `stopping.windows`; collective at first."""
        if self._like is not None:
            return self._like.windows
        V, (vertices, _) = self.u_D.function_space, self.measured
        midpoints = vertices.mean(axis=1)
        if Layout.of_space(V).cr:  # a dof and its facet have the same owner
            return windows(V.mesh.comm, midpoints[self.facets_by_dof()])
        places: FloatArray = np.full((len(self.bounded), 3), -np.inf)
        for axis in range(3):
            of_dofs: FloatArray = np.full(len(self.u_D.x.array), -np.inf)
            np.maximum.at(of_dofs, self.contact_dofs, midpoints[:, axis, None])
            Layout.of_space(V).shared_maximum(of_dofs)
            places[:, axis] = of_dofs[self.bounded]
        return windows(V.mesh.comm, places)

    @cached_property
    def _known_trivial(self) -> list[FloatArray]:
        """As `_trivial` has it, for those who have the same values, and ask again and again."""
        return self._trivial()

    def _trivial(self) -> list[FloatArray]:
        """Multiply A by the most trivial start, and by that without its constant; collective."""
        comm, products = self._data.V.mesh.comm, []
        start, product = self.A.createVecRight(), self.A.createVecLeft()
        dirichlet = self.owned_dirichlet
        for number in dict.fromkeys((self._middle(), -self.offset)):
            on_bounds = np.clip(number, self.bounds.lower, self.bounds.upper)
            start.array[:] = number
            start.array[self.bounded] = on_bounds
            start.array[dirichlet] = self.u_D.x.array[dirichlet]
            if number == 0.0 and not comm.allreduce(bool(on_bounds.any()), op=MPI.LOR):
                products.append(start.array_r.copy())  # 0 but for Γ0, whose rows are the identity's
                continue
            self.A.mult(start, product)
            products.append(product.array_r.copy())
        release(start, product)
        return products

    def _middle(self) -> float:
        """Compute the number that u_D is around; collective."""
        values = self.u_D.x.array[self.dirichlet]
        bottom, top = extent(self.u_D.function_space.mesh.comm, values)
        return 0.5 * (bottom + top) if bottom <= top else 0.0

    def _scale(self, trivial: Sequence[FloatArray]) -> float:
        """Measure the trivial start's residual; collective.

        Args:
            trivial: As `_trivial` has it.
        """
        comm, b = self._data.V.mesh.comm, self.b[: self.A.getLocalSize()[0]]
        residuals = [each - b for each in trivial]
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.array([each @ each for each in residuals])
        norms = np.sqrt(summed(comm, squares))
        scale = norms[0] if self.offset else max(norms[0], LEAST_SCALE * norms[-1])
        if self.drifts:  # loads are what is left where u is 0
            scale = norms[-1]
        if not np.isfinite(norms).all():
            raise InputError("data: so large that their squares overflow; choose other units")
        largest = max(
            float(max(each.max(initial=0.0), -each.min(initial=0.0))) for each in residuals
        )
        if max(comm.allgather(largest)) >= TINY:
            return scale
        self._insist_on_nothing(residuals)
        return 0.0

    def _insist_on_nothing(self, residuals: Sequence[FloatArray]) -> None:
        """Insist on loads that make no difference, as they are to count as 0; collective.

        Raises:
            InputError: They would move u, or hold it on the obstacle.
        """
        given = np.abs(np.concatenate([self.lower, self.upper]))
        given = given[given < PETSc.INFINITY]
        with np.errstate(over="ignore"):
            moves = [np.abs(each) / self.operator.whole_diagonal for each in residuals]
        found = [max(float(each.max(initial=0.0)) for each in moves), given.max(initial=0.0)]
        moved, size = np.max(self._data.V.mesh.comm.allgather(found), axis=0)
        drowned = size < NOTHING**2 or moved <= BESIDE * size
        if moved > NOTHING or not drowned:
            raise InputError("data: so small that their squares are lost; choose other units")

    @property
    def owned_dirichlet(self) -> Int32Array:
        """The owned ones of the dofs on Γ0."""
        return self.dirichlet[self.dirichlet < self.A.getLocalSize()[0]]

    @contextmanager
    def vectors(self, u: fem.Function, residual: fem.Function) -> Iterator[Vectors]:
        """Lend the complementarity problem's vectors for a block, on the functions' memory."""
        V = u.function_space
        arrays = self.b, self.lower, self.upper, u.x.array, residual.x.array
        vectors = Vectors(*(ghosted_vector(V, array) for array in arrays))
        try:
            yield vectors
        finally:
            release(*(getattr(vectors, each.name) for each in fields(vectors)))

    def dofs_that_hold(self) -> Int32Array:
        """Find local dofs on Γ0, or on which a_h(1, ·) does not vanish; collective."""
        of_constants = self._of_constants()
        if of_constants is None:
            return self.dirichlet
        of_constants[self.dirichlet] = 1.0
        return np.flatnonzero(of_constants > 0.0).astype(np.int32)

    def _of_constants(self) -> FloatArray | None:
        """Compute a_h(1, ·), ghosts up to date, shape (dofs,), if it is not 0; collective."""
        found = self._data.of_constants()
        return None if found is None else Layout.of_space(self._data.V).shared_sum(found.copy())

    def _bc(self, values: fem.Function) -> fem.DirichletBC:
        """Impose values on Γ0, where all unknowns of a node are set."""
        block = values.function_space.dofmap.index_map_bs
        return fem.dirichletbc(values, np.unique(self.dirichlet // block))

    def row_sums(self) -> FloatArray:
        """Sum up the owned rows of A: a_h(1, ·) but where a neighbour is on Γ0."""
        ones, sums = (fem.Function(self.u_D.function_space) for _ in range(2))
        ones.x.array[:] = 1.0
        fem.apply_lifting(sums.x.array, [self._data.a], [[self._bc(ones)]])
        if (of_constants := self._data.of_constants()) is not None:
            sums.x.array[:] += of_constants
        Layout.of_space(sums.function_space).shared_sum(sums.x.array)
        sums.x.array[self.dirichlet] = 1.0
        return sums.x.array[: self.A.getLocalSize()[0]].copy()

    def masses(self) -> FloatArray | None:
        """Compute what c and b have in a row of A and in its neighbours', shape (dofs,).

        An entry of A that is next to nothing may be what rounding has left of these.

        Returns:
            Sums of a_h(1, ·) of owned dofs; None where there are no c and no b.
        """
        if (of_constants := self._of_constants()) is None:
            return None
        pattern = with_entries(self.A, np.ones_like)
        here, around = pattern.createVecs()
        here.array[:] = np.abs(of_constants[: len(here.array_r)])
        here.array[self.owned_dirichlet] = 0.0
        pattern.mult(here, around)
        found: FloatArray = around.array_r.copy()
        release(pattern, here, around)
        return found

    def data_rounded(self) -> float:
        """Bound what rounding of u_D and of the loads may change in b, summed up; collective."""
        owned, fixed = self.A.getLocalSize()[0], self.owned_dirichlet
        forces = self.b[:owned].copy()
        forces[fixed] = 0.0  # b has u_D there
        # b − χ is u_D's share
        size = _sum_of_sizes(forces) + 2.0 * _sum_of_sizes(self.chi[:owned])
        if self.offset:
            sums = self.row_sums()
            sums[fixed] = 0.0
            size += abs(self.offset) * _sum_of_sizes(sums)
        return DATUM * float(self.u_D.function_space.mesh.comm.allreduce(float(size)))

    def data_rounding(self, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw what rounding may have done to the data; collective.

        Args:
            seed: For the same numbers again.

        Returns:
            Changes of b in owned dofs, 0 on Γ0, and of the nearer of the bounds of each bounded
            dof, infinite ones aside, shape (n,).
        """
        V = self.u_D.function_space
        layout, rng = Layout.of_space(V), np.random.default_rng((seed, V.mesh.comm.rank))

        def drawn(size: FloatArray) -> FloatArray:
            return DATUM * size * rng.choice([-1.0, 1.0], len(size))

        values, change = fem.Function(V), fem.Function(V)
        values.x.array[self.dirichlet] = drawn(np.abs(self.u_D.x.array[self.dirichlet]))
        values.x.array[self.dirichlet] += drawn(np.full(len(self.dirichlet), abs(self.offset)))
        values.x.scatter_forward()
        fem.apply_lifting(change.x.array, [self._data.a], [[self._bc(values)]])
        layout.shared_sum(change.x.array)
        owned = self.A.getLocalSize()[0]
        of_load = change.x.array[:owned] + drawn(np.abs(self.chi[:owned]))
        of_load[self.owned_dirichlet] = 0.0
        least = np.minimum(np.abs(self.bounds.lower), np.abs(self.bounds.upper))
        return of_load, drawn(least + abs(self.offset))

    def start(self) -> fem.Function:
        """Make the function that is u_D on Γ0 and 0 elsewhere, but for the offset; collective.

        Where the most trivial one is the solution, as there is no load at all, it is that.
        """
        u = fem.Function(self.u_D.function_space)
        u.x.array[:] = self.u_D.x.array
        if self.is_trivial:
            u.x.array[:] = self._middle()
            u.x.array[self.dirichlet] = self.u_D.x.array[self.dirichlet]
        return u

    @property
    def is_trivial(self) -> bool:
        """True if the most trivial function, on its bounds, leaves nothing of the equations."""
        return self.residual_scale == 0.0

    def residual(self, u: fem.Function, r: fem.Function) -> float:
        """Compute r = A u − b, ghosts included, and its norm."""
        V = u.function_space
        x, y, b = (ghosted_vector(V, each) for each in (u.x.array, r.x.array, self.b))
        self.A.mult(x, y)
        y.axpy(-1.0, b)
        norm = y.norm()
        for vector in (x, y, b):
            vector.destroy()
        r.x.scatter_forward()
        return norm


def _sum_of_sizes(values: FloatArray) -> float:
    """Sum up absolute values; BLAS makes no array of them, but refuses an empty one."""
    return float(dasum(values)) if len(values) else 0.0


def _assembled(a: fem.Form, bc: fem.DirichletBC, layout: Layout) -> PETSc.Mat:
    """Assemble the matrix of a_h, with the identity's rows and columns on Γ0; collective."""
    with defaults(MATRICES, prefix=""):
        A = (
            assemble_matrix(empty_matrix(layout), a, [bc])
            if layout.cr
            else assemble_matrix(a, [bc])
        )
    A.assemble()
    A.setOption(PETSc.Mat.Option.SPD, True)
    return A
