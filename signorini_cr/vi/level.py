"""One mesh and the variational inequality (1.8) that is assembled on it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from ..errors import InputError
from ..fem.physics import OnMesh, Physics
from ..mesh.domain import Domain
from ..multigrid.hierarchy import NestedMesh
from ..multigrid.parents import Parents
from .floating import Floating
from .system import System


@dataclass(eq=False)
class Level:
    """One mesh with everything that is assembled on it.

    Attributes:
        meshes: The meshes up to this one, coarsest first.
        nothing_floats: True if each piece of the domain is known to be held by Γ0, or by b or c;
            refinement keeps that.
        like: A system with the same matrix, if there is one.
    """

    meshes: tuple[NestedMesh, ...]
    nothing_floats: bool = False
    like: System | None = None

    def __post_init__(self) -> None:
        """Insist on a PETSc of real numbers in double precision."""
        if PETSc.ScalarType is not np.float64:
            raise InputError(f"PETSc's numbers are {PETSc.ScalarType.__name__}; float64 is needed")
        self._snapshot = self.physics.snapshot([each.domain for each in self.meshes])

    def as_made(self) -> AbstractContextManager[None]:
        """Open a block in which data that may change are what they were when this was made."""
        return self._snapshot.again()

    @property
    def number(self) -> int:
        """Position in the sequence, from 0."""
        return len(self.meshes) - 1

    @property
    def physics(self) -> Physics:
        """The physics that is solved, shared by all levels."""
        return self.meshes[-1].physics

    @property
    def domain(self) -> Domain:
        """Mesh and boundary parts."""
        return self.meshes[-1].domain

    @property
    def V(self) -> fem.FunctionSpace:
        """The discrete space."""
        return self.meshes[-1].V

    @property
    def parents(self) -> Parents | None:
        """The cells of the mesh below that hold this one's."""
        return self.meshes[-1].parents

    @property
    def data(self) -> OnMesh:
        """The physics on this mesh."""
        return self.meshes[-1].data

    @cached_property
    def system(self) -> System:
        """The assembled variational inequality."""
        return System(self.data, self.like)

    @cached_property
    def floating(self) -> Floating | None:
        """Pieces that nothing but an obstacle can hold, None if there are none."""
        if self.nothing_floats:
            return None
        found = Floating.of(self.V, self.system.dirichlet)
        if found.count:  # what else may hold them takes a form of its own to be known
            found = Floating.of(self.V, self.system.dofs_that_hold())
        return found if found.count else None
