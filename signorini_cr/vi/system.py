"""The variational inequality (1.8) as PETSc has it: matrix, vector and bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from mpi4py import MPI
from petsc4py import PETSc

from ..data.moments import Sampled
from ..errors import InputError, raise_together
from ..fem.problem import Forms
from ..fem.space import closure_dofs, facet_entities, ghosted_vector, shared_maximum, shared_sum
from ..garbage import release
from ..mesh.domain import CONTACT, DIRICHLET, Domain
from ..multigrid.constrained import ConstrainedMatrix
from ..multigrid.parents import Layout
from ..multigrid.pattern import empty_matrix
from ..options import MATRICES, defaults

FloatArray = npt.NDArray[np.float64]

ROUNDING = 1e-5
"""Least scale, in parts of what it would be from zero: A u is not known to all digits of u."""


@dataclass(frozen=True, eq=False)
class Vectors:
    """The complementarity problem's vectors.

    Attributes:
        b: Right-hand side, with the Dirichlet values in their rows.
        lower: Bound of each dof, `PETSc.NINFINITY` for all but the bounded ones.
        x: For the solver the start on entry, with the Dirichlet values in place, and the solution
            on exit.
        residual: On exit A x − b.
    """

    b: PETSc.Vec
    lower: PETSc.Vec
    x: PETSc.Vec
    residual: PETSc.Vec


class System:
    """The variational inequality (1.8) as matrix, vector and bounds.

    Attributes:
        A: Matrix of a_h with the rows and columns of Γ0's dofs replaced by the identity's.
        b: Vector of χ less the Dirichlet values' share, the values themselves in their rows.
        chi: Vector of χ alone, ghosts up to date.
        lower: Bounds, α on Γ1 and `PETSc.NINFINITY` elsewhere, ghosts up to date, shape (dofs,).
        dirichlet: Local dofs on Γ0, ghosts included.
        bounded: Owned local dofs with a bound, ascending.
        u_D: Function with the Dirichlet values, 0 elsewhere.
        obstacle_at_vertices: α at the vertices of the contact facets, shape (n, d).
        residual_scale: Norm of the residual at the most trivial start, which all residuals are
            measured against: the number in the middle of the values u_D takes, raised to α on Γ1
            where that is larger, u_D on Γ0. A constant added to u_D and α makes no difference
            unless it is so large that differences drown in it.
    """

    def __init__(
        self, forms: Forms, domain: Domain, V: fem.FunctionSpace, chi: Callable[[], FloatArray]
    ):
        """Assemble it; collective.

        Args:
            forms: The compiled forms.
            domain: Mesh and boundary parts.
            V: The discrete space.
            chi: Gives χ (1.10) by facet dof for the Crouzeix-Raviart element, this rank's share.

        Raises:
            InputError: Data are not finite, or κ is not above 0.
        """
        comm = domain.mesh.comm
        forms.insist_on_mesh(domain.mesh)
        on_dirichlet, self.u_D, _ = _boundary_values(forms, domain, V, DIRICHLET)
        on_contact, lower, self.obstacle_at_vertices = _boundary_values(forms, domain, V, CONTACT)
        # Where the two parts meet in a P1 vertex the Dirichlet value holds
        bounded = on_contact & ~on_dirichlet
        self.lower = np.where(bounded, lower.x.array, PETSc.NINFINITY)
        self.dirichlet = np.flatnonzero(on_dirichlet).astype(np.int32)
        owned = V.dofmap.index_map.size_local
        self.bounded = np.flatnonzero(bounded[:owned]).astype(np.int32)
        bc = fem.dirichletbc(self.u_D, self.dirichlet)
        self._a = a = forms.a.on(domain, [V, V])
        with defaults(MATRICES, prefix=""):
            if forms.element == "CR":
                self.A = assemble_matrix(empty_matrix(Layout.of_space(V)), a, [bc])
            else:
                self.A = assemble_matrix(a, [bc])
        self.A.assemble()
        diagonal = self.A.getDiagonal()
        positive = bool((diagonal.array_r > 0.0).all())
        release(diagonal)
        complaint = "data: the coefficient must be finite and above 0 everywhere"
        raise_together(comm, None if positive else complaint)
        self.A.setOption(PETSc.Mat.Option.SPD, True)
        self.chi = fem.Function(V)
        if forms.element == "CR" and forms.loaded:
            self.chi.x.array[:] = chi()
        elif forms.chi is not None:
            fem.assemble_vector(self.chi.x.array, forms.chi.on(domain, [V]))
        self.b = fem.Function(V)
        self.b.x.array[:] = self.chi.x.array
        fem.apply_lifting(self.b.x.array, [a], [[bc]])
        for vector in (self.chi, self.b):
            shared_sum(comm, V.dofmap.index_map, vector.x.array)
        self.b.x.array[self.dirichlet] = self.u_D.x.array[self.dirichlet]
        _require_finite(comm, "f, g or coefficient", self.b.x.array)
        self.residual_scale = self._scale(bounded)

    def _scale(self, bounded: npt.NDArray[np.bool_]) -> float:
        """Measure the trivial start's residual.

        Args:
            bounded: Whether the dofs have a bound, for all local ones.
        """
        comm, values = self.u_D.function_space.mesh.comm, self.u_D.x.array[self.dirichlet]
        top = comm.allreduce(float(values.max(initial=-np.inf)), op=MPI.MAX)
        bottom = comm.allreduce(float(values.min(initial=np.inf)), op=MPI.MIN)
        middle = 0.5 * (bottom + top) if bottom <= top else 0.0
        norms = []
        for number in dict.fromkeys((middle, 0.0)):
            start, residual = (fem.Function(self.u_D.function_space) for _ in range(2))
            start.x.array[:] = number
            start.x.array[self.dirichlet] = values
            start.x.array[bounded] = np.maximum(self.lower[bounded], number)
            norms.append(self.residual(start, residual))
        scale = max(norms[0], ROUNDING * norms[-1])
        if not np.isfinite(scale):
            raise InputError("data: so large that their squares overflow; choose other units")
        return scale

    @cached_property
    def operator(self) -> ConstrainedMatrix:
        """A as the solver uses it."""
        return ConstrainedMatrix(self.A, self.bounded)

    @property
    def owned_dirichlet(self) -> npt.NDArray[np.int32]:
        """The owned ones of the dofs on Γ0."""
        return self.dirichlet[self.dirichlet < self.A.getLocalSize()[0]]

    @contextmanager
    def vectors(self, u: fem.Function, residual: fem.Function) -> Iterator[Vectors]:
        """Lend the complementarity problem's vectors for a block, on the functions' memory."""
        V = u.function_space
        arrays = self.b.x.array, self.lower, u.x.array, residual.x.array
        vectors = Vectors(*(ghosted_vector(V, array) for array in arrays))
        try:
            yield vectors
        finally:
            release(vectors.b, vectors.lower, vectors.x, vectors.residual)

    def row_sums(self) -> FloatArray:
        """Sum up the owned rows of A: 0 where no neighbour is on Γ0, whose columns A is without."""
        ones, sums = (fem.Function(self.u_D.function_space) for _ in range(2))
        ones.x.array[:] = 1.0
        bc = fem.dirichletbc(ones, self.dirichlet)
        fem.apply_lifting(sums.x.array, [self._a], [[bc]])
        shared_sum(
            sums.function_space.mesh.comm, sums.function_space.dofmap.index_map, sums.x.array
        )
        sums.x.array[self.dirichlet] = 1.0
        return sums.x.array[: self.A.getLocalSize()[0]].copy()

    def start(self) -> fem.Function:
        """The function that is u_D on Γ0 and 0 elsewhere."""
        u = fem.Function(self.u_D.function_space)
        u.x.array[:] = self.u_D.x.array
        return u

    def residual(self, u: fem.Function, r: fem.Function) -> float:
        """Compute r = A u − b, ghosts included, and its norm."""
        V = u.function_space
        x, y, b = (ghosted_vector(V, w.x.array) for w in (u, r, self.b))
        self.A.mult(x, y)
        y.axpy(-1.0, b)
        norm = y.norm()
        for vector in (x, y, b):
            vector.destroy()
        r.x.scatter_forward()
        return norm


def _boundary_values(
    forms: Forms, domain: Domain, V: fem.FunctionSpace, part: int
) -> tuple[npt.NDArray[np.bool_], fem.Function, FloatArray]:
    """Data on one boundary part as the element takes them: CR facet means, P1 values at vertices.

    Returns:
        Which dofs lie on the part, a Function with the values there, and the values at the
        facets' vertices, shape (n, d).
    """
    facets = domain.facets(part)
    sampled = Sampled.of(forms)
    if part == DIRICHLET:
        key, trace = "dirichlet", sampled.u_D
    else:
        key, trace = "obstacle", sampled.alpha
    at_vertices, _, inside = trace.at(domain.mesh, facet_entities(domain.mesh, facets))
    at_vertices, means = at_vertices.T, trace.weights @ inside
    dofs = closure_dofs(V, facets)
    # Π_h K ⊂ K_h holds with facet means for any α and u_D
    of_dofs = means[:, None] if dofs.shape[1] == 1 else at_vertices
    # before the maximum over the ranks, which a NaN may lose
    _require_finite(V.mesh.comm, key, of_dofs)
    values = fem.Function(V)
    on_part = np.zeros_like(values.x.array)
    values.x.array[:] = PETSc.NINFINITY
    values.x.array[dofs] = of_dofs
    on_part[dofs] = 1.0
    # A rank may own a dof of the part without owning any of its facets
    for array in (values.x.array, on_part):
        shared_maximum(V, array)
    values.x.array[on_part == 0.0] = 0.0
    return on_part > 0.0, values, at_vertices


def _require_finite(comm: MPI.Comm, key: str, values: FloatArray) -> None:
    raise_together(
        comm,
        None
        if (np.abs(values) < PETSc.INFINITY).all()
        else f"data: {key} is not finite, or too large, at some point of the mesh; "
        "where(condition, a, b), or ufl.conditional, can set a value apart",
    )
