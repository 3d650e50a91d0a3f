"""[time] in a problem file: what is solved, what is left behind, what is refused."""

import csv
import functools
import json
import math
import os
import re
import shutil
import signal
import xml.etree.ElementTree as ET
from itertools import pairwise

import helpers
import numpy as np
import pytest
from helpers import is_picture
from mpi4py import MPI

from signorini_cr import evolution, limits, memory
from signorini_cr.app import cli, timerun
from signorini_cr.app.cli import main
from signorini_cr.app.formula import Clock
from signorini_cr.errors import NotConverged
from signorini_cr.output.meanings import REPORT, STEP
from signorini_cr.output.report import FILES
from signorini_cr.output.series import is_kept

pytestmark = pytest.mark.slow

COMM = MPI.COMM_WORLD
CASE = """[domain]
vertices = [[0, 0], [1, 0], [1, 1], [0, 1]]
boundary = ["contact", "neumann", "dirichlet", "neumann"]
size = 0.4
[define]
wave = "sin(4*t)"
[data]
f = "-20*wave*x"
obstacle = "-0.1 - 0.02*t"
[time]
end = 1.5
steps = 6
initial = "0.1*(y - 1)"
capacity = "1 + 1"
[quantities]
inflow = { flux = "dirichlet" }
whole = { mean = "domain" }
"""


@pytest.fixture
def case(shared_tmp_path):
    """Writes a problem file and gives its path."""

    def write(text=CASE):
        path = shared_tmp_path / "case.toml"
        if COMM.rank == 0:
            path.write_text(text, encoding="utf-8")
        COMM.Barrier()
        return path

    return write


@pytest.fixture
def undrawn(monkeypatch):
    """Without pictures."""
    helpers.undrawn(monkeypatch)


def in_scheme(scheme):
    """The case by the name of its scheme; "adaptive" is bdf2 on a mesh that is adapted to it."""
    if scheme == "adaptive":
        return in_scheme("bdf2") + '[refine]\nmode = "adaptive"\nmax_dofs = 300\n'
    return CASE.replace("steps = 6", f'steps = 6\nscheme = "{scheme}"')


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Gives what a run that nothing ends leaves behind, made once for a scheme; one is drawn."""
    folder = COMM.bcast(tmp_path_factory.mktemp("whole"), root=0)

    @functools.cache
    def made(scheme):
        path = folder / scheme / "case.toml"
        if COMM.rank == 0:
            path.parent.mkdir()
            path.write_text(in_scheme(scheme), encoding="utf-8")
        with pytest.MonkeyPatch.context() as patch:
            if scheme != "bdf2":
                helpers.undrawn(patch)
            assert solved(path, path.parent / "out") == 0
        return path.parent / "out"

    return made


def steps_by_hand():
    """Implicit Euler on the same mesh, in Python."""
    import ufl
    from dolfinx import fem

    from signorini_cr import Contact, Dirichlet, Neumann, Problem, solve_in_time

    domain = helpers.HELD_ABOVE.mesh(0.4)
    t = fem.Constant(domain.mesh, 0.0)
    problem = Problem(
        f=lambda x: -20 * ufl.sin(4 * t) * x[0],
        conditions={
            "contact": Contact(-0.1 - 0.02 * t),
            "neumann": Neumann(),
            "dirichlet": Dirichlet(0.0),
        },
    )
    return [
        (time, solution.contact.force, solution.contact.number_active)
        for time, solution in solve_in_time(
            problem, domain, end=1.5, steps=6, time=t, capacity=2.0,
            initial=lambda x: 0.1 * (x[1] - 1),
        )
    ]  # fmt: skip


def test_what_a_run_in_time_leaves_behind(case, shared_tmp_path, capsys):
    """The figures are those of Python; table, report, series and fields agree with one another."""
    out = shared_tmp_path / "out"
    if COMM.rank == 0:
        out.mkdir()
        for name in ("report.json", "step_00099.vtu", "convergence.png", "mine.txt"):
            (out / name).write_text("of a former run")
    COMM.Barrier()
    assert main(["solve", str(case()), "--out", str(out)]) == 0
    expected = steps_by_hand()
    if COMM.rank > 0:
        return
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80
    flat = " ".join(printed.split())
    assert "t from 0 to 1.5 in 6 steps of euler; 2 ∂u/∂t" in flat
    for words in ("force: ∫_Γ1 λ_h; ", "certified: in no step is ", "s for 6 steps, "):
        assert words in flat
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    with (out / "times.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    asked = [
        f"quantities_{name}_{key}"
        for name in ("inflow", "whole")
        for key in ("kind", "weighted", "value", "lower", "upper", "reason")
    ]
    assert list(report["times"][0]) == list(STEP)
    assert set(report) <= {name.partition(".")[0] for name in REPORT}
    ends = ["energy_bounds_lower", "energy_bounds_upper"]
    several = {"quantities": asked, "energy_bounds": ends}
    columns = [several.get(name, [name]) for name in STEP]
    assert list(rows[0]) == [name for names in columns for name in names]
    assert len(rows) == len(report["times"]) == len(expected) == 6
    for step, (row, record, (time, force, active)) in enumerate(
        zip(rows, report["times"], expected, strict=True), start=1
    ):
        assert int(row["step"]) == record["step"] == step
        assert record["time"] == pytest.approx(time) == 0.25 * step
        assert record["force"] == pytest.approx(force, rel=1e-7, abs=1e-10)
        assert float(row["force"]) == record["force"]
        assert record["active"] == active
        assert record["bound_h1"] > 0.0
        assert record["energy_bounds"]["lower"] <= record["energy_bounds"]["upper"]
    assert {record["active"] > 0 for record in report["times"]} == {True, False}
    series = ET.parse(out / "series.pvd").getroot()
    named = [(each.get("timestep"), each.get("file")) for each in series.iter("DataSet")]
    assert [float(t) for t, _ in named] == pytest.approx(np.arange(1, 7) * 0.25)
    assert sorted(path.name for path in out.glob("step_*.vtu")) == [name for _, name in named]
    assert not (out / "convergence.png").exists() and (out / "mine.txt").exists()
    assert is_picture(out / "strip.png")
    for row, record in zip(rows, report["times"], strict=True):
        for name, found in record["quantities"].items():
            assert found["lower"] < found["value"] < found["upper"]
            assert float(row[f"quantities_{name}_upper"]) == found["upper"]
    assert len({record["quantities"]["whole"]["value"] for record in report["times"]}) == 6
    for name in ("inflow", "whole"):
        ends = [
            pick(record["quantities"][name][end] for record in report["times"])
            for pick, end in ((min, "lower"), (max, "upper"))
        ]
        certain = "certified: in no step's own problem, in which the steps before are data,"
        told = re.search(rf"{certain} is {name} outside \[(.*?), (.*?)\]", flat)
        low, high = (float(text.replace("−", "-")) for text in told.groups())
        assert low <= ends[0] and ends[1] <= high
        assert (low, high) == pytest.approx(ends, rel=0.1, abs=0.1)
    (level,) = report["levels"]
    assert level["quantities"] == report["times"][-1]["quantities"]
    assert level["contact"]["force"] == report["times"][-1]["force"]
    for found in level["quantities"].values():
        assert found["lower"] < found["value"] < found["upper"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("end = 1.5", "end = 0", "time.end: a number above 0 is needed"),
        ("end = 1.5\n", "", "time.end: this key is missing"),
        ("end = 1.5", "end = 1e-320", "time.end: 9.99989e-321 is too little for numbers"),
        ("end = 1.5", "end = 8e307", "time.end: 8e+307 is too much for numbers to tell"),
        ("steps = 6", "steps = 2.5", "time.steps: a whole number is needed"),
        ("steps = 6", 'steps = 6\nscheme = "trapez"', "time.scheme"),
        ('capacity = "1 + 1"', 'capacity = "x"', "time.capacity: a number above 0 is needed"),
        ('capacity = "1 + 1"', "capacity = -1", "time.capacity: a number above 0 is needed"),
        ('initial = "0.1*(y - 1)"', 'initial = "t"', "time.initial: this must not depend on t"),
        (
            "[data]",
            '[data]\ncoefficient = "1 - t"',
            "is 0; it must be above 0 everywhere, at the time 1",
        ),
        ("[data]", '[data]\nreaction = "x - t"', "must be 0 or more everywhere, at the time 0.25"),
        (
            'dirichlet", "neumann"]\nsize = 0.4\n[define]\nwave = "sin(4*t)"\n[data]',
            'dirichlet", "dirichlet"]\nsize = 0.4\n[define]\nwave = "sin(4*t)"\n[data]\n'
            'dirichlet = "-0.2*t"',
            "only -0.15; the obstacle must not be above it, at the time 0.75",
        ),
        ("wave =", "t = 1\nwave =", "define.t: t is the time"),
        ("wave =", '"ｔ" = 1\nwave =', "define.ｔ: t is the time"),
        ("[time]", '[exact]\nu = "x"\n[time]', "exact.u: a problem in time has none"),
    ],
)
def test_what_makes_no_sense_in_time(old, new, said, case, shared_tmp_path, capfd):
    assert old in CASE
    out = shared_tmp_path / "out"
    path = case(CASE.replace(old, new))
    assert main(["solve", str(path), "--out", str(out)]) == 2
    if COMM.rank == 0:
        assert said in " ".join(capfd.readouterr().err.split())
        assert not out.exists()


def test_fields_of_steps_go_where_another_run_has_none(case, undrawn, shared_tmp_path):
    """Beside a report lies what is of its run, and what is the user's own."""
    out = shared_tmp_path / "out"
    assert solved(case(), out) == 0
    assert len([*out.glob("step_*.vtu")]) == 6
    COMM.Barrier()
    if COMM.rank == 0:
        (out / "mine.txt").write_text("kept")
    static = CASE.partition("[time]")[0].replace("sin(4*t)", "1").replace(" - 0.02*t", "")
    assert solved(case(static), out) == 0
    names = {path.name for path in out.iterdir()}
    assert {"mine.txt", "solution.vtu"} <= names and not names & {"times.csv", "series.pvd"}
    assert not any(name.startswith("step_") for name in names)


@pytest.mark.parametrize("steady", [True, False])
def test_files_of_somebody_else_stay(steady, case, undrawn, shared_tmp_path):
    """Though they are called as a run's might be: where no run has been none is a run's."""
    out, own = shared_tmp_path / "out", CASE.partition("[time]")[0].replace("sin(4*t)", "1")
    own = own.replace(" - 0.02*t", "") if steady else CASE
    others = [*FILES, "step_mine.vtu", "step_00077.vtu", "step_1.vtu", "step_000001_old.vtu"]
    others.remove("report.json")  # which would tell of a run, and so would what it resumes from
    others.remove("restart.npz")
    if COMM.rank == 0:
        out.mkdir()
        for name in others:
            (out / name).write_text("mine")
    for time in range(2):
        assert solved(case(own), out) == 0
        mine = {name for name in others if (out / name).exists()}
        mine = {name for name in mine if (out / name).read_bytes() == b"mine"}
        COMM.Barrier()
        fields = {"step_mine.vtu", "step_1.vtu", "step_000001_old.vtu"}
        if time == 0:
            assert fields | {"step_00077.vtu", "report.html", "check.png"} <= mine
            assert ("times.csv" in mine) == steady
        else:
            assert mine == fields


@pytest.mark.parametrize("option", ["--element=p1"])
def test_options_that_do_not_go_with_time(option, case, shared_tmp_path, capfd):
    assert main(["solve", str(case()), "--out", str(shared_tmp_path / "out"), option]) == 2
    if COMM.rank == 0:
        error = capfd.readouterr().err
        assert option.split("=")[0] in error and "problems in time" in error


def solved(path, out, *words):
    COMM.Barrier()
    status = main(["solve", str(path), "--out", str(out), "-q", *map(str, words)])
    COMM.Barrier()
    return status


def report_in(out):
    return json.loads((out / "report.json").read_text(encoding="utf-8"))


def assert_same(one, other):
    """All figures of all steps, and of the last one, but for iterations and seconds."""
    one, other = map(report_in, (one, other))
    pairs = zip(one["times"], other["times"], strict=True)
    for a, b in [*pairs, (one["levels"][0], other["levels"][0])]:
        for key in a.keys() & {"step", "time", "active", "cells", "dofs"}:
            assert a[key] == b[key], key
        for key in a.keys() & {"energy", "force", "length", "bound_h1"}:
            assert a[key] == pytest.approx(b[key], rel=1e-6, abs=1e-9), key
    for name, a in one["levels"][0]["quantities"].items():
        b = other["levels"][0]["quantities"][name]
        assert [a[k] for k in ("lower", "value", "upper")] == pytest.approx(
            [b[k] for k in ("lower", "value", "upper")], rel=1e-6
        )
    assert (one["complete"], one["title"]) == (other["complete"], other["title"])


@pytest.mark.parametrize("scheme", ["euler", "bdf2", "adaptive"])
@pytest.mark.parametrize("after", [1, 2, 4])
def test_a_run_that_is_resumed_ends_as_if_it_had_not_ended(
    scheme, after, case, whole, shared_tmp_path, monkeypatch, capfd
):
    """Ended in the midst of a step; what was finished before is there, and nothing is lost.

    One of them draws, which takes most of the time that all this takes.
    """
    path, whole, draws = case(in_scheme(scheme)), whole(scheme), (scheme, after) == ("bdf2", 2)
    out = shared_tmp_path / "out"
    if not draws:
        helpers.undrawn(monkeypatch)
    with monkeypatch.context() as patch:
        original, begin = evolution.Solver.solve, timerun.Steps._solve_on
        left = [math.inf]  # until the mesh is found

        def solve(self, *arguments):
            left[0] -= 1
            if left[0] < 0:
                raise NotConverged("so it was told")
            return original(self, *arguments)

        def solve_on(self, meshes):
            left[0] = after
            begin(self, meshes)

        patch.setattr(timerun.Steps, "_solve_on", solve_on)
        patch.setattr(evolution.Solver, "solve", solve)
        assert solved(path, out) == 3
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        kept = f"steps 1 to {after} are" if after > 1 else "step 1 is"
        assert f"time step {after + 1}: so it was told {kept} finished and kept in" in error
        assert len(report_in(out)["times"]) == after and not report_in(out)["complete"]
    assert solved(path, out, "--resume") == 0
    assert_same(out, whole)
    names = [{each.name for each in folder.iterdir()} for folder in (out, whole)]
    if draws:
        strips = [(each / "strip.png").read_bytes() for each in (out, whole)]
        assert len(strips[0]) == pytest.approx(len(strips[1]), rel=0.01)
    else:
        names[1] = {name for name in names[1] if not name.endswith(".png")}
    assert names[0] == names[1]
    assert solved(path, out, "--resume") == 0  # nothing is left to do
    assert_same(out, whole)


@pytest.mark.serial
@pytest.mark.parametrize(
    "first, then, scheme", [(1, 2, "bdf2"), (2, 1, "bdf2"), (2, 1, "adaptive")]
)
def test_on_another_number_of_ranks(first, then, scheme, case, whole, shared_tmp_path):
    """Three of six steps are done, with two steps behind each as bdf2 has them."""
    whole, out, run = whole(scheme), shared_tmp_path / "out", shared_tmp_path / "run.py"
    run.write_text(FEW_STEPS)
    words = ["solve", case(in_scheme(scheme)), "--out", out, "-q"]
    done = helpers.start(run, *words, ranks=first, MOST="3")
    assert "time step 4: told" in " ".join(done.stderr.split())
    done = helpers.start(run, *words, "--resume", ranks=then)
    assert (done.returncode, done.stderr) == (0, "")
    assert_same(out, whole)


@pytest.mark.serial
def test_ended_again_and_again(case, whole, shared_tmp_path):
    """After one more step each time, in which the steps before are still those of another run."""
    whole, out, run = whole("bdf2"), shared_tmp_path / "out", shared_tmp_path / "run.py"
    run.write_text(FEW_STEPS)
    words = ["solve", case(in_scheme("bdf2")), "--out", out, "-q"]
    helpers.start(run, *words, MOST="3")
    for step, ranks in ((5, 2), (6, 1)):  # the last that is kept is looked at once more
        done = helpers.start(run, *words, "--resume", ranks=ranks, MOST="2")
        assert f"time step {step}: told" in " ".join(done.stderr.split())
    for _ in range(2):
        done = helpers.start(run, *words, "--resume", ranks=2)
        assert (done.returncode, done.stderr) == (0, "")
        assert_same(out, whole)


FEW_STEPS = """import os, sys
from signorini_cr import evolution
from signorini_cr.app import cli, timerun
from signorini_cr.errors import NotConverged
from signorini_cr.output import plots
plots.can_draw = lambda comm: False
found = []
def solve_on(self, meshes, begin=timerun.Steps._solve_on):
    found.append(0)
    begin(self, meshes)
def stop(self, *arguments, solve=evolution.Solver.solve):
    found[:] = [each + 1 for each in found]
    if max(found, default=0) > int(os.environ.get("MOST", "99")):
        raise NotConverged("told")
    return solve(self, *arguments)
timerun.Steps._solve_on, evolution.Solver.solve = solve_on, stop
sys.exit(cli.main())
"""


def test_what_another_run_in_time_has_left_is_refused(case, undrawn, shared_tmp_path, capfd):
    out = shared_tmp_path / "out"
    assert solved(case(), out) == 0
    for old, new, told in (
        ("steps = 6", "steps = 7", "time.steps was 6 and is 7"),
        ("end = 1.5", "end = 1", "time.end was 1.5 and is 1"),
        ("[time]", "[refine]\nlevels = 2\n[time]", "--levels) was 1 and is 2"),
    ):
        assert solved(case(CASE.replace(old, new)), out, "--resume") == 2
        if COMM.rank == 0:
            assert told in " ".join(capfd.readouterr().err.split())


def test_a_step_that_would_end_too_late_is_not_begun(
    case, undrawn, shared_tmp_path, monkeypatch, capfd
):
    """Each step takes a second, of three and a half."""

    class Clock:
        now = 0.0

        @classmethod
        def perf_counter(cls):
            return cls.now

    admit = limits.Limits.admit_step

    def after(self, comm):
        Clock.now += 1.0
        admit(self, comm)

    monkeypatch.setattr(limits, "time", Clock)
    monkeypatch.setattr(limits.Limits, "admit_step", after)
    monkeypatch.setattr(timerun.Run, "time_left", property(lambda run: run.args.max_time))
    out = shared_tmp_path / "out"
    assert solved(case(), out, "--max-time", 3.5) == 3
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        assert (
            "time step 4: it would take about 1 s, and of the time limit there are 0.5 s" in error
        )
        assert "steps 1 to 3 are finished and kept in" in error
    assert len(report_in(out)["times"]) == 3
    assert solved(case(), out, "--resume") == 0
    assert len(report_in(out)["times"]) == 6


def test_a_mesh_that_memory_does_not_hold_is_refused_before_the_first_step(
    case, shared_tmp_path, monkeypatch, capfd
):
    monkeypatch.setattr(memory, "_spare", lambda: 1.0)
    out = shared_tmp_path / "out"
    assert solved(case(), out, "--levels", 3) == 3
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        assert "time step 1: level 2: its" in error and "degrees of freedom would take" in error
        assert not out.exists()


LIMITED = CASE + '[refine]\nmode = "adaptive"\n'


def test_a_mesh_adapted_to_all_steps(case, undrawn, shared_tmp_path, capfd):
    """The last mesh that was tried is the one that is solved on, and its bound what was found."""
    out = shared_tmp_path / "out"
    path = case(LIMITED + "max_dofs = 300\n[units]\n")
    assert main(["solve", str(path), "--out", str(out)]) == 0
    report = report_in(out)
    if COMM.rank == 0:
        told = capfd.readouterr().out
        tried = re.search(r"level +cells +dofs +bound\n((?: +[\d.]+)+\n)+\n", told)
        level, cells, dofs, bound = tried[0].split("\n")[-3].split()
        (finest,) = report["levels"]
        assert (int(cells), int(dofs)) == (finest["cells"], finest["dofs"])
        assert int(level) == finest["level"] > 1 and int(dofs) <= 300
        assert f"above {bound}\n" in told
        largest = max(step["bound_h1"] for step in report["times"])
        assert float(bound) == pytest.approx(largest, rel=0.01)
        assert report["search"][-1]["bound_h1"] == pytest.approx(largest, rel=1e-6)
        assert set(report) <= {name.partition(".")[0] for name in REPORT}
        assert [each["level"] for each in report["search"]] == list(range(int(level) + 1))
        assert len(report["times"]) == 6 and report["complete"]


@pytest.mark.parametrize(
    ("limits", "status", "said"),
    [
        ("tolerance = 1.0\n", 0, "the bound has reached the tolerance of 1: no further mesh"),
        ("tolerance = 0.1\nlevels = 3\n", 3, "the tolerance of 0.1, and levels = 3 allows no"),
        ("tolerance = 0.1\nmax_dofs = 150\n", 3, "and max_dofs = 150 allows no further mesh"),
        ("levels = 1\n", 0, "in no step is"),
    ],
)
def test_where_the_search_for_a_mesh_ends(
    limits, status, said, case, undrawn, shared_tmp_path, capfd
):
    out = shared_tmp_path / "out"
    assert main(["solve", str(case(LIMITED + limits)), "--out", str(out)]) == status
    if COMM.rank == 0:
        assert said in " ".join("".join(capfd.readouterr()).split())
    report = report_in(out)
    bound = max(step["bound_h1"] for step in report["times"])
    assert len(report["times"]) == 6 and report["complete"] == (status == 0)
    if "tolerance" in limits:
        assert (bound <= float(limits.split()[2])) == (status == 0)
    for changed in ("fraction = 0.4\n", "max_dofs = 200\n"):
        text = LIMITED + re.sub(rf"{changed.split()[0]}.*\n", "", limits) + changed
        assert solved(case(text), out, "--resume") == 2


@pytest.mark.parametrize("capacity", ["1e-9", "1"])
@pytest.mark.parametrize("tolerance, status", [("0", 0), ("1e-15", 3)])
def test_a_search_for_a_mesh_that_rounding_ends(
    tolerance, status, capacity, case, undrawn, shared_tmp_path, capfd
):
    """What is constant for all times needs one mesh, whatever the solver leaves of its load."""
    text = LIMITED.replace('f = "-20*wave*x"', "dirichlet = 1").replace("1 + 1", capacity)
    text = text.replace("0.1*(y - 1)", "1") + f"tolerance = {tolerance}\n"
    assert main(["solve", str(case(text)), "--out", str(shared_tmp_path / "out")]) == status
    assert len(report_in(shared_tmp_path / "out")["search"]) == 1
    if COMM.rank == 0:
        said = " ".join("".join(capfd.readouterr()).split())
        assert ("what is left of the bound is rounding: no finer mesh" in said) == (status == 0)
        assert ("and what is left of it is rounding" in said) == (status == 3)


def test_a_mesh_that_does_not_fit_leaves_the_one_below(
    case, undrawn, shared_tmp_path, monkeypatch, capfd
):
    def full(self, solution, dofs, runs):
        if solution.level.number == 1:
            raise NotConverged("too large", 2)

    monkeypatch.setattr(limits.Limits, "admit", full)
    out = shared_tmp_path / "out"
    assert solved(case(LIMITED), out) == 3
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        stopped = "the search for a mesh stopped on level 2: too large"
        assert f"{stopped} steps 1 to 6 are finished and kept in" in error
    report = report_in(out)
    assert (report["levels"][0]["level"], report["complete"]) == (1, False)
    assert [each["level"] for each in report["search"]] == [0, 1]
    assert solved(case(LIMITED), out, "--resume") == 3  # the reason is the same as before
    assert not report_in(out)["complete"]
    monkeypatch.undo()
    helpers.undrawn(monkeypatch)
    limited = LIMITED + "max_dofs = 300\n"
    whole = shared_tmp_path / "whole"
    assert solved(case(limited), whole) == 0
    with monkeypatch.context() as patch:
        patch.setattr(limits.Limits, "admit", full)
        shutil.rmtree(out) if COMM.rank == 0 else None
        assert solved(case(limited), out) == 3
    assert solved(case(limited), out, "--resume") == 0
    assert_same(out, whole)
    again, expected = (report_in(each)["search"] for each in (out, whole))
    assert len(again) == len(expected)
    for each, other in zip(again, expected, strict=True):
        # cells may be on other ranks, and sums over these in another order
        assert each == other | {"bound_h1": pytest.approx(other["bound_h1"], rel=1e-12)}


@pytest.mark.serial
def test_a_search_that_is_interrupted_goes_on(
    case, undrawn, whole, shared_tmp_path, monkeypatch, capfd
):
    """On the third mesh; two have been tried, and that is kept."""
    path, out = case(in_scheme("adaptive")), shared_tmp_path / "out"
    progress = cli.Screen.progress

    def interrupted(self, text):
        progress(self, text)
        if text.startswith("level 2, step 3"):
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(cli.Screen, "progress", interrupted)
        assert solved(path, out) == 143
    words = " ".join(capfd.readouterr().err.split())
    assert words == f"signorini-cr: terminated; levels 0 to 1 are finished and kept in {out}"
    assert {each.name for each in out.iterdir()} == {"report.json", "restart.npz"}
    report = report_in(out)
    assert (len(report["search"]), report["times"], report["complete"]) == (2, [], False)
    assert main(["solve", str(path), "--out", str(out), "--resume"]) == 0
    told = capfd.readouterr().out
    assert f"going on after level 1, kept in {out}" in " ".join(told.split())
    assert_same(out, whole("adaptive"))
    assert report_in(out)["search"] == report_in(whole("adaptive"))["search"]


def test_steps_of_the_solver_are_told(case, undrawn, shared_tmp_path, capsys):
    out = shared_tmp_path / "out"
    assert main(["solve", str(case()), "--out", str(out), "-v"]) == 0
    if COMM.rank == 0:
        told = capsys.readouterr().out
        steps = re.findall(r"^  time step (\d+)  step +(\d+)  residual", told, re.MULTILINE)
        newton = [step["newton_iterations"] for step in report_in(out)["times"]]
        last = {int(time): int(step) for time, step in steps}
        assert list(last) == [1, 2, 3, 4, 5, 6]
        assert all(last[k + 1] >= n for k, n in enumerate(newton))


def test_no_mesh_at_all(case, shared_tmp_path, monkeypatch, capfd):
    """The first run does not get to its end."""
    original, calls = evolution.Solver.solve, []

    def solve(self, *arguments):
        calls.append(1)
        if len(calls) > 3:
            raise NotConverged("so it was told", 0)
        return original(self, *arguments)

    monkeypatch.setattr(evolution.Solver, "solve", solve)
    out = shared_tmp_path / "out"
    assert solved(case(LIMITED), out) == 3
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        assert "level 0: so it was told" in error and "nothing was written" in error
        assert not out.exists()


def test_long_tables_are_not_written_with_each_step():
    """With all of the first 200; then as rarely as is needed to take a fixed share of the time."""
    kept = [step for step in range(1, 20_001) if is_kept(step)]
    assert kept[:199] == list(range(1, 200))
    assert all(b - a <= 2 + b // 100 for a, b in pairwise(kept))
    assert len(kept) < 1500


@pytest.mark.serial
def test_without_time_t_is_a_name_like_others(case, capfd, shared_tmp_path):
    text = CASE.split("[time]")[0]
    path = case(text)
    assert main(["check", str(path)]) == 2
    assert "t" in capfd.readouterr().err
    path = case(text.replace("wave =", "t = 0.3\nwave ="))
    assert main(["check", str(path), "--out", str(shared_tmp_path / "out")]) == 0


@pytest.mark.serial
def test_the_clock_moves_what_holds_it():
    import ufl
    from dolfinx.mesh import create_unit_square

    clock, mesh = Clock(), create_unit_square(MPI.COMM_SELF, 1, 1)
    clock.value = 2.0
    x = ufl.SpatialCoordinate(mesh)
    constant = clock.on(x)
    assert constant is clock.on(ufl.SpatialCoordinate(mesh)) and float(constant) == 2.0
    clock.value = 3.0
    assert float(constant) == 3.0 and clock.on(np.zeros((2, 4))) == 3.0


def test_the_limit_of_time_counts_while_data_are_looked_at(case, shared_tmp_path, capfd):
    """A hundred thousand steps are tried out before the first one is solved."""
    text = CASE.replace("steps = 6", "steps = 100000").replace("[data]", '[data]\nreaction = "t"')
    out = shared_tmp_path / "out"
    assert solved(case(text), out, "--max-time", 1e-3) == 3
    if COMM.rank == 0:
        error = " ".join(capfd.readouterr().err.split())
        assert "the time limit is over, and the data are looked at up to step 0 of 100000" in error
        assert not out.exists()
