"""The files that are left where a run is ended from outside, or by lack of memory."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path

import helpers
import kills
import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr import memory
from signorini_cr.app import cli, signals
from signorini_cr.app.run import what_is_kept
from signorini_cr.errors import InputError, naming, on_root
from signorini_cr.memory import ran_out_of_memory
from signorini_cr.output import files
from signorini_cr.output.report import FILES

pytestmark = pytest.mark.slow

COMM = MPI.COMM_WORLD


@pytest.mark.serial
@pytest.mark.parametrize(
    "seed, ranks, case",
    [
        (0, None, "uniform"),
        (3, None, "uniform"),
        (9, None, "uniform"),
        (1, 3, "adaptive"),
        (2, 1, "time"),
        (5, 3, "time"),
    ],
)
def test_a_run_that_is_ended_leaves_whole_files_of_one_run(
    seed: int, ranks: int | None, case: str, tmp_path: Path
) -> None:
    """A few seeds; `python3 tests/kills.py` has as many as one likes."""
    end = kills.killed(tmp_path, seed, (1, 2) if ranks is None else (ranks,), (case,))
    assert end.faults == [], f"{end.kind}: {end.faults}"
    one = end.kind.startswith("1 ")
    # Open MPI's mpirun has 128 more than the signal that has ended ranks, MPICH's the signal itself
    launcher = () if one else (1, 137, signal.Signals[end.kind.split()[1]])
    assert end.status in (130, 143, -2, -9, -15, 0, *launcher)


LIMITED = """
import resource
from pathlib import Path
from mpi4py import MPI
from signorini_cr import limits
from signorini_cr.vi.level import Level
limits.shortage = lambda *_: None  # no estimate beforehand
made = Level.__post_init__

def limited(self):
    made(self)
    if self.number == 6 and MPI.COMM_WORLD.rank in LIMITED_RANKS:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + 20_000_000
        resource.setrlimit(resource.RLIMIT_AS, (most, most))

Level.__post_init__ = limited
"""


@pytest.mark.serial
@pytest.mark.parametrize("limited", [(0,), (1,)])
def test_where_memory_ends_the_levels_before_are_kept(limited, tmp_path: Path) -> None:
    """The limit comes when level 6 has its mesh, and bites when the arrays are large enough.

    Not while a mesh is made: DOLFINx 0.11 does that in threads, whose errors end the process.
    """
    program = LIMITED.replace("LIMITED_RANKS", repr(limited))
    done = helpers.altered(tmp_path, kills.CASE, program, ranks=limited[-1] + 1)
    assert done.returncode == cli.NOT_CONVERGED, done.stderr
    words = " ".join(done.stderr.split())
    level = int(words.split("stopped after level ")[1].split(":")[0]) + 1
    assert level >= 6
    assert f"level {level - 1}: out of memory, of which this process has had 0." in words
    assert f"levels 0 to {level - 1} are finished and kept in" in words
    assert "Traceback" not in done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [each["level"] for each in report["levels"]] == list(range(level))
    assert report["complete"] is False
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"report.json", "levels.csv", "levels.md", "contact.csv", "restart.npz"}


@pytest.mark.serial
@pytest.mark.parametrize("most", [100_000_000, 300_000_000, 500_000_000])
def test_where_memory_ends_at_the_beginning_one_message_tells(most: int, tmp_path: Path) -> None:
    """`ulimit -v`, before a library is loaded and while some are."""
    program = f"import resource\nresource.setrlimit(resource.RLIMIT_AS, ({most}, {most}))"
    done = helpers.altered(tmp_path, kills.CASE.replace("9", "1"), program, "-q")
    if done.returncode == 0:
        assert most > memory.LEAST_SPACE
        return
    words = " ".join(done.stderr.split())
    assert done.returncode == cli.NOT_CONVERGED, words
    assert words.startswith(f"signorini-cr: {tmp_path / 'case.toml'}: ")
    assert "out of memory" in words and "Traceback" not in words


@pytest.mark.serial
@pytest.mark.parametrize("most", [20, 40])
def test_where_few_files_may_be_open_one_message_tells(most: int, tmp_path: Path) -> None:
    """`ulimit -n`, before MPI ends the process."""
    program = f"import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, ({most}, {most}))"
    done = helpers.altered(tmp_path, kills.CASE, program)
    words = " ".join(done.stderr.split())
    assert done.returncode == cli.NOT_CONVERGED, words
    assert words.endswith(f"ulimit -n allows {most} open files, and 64 are needed")
    assert not (tmp_path / "out").exists()


@pytest.mark.serial
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize(
    "surroundings, words",
    [
        # `python3 -OO`, in which the parser that compiling takes has no grammar
        ({"PYTHONOPTIMIZE": "2"}, "Python runs without docstrings"),
        # SciPy, which reads it, would end in a traceback
        (
            {"SOURCE_DATE_EPOCH": "abc"},
            "SOURCE_DATE_EPOCH is 'abc'; the environment is to have a whole",
        ),
    ],
    ids=["docstrings", "epoch"],
)
def test_surroundings_that_will_not_do_are_told_once(
    ranks: int, surroundings: dict[str, str], words: str, tmp_path: Path
) -> None:
    (tmp_path / "case.toml").write_text(kills.CASE)
    argv = ["solve", tmp_path / "case.toml", "--out", tmp_path / "out"]
    done = helpers.command(*argv, ranks=ranks, **surroundings)
    assert done.returncode == cli.BAD_INPUT, done.stderr
    assert done.stderr.count(words) == 1
    assert "Traceback" not in done.stderr and not (tmp_path / "out").exists()


@pytest.mark.serial
def test_pictures_are_drawn_whatever_notebooks_name(tmp_path: Path) -> None:
    """A backend that is missing here keeps Matplotlib from being loaded."""
    (tmp_path / "case.toml").write_text(kills.CASE)
    argv = ["solve", tmp_path / "case.toml", "--out", tmp_path / "out", "--levels", "1"]
    done = helpers.command(*argv, MPLBACKEND="module://nowhere.backend")
    assert (done.returncode, done.stderr) == (0, "")
    assert helpers.is_picture(tmp_path / "out" / "solution.png")


@pytest.mark.serial
def test_what_libraries_warn_of_ends_no_run(tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text(kills.CASE)
    argv = ["solve", tmp_path / "case.toml", "--out", tmp_path / "out", "--levels", "1"]
    done = helpers.command(*argv, PYTHONWARNINGS="error")
    assert done.returncode == 0 and "Traceback" not in done.stderr


@pytest.mark.serial
def test_a_folder_that_is_gone_is_told(tmp_path: Path) -> None:
    """The one that the command is started in."""
    (gone := tmp_path / "gone").mkdir()
    done = helpers.altered(tmp_path, kills.CASE, "import os\nos.rmdir(os.getcwd())", cwd=gone)
    assert done.returncode == cli.BAD_INPUT
    words = " ".join(done.stderr.split())
    assert words.startswith("signorini-cr: the folder that it was started in cannot be used: No su")
    assert not (tmp_path / "out").exists()


PLACES = """import os
from signorini_cr import temporary
os.environ.update(TMPDIR="/proc/nowhere")
temporary.USUAL = USUAL
"""


@pytest.mark.serial
@pytest.mark.parametrize("there", [True, False])
def test_where_temporary_files_cannot_be_written(there: bool, tmp_path: Path) -> None:
    """Open MPI would end the process with a signal."""
    usual = ("/proc/nowhere", str(tmp_path)) if there else ("/dev/full", "/proc")
    program = PLACES.replace("= USUAL", f"= {usual!r}")
    done = helpers.altered(tmp_path, kills.CASE.replace("9", "1"), program)
    words = " ".join(done.stderr.split())
    begins = "temporary files cannot be kept in /proc/nowhere (No such file or directory)"
    if there:
        assert words == f"signorini-cr: warning: {begins}: {tmp_path} takes them"
        assert done.returncode == 0
    else:
        assert words.startswith(f"signorini-cr: {begins}, nor in another usual place; TMPDIR may")
        assert done.returncode == cli.BAD_INPUT
    assert (tmp_path / "out").exists() is there


@pytest.mark.serial
def test_a_run_without_a_home_folder(tmp_path: Path) -> None:
    """Open MPI and DOLFINx ask for it; what is compiled goes where the system says it is."""
    program = "import os\nos.environ.pop('HOME', None)"
    done = helpers.altered(tmp_path, kills.CASE.replace("9", "1"), program, "-q")
    assert (done.returncode, done.stderr) == (0, "")


def test_errors_that_mean_memory() -> None:
    for error in (MemoryError(), PETSc.Error(55), OSError(12, "Cannot allocate memory")):
        assert ran_out_of_memory(error)
    assert not ran_out_of_memory(PETSc.Error(71))
    wrapped = RuntimeError("in a callback")
    wrapped.__cause__ = MemoryError()
    assert ran_out_of_memory(wrapped)
    quoted = InputError("f: no name MemoryError")  # what the user has written
    assert not ran_out_of_memory(quoted)
    with pytest.raises(InputError) as caught, naming("x"):
        raise InputError("cannot write") from OSError(12, "Cannot allocate memory")
    assert ran_out_of_memory(caught.value)


@pytest.mark.serial
def test_memory_is_that_of_the_program_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that a large one starts has held no more than a small one has."""
    program = "from signorini_cr.memory import most_memory; print(most_memory())"
    ballast = np.ones(40_000_000)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert 1e7 < float(done.stdout) < ballast.nbytes
    assert memory.most_memory() > ballast.nbytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: b"")  # no such system
    assert memory.most_memory() > ballast.nbytes


@pytest.mark.serial
@pytest.mark.parametrize("name", ["dam 5 kB.py", "lösungen_eis_ä.py", "a:b", "a\x0bVmHWM: 1 kB"])
def test_a_program_may_have_any_name(name: str) -> None:
    """The system keeps 15 bytes of it, wherever a character ends."""
    program = (
        "import sys\nfrom pathlib import Path\nfrom signorini_cr.memory import most_memory\n"
        "Path('/proc/self/comm').write_bytes(sys.argv[1].encode())\nprint(most_memory())"
    )
    done = subprocess.run([sys.executable, "-c", program, name], capture_output=True, check=True)
    assert float(done.stdout) > 1e7


@pytest.mark.parametrize("former", [FILES, ["report.json", "levels.csv", "levels.md"]])
def test_the_report_goes_first_and_comes_last(former, shared_tmp_path: Path, monkeypatch) -> None:
    """So that wherever it is found, nothing of a former run is beside it; short ones are included.

    A run that was ended early has left nothing but what the next one's first level writes anew.
    """
    seen: list[set[str]] = []
    replace, unlink = os.replace, Path.unlink

    def look(path: Path) -> None:
        seen.append({each.name for each in path.iterdir() if each.is_file()})

    def replaced(source: Path, target: Path) -> None:
        replace(source, target)
        look(Path(target).parent)

    def unlinked(path: Path, *args: bool, **kwargs: bool) -> None:
        unlink(path, *args, **kwargs)
        look(path.parent)

    if COMM.rank == 0:
        for name in former:
            (shared_tmp_path / name).write_text("former")
    COMM.Barrier()
    monkeypatch.setattr(os, "replace", replaced)
    monkeypatch.setattr(Path, "unlink", unlinked)

    def write(path: Path) -> None:
        if COMM.rank == 0:
            path.write_text("new")

    names = ["report.json", "levels.csv", "levels.md"]
    writers = dict.fromkeys(names, write)
    files.write_files(shared_tmp_path, writers, removed=FILES, begins=True)
    if COMM.rank == 0:
        assert [("report.json" in there) for there in seen] == [False] * (len(seen) - 1) + [True]
        assert seen[-1] == set(names)
        assert all((shared_tmp_path / name).read_text() == "new" for name in names)


@pytest.mark.serial
@pytest.mark.parametrize("renamed", [1, 2, 3, 4, 5])
def test_no_report_of_a_former_run_is_beside_tables_of_another(tmp_path: Path, renamed) -> None:
    """Both are killed while they publish: the first after its first mesh, the other on the way."""
    program = (
        "import os, signal\n"
        "def replace(a, b, do=os.replace, seen=[]):\n"
        "    do(a, b)\n"
        "    seen.append(b)\n"
        "    if len(seen) == COUNT:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "os.replace = replace"
    )
    out = tmp_path / "out"
    first = program.replace("COUNT", "5")
    assert helpers.altered(tmp_path, kills.CASE, first, "-q").returncode == -signal.SIGKILL
    assert len(json.loads((out / "report.json").read_text())["levels"]) == 1
    case, second = kills.CASE.replace("f = -3", "f = -30"), program.replace("COUNT", str(renamed))
    assert helpers.altered(tmp_path, case, second, "-q").returncode == -signal.SIGKILL
    assert (out / "report.json").exists() == (renamed == 5)


@pytest.mark.serial
def test_a_page_shows_the_file_that_was_solved(tmp_path: Path) -> None:
    """Whatever has become of it meanwhile."""
    program = (
        "from pathlib import Path\nfrom signorini_cr.app import run\n"
        "def make(*args, do=run.output.make_report, **more):\n"
        "    Path(CASE).unlink(missing_ok=True)\n"
        "    return do(*args, **more)\n"
        "run.output.make_report = make"
    ).replace("CASE", repr(str(tmp_path / "case.toml")))
    case = kills.CASE.replace("levels = 9", "levels = 1")
    done = helpers.altered(tmp_path, case, program, "-q", "--html")
    assert (done.returncode, done.stderr) == (0, "")
    assert "0.1*x - 0.2" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.serial
def test_what_a_killed_run_leaves_the_next_one_removes(tmp_path: Path) -> None:
    """But not what a living one is writing, nor anything else that is hidden."""
    stale, alien = tmp_path / (files.STAGE + "stale"), tmp_path / ".signorini"
    stale.mkdir()
    (stale / "solution.vtu").write_text("half")
    alien.mkdir()
    program = (
        "import sys, time\nfrom pathlib import Path\nfrom signorini_cr.output.files import _enter\n"
        f"print(_enter(Path({str(tmp_path)!r}))[0], flush=True)\ntime.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    living = Path(other.stdout.readline().strip())
    files.check_writable(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([alien, living])
    other.send_signal(signal.SIGKILL)
    other.communicate()
    files.check_writable(tmp_path)
    assert list(tmp_path.iterdir()) == [alien]


@pytest.mark.serial
@pytest.mark.parametrize("last", ["levels.csv", "report.json"])
def test_what_a_run_leaves_that_is_killed_while_it_makes_its_folder(
    tmp_path: Path, last: str
) -> None:
    """The next one into that folder removes it: nothing lies beside, in a folder that stays."""
    program = (
        "import os, signal\n"
        "def replace(a, b, do=os.replace):\n"
        "    do(a, b)\n"
        f"    if b.name == {last!r} and b.parent.name == 'out':\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "os.replace = replace"
    )
    case = kills.CASE.replace("9", "1")
    before = set(tmp_path.iterdir())
    assert helpers.altered(tmp_path, case, program, "-q").returncode == -signal.SIGKILL
    out = tmp_path / "out"
    assert (out / last).exists() and any(out.glob(files.STAGE + "*"))
    files.check_writable(out)
    assert not any(out.glob(files.STAGE + "*"))
    made = {path.name for path in set(tmp_path.iterdir()) - before}
    assert not any(name.startswith(files.STAGE) for name in made)


def test_folders_that_get_no_file_are_not_made(shared_tmp_path: Path) -> None:
    def fail(path: Path) -> None:
        raise InputError("no")

    with pytest.raises(InputError, match="no"):
        files.write_files(shared_tmp_path / "a" / "b", {"x": fail})
    COMM.Barrier()  # rank 0 tidies up
    assert not any(shared_tmp_path.iterdir())
    COMM.Barrier()
    folder = shared_tmp_path / "a" / "b"
    assert files.write_files(folder, {"x": lambda path: on_root(COMM, path.touch)}) == ["x"]
    assert [path.name for path in folder.iterdir()] == ["x"]
    COMM.Barrier()
    roundabout = shared_tmp_path / "c" / ".." / "a" / "b"
    files.write_files(roundabout, {"x": lambda path: on_root(COMM, path.touch)})
    assert (roundabout / "x").exists()


@pytest.mark.serial
def test_where_memory_does_not_do_for_a_message(tmp_path: Path) -> None:
    program = (
        "import os\nfrom signorini_cr.app import cli\n"
        "def none(*_):\n    raise MemoryError\n"
        "cli._run = none\n"
    )
    for ranks in (1, 2):
        done = helpers.altered(tmp_path, kills.CASE, program, ranks=ranks)
        assert done.returncode == cli.NOT_CONVERGED
        assert done.stderr.startswith("signorini-cr: out of memory\n")


@pytest.mark.serial
def test_what_is_kept_in_a_folder_that_is_gone(tmp_path: Path) -> None:
    kept = [{"level": 0}, {"level": 1}]
    assert what_is_kept(kept, tmp_path / "out").endswith("taken away, and what was kept in it")
    assert what_is_kept(kept, tmp_path).startswith("levels 0 to 1 are finished and kept in")


def test_a_disk_that_fills_up_keeps_the_levels_before(shared_tmp_path, monkeypatch, capfd) -> None:
    from signorini_cr.output import report as output

    (shared_tmp_path / "case.toml").write_text(kills.CASE.replace("9", "3"))
    COMM.Barrier()
    write_levels = output.write_levels

    def full(folder, report, *others):
        if len(report["levels"]) > 2:
            raise InputError("cannot write levels.csv: No space left on device")
        return write_levels(folder, report, *others)

    monkeypatch.setattr(output, "write_levels", full)
    out = shared_tmp_path / "out"
    argv = ["solve", str(shared_tmp_path / "case.toml"), "--out", str(out), "-q"]
    assert cli.main(argv) == cli.NOT_CONVERGED
    COMM.Barrier()
    assert len(json.loads((out / "report.json").read_text())["levels"]) == 2
    words = " ".join(capfd.readouterr().err.split())
    if COMM.rank == 0:
        assert "--out: cannot write levels.csv: No space left on device levels 0 to 1" in words
        assert words.endswith(f"are finished and kept in {out}")


@pytest.mark.serial
@pytest.mark.parametrize(
    "number, word, expected",
    [
        (signal.SIGINT, "interrupted", 130),
        (signal.SIGTERM, "terminated", 143),
        (signal.SIGHUP, "terminated", 129),
        (signal.SIGXCPU, "terminated", 152),
    ],
)
def test_an_interruption_inside_a_callback_is_one(
    number: signal.Signals, word: str, expected: int, tmp_path: Path, monkeypatch, capsys
) -> None:
    """In the midst of PETSc, which makes an error of its own of it; two levels are done."""
    (tmp_path / "case.toml").write_text(kills.CASE)
    step = cli.Screen.step

    def interrupted(self: cli.Screen, text: str) -> None:
        step(self, text)
        if "level 2" in text:
            os.kill(os.getpid(), number)

    monkeypatch.setattr(cli.Screen, "step", interrupted)
    out = tmp_path / "out"
    status = cli.main(["solve", str(tmp_path / "case.toml"), "--out", str(out), "-q"])
    words = " ".join(capsys.readouterr().err.split())
    assert status == expected
    assert words == f"signorini-cr: {word}; levels 0 to 1 are finished and kept in {out}"
    assert len(json.loads((out / "report.json").read_text())["levels"]) == 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.serial
def test_a_terminal_that_is_closed_ends_a_run(tmp_path: Path) -> None:
    """MPI's libraries may set handlers of their own, when they are loaded."""
    program = (
        "import os, signal\nfrom signorini_cr.app import cli\n"
        "def step(self, text):\n"
        "    if 'level 2' in text:\n        os.kill(os.getpid(), signal.SIGHUP)\n"
        "cli.Screen.step = step"
    )
    done = helpers.altered(tmp_path, kills.CASE, program, "-q")
    assert done.returncode == 129
    assert " ".join(done.stderr.split()).startswith("signorini-cr: terminated; levels 0 to 1 are")


@pytest.mark.serial
def test_a_signal_is_not_lost_in_a_finalizer() -> None:
    """Python drops what is raised there, and would go on as if nothing had been asked."""

    class Thing:
        pass

    def told(_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)

    thing = Thing()
    watch = weakref.ref(thing, told)
    with signals.interruptible() as asked:
        del thing
        assert watch() is None and asked == [signal.SIGTERM]
        with pytest.raises(KeyboardInterrupt):
            for _ in range(300):
                time.sleep(0.01)


@pytest.mark.serial
@pytest.mark.parametrize("case, first", [("uniform", "levels 0 to"), ("time", "steps 1 to")])
def test_told_while_files_are_put_in_place(
    case: str, first: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    """What is there then is what is told: the signal waits until both are done."""
    text = kills.CASES[case].replace("levels = 9", "levels = 3")
    (tmp_path / "case.toml").write_text(text)
    replace, out = os.replace, tmp_path / "out"
    calls: list[str] = []

    def replaced(source: Path, target: Path) -> None:
        replace(source, target)
        calls.append(Path(target).name)
        if calls.count("report.json") == 2 and calls[-1] == "report.json":
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)

    monkeypatch.setattr(os, "replace", replaced)
    assert cli.main(["solve", str(tmp_path / "case.toml"), "--out", str(out), "-q"]) == 143
    words = " ".join(capsys.readouterr().err.split())
    number = kills.levels_in(out)
    last = number - 1 if case == "uniform" else number
    assert number >= 2
    assert words.endswith(f"terminated; {first} {last} are finished and kept in {out}")


@pytest.mark.serial
def test_a_rank_without_the_others_does_not_solve_alone(tmp_path: Path, monkeypatch) -> None:
    """As where mpirun was killed while the ranks were starting, or belongs to another MPI."""
    (tmp_path / "case.toml").write_text(kills.CASE)
    monkeypatch.setenv("PMI_SIZE", "2")
    status = cli.main(["solve", str(tmp_path / "case.toml"), "--out", str(tmp_path / "out")])
    assert status == cli.BAD_INPUT
    assert not (tmp_path / "out").exists()


@pytest.mark.serial
def test_a_signal_waits_for_an_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library that is being loaded is loaded; then the run ends."""
    (tmp_path / "told_while_loading.py").write_text(
        "import os, signal, time\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
        "time.sleep(0.2)\n"
        "loaded = 1\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with signals.interruptible() as asked:
        module = importlib.import_module("told_while_loading")
        with pytest.raises(KeyboardInterrupt):
            time.sleep(5.0)
    assert module.loaded == 1 and set(asked) == {signal.SIGTERM}


@pytest.mark.serial
def test_told_twice_is_told_once() -> None:
    """By the terminal and by mpirun: the second must not disturb what ends the run."""
    with signals.interruptible() as asked:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5.0)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)
    assert asked == [signal.SIGINT, signal.SIGTERM]
