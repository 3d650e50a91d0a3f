"""Linear problems that tell what functionals of u are worth, on the meshes of a solution."""

from __future__ import annotations

from dolfinx import fem

from .diffusion import Diffusion
from .estimate.certificate import Certificate, certify
from .fem.problem import Problem
from .fem.space import ghosted_vector
from .garbage import release
from .multigrid.hierarchy import NestedMesh
from .options import ESTIMATE_PREFIX, MEAN, solve_once
from .solution import Solution
from .vi.contact import contact_facts
from .vi.level import Level
from .vi.solver import Iterations


def certified(dual: Problem, level: Level) -> Certificate:
    """Return what is certain about its solution, with a companion in P1 where that will do.

    It is true for whatever comes of a linear solve, in which Γ1 counts for nothing. Collective.
    """
    coarsest = level.meshes[0].domain
    physics = Diffusion(dual, coarsest.mesh, "CR", coarsest.parts, coarsest.materials)
    meshes = (NestedMesh(physics, each.domain, each.parents) for each in level.meshes)
    level = Level(tuple(meshes))
    system = level.system
    u, residual = system.start(), fem.Function(level.V)
    load, found = (ghosted_vector(level.V, each.x.array) for each in (system.b, u))
    solve_once(system.A, load, found, MEAN, ESTIMATE_PREFIX)
    u.x.scatter_forward()
    system.residual(u, residual)
    release(load, found)
    contact = contact_facts(level.data, system, u, residual, Iterations(0, 0, ""))
    u.x.array[:] += system.offset
    z = Solution(level, u, residual, contact, 0.0, Iterations(0, 0, ""))
    certificate = certify(z, sweeps=0)
    level.tidy()
    return certificate
