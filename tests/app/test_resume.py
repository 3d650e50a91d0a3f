"""Runs that go on from the last level of another one, and levels that are refused beforehand."""

import json
import math
import os
import resource
from collections.abc import Callable
from pathlib import Path

import helpers
import kills
import numpy as np
import pytest
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    Neumann,
    Polygon,
    Problem,
    Solver,
    limits,
    memory,
    solve,
    solve_adaptive,
    solve_levels,
)
from signorini_cr.app import cli, run
from signorini_cr.errors import InputError, NotConverged
from signorini_cr.fem.physics import OnMesh
from signorini_cr.output import checkpoint
from signorini_cr.restart import Restart
from signorini_cr.vi.system import System

pytestmark = pytest.mark.slow

COMM = MPI.COMM_WORLD
CASE = """[domain]
vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
boundary = ["contact", "dirichlet", "dirichlet", "dirichlet"]
size = 0.5
[data]
f = -3
obstacle = "0.1*x - 0.2"
[refine]
mode = "MODE"
levels = 4
"""
MODES = ("uniform", "adaptive")


CORNERS = np.array([[-1, 0], [1, 0], [1, 1], [-1, 1]])


def rectangle(size: float) -> Domain:
    parts = ("contact", "dirichlet", "dirichlet", "dirichlet")
    return Polygon(CORNERS, parts).mesh(size)


@pytest.fixture
def case(shared_tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Write case.toml into the folder of the test, which is the current one."""
    monkeypatch.chdir(shared_tmp_path)
    helpers.undrawn(monkeypatch)

    def write(mode: str = "uniform", old: str = "", new: str = "") -> None:
        if COMM.rank == 0:
            Path("case.toml").write_text(CASE.replace("MODE", mode).replace(old, new))
        COMM.Barrier()

    return write


def solved(*words: object, out: str = "out") -> int:
    COMM.Barrier()  # all have looked at what is there before one begins to write
    status = cli.main(["solve", "case.toml", "--out", out, "-q", *map(str, words)])
    COMM.Barrier()
    return status


def report(out: str = "out") -> dict:
    found: dict = json.loads(Path(out, "report.json").read_text())
    return found


def assert_same(one: dict, other: dict) -> None:
    """All figures, but for iterations and seconds; contact forces are known to 1e-7."""
    for a, b in zip(one["levels"], other["levels"], strict=True):
        for key, close in {"cells": 0.0, "dofs": 0.0, "h": 1e-15, "energy": 1e-9}.items():
            assert a[key] == pytest.approx(b[key], rel=close), key
        assert (a["bound_h1"] or 0) == pytest.approx(b["bound_h1"] or 0, rel=1e-7)
        for key in ("facets", "active"):
            assert a["contact"][key] == b["contact"][key]
        assert a["contact"]["length"] == pytest.approx(b["contact"]["length"], rel=1e-12)
        assert a["contact"]["force"] == pytest.approx(b["contact"]["force"], rel=2e-7)
        points = [np.array(each["contact"]["transitions"]) for each in (a, b)]
        assert points[0] == pytest.approx(points[1], abs=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_a_run_that_is_resumed_ends_as_if_it_had_not_ended(mode: str, case, capfd) -> None:
    case(mode)
    assert solved(out="whole") == 0
    assert solved("--levels", 2) == 0
    kept = report()["levels"]
    assert len(kept) == 2
    assert solved("--resume") == 0
    assert report()["levels"][:2] == kept
    assert_same(report(), report("whole"))
    assert report()["complete"] is True
    assert set(os.listdir("out")) == set(os.listdir("whole"))
    before = report()
    assert solved("--resume") == 0  # nothing is left to do
    assert report() == before
    assert capfd.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("mode, first, then", [("uniform", 1, 2), ("adaptive", 2, 1)])
def test_on_another_number_of_ranks(mode: str, first: int, then: int, case) -> None:
    case(mode)
    assert solved(out="whole") == 0
    for ranks, words in ((first, ("--levels", "3")), (then, ("--resume",))):
        if ranks == 1:  # as this process is
            assert solved(*words) == 0
            continue
        argv = "solve", "case.toml", "--out", "out", *words
        done = helpers.undrawn_command(*argv, ranks=ranks)
        assert done.returncode == 0, done.stderr
    assert_same(report(), report("whole"))


def test_p1_is_resumed_as_well(case) -> None:
    case()
    assert solved("--element", "p1", "--levels", 3, out="whole") == 0
    assert solved("--element", "p1", "--levels", 2) == 0
    assert solved("--element", "p1", "--resume", "--levels", 3) == 0
    assert_same(report(), report("whole"))


def test_where_there_is_nothing_a_resumed_run_begins(case) -> None:
    case()
    assert solved("--resume", "--levels", 2) == 0
    assert len(report()["levels"]) == 2


@pytest.mark.parametrize(
    "old, new, words, told",
    [
        ("f = -3", "f = -2", [], "data.f was -3 and is -2"),
        ("size = 0.5", "size = 0.4", [], "domain.size was 0.5 and is 0.4"),
        ("uniform", "adaptive", [], 'refine.mode was "uniform" and is "adaptive"'),
        ("", "", ["--element", "p1"], '--element was "cr" and is "p1"'),
        ("[refine]", "g = 1\n[refine]", [], "data.g was not given and is 1"),
        ("[refine]", "[time]\nend = 1\nsteps = 2\n[refine]", [], "time.end was not given and is 1"),
        (
            "[refine]",
            '[quantities]\nall = { mean = "domain" }\n[refine]',
            [],
            'quantities.all was not given and is {"mean": "domain"}',
        ),
    ],
)
def test_another_problem_is_refused(old, new, words, told, case, capfd) -> None:
    case()
    assert solved("--levels", 2) == 0
    before = Path("out", "report.json").read_bytes()
    case("uniform", old, new)
    assert solved("--resume", *words) == cli.BAD_INPUT
    error = " ".join(capfd.readouterr().err.split())
    if COMM.rank == 0:
        assert "case.toml: --resume: out has results of another run:" in error
        assert told in error
    assert Path("out", "report.json").read_bytes() == before


def _behind(path: Path) -> None:
    np.savez(path, sum=np.zeros(1))
    path.write_bytes(b"\0" * 8 + path.read_bytes())


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "nothing": (lambda path: path.write_bytes(b""), "it is no archive"),
    "a beginning": (lambda path: path.write_bytes(b"PK"), "it is no archive"),
    "an archive behind something": (_behind, "it is no archive"),
    "text": (lambda path: path.write_text("no archive"), "it is no archive"),
    "a pipe": (os.mkfifo, "this is a device or a pipe; a file is needed"),
    "zeros": (lambda path: path.symlink_to("/dev/zero"), "this is a device or a pipe"),
    "much": (lambda path: path.open("wb").truncate(2**34), "it is no archive"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_refused(damage: str, case, capfd) -> None:
    """Before anything is read from it that may have no end."""
    case()
    make, words = DAMAGES[damage]
    if COMM.rank == 0:
        Path("out").mkdir()
        make(Path("out", checkpoint.NAME))
    assert solved("--resume") == cli.BAD_INPUT
    if COMM.rank == 0:
        said = " ".join(capfd.readouterr().err.split())
        assert "--resume: cannot read out/restart.npz: " + words in said


def rewritten(change: Callable[[dict, dict], None]) -> None:
    """An archive that is in order, with other content."""
    path = Path("out", checkpoint.NAME)
    with np.load(path) as file:
        arrays = dict(file)
    text = json.loads(bytes(arrays["facts"]))
    change(arrays, text)
    if "facts" in arrays:
        arrays["facts"] = np.frombuffer(json.dumps(text).encode(), dtype=np.uint8)
    np.savez(path, **arrays)


CHANGES = {
    "no levels": lambda arrays, text: text["facts"].pop("levels"),
    "no problem": lambda arrays, text: text["facts"].pop("said"),
    "levels of nothing": lambda arrays, text: text["facts"].update(levels=[{}, {}]),
    "many meshes": lambda arrays, text: text.update(meshes=99),
    "fewer than none": lambda arrays, text: text.update(meshes=-1),
    "other values": lambda arrays, text: arrays.update(u0=arrays["u0"] + 1.0),
    "not a number": lambda arrays, text: arrays.update(u0=np.nan * arrays["u0"]),
    "too short": lambda arrays, text: arrays.update(u0=arrays["u0"][:5]),
    "words": lambda arrays, text: arrays.update(at0=np.full(len(arrays["at0"]), "a")),
    "nothing known": lambda arrays, text: arrays.pop("facts"),
    "no sum": lambda arrays, text: arrays.pop("sum"),
    "objects": lambda arrays, text: arrays.update(at0=np.array([None, 1])),
}


@pytest.mark.serial
def test_a_file_that_was_changed_is_refused(case, capfd) -> None:
    """Also where all looks in order; nothing is solved for a look."""
    case()
    assert solved("--levels", 2) == 0
    path = Path("out", checkpoint.NAME)
    whole = path.read_bytes()
    for name, change in CHANGES.items():
        path.write_bytes(whole)
        rewritten(change)
        assert solved("--resume") == cli.BAD_INPUT, name
        error = " ".join(capfd.readouterr().err.split())
        assert "--resume: cannot read out/restart.npz: " in error, name
        assert "it is to be removed, and the run begun anew" in error
    path.write_bytes(whole)
    assert solved("--resume") == 0


@pytest.mark.serial
def test_damaged_archives_are_read_or_refused(case) -> None:
    """Headers and the table of contents are hit as often as the rest."""
    case()
    assert solved("--levels", 2) == 0
    path = Path("out", checkpoint.NAME)
    whole, ends = path.read_bytes(), []
    random = np.random.default_rng(1)
    for _ in range(400):
        data = bytearray(whole)
        if random.random() < 0.3:
            del data[random.integers(len(data)) :]
        else:
            near = random.integers(400, size=4)
            places = [random.integers(len(data)), near[0], near[1], len(data) - 1 - near[2]]
            for at in random.choice(places, size=2):
                data[at] ^= 1 << random.integers(8)
        path.write_bytes(data)
        try:
            ends.append(checkpoint.read_checkpoint("out", MPI.COMM_SELF) is not None)
        except InputError:
            ends.append(False)
    assert 0 < sum(ends) < 200  # a few bits mean nothing, those of dates


def test_another_mesh_is_noticed() -> None:
    problem = Problem(f=-3.0, obstacle=-0.2)
    (solution,) = solve_levels(problem, rectangle(0.5), 1)
    restart = COMM.bcast(Restart.of(solution, None, adaptive=False))
    with pytest.raises(InputError, match="the mesh is not the one"):
        next(solve_levels(problem, rectangle(0.4), 2, restart=restart))


def test_from_python_the_steps_are_those_of_a_run_in_one_piece() -> None:
    """One more Newton step on the mesh it goes on from, at most; the same on those above."""
    problem, domain = Problem(f=-3.0, obstacle=lambda x: 0.1 * x[0] - 0.2), rectangle(0.5)
    whole = list(solve_adaptive(problem, domain, levels=6))
    restart = None
    for each in whole[:4]:
        restart = Restart.of(each, restart, adaptive=True)
    restart = COMM.bcast(restart)
    rest = list(solve_adaptive(problem, domain, levels=6, restart=restart))
    assert [each.level.number for each in rest] == [3, 4, 5]
    assert rest[0].iterations.newton <= 1
    for one, other in zip(rest, whole[3:], strict=True):
        assert one.cells == other.cells
        assert one.energy == pytest.approx(other.energy, rel=1e-10)
        assert one.contact.number_active == other.contact.number_active
    for one, other in zip(rest[1:], whole[4:], strict=True):
        assert one.iterations.newton == other.iterations.newton


@pytest.mark.parametrize("wall", [Dirichlet(0.0), Neumann()])
def test_meshes_that_are_solved_already_are_not_assembled(wall, monkeypatch) -> None:
    """But the first, which tells whether something holds all of the domain."""
    problem = Problem(f=-1.0, conditions={"floor": Contact(0.0), "wall": wall})
    sides = ("floor", "wall", "wall", "wall")
    domain = Polygon(CORNERS, sides, names=("floor", "wall")).mesh(0.5)
    first, second, third, fourth = solve_levels(problem, domain, 4)
    restart = Restart.of(second, Restart.of(first, None, False), False)
    restart = COMM.bcast(Restart.of(third, restart, False))
    assembled = []
    data = System.__init__

    def counted(system: System, on_mesh: OnMesh, *more: object) -> None:
        assembled.append(on_mesh.domain.mesh)
        data(system, on_mesh, *more)

    monkeypatch.setattr(System, "__init__", counted)
    again, last = solve_levels(problem, domain, 4, restart=restart)
    assert [again.cells, last.cells] == [third.cells, fourth.cells]
    assert len(assembled) == 3 and assembled[0] is domain.mesh
    assert last.energy == pytest.approx(fourth.energy, rel=1e-10)


@pytest.mark.parametrize("mode", MODES)
def test_a_level_that_would_end_too_late_is_not_begun(mode: str, case, monkeypatch, capfd) -> None:
    """Levels take as long as their dofs say: the last one has to be left out."""
    now = 0.0

    class Clock:
        @staticmethod
        def perf_counter() -> float:
            return now

    monkeypatch.setattr(limits, "time", Clock)
    admit = limits.Limits.admit

    def after(self, solution, dofs, *others) -> None:
        nonlocal now
        now += solution.dofs
        admit(self, solution, dofs, *others)

    monkeypatch.setattr(limits.Limits, "admit", after)
    case(mode)
    assert solved(out="whole") == 0
    dofs = [each["dofs"] for each in report("whole")["levels"]]
    assert solved("--max-time", sum(dofs) - dofs[-1] + 60) == cli.NOT_CONVERGED
    assert_same({"levels": report()["levels"]}, {"levels": report("whole")["levels"][:-1]})
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        assert "case.toml: stopped on level 3: its" in error
        assert "of the time limit there are" in error
        assert "levels 0 to 2 are finished and kept in out" in error
    assert report()["complete"] is False
    now = 0.0
    assert solved("--resume", "--max-time", 10 * sum(dofs)) == 0
    assert_same(report(), report("whole"))


def test_time_grows_as_between_the_last_two_levels(monkeypatch) -> None:
    """1, 2 and 5 seconds at 10, 20 and 50 dofs: 100 dofs take 10, and 8 are left of 16."""

    class Clock:
        times = iter([0.0, 1.0, 3.0, 8.0])

        @classmethod
        def perf_counter(cls) -> float:
            return next(cls.times)

    class Done:
        """Of a solution what is looked at."""

        def __init__(self, number: int, dofs: int) -> None:
            self.level = type("Level", (), {"number": number})
            self.domain = type("Domain", (), {"mesh": type("Mesh", (), {"comm": COMM})})
            index_map = type("Map", (), {"size_local": dofs, "size_global": dofs})
            dofmap = type("Dofmap", (), {"index_map": index_map, "index_map_bs": 1})
            self.u = type("U", (), {"function_space": type("V", (), {"dofmap": dofmap})})

    monkeypatch.setattr(limits, "time", Clock)
    some = limits.Limits(16.0)
    some.admit(Done(0, 10), 20)
    some.admit(Done(1, 20), 50)
    with pytest.raises(NotConverged, match=r"its 100 .* about 10 s, and .* are 8 s left") as caught:
        some.admit(Done(2, 50), 100)
    assert caught.value.level == 3


def test_another_mesh_is_refused(case, monkeypatch, capfd) -> None:
    """As another gmsh may make of the same polygon: here the mesh of another size."""
    case()
    assert solved("--levels", 2) == 0
    before = report()
    there = Restart.of(solve(Problem(), rectangle(0.4)), None, adaptive=False)
    another = Restart((), COMM.bcast(there.u))  # as it is read
    monkeypatch.setattr(Restart, "meshes", lambda self, domain: iter(()))
    read = run.read_checkpoint
    monkeypatch.setattr(run, "read_checkpoint", lambda *place: (another, read(*place)[1]))
    capfd.readouterr()
    assert solved("--resume") == cli.BAD_INPUT
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        assert "--resume: the mesh is not the one that the levels before were solved on: " in error
        assert error.endswith("; another --out begins anew")
    assert report() == before


@pytest.mark.serial
@pytest.mark.parametrize("seconds", ["0.01", "2"])
@pytest.mark.parametrize("ranks", [1, 2])
def test_little_time_is_enough_for_the_first_level(seconds: str, ranks: int, tmp_path) -> None:
    """And ranks that were started apart have different times left."""
    program = (
        "from signorini_cr.app import cli, commandline\nrun = cli._run\n"
        "def begun_apart(args, *others):\n"
        "    args.began -= 1.9 * commandline.launched()[0]\n    return run(args, *others)\n"
        "cli._run = begun_apart"
    )
    words = "-q", "--max-time", seconds
    done = helpers.altered(tmp_path, kills.CASE, program, *words, ranks=ranks, seconds=60)
    assert done.returncode == cli.NOT_CONVERGED, done.stderr
    words = " ".join(done.stderr.split())
    assert words.count("of the time limit there are") == 1 and "finished and kept" in words


def test_a_level_that_memory_does_not_hold_is_refused(case, monkeypatch, capfd) -> None:
    """100 MB are left: too little for 400,000 dofs at 0.8 kB, enough for 500."""
    monkeypatch.setattr(memory, "_spare", lambda: 1e8)
    # what tests before this one have held and given back, of which 1e8 would have to be more
    status = memory._status
    monkeypatch.setattr(memory, "_status", lambda: (found := status()) | {"VmHWM": found["VmRSS"]})
    assert memory.shortage(COMM, 1e9) is not None
    monkeypatch.setattr(limits, "BYTES", 2e5)
    case()
    assert solved() == cli.NOT_CONVERGED
    levels = report()["levels"]
    dofs = [each["dofs"] for each in levels]
    assert 2e5 * 3 * dofs[-1] > 1e8  # and that of the level before was not
    assert len(dofs) < 4
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        assert f"stopped on level {len(dofs)}: its {4 * dofs[-1]} degrees of freedom would" in error
        assert "GB more memory, and there are 0.1 GB" in error


@pytest.mark.parametrize("element, dim", [("CR", 1), ("P1", 0)])
def test_so_is_a_first_level(element: str, dim: int, monkeypatch) -> None:
    """After a restart it is the last one that was solved; one byte is left."""
    problem, domain = Problem(f=-3.0, obstacle=-0.2), rectangle(0.5)
    coarse, fine = solve_levels(problem, domain, 2, element)
    restart = Restart.of(fine, Restart.of(coarse, None, False), False)
    monkeypatch.setattr(memory, "_spare", lambda: 1.0)
    dofs = domain.mesh.topology.index_map(dim).size_global
    for start, number, count in ((None, 0, dofs), (COMM.bcast(restart), 1, fine.dofs)):
        with pytest.raises(NotConverged, match=f"its {count} degrees of freedom") as caught:
            next(solve_levels(problem, domain, 2, element, restart=start))
        assert caught.value.level == number


def test_so_are_meshes_of_a_solver() -> None:
    """Of 20 meshes: 10^13 dofs, which no machine holds; none of them is begun."""
    domain = rectangle(0.5)
    with pytest.raises(NotConverged, match="degrees of freedom would take about") as caught:
        Solver(Problem(f=-3.0, obstacle=-0.2), domain, levels=20)
    assert caught.value.level == 19


@pytest.mark.serial
def test_what_is_left(monkeypatch, tmp_path: Path) -> None:
    """Of the address space, of the machine, and of cgroups of both versions, caches added."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    peak = memory._status()["VmPeak"]
    try:
        resource.setrlimit(resource.RLIMIT_AS, (int(peak + 2e9), hard))
        assert memory.shortage(COMM, 1e9) is None
        assert memory.shortage(COMM, 3e9) == "3 GB more memory, and ulimit -v leaves 2 GB"
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    text = {
        "/proc/meminfo": "MemTotal: 9000000 kB\nMemAvailable: 5000000 kB\n",
        "/proc/self/cgroup": "4:memory:/a/b\n3:cpu:/a\n0::/c\n",
        "memory/a/memory.limit_in_bytes": "4000000000\n",
        "memory/a/memory.usage_in_bytes": "3500000000\n",
        "memory/a/memory.stat": "active_file 7\ntotal_inactive_file 300000000\n",
        "c/memory.max": "max\n",
        "c/memory.current": "1\n",
        "memory.max": "2000000000\n",
        "memory.current": "1900000000\n",
        "memory.stat": "anon 5\ninactive_file 100000000\nactive_file 50000000\n",
    }

    def told(path: Path) -> str:
        name = path.relative_to(memory.CGROUPS) if path.is_relative_to(memory.CGROUPS) else path
        return text.get(str(name), "")

    monkeypatch.setattr(memory, "_text", told)
    assert memory._spare() == 250_000_000
    del text["memory.max"]
    assert memory._spare() == 800_000_007
    del text["memory/a/memory.limit_in_bytes"]
    assert memory._spare() == 5_120_000_000
    text.clear()
    assert memory._spare() == math.inf
