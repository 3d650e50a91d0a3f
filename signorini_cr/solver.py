"""The discrete variational inequality (1.8), solved by PETSc's SNES `vinewtonrsls`.

Find u ∈ K_h with a_h(u, v − u) ≥ χ(v − u) for all v ∈ K_h. With A and b the matrix and the vector of
a_h and χ this is the complementarity problem

    (Au − b)_i ≥ 0,  u_i ≥ α_i,  (Au − b)_i (u_i − α_i) = 0   for the dofs i on Γ1,

and (Au − b)_i = 0 for all others. The reduced-space method drops the dofs that sit on their bound
with (Au − b)_i > 0, solves for the rest, and repeats: with full steps it is the primal-dual active
set method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from petsc4py import PETSc

from .errors import NotConverged

PREFIX = "signorini_"
"""Prefix of the PETSc options that reach the solver, as in ``-signorini_ksp_rtol 1e-10``."""

# What can be set through options only. Full steps are the primal-dual active set method: the default
# line search tests a norm that may rightly rise. A contact dof counts as active within the zero
# tolerance of its bound; PETSc's default is absolute and would freeze data of small magnitude.
DEFAULTS = {"snes_linesearch_type": "basic", "snes_vi_zero_tolerance": 1e-30}

Monitor = Callable[[int, float, int, int], None]
"""Called on all ranks after each step: step, residual norm, active dofs, linear iterations."""


@dataclass(frozen=True)
class Iterations:
    """What the solver did: Newton steps, linear (CG) iterations, and the preconditioner taken."""

    newton: int
    linear: int
    preconditioner: str


def solve_vi(
    A: PETSc.Mat,
    b: PETSc.Vec,
    lower: PETSc.Vec,
    x: PETSc.Vec,
    *,
    load: float,
    tolerance: float = 1e-9,
    monitor: Monitor | None = None,
    level: int | None = None,
) -> Iterations:
    """Solve the variational inequality in place.

    Args:
        A: Symmetric positive definite matrix, Dirichlet rows and columns those of the identity.
        b: Right-hand side, with the Dirichlet values in their rows.
        lower: Bound of each dof, `PETSc.NINFINITY` where there is none.
        x: On entry the start, with the Dirichlet values in place; on exit the solution.
        load: Norm that the residual is measured against, `System.load`; the same for all starts.
        tolerance: The solve ends when the residual's norm is below ``tolerance * load``.
        monitor: Called after each step.
        level: Named in the error.

    Raises:
        NotConverged: With the name PETSc gives to the reason.
    """
    comm = A.getComm()
    residual = b.duplicate()
    snes = PETSc.SNES().create(comm)
    snes.setOptionsPrefix(PREFIX)
    snes.setType(PETSc.SNES.Type.VINEWTONRSLS)

    def function(_: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        A.mult(x, f)
        f.axpy(-1.0, b)

    snes.setFunction(function, residual)
    snes.setJacobian(lambda *_: None, A)
    upper = b.duplicate()
    upper.set(PETSc.INFINITY)
    snes.setVariableBounds(lower, upper)
    # rtol is relative to the start, so a warm start needs the absolute one
    snes.setTolerances(rtol=0.0, atol=tolerance * load or 1e-300, max_it=100)
    ksp = snes.getKSP()
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setTolerances(rtol=1e-8, atol=0.1 * tolerance * load, max_it=1000)
    ksp.getPC().setType(PETSc.PC.Type.HYPRE)

    linear = [0]

    def report(snes: PETSc.SNES, step: int, norm: float) -> None:
        linear[0] = snes.getLinearSolveIterations()
        if monitor is not None:
            monitor(step, norm, active_dofs(snes.getSolution(), residual, lower), linear[0])

    snes.setMonitor(report)
    with _defaults(DEFAULTS):
        snes.setFromOptions()
    snes.solve(None, x)
    reason = snes.getConvergedReason()
    linear_reason = ksp.getConvergedReason()
    iterations = Iterations(
        snes.getIterationNumber(), snes.getLinearSolveIterations(), ksp.getPC().getType()
    )
    snes.destroy()
    for vector in (residual, upper):
        vector.destroy()
    if reason < 0:
        words = _name(PETSc.SNES.ConvergedReason, reason)
        if linear_reason < 0:
            words += f" (KSP {_name(PETSc.KSP.ConvergedReason, linear_reason)})"
        raise NotConverged(
            f"SNES stopped with {words} after {iterations.newton} Newton steps "
            f"and {iterations.linear} linear iterations",
            level,
        )
    return iterations


def active_dofs(x: PETSc.Vec, residual: PETSc.Vec, lower: PETSc.Vec) -> int:
    """Number of dofs on their bound with a residual pushing them there, over all ranks."""
    active = (x.array_r <= lower.array_r) & (residual.array_r > 0)
    return int(x.getComm().tompi4py().allreduce(int(active.sum())))


@contextmanager
def _defaults(options: dict[str, object]) -> Iterator[None]:
    """Set options for the time of a block, those the user has set excepted."""
    database = PETSc.Options(PREFIX)
    ours = {name: value for name, value in options.items() if not database.hasName(name)}
    for name, value in ours.items():
        database.setValue(name, value)
    try:
        yield
    finally:
        for name in ours:
            database.delValue(name)


def _name(reasons: type, value: int) -> str:
    """Name of a converged reason; several may share a value, the longest says most."""
    names = [n for n, v in vars(reasons).items() if v == value and n.isupper()]
    return max(names, key=len, default=str(value))
