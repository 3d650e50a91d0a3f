"""Forms that a run which was ended has left half compiled."""

import os
import time
from pathlib import Path

import pytest
import ufl
from dolfinx import fem
from dolfinx import jit as dolfinx_jit
from dolfinx.mesh import create_unit_square
from mpi4py import MPI

from signorini_cr.jit import ABANDONED, compiled, remove_unfinished

COMM = MPI.COMM_WORLD


@pytest.fixture
def cache(shared_tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and a second instead of ten for those who wait."""
    options = dolfinx_jit.get_options() | {"cache_dir": shared_tmp_path, "timeout": 1}
    monkeypatch.setattr(dolfinx_jit, "get_options", lambda *_: dict(options))
    return shared_tmp_path


def make(value: float) -> fem.Form:
    mesh = create_unit_square(COMM, 2, 2)
    one = fem.Constant(mesh, value) * ufl.SpatialCoordinate(mesh)[0] ** 3
    return compiled(COMM, fem.form, one * ufl.dx(mesh))


def sources(cache: Path) -> list[Path]:
    return [path for path in cache.iterdir() if path.suffix == ".c"]


def left_by_a_killed_run(cache: Path, age: float) -> None:
    """What is there when a process ends between the empty source and the mark."""
    make(1.0)
    COMM.Barrier()
    if COMM.rank == 0:
        (source,) = sources(cache)
        for path in cache.iterdir():
            if path != source:
                path.unlink()
        source.write_text("")
        then = time.time() - age
        os.utime(source, (then, then))
    COMM.Barrier()


def test_what_is_abandoned_is_compiled_anew(cache: Path) -> None:
    left_by_a_killed_run(cache, 2 * ABANDONED)
    form = make(1.0)
    integral = COMM.allreduce(fem.assemble_scalar(form))
    assert integral == pytest.approx(0.25, rel=1e-12)
    (source,) = sources(cache)
    assert source.with_suffix(".c.cached").exists() and source.stat().st_size > 0


def test_who_is_still_at_work_is_waited_for(cache: Path, monkeypatch) -> None:
    """The file is touched by another process, until it is left alone."""
    left_by_a_killed_run(cache, 0.0)
    monkeypatch.setattr("signorini_cr.jit.ABANDONED", 3.0)
    COMM.Barrier()
    began = time.time()
    make(1.0)
    assert time.time() - began > 2.5


def test_other_errors_are_passed_on(cache: Path) -> None:
    def fails() -> None:
        raise RuntimeError("Failed just-in-time compilation of form: no compiler")

    with pytest.raises(RuntimeError, match="no compiler"):
        compiled(COMM, fails)


def test_an_interrupted_compilation_leaves_nothing(cache: Path) -> None:
    old = cache / "libffcx_forms_old.c"
    if COMM.rank == 0:
        old.write_text("another program's")
        os.utime(old, (1.0, 1.0))
    COMM.Barrier()

    def interrupted() -> None:
        if COMM.rank == 0:
            (cache / "libffcx_forms_half.c").touch()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compiled(COMM, interrupted)
    COMM.Barrier()
    assert sources(cache) == [old]
    COMM.Barrier()
    if COMM.rank == 0:
        remove_unfinished(until=time.time() - ABANDONED)
    COMM.Barrier()
    assert sources(cache) == []
