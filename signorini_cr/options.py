"""PETSc options: what users may set stands under one prefix, and comes first."""

from __future__ import annotations

import atexit
import gc
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import ParamSpec, TypeVar

from petsc4py import PETSc

from .errors import InputError
from .garbage import release
from .memory import ran_out_of_memory

P = ParamSpec("P")
T = TypeVar("T")

PREFIX = "signorini_"
"""Prefix of the PETSc options that reach the solver, as in ``-signorini_snes_atol 1e-12``."""

REDUCED_PREFIX = PREFIX + "reduced_"
"""That of SNES's own linear solver, a shell around the one that ``-signorini_ksp_`` is about."""

BOTTOM_PREFIX = PREFIX + "bottom_"
"""That of what solves the space at the bottom of the multigrid cycle."""

ALONE_PREFIX = PREFIX + "alone_"
"""That of what takes the cycle's place where it has been given up."""

ESTIMATE_PREFIX = PREFIX + "estimate_"
"""That of the linear systems of the certificate; what they leave costs sharpness, not validity."""

OF_SOLVERS = re.compile("-(snes|ksp|pc)_[a-z]")
"""Beginnings of solvers' options that are lost without the prefix."""

OF_PETSC = (
    "-log_view", "-log_view_memory", "-log_trace", "-options_left", "-options_view",
    "-malloc_dump", "-malloc_view", "-memory_view",
)  # fmt: skip
"""Options of PETSc itself, which reads them when it starts, and whose names nothing else has."""

HAS_MUMPS = PETSc.Sys.hasExternalPackage("mumps")

AMG = PETSc.PC.Type.HYPRE if PETSc.Sys.hasExternalPackage("hypre") else PETSc.PC.Type.GAMG
"""Algebraic multigrid: hypre's BoomerAMG, or PETSc's own where it was built without hypre."""

# What follows are PETSc's settings, one dictionary a solver; what users set comes before them.
# Computed figures, as tolerances are, stand where they are computed.

MATRICES = {"mat_no_inode": None}
"""PETSc joins neighbouring rows of the same pattern, which takes time to look for; few have it."""

NEWTON: dict[str, object] = {
    "snes_type": PETSc.SNES.Type.VINEWTONRSLS,
    # full steps are the primal-dual active set method: PETSc's usual line search tests a norm
    # that may rightly rise
    "snes_linesearch_type": "basic",
    # a contact dof counts as active within this of its bound; PETSc's is absolute and would
    # freeze data of small magnitude
    "snes_vi_zero_tolerance": 0.0,
    # relative to the start, and a warm start needs the absolute one
    "snes_rtol": 0.0,
    "snes_max_it": 300,
}
"""The active set method. SNES hands its linear systems to a solver in Python."""

REDUCED: dict[str, object] = {
    "ksp_type": PETSc.KSP.Type.CG,
    "ksp_rtol": 0.0,
    "ksp_max_it": 1000,
    "pc_type": PETSc.PC.Type.PYTHON,
}
"""The linear systems; the preconditioner in Python is the multigrid cycle."""

BOOMERAMG: dict[str, object] = {
    "pc_type": AMG,
    # Gauss-Seidel forward on the way down and backward on the way up: as symmetric as PETSc's
    # default, which goes both ways each time, and a third cheaper
    "pc_hypre_boomeramg_relax_type_down": "SOR/Jacobi",
    "pc_hypre_boomeramg_relax_type_up": "backward-SOR/Jacobi",
    # in one pass through all rows, not in one for those of coarse points and one for the others:
    # as many CG steps, and a third cheaper once more
    "pc_hypre_boomeramg_no_CF": True,
}
"""Algebraic multigrid at the bottom of the cycle, or in its place."""

COMPANION: dict[str, object] = {
    "ksp_type": PETSc.KSP.Type.CG,
    # the energy is what the companion is to bring down
    "ksp_norm_type": "natural",
    "ksp_max_it": 100,
    "pc_type": AMG,
    # without these two PETSc's own takes 200 steps where cells are thin, and with them 15
    "pc_gamg_threshold": 0.02,
    "pc_gamg_aggressive_coarsening": 0,
}
"""The best companion, where it is solved for."""

DUAL: dict[str, object] = {
    "ksp_type": PETSc.KSP.Type.CG,
    # in the residual's norm as much as a thousand times more may be left
    "ksp_norm_type": "natural",
    # what steps have left depends on the ranks, and an interval is no better known than that
    "ksp_rtol": 1e-10,
    "pc_type": AMG,
}
"""The linear problems of bounds of means and flows: dual ones, and weights that are harmonic."""

LARGE_FACTORS: dict[str, object] = {
    "pc_type": PETSc.PC.Type.CHOLESKY,
    "pc_factor_mat_solver_type": "mumps",
    # minimum degree takes least time for matrices of plane meshes, on two ranks as well
    "mat_mumps_icntl_7": 0,
}
"""Factors in the place of the cycle."""

WHOLE_FACTORS: dict[str, object] = {
    "pc_type": PETSc.PC.Type.CHOLESKY,
    "pc_factor_zeropivot": 1e-300,
    # a fifth less to solve with than nested dissection's, and no slower to make
    "pc_factor_mat_ordering_type": "qmd",
}
"""Factors of a small matrix that is solved with again and again."""

SMALL_FACTORS: dict[str, object] = {
    "pc_type": PETSc.PC.Type.CHOLESKY,
    # PETSc's smallest pivot is absolute and would refuse coefficients of small magnitude
    "pc_factor_zeropivot": 1e-300,
    "redundant_pc_factor_zeropivot": 1e-300,
}
"""Factors at the bottom of the cycle, on one rank."""

REDUNDANT_FACTORS: dict[str, object] = {**SMALL_FACTORS, "pc_type": PETSc.PC.Type.REDUNDANT}
"""The same on several ranks: each has all of them."""


class OptionRefused(InputError):
    """PETSc does not take an option that was set, whatever it is that is to be solved."""


def take(words: Sequence[str]) -> None:
    """Take the options under the prefix from a command line that PETSc has not seen.

    They are options of this program, whoever else reads that line. What is set already is left as
    it is. As with PETSc, the word behind an option is its value if it is no option itself.
    """
    given = {
        word: None if re.match("--?[a-zA-Z]", after) else after
        for word, after in pairwise([*words, "-none"])
        if word.startswith(f"-{PREFIX}")
    }
    database, known = PETSc.Options(), _in_database()
    for word, value in given.items():
        if word.lower() not in known:
            database.setValue(word, value)


def _in_database() -> set[str]:
    """List PETSc's options without using any: those that are asked for by name count as used."""
    return {f"-{name}".lower() for name in PETSc.Options().getAll()}


def unheard(words: Sequence[str]) -> list[str]:
    """Say which options of a script's command line PETSc has never seen, and what to write.

    Whatever stands in its database is PETSc's business, which tells what nothing has used.

    Args:
        words: The command line; what looks like no option of PETSc's is the script's own.

    Returns:
        Up to two warnings.
    """
    there = _in_database()
    lost = [word for word in dict.fromkeys(words) if OF_SOLVERS.match(word) or word in OF_PETSC]
    lost = [word for word in lost if word.lower() not in there]
    solver = [word for word in lost if OF_SOLVERS.match(word)]
    own = [word for word in lost if word in OF_PETSC]
    warnings = []
    if solver:
        known = ", ".join(f"-{PREFIX}{word[1:]}" for word in solver)
        warnings.append(f"{', '.join(solver)} did not reach the solver; write {known}")
    if own:
        values = dict(pairwise([*words, "-none"]))
        given = " ".join(w if values[w].startswith("-") else f"{w} {values[w]}" for w in own)
        warnings.append(
            f"{', '.join(own)} did not reach PETSc; set PETSC_OPTIONS='{given}' in the"
            " environment, or call petsc4py.init(sys.argv) right behind import signorini_cr"
        )
    return warnings


def _tell_unheard(words: Sequence[str]) -> None:
    """Warn at the end, as PETSc does of options that nothing has used: it may still be told."""
    if PETSc.Sys.isInitialized() and not PETSc.Sys.isFinalized():
        for warning in unheard(words) if PETSc.COMM_WORLD.getRank() == 0 else ():
            print(f"signorini_cr: warning: {warning}", file=sys.stderr)


# A script's own, which it need not hand to petsc4py.init
take(sys.argv[1:])
atexit.register(_tell_unheard, sys.argv[1:])


def read(thing: PETSc.SNES | PETSc.KSP | PETSc.PC) -> None:
    """Let a solver read its options; collective.

    Raises:
        OptionRefused: PETSc does not know a type that was asked for, or cannot read a value.
    """
    try:
        thing.setFromOptions()
    except PETSc.Error as error:
        raise OptionRefused(
            f"PETSc refuses an option that begins with -{thing.getOptionsPrefix()}: {_words(error)}"
        ) from error


def read_number(name: str, default: float) -> float:
    """Read an option that is a number, 0 or more.

    Raises:
        InputError: It is something else.
    """
    try:
        value = float(PETSc.Options(PREFIX).getReal(name, default))
    except PETSc.Error as error:
        raise InputError(f"PETSc refuses -{PREFIX}{name}: {_words(error)}") from error
    if not value >= 0.0:
        raise InputError(f"-{PREFIX}{name} is {value:g}; it must not be negative")
    return value


def read_word(name: str, allowed: Sequence[str]) -> str:
    """Read an option that is one of some words; the first is the default.

    Raises:
        InputError: It is something else.
    """
    word = PETSc.Options(PREFIX).getString(name, allowed[0])
    if word not in allowed:
        raise InputError(f"-{PREFIX}{name} is {word!r}; allowed are {', '.join(allowed)}")
    return str(word)


@contextmanager
def explained() -> Iterator[Callable[[Callable[P, T]], Callable[P, T]]]:
    """Say what is behind errors of PETSc in a block.

    What Python code raises that PETSc calls, a monitor for one, comes out as it was raised. PETSc
    hands on a number only, and meanwhile the exception is pending, which whatever Python does then
    may clear: petsc4py, which counts on it, ends the process with a segmentation fault if garbage
    is collected on the way. So there is no collection in the block; and a function is to be given
    to PETSc as the context makes it, which keeps what it raises.

    Raises:
        InputError: PETSc stopped, and options have been set.
    """
    kept: list[Exception] = []

    def keep(function: Callable[P, T]) -> Callable[P, T]:
        def keeping(*args: P.args, **kwargs: P.kwargs) -> T:
            try:
                return function(*args, **kwargs)
            except Exception as error:
                kept.append(error)
                raise

        return keeping

    collects = gc.isenabled()
    gc.disable()
    try:
        yield keep
    except PETSc.Error as error:
        origin: BaseException = kept.pop(0) if kept else error
        while isinstance(origin, PETSc.Error) and origin.__cause__ is not None:
            origin = origin.__cause__
        if not isinstance(origin, PETSc.Error):
            raise origin from origin.__cause__
        options = PETSc.Options(PREFIX).getAll()
        if not options or ran_out_of_memory(error):
            raise
        given = ", ".join(f"-{PREFIX}{name} {value}".rstrip() for name, value in options.items())
        raise InputError(f"PETSc can't solve with {given}: {_words(origin)}") from error
    finally:
        if collects:
            gc.enable()


def solve_once(
    A: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec, options: Mapping[str, object], prefix: str
) -> None:
    """Solve A x = b by a solver that is made for it alone, from such defaults; collective.

    Raises:
        OptionRefused: As for `read`.
    """
    ksp = PETSc.KSP().create(A.getComm())
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(A)
    try:
        with defaults(options, prefix):
            read(ksp)
        ksp.solve(b, x)
    finally:
        release(ksp)


@contextmanager
def defaults(options: Mapping[str, object], prefix: str = PREFIX) -> Iterator[None]:
    """Set options for the time of a block, those the user has set excepted."""
    database = PETSc.Options(prefix)
    ours = {name: value for name, value in options.items() if not database.hasName(name)}
    for name, value in ours.items():
        database.setValue(name, value)
    try:
        yield
    finally:
        for name in ours:
            database.delValue(name)


def _words(error: BaseException) -> str:
    """Return the last line of a PETSc error, which says what went wrong; those before say where."""
    return str(error).splitlines()[-1].split("] ", 1)[-1]
