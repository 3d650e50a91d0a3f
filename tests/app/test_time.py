"""[time] in a problem file: what is solved, what is left behind, what is refused."""

import csv
import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from helpers import is_picture
from mpi4py import MPI

from signorini_cr.app.cli import main
from signorini_cr.app.formula import Clock
from signorini_cr.output.meanings import STEP

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


def steps_by_hand():
    """Implicit Euler on the same mesh, in Python."""
    import ufl
    from dolfinx import fem

    from signorini_cr import Contact, Dirichlet, Neumann, Polygon, Problem, solve_in_time

    edges = ["contact", "neumann", "dirichlet", "neumann"]
    domain = Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], edges).mesh(0.4)
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
        for name in ("step_00099.vtu", "convergence.png", "mine.txt"):
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
    for words in ("force: ∫_Γ1 λ_h; ", "certified: in no step is ", "s for all 6 steps, "):
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
    columns = [asked if name == "quantities" else [name] for name in STEP]
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
        told = re.search(
            rf"certified: {name} of each step's own problem is in \[(.*?), (.*?)\]", flat
        )
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
        ("steps = 6", "steps = 2.5", "time.steps: a whole number is needed"),
        ("steps = 6", 'steps = 6\nscheme = "trapez"', "time.scheme"),
        ('capacity = "1 + 1"', 'capacity = "x"', "time.capacity: a number above 0 is needed"),
        ('capacity = "1 + 1"', "capacity = -1", "time.capacity: a number above 0 is needed"),
        ('initial = "0.1*(y - 1)"', 'initial = "t"', "time.initial: this must not depend on t"),
        ("[data]", '[data]\ncoefficient = "1 + t"', "data.coefficient: this must not depend on t"),
        ("wave =", "t = 1\nwave =", "define.t: t is the time"),
        ("[time]", '[refine]\nmode = "adaptive"\n[time]', "refine.mode: a problem in time needs"),
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


@pytest.mark.parametrize("option", ["--resume", "--max-time=9", "--element=p1"])
def test_options_that_do_not_go_with_time(option, case, shared_tmp_path, capfd):
    assert main(["solve", str(case()), "--out", str(shared_tmp_path / "out"), option]) == 2
    if COMM.rank == 0:
        error = capfd.readouterr().err
        assert option.split("=")[0] in error and "problems in time" in error


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
