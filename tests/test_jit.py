"""Forms that a run which was ended has left half compiled."""

import os
import time
from pathlib import Path

import pytest
import ufl
from dolfinx import fem
from dolfinx import jit as dolfinx_jit
from dolfinx.mesh import create_unit_square
from helpers import start
from mpi4py import MPI

from signorini_cr import jit
from signorini_cr.errors import InputError
from signorini_cr.jit import ABANDONED, compiled, remove_unfinished

COMM = MPI.COMM_WORLD


@pytest.fixture
def cache(shared_tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and a second instead of ten for those who wait."""
    options = dolfinx_jit.get_options() | {"cache_dir": shared_tmp_path, "timeout": 1}
    monkeypatch.setattr(dolfinx_jit, "get_options", lambda more=None: options | (more or {}))
    return shared_tmp_path


def make(value: float) -> fem.Form:
    mesh = create_unit_square(COMM, 2, 2)
    one = fem.Constant(mesh, value) * ufl.SpatialCoordinate(mesh)[0] ** 3
    return compiled(COMM, fem.form, one * ufl.dx(mesh))


def sources(cache: Path) -> list[Path]:
    return [path for path in cache.iterdir() if path.suffix == ".c"]


def left_by_a_killed_run(cache: Path, age: float) -> None:
    """Leave what is there when a process ends between the empty source and the mark."""
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


@pytest.mark.slow
def test_what_is_abandoned_is_compiled_anew(cache: Path) -> None:
    left_by_a_killed_run(cache, 2 * ABANDONED)
    form = make(1.0)
    integral = COMM.allreduce(fem.assemble_scalar(form))
    assert integral == pytest.approx(0.25, rel=1e-12)
    (source,) = sources(cache)
    assert source.with_suffix(".c.cached").exists() and source.stat().st_size > 0


@pytest.mark.slow
def test_who_is_still_at_work_is_waited_for(cache: Path, monkeypatch) -> None:
    """The file is touched by another process, until it is left alone."""
    left_by_a_killed_run(cache, 0.0)
    monkeypatch.setattr("signorini_cr.jit.ABANDONED", 3.0)
    COMM.Barrier()
    began = time.time()
    make(1.0)
    assert time.time() - began > 2.5


@pytest.mark.serial
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("ffcx_options.json", '{"scalar_type":', "ffcx_options.json: this is no JSON"),
        ("ffcx_options.json", "[1]", "ffcx_options.json: a JSON object is needed"),
        (
            "dolfinx_jit_options.json",
            '{"cffi_extra_compile_args": 5}',
            "cffi_extra_compile_args is 5; a list of words is needed",
        ),
        (
            "dolfinx_jit_options.json",
            '{"timeuot": 5}',
            "no option 'timeuot'; did you mean",
        ),
    ],
)
def test_options_of_the_libraries_that_cannot_be_used(name, text, words, tmp_path) -> None:
    (tmp_path / name).write_text(text)
    (tmp_path / "run.py").write_text(PLAIN)
    done = start(tmp_path / "run.py", cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert done.returncode == 1 and words in done.stderr.splitlines()[-1], done.stderr
    assert "signorini_cr.errors.InputError: " in done.stderr


PLAIN = """
from dolfinx.mesh import create_unit_square
from mpi4py import MPI
import ufl
from signorini_cr import jit
from dolfinx import fem
mesh = create_unit_square(MPI.COMM_WORLD, 1, 1)
jit.compiled(mesh.comm, fem.form, ufl.SpatialCoordinate(mesh)[0] ** 5 * ufl.dx(mesh))
"""


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


def library(cache: Path) -> Path:
    (found,) = (path for path in cache.iterdir() if path.suffix == ".so")
    return found


def flipped(data: bytes) -> bytes:
    return data[:1000] + bytes([data[1000] ^ 1]) + data[1001:]


DAMAGES = {
    "emptied": lambda data: b"",
    "cut short": lambda data: data[: len(data) // 2],
    "a bit flipped": flipped,
    "another file": lambda data: b"no library",
}


@pytest.mark.slow
@pytest.mark.parametrize("noted", [True, False])
@pytest.mark.parametrize("kind", [*DAMAGES, "away"])
def test_a_damaged_library_is_made_anew(kind: str, noted: bool, cache: Path) -> None:
    """Loading it would end the process with a bus error; without a note, its end tells."""
    if kind == "a bit flipped" and not noted:
        pytest.skip("that is what the note is for")
    make(2.0)
    COMM.Barrier()
    if COMM.rank == 0:
        path = library(cache)
        data = path.read_bytes()
        path.unlink()  # what is loaded stays as it is
        if kind != "away":
            path.write_bytes(DAMAGES[kind](data))
        if not noted:
            next(cache.glob("*.sum")).unlink()
    COMM.Barrier()
    integral = COMM.allreduce(fem.assemble_scalar(make(2.0)))
    assert integral == pytest.approx(0.5, rel=1e-12)
    COMM.Barrier()
    assert library(cache).stat().st_size > 10_000
    names = {path.suffix for path in cache.iterdir()}
    assert names <= {".c", ".cached", ".so", ".o", ".sum"}


def test_a_form_is_loaded_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not for each solve anew, and whatever else there is in the folder."""
    loads: list[str] = []
    load = jit._load
    monkeypatch.setattr(jit, "_load", lambda *facts: (loads.append(facts[1]), load(*facts))[1])
    values = [COMM.allreduce(fem.assemble_scalar(make(3.0))) for _ in range(4)]
    assert values == pytest.approx([0.75] * 4, rel=1e-12)
    assert len(loads) == 1


@pytest.mark.parametrize("kind", ["file", "device", "nowhere"])
def test_where_forms_cannot_be_kept_they_are_compiled_all_the_same(
    kind: str, shared_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (shared_tmp_path / "file").touch()
    places = {"file": str(shared_tmp_path / "file"), "device": "/dev/null", "nowhere": "/proc/x"}
    options = dolfinx_jit.get_options() | {"cache_dir": places[kind] + "/fenics"}
    monkeypatch.setattr(dolfinx_jit, "get_options", lambda more=None: options | (more or {}))
    monkeypatch.setattr(jit, "_elsewhere", None)
    words: list[str] = []
    monkeypatch.setattr(jit, "tell", words.append)
    for value in (3.0, 4.0):
        integral = COMM.allreduce(fem.assemble_scalar(make(value)))
        assert integral == pytest.approx(value / 4, rel=1e-12)
    (told,) = words
    assert told.startswith(f"compiled forms cannot be kept in {places[kind]}/fenics (")
    assert "they are compiled for this run only" in told
    own = jit._elsewhere
    assert own is not None and Path(own).is_dir()
    monkeypatch.setattr(jit, "_elsewhere", "/proc/x")
    with pytest.raises(InputError, match=r"cannot be kept in /proc/x .*XDG_CACHE_HOME may name"):
        make(5.0)


def test_where_the_compiler_has_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps files elsewhere while it is at work."""
    monkeypatch.setenv("TMPDIR", "/proc/x")
    monkeypatch.setattr("tempfile.tempdir", "/proc/x")
    monkeypatch.setenv("CC", "false")
    with pytest.raises(InputError, match=r"files, /proc/x, cannot be written to .*TMPDIR may name"):
        make(7.25)


@pytest.mark.parametrize("compiler", ["false", "/nowhere/gcc"])
def test_a_compiler_that_fails_is_told_in_words(
    compiler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", compiler)
    words = rf"forms cannot be compiled: .*{compiler}.*; a C compiler that works is needed"
    with pytest.raises(InputError, match=words):
        make(7.75)


@pytest.mark.serial
def test_temporary_folders_of_runs_that_were_killed_go(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / f"{jit.OWN}999999999-abc").mkdir()
    living = tmp_path / f"{jit.OWN}{os.getpid()}-abc"
    living.mkdir()
    assert {Path(jit._own_folder()), living} == set(tmp_path.iterdir())
