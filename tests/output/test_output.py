"""The report, the tables, the files: do they say what the solution says?"""

import csv
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import ufl
from helpers import rectangle
from mpi4py import MPI

from signorini_cr import InputError, Problem, solve, solve_levels
from signorini_cr.estimate.certificate import SHARES, Certificate
from signorini_cr.output import report as output
from signorini_cr.output.files import check_writable, write_files

pytestmark = pytest.mark.ranks

WORLD = MPI.COMM_WORLD

LEVEL = {
    "level", "cells", "dofs", "h", "newton_iterations", "linear_iterations", "energy", "kkt",
    "contact", "error_h1", "error_l2", "rate_h1", "rate_l2", "bound_h1", "effectivity", "seconds",
    "bound_energy_norm", "quantities", "bound_reason", "bound_parts", "energy_bounds",
}  # fmt: skip
CONTACT_HEADER = ["part", "arc_length", "x", "y", "length", "obstacle", "u", "pressure", "active"]


# Contact on x < 0
def exact(x):
    plus = ufl.conditional(ufl.gt(x[0], 0), x[0], 0.0)
    minus = ufl.conditional(ufl.lt(x[0], 0), -x[0], 0.0)
    return plus**3 - x[1] * minus**3


PROBLEM = Problem(exact=exact)


def run(comm=WORLD, levels=3):
    records = []
    for solution in solve_levels(PROBLEM, rectangle(4, comm), levels):
        records.append(output.level_record(solution, records[-1] if records else None))
    return solution, output.make_report("A", "CR", comm, records)


@pytest.fixture(scope="module")
def finished():
    return run()


@pytest.fixture
def folder(shared_tmp_path, finished):
    solution, report = finished
    output.write_output(shared_tmp_path / "out", report, solution, pictures=False)
    return shared_tmp_path / "out"


def test_the_report_has_the_keys_that_others_rely_on(folder):
    report = json.loads((folder / "report.json").read_text())
    keys = {"title", "element", "ranks", "versions", "complete", "force_bounds", "levels"}
    assert set(report) == keys and report["complete"] is True
    assert set(report["versions"]) == {"signorini_cr", "dolfinx", "petsc", "gmsh"}
    for record in report["levels"]:
        assert set(record) == LEVEL
        kkt = {"min_gap", "min_pressure", "complementarity", "residual", "force_error"}
        assert set(record["kkt"]) == kkt
        contact = {"facets", "active", "length", "force", "force_bounds", "transitions"}
        assert set(record["contact"]) == contact
        assert set(record["contact"]["force_bounds"]) == {"lower", "upper", "reason"}
        assert set(record["seconds"]) == {"mesh", "assemble", "solve", "estimate"}
    assert report["ranks"] == WORLD.size
    assert [record["level"] for record in report["levels"]] == [0, 1, 2]


def test_the_report_says_what_the_solution_says(finished, folder):
    solution, _ = finished
    record = json.loads((folder / "report.json").read_text())["levels"][-1]
    assert (record["cells"], record["contact"]["facets"]) == (1024, 32)
    assert record["energy"] == solution.energy
    assert record["contact"]["force"] == solution.contact.force
    # ∫ |x|³ over (−1, 0), and the end of contact, at the origin
    assert record["contact"]["force"] == pytest.approx(0.25, rel=0.02)
    (point,) = record["contact"]["transitions"]
    assert len(point) == 2
    assert point == pytest.approx([0, 0], abs=0.15)
    assert record["rate_h1"] == pytest.approx(1, abs=0.1)
    assert record["rate_l2"] == pytest.approx(2, abs=0.1)
    assert record["error_h1"] <= record["bound_h1"] <= 1.45 * record["error_h1"]
    assert record["energy_bounds"]["lower"] <= record["energy_bounds"]["upper"]
    assert record["bound_reason"] is None


def test_rates_need_two_errors_on_two_meshes(finished):
    solution, report = finished
    last = report["levels"][-1]
    assert output.level_record(solution)["rate_h1"] is None
    assert output.level_record(solution, last)["rate_h1"] is None
    assert solution.cells % 4 == 0
    coarser = last | {"cells": solution.cells // 4, "h": 2 * last["h"], "error_l2": None}
    record = output.level_record(solution, coarser | {"error_h1": 2**1.5 * last["error_h1"]})
    assert record["rate_h1"] == pytest.approx(1.5)
    assert record["rate_l2"] is None


def test_rates_on_adaptive_meshes_go_by_the_number_of_dofs(finished):
    """The largest cell may be what it was, or differ by rounding."""
    solution, report = finished
    last = report["levels"][-1]
    coarser = last | {
        "cells": solution.cells // 5,
        "h": (1 + 1e-15) * last["h"],
        "dofs": solution.dofs / 9,
        "error_h1": 3 * last["error_h1"],
        "error_l2": 9 * last["error_l2"],
    }
    record = output.level_record(solution, coarser)
    assert record["rate_h1"] == pytest.approx(1.0)
    assert record["rate_l2"] == pytest.approx(2.0)


def test_the_bound_and_its_time_are_reported(finished):
    """Whoever makes a certificate books its time; the report reads."""
    solution, report = finished
    plain = report["levels"][-1]
    assert 0.0 < solution.certificate.seconds <= plain["seconds"]["estimate"]
    try:
        solution.certificate = Certificate(bound_h1=3 * plain["error_h1"])
        record = output.level_record(solution)
        solution.certificate = Certificate(reason="no")
        unknown = output.level_record(solution)
    finally:
        del solution.certificate
    assert record["bound_h1"] == pytest.approx(3 * plain["error_h1"])
    assert record["effectivity"] == pytest.approx(3)
    assert record["seconds"] == plain["seconds"]
    assert unknown["bound_h1"] is unknown["effectivity"] is None
    assert unknown["energy_bounds"] == {"lower": None, "upper": None}
    assert unknown["bound_reason"] == "no"


def test_without_an_exact_solution_errors_are_null():
    record = output.level_record(solve(Problem(f=1.0), rectangle(4)))
    assert all(record[key] is None for key in ("error_h1", "error_l2", "rate_h1", "rate_l2"))


def test_what_json_does_not_know_is_null():
    odd = {"a": np.float64("nan"), "b": (np.inf, np.int32(3)), "c": np.array([[1.0, -np.inf]])}
    assert output.plain(odd) == {"a": None, "b": [None, 3], "c": [[1.0, None]]}
    json.dumps(output.plain(odd), allow_nan=False)


def test_one_rank_reports_what_all_ranks_report(finished):
    alone = output.plain(run(MPI.COMM_SELF)[1])["levels"]

    def figures(value):
        if isinstance(value, dict):
            # Iterations of the linear solver, times and what rounding leaves of zero may differ
            skip = ("linear_iterations", "seconds", "kkt", "bound_parts")
            return [x for key, item in value.items() if key not in skip for x in figures(item)]
        return [x for item in value for x in figures(item)] if isinstance(value, list) else [value]

    def wanted(value):
        words = value is None or isinstance(value, str)  # newer versions of approx take no words
        return value if words else pytest.approx(value, rel=1e-6, abs=1e-9)

    for mine, all_of_us in zip(alone, finished[1]["levels"], strict=True):
        assert figures(mine) == [wanted(x) for x in figures(all_of_us)]


def variants(record):
    """The record with and without an exact solution and a bound, its numbers large."""
    large = record | {"cells": 9_999_999, "dofs": 9_999_999, "linear_iterations": 999, "level": 12}
    large["contact"] = record["contact"] | {"active": 123_456}
    large |= {"rate_h1": -1.2345, "rate_l2": 12.345}
    for exact_known in (True, False):
        known = {} if exact_known else dict.fromkeys(("error_h1", "error_l2"), None)
        for bound in (1.234e-7, None):
            yield large | known | {"bound_h1": bound, "effectivity": bound and 345.6}


def test_the_table_fits_eighty_columns_and_is_aligned(finished):
    for record in variants(finished[1]["levels"][-1]):
        header, row = output.table_header(record), output.table_row(record)
        assert len(header) == len(row) <= 80
        # Every column ends where its title ends
        ends = [match.end() for match in re.finditer(r"\S+", row)]
        assert len(ends) >= 9
        assert all(header[end - 1] != " " for end in ends)
        assert ("bound" in header) == (record["bound_h1"] is not None)
        assert ("H1 error" in header) == (record["error_h1"] is not None)
        assert ("energy" in header) == (record["error_h1"] is None)


def test_rows_keep_the_columns_of_the_first(finished):
    record = finished[1]["levels"][-1]
    without = record | {"error_h1": None, "error_l2": None}
    assert len(output.table_row(without, record)) == len(output.table_header(record))


def test_the_markdown_table_is_the_printed_one(finished, folder):
    levels = finished[1]["levels"]
    head, rule, *rows = (folder / "levels.md").read_text().splitlines()
    assert len(rows) == len(levels)
    assert re.fullmatch(r"\|( -+: \|)+", rule)
    assert head.replace("|", " ").split() == output.table_header(levels[0]).split()
    for row, record in zip(rows, levels, strict=True):
        assert row.replace("|", " ").split() == output.table_row(record, levels[0]).split()


def test_levels_csv_holds_the_whole_record(finished, folder):
    with (folder / "levels.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "level", "cells", "dofs", "h", "newton_iterations", "linear_iterations", "energy",
        "kkt_min_gap", "kkt_min_pressure", "kkt_complementarity", "kkt_residual",
        "kkt_force_error",
        "contact_facets", "contact_active", "contact_length", "contact_force",
        "contact_transitions", "contact_force_bounds_lower", "contact_force_bounds_upper",
        "contact_force_bounds_reason", "error_h1", "error_l2", "rate_h1", "rate_l2", "bound_h1",
        "bound_energy_norm", "effectivity", "bound_reason",
        *(f"bound_parts_{name}" for name in SHARES),
        "energy_bounds_lower", "energy_bounds_upper", "seconds_mesh", "seconds_assemble",
        "seconds_solve", "seconds_estimate",
    ]  # fmt: skip
    for row, record in zip(rows, finished[1]["levels"], strict=True):
        assert float(row["contact_force"]) == record["contact"]["force"]
        assert float(row["error_h1"]) == record["error_h1"]
        points = [[float(x) for x in p.split()] for p in row["contact_transitions"].split(";") if p]
        assert points == record["contact"]["transitions"]
    assert rows[0]["rate_h1"] == ""


def test_contact_csv_runs_along_the_boundary_and_adds_up(finished, folder):
    contact = finished[1]["levels"][-1]["contact"]
    with (folder / "contact.csv").open() as file:
        assert next(csv.reader(file)) == CONTACT_HEADER
    rows = np.loadtxt(folder / "contact.csv", delimiter=",", skiprows=1)
    column = dict(zip(CONTACT_HEADER, rows.T, strict=True))
    assert len(rows) == contact["facets"]
    assert np.all(column["part"] == 0)
    assert np.all(np.diff(column["arc_length"]) > 0)
    assert column["arc_length"] == pytest.approx(column["x"] + 1)
    assert column["y"] == pytest.approx(0)
    assert column["pressure"] @ column["length"] == pytest.approx(contact["force"], rel=1e-10)
    assert column["active"].sum() == contact["active"]
    assert column["active"] @ column["length"] == pytest.approx(contact["length"])
    assert set(column["active"]) == {0.0, 1.0}


def test_a_writer_that_fails_leaves_everything_as_it_was(shared_tmp_path):
    folder = shared_tmp_path / "kept"
    if WORLD.rank == 0:
        folder.mkdir()
        (folder / "report.json").write_text("old")
        (folder / "notes.txt").write_text("mine")
    WORLD.barrier()

    def good(path):
        if WORLD.rank == 0:
            path.write_text("new")

    def bad(path):
        raise InputError("no")

    for target in (folder, shared_tmp_path / "not" / "there"):
        with pytest.raises(InputError, match="no"):
            write_files(target, {"report.json": good, "levels.csv": bad}, removed=["notes.txt"])
        WORLD.barrier()
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "report.json"]
    assert (folder / "report.json").read_text() == "old"
    assert sorted(path.name for path in shared_tmp_path.iterdir()) == ["kept"]


def test_only_our_own_leftovers_are_removed(finished, shared_tmp_path):
    if WORLD.rank == 0:
        for name in ("convergence.png", "notes.txt", "report.json"):
            (shared_tmp_path / name).write_text("old")
    WORLD.barrier()
    solution, report = finished
    names = output.write_output(shared_tmp_path, report, solution, pictures=False)
    WORLD.barrier()
    there = {path.name for path in shared_tmp_path.iterdir()}
    assert there == {*names, "notes.txt"} and set(names) <= set(output.FILES)
    assert "convergence.png" not in there
    assert (shared_tmp_path / "notes.txt").read_text() == "old"
    assert json.loads((shared_tmp_path / "report.json").read_text())["title"] == "A"


def test_a_folder_that_cannot_be_written_is_found_out_first(shared_tmp_path):
    if WORLD.rank == 0:
        (shared_tmp_path / "file").write_text("")
        (shared_tmp_path / "taken" / "report.json").mkdir(parents=True)
        (shared_tmp_path / "link").symlink_to("nowhere")
    WORLD.barrier()
    check_writable(shared_tmp_path / "a" / "b")
    assert {path.name for path in shared_tmp_path.iterdir()} == {"file", "taken", "link"}
    with pytest.raises(InputError, match="link is not a folder"):
        check_writable(shared_tmp_path / "link")
    with pytest.raises(InputError, match="name too long"):
        check_writable(shared_tmp_path / ("x" * 300))
    with pytest.raises(InputError, match="file is not a folder"):
        check_writable(shared_tmp_path / "file" / "out")
    with pytest.raises(InputError, match="of that name"):
        check_writable(shared_tmp_path / "taken", output.FILES)
    with pytest.raises(InputError, match="/proc is not writable"):
        check_writable("/proc/none")  # whatever its permissions say


@pytest.mark.parametrize(
    ("name", "place", "function"),
    [
        ("report.json", Path, "write_text"),
        ("solution.vtu", os, "posix_fallocate"),
        ("solution.vtu", os, "pwrite"),
    ],
)
def test_a_full_disk_is_told_in_words(
    name, place, function, finished, shared_tmp_path, monkeypatch
):
    """Whichever rank sees it."""

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    if WORLD.rank == (WORLD.size - 1 if function == "pwrite" else 0):
        monkeypatch.setattr(place, function, full)
    solution, report = finished
    with pytest.raises(InputError, match=f"cannot write {name}: No space left"):
        output.write_output(shared_tmp_path / "out", report, solution)
    WORLD.barrier()
    assert not (shared_tmp_path / "out").exists()


@pytest.mark.slow
def test_a_picture_that_cannot_be_drawn_is_left_out(finished, shared_tmp_path, monkeypatch):
    """It does not cost the field; that of a former run goes."""
    solution, report = finished
    output.write_output(shared_tmp_path / "out", report, solution)

    def failing(*_, **__):
        raise KeyError("latex")

    monkeypatch.setattr(output.plots, "plot_contact", failing)
    told = []
    names = output.write_output(shared_tmp_path / "out", report, solution, tell=told.append)
    assert told == ["contact.png cannot be drawn: KeyError: 'latex'"]
    WORLD.barrier()
    there = {path.name for path in (shared_tmp_path / "out").iterdir()}
    assert set(names) == there and {"solution.vtu", "solution.png"} <= there
    assert "contact.png" not in there


@pytest.mark.slow
@pytest.mark.serial
def test_settings_of_matplotlib_that_need_what_is_missing(finished, tmp_path):
    """Here, LaTeX."""
    import matplotlib

    solution, report = finished
    with matplotlib.rc_context({"text.usetex": True}):
        names = output.write_output(tmp_path, report, solution, tell=pytest.fail)
    assert "solution.png" in names
