"""Ctrl-C, SIGTERM, SIGHUP and SIGXCPU: an end in good order, at a moment when it does no harm."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

ENDING = signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGXCPU
"""Signals that ask for an end; SIGHUP where a terminal is closed, SIGXCPU after a limit of time."""


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Keep in mind the signals that asked for an end, and turn them into KeyboardInterrupt.

    That may reach us as another error, of PETSc, whose callback it was raised in. An import is left
    to finish, as libraries that are being loaded may end the process, and so is `keep`, so that
    what is told of files is true; and whoever is told twice within a second, by the user and by
    mpirun, say, is told once. Where Python drops what is raised, in a finalizer, say, it is told
    anew.
    """
    asked: list[int] = []
    latest = -math.inf

    def soon(number: int) -> None:
        again = threading.Timer(0.05, os.kill, (os.getpid(), number))
        again.daemon = True
        again.start()

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal latest
        asked.append(number)
        if _must_not_be_disturbed(frame):
            soon(number)
        elif time.monotonic() - latest > 1.0:
            latest = time.monotonic()
            raise KeyboardInterrupt

    def dropped(facts: sys.UnraisableHookArgs) -> None:
        nonlocal latest
        if asked and issubclass(facts.exc_type, KeyboardInterrupt):
            latest = -math.inf
            soon(asked[0])
        else:
            drop(facts)

    drop, sys.unraisablehook = sys.unraisablehook, dropped
    found: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():  # others can't be interrupted
        # not where it is ignored, as in the background or by nohup
        for each in ENDING:
            if signal.getsignal(each) in (signal.default_int_handler, signal.SIG_DFL):
                found[each] = signal.signal(each, ask)
    try:
        yield asked
    finally:
        sys.unraisablehook = drop
        for each, handler in found.items():
            signal.signal(each, handler)


def _must_not_be_disturbed(frame: FrameType | None) -> bool:
    """Tell whether what runs has been called by an import or by `keep`."""
    while frame is not None:
        code = frame.f_code
        if code is keep.__code__ or code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def status_of(asked: Sequence[int]) -> int:
    """Return the exit status after a signal; from here on it is too late for another one."""
    if threading.current_thread() is threading.main_thread():
        for each in ENDING:
            signal.signal(each, signal.SIG_IGN)
    return 128 + (asked[0] if asked else signal.SIGINT)


def keep(
    write: Callable[[], object], kept: list[dict[str, Any]], records: list[dict[str, Any]]
) -> None:
    """Write, and note what is safe then; signals wait for that, see `_must_not_be_disturbed`."""
    write()
    kept += records
