"""Linear problems that tell what functionals of u are worth, on the meshes of a solution."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from dolfinx import fem

from .diffusion import Diffusion
from .estimate.certificate import Certificate, certify
from .fem.problem import Problem
from .fem.space import ghosted_vector
from .garbage import release
from .mesh.domain import Domain
from .multigrid.hierarchy import NestedMesh
from .options import DUAL, ESTIMATE_PREFIX, solve_once
from .vi.level import Level


@dataclass(eq=False)
class Dual:
    """A solution, as certificates want it.

    Attributes:
        level: The mesh, with those below it.
        u: The discrete solution.
    """

    level: Level
    u: fem.Function

    @property
    def domain(self) -> Domain:
        """Mesh and boundary parts."""
        return self.level.domain

    @property
    def element(self) -> str:
        """The element's name."""
        return self.level.physics.element


@contextmanager
def solved(dual: Problem, level: Level) -> Iterator[Dual]:
    """Solve a problem without contact, for a block that makes use of the solution; collective.

    What is certain about it is so for whatever comes of the solve.

    Args:
        dual: The problem.
        level: The meshes.

    Yields:
        The solution; what its certificate takes beside it goes with the block.
    """
    coarsest = level.meshes[0].domain
    physics = Diffusion(dual, coarsest.mesh, "CR", coarsest.parts, coarsest.materials)
    meshes = (NestedMesh(physics, each.domain, each.parents) for each in level.meshes)
    level = Level(tuple(meshes))
    system = level.system
    less = system.start()
    load, found = (ghosted_vector(level.V, each) for each in (system.b, less.x.array))
    solve_once(system.A, load, found, DUAL, ESTIMATE_PREFIX)
    less.x.scatter_forward()
    release(load, found)
    try:
        yield Dual(level, system.with_offset(less))
    finally:
        level.meshes[-1].tidy()


def certified(dual: Problem, level: Level) -> Certificate:
    """Solve it and say what is certain, with a companion in P1 where that will do; collective."""
    with solved(dual, level) as z:
        return certify(z, sweeps=0)
