"""Tools that all tests share: a time limit, one folder for all ranks, the marker `serial`."""

import faulthandler
import gc
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr import jit

SECONDS = float(os.environ.get("SIGNORINI_TEST_SECONDS", "300"))
_stderr = 2


def pytest_addoption(parser: pytest.Parser) -> None:
    words = "of tests that are slow run those with the first of their parameters alone"
    parser.addoption("--first", action="store_true", help=words)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--first"):
        return
    begun: set[str] = set()
    kept: list[pytest.Item] = []
    left_out: list[pytest.Item] = []
    for item in items:
        test = item.nodeid.partition("[")[0]
        again = test in begun and item.get_closest_marker("slow")
        (left_out if again else kept).append(item)
        begun.add(test)
    config.hook.pytest_deselected(items=left_out)
    items[:] = kept


def pytest_configure(config: pytest.Config) -> None:
    # Here fd 2 is the real one; while a test runs it is the capture file
    global _stderr
    _stderr = os.dup(2)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup has it ignored, by all that tests start
    # What runs that were killed have left would keep forms of the tests' own waiting
    if MPI.COMM_WORLD.rank == 0:
        jit.remove_unfinished(until=time.time() - jit.ABANDONED)
    MPI.COMM_WORLD.Barrier()


def pytest_collection_finish() -> None:
    # What has been imported stays: whoever looks for cycles need not go through it each time
    gc.collect()
    gc.freeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("serial") and MPI.COMM_WORLD.size > 1:
        pytest.skip("one process is enough")


@pytest.fixture(autouse=True)
def time_limit() -> Iterator[None]:
    """End the process of a test that hangs: mpirun then ends the other ranks as well.

    A rank that waits inside MPI never gets back to Python, so no signal handler would run.
    """
    faulthandler.dump_traceback_later(SECONDS, exit=True, file=_stderr)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture
def shared_tmp_path(tmp_path: Path) -> Path:
    """Rank 0's `tmp_path`, on every rank."""
    return MPI.COMM_WORLD.bcast(tmp_path, root=0)


@pytest.fixture
def options() -> Iterator[Callable[[str, object], None]]:
    """Set options under the prefix; they are gone after the test."""
    database = PETSc.Options("signorini_")
    names: list[str] = []

    def set_option(name: str, value: object) -> None:
        names.append(name)
        database.setValue(name, value)

    yield set_option
    for name in names:
        database.delValue(name)
