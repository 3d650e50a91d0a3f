"""PETSc options: what users may set stands under one prefix, and comes first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from petsc4py import PETSc

from .errors import InputError
from .memory import ran_out_of_memory

PREFIX = "signorini_"
"""Prefix of the PETSc options that reach the solver, as in ``-signorini_snes_atol 1e-12``."""

NO_INODES = {"mat_no_inode": None}
"""PETSc joins neighbouring rows of the same pattern, which takes time to look for; few have it."""

AMG = PETSc.PC.Type.HYPRE if PETSc.Sys.hasExternalPackage("hypre") else PETSc.PC.Type.GAMG
"""Algebraic multigrid: hypre's BoomerAMG, or PETSc's own where it was built without hypre."""


def read(thing: PETSc.SNES | PETSc.KSP | PETSc.PC) -> None:
    """Let a solver read its options; collective.

    Raises:
        InputError: PETSc does not know a type that was asked for, or cannot read a value.
    """
    try:
        thing.setFromOptions()
    except PETSc.Error as error:
        raise InputError(
            f"PETSc refuses an option that begins with -{thing.getOptionsPrefix()}: {_words(error)}"
        ) from error


def read_number(name: str, default: float) -> float:
    """An option that is a number, 0 or more.

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


@contextmanager
def explained() -> Iterator[None]:
    """Say what is behind errors of PETSc in a block.

    What Python code raises that PETSc calls, a monitor for one, comes out as it was raised.

    Raises:
        InputError: PETSc stopped, and options have been set.
    """
    try:
        yield
    except PETSc.Error as error:
        origin: BaseException = error
        while isinstance(origin, PETSc.Error) and origin.__cause__ is not None:
            origin = origin.__cause__
        if not isinstance(origin, PETSc.Error):
            raise origin from origin.__cause__
        options = PETSc.Options(PREFIX).getAll()
        if not options or ran_out_of_memory(error):
            raise
        given = ", ".join(f"-{PREFIX}{name} {value}".rstrip() for name, value in options.items())
        raise InputError(f"PETSc can't solve with {given}: {_words(origin)}") from error


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
    """The last line of an error of PETSc, which says what went wrong; those before say where."""
    return str(error).splitlines()[-1].split("] ", 1)[-1]
