"""The two errors a user meets, and how ranks come to agree on them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any, TypeVar

from mpi4py import MPI

T = TypeVar("T")


class InputError(ValueError):
    """A mistake in what the user wrote: it says what was found and what is allowed."""


class NotConverged(RuntimeError):
    """The solver stopped short of a solution.

    Attributes:
        level: The mesh of the sequence it happened on, counted from 0, if known.
        reason: What stopped it, in words.
    """

    def __init__(self, reason: str, level: int | None = None) -> None:
        """Keep `reason` and `level` for whoever catches the error."""
        where = "" if level is None else f"level {level}: "
        super().__init__(where + reason)
        self.reason = reason
        self.level = level


@contextmanager
def naming(thing: object, rule: str = "") -> Iterator[None]:
    """Let the message of an InputError begin with what it is about.

    Args:
        thing: A file, a key or an option.
        rule: What the message ends with.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{thing}: {error}" + (rule and f"; {rule}")) from error.__cause__


def insist_on_kind(name: str, value: object, kinds: type | tuple[type, ...], needed: str) -> None:
    """Refuse an argument of another kind: two may have changed places.

    Args:
        name: What the argument is called.
        value: What was given for it.
        kinds: What it may be.
        needed: The same in words.
    """
    if not isinstance(value, kinds):
        raise InputError(f"{name} is of the type {type(value).__name__}: {needed} is needed")


def insist_on_function(name: str, value: object) -> None:
    """Refuse what can't be called.

    Args:
        name: What the argument is called.
        value: What was given for it.
    """
    if not callable(value):
        raise InputError(f"{name} is of the type {type(value).__name__}: a function is needed")


def to_float(name: str, value: Any, needed: str = "a number") -> float:
    """Turn a real number of any kind into a float; refuse what is none.

    Others compute in a precision of their own, or NumPy does not know them.

    Args:
        name: What the argument is called.
        value: What was given for it.
        needed: What it may be, in words.
    """
    insist_on_kind(name, value, Real, needed)
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{name} is larger than {sys.float_info.max:.2g}, the most") from None


def insist_on_count(name: str, value: Any) -> int:
    """Refuse what is no whole number of 1 or more.

    Args:
        name: What the argument is called.
        value: What was given for it.

    Returns:
        That, as Python's own number.
    """
    insist_on_kind(name, value, Integral, "a whole number")
    if value < 1:
        raise InputError(f"{name} is {value}; it must be 1 or more")
    return int(value)


def insist_on_number(name: str, value: Any, least: float, strict: bool = False) -> float:
    """Refuse what is no number, or below another one.

    Args:
        name: What the argument is called.
        value: What was given for it.
        least: What it must not be below.
        strict: Whether that one itself is refused, too.

    Returns:
        That, as a float.
    """
    number = to_float(name, value)
    if not (number > least if strict else number >= least):
        needed = f"above {least:g}" if strict else f"{least:g} or more"
        raise InputError(f"{name} is {value}; it must be {needed}")
    return number


def on_root(comm: MPI.Comm, function: Callable[..., T], *args: object) -> T:
    """Call `function(*args)` on rank 0 alone and give all ranks its result.

    What it raises is raised on every rank, so that no rank is left waiting.

    Args:
        comm: The ranks that take part; all must call.
        function: Returns something that can be pickled.
        *args: Handed over to `function`.
    """
    found = together(comm, lambda: function(*args) if comm.rank == 0 else None)
    return comm.bcast(found, root=0)


def together(comm: MPI.Comm, function: Callable[..., T], *args: object) -> T:
    """Call `function(*args)` on every rank; what it raises on any is raised on all.

    Args:
        comm: The ranks that take part; all must call.
        function: What is not collective itself, as a function of the user's.
        *args: Handed over to `function`.
    """
    result: T
    error: Exception | None = None
    try:
        result = function(*args)
    except Exception as caught:
        error = caught
    fail_together(comm, error)
    return result


def fail_together(comm: MPI.Comm, error: Exception | None) -> None:
    """Raise on all ranks what has gone wrong on any, so that no rank is left waiting.

    Args:
        comm: The ranks that take part; all must call.
        error: What this rank has caught, None if nothing; it is raised here as it is. The others
            raise an InputError or a RuntimeError with the words of the lowest such rank.
    """
    first = comm.allreduce(comm.size if error is None else comm.rank, op=MPI.MIN)
    if first == comm.size:
        return
    # An exception need not survive pickling: send its kind and its words
    sent = None if error is None else (isinstance(error, InputError), _words(error))
    is_input, words = comm.bcast(sent, root=first)
    if error is not None:
        raise error
    raise InputError(words) if is_input else RuntimeError(f"rank {first} failed: {words}")


def raise_together(comm: MPI.Comm, complaint: str | None) -> None:
    """Raise InputError on all ranks if any rank has a complaint (the lowest rank's is shown).

    Args:
        comm: The ranks that take part; all must call.
        complaint: This rank's message, or None if it has nothing to say.
    """
    first = comm.allreduce(comm.size if complaint is None else comm.rank, op=MPI.MIN)
    if first < comm.size:
        raise InputError(comm.bcast(complaint, root=first))


def _words(error: Exception) -> str:
    return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
