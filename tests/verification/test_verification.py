"""The verification suite runs, passes, fails when it must, and its references stand."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import helpers
import numpy as np
import pytest
from mpi4py import MPI

pytestmark = pytest.mark.slow

FOLDER = helpers.ROOT / "verification"
sys.path.insert(0, str(FOLDER))

import bounds  # noqa: E402
import exactly  # noqa: E402
import manufactured  # noqa: E402
import reference  # noqa: E402
import sharpness  # noqa: E402
import solves  # noqa: E402
from report import Group, Row, document, write  # noqa: E402

from signorini_cr import solve  # noqa: E402

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("make", manufactured.CLASSES, ids=lambda make: make.__name__)
def test_manufactured_solutions_solve_their_problems(make):
    """Green's formula, boundary values and signs, by quadrature."""
    for seed in range(4):
        assert make(np.random.default_rng(seed)).checked() <= bounds.SOLVES


@pytest.mark.serial
def test_a_wrong_solution_is_told():
    made = manufactured.load_jumps(np.random.default_rng(1))
    formula = made.f
    wrong = made.__class__(**{**vars(made), "f": lambda m, *a: 1.001 * formula(m, *a)})
    assert made.checked() < 1e-12 < 1e-6 < wrong.checked()


@pytest.mark.serial
def test_split_triangles_integrate_what_jumps():
    """The area left of a slant line, and ∫ r^{-1/2}, known in closed form."""
    square = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=float)
    pieces = exactly.Pieces(square, [(1.0, 0.5, 0.6)], [])
    left = pieces.integral((pieces.x + 0.5 * pieces.y < 0.6).astype(float))
    assert np.isclose(left, 0.35, rtol=1e-13)
    pieces = exactly.Pieces(square, [], [(0.0, 0.0, 1e-9)])
    t, w = np.polynomial.legendre.leggauss(40)
    angle = (t + 1) * np.pi / 8
    exact = 2 * np.pi / 8 * (w @ (np.cos(angle) ** -1.5)) / 1.5
    radius = np.hypot(pieces.x, pieces.y)
    assert np.isclose(pieces.integral(radius**-0.5), exact, rtol=1e-8)


def test_reference_does_not_depend_on_where_it_starts():
    """All facets active at the start, or none: the same forces, at any contrast."""
    for contrast in (1e2, 1e4, 1e12):
        case = solves._stiff("test", solves.RECTANGLE, solves._aslant, contrast, 1)
        cells = reference.gathered(case.mesh())
        if cells is None:
            continue
        values = {
            key: solves.numeric(formula, case.parameters) for key, formula in case.formulas.items()
        }
        discrete = reference.Discrete(cells, reference.Data(**values))
        one, other = discrete.solve(), discrete.solve(start=True)
        assert one.active.any() and not one.active.all()
        assert max(one.change, other.change) < 1e-9
        assert np.array_equal(one.active, other.active)
        assert np.allclose(one.force, other.force, rtol=1e-9, atol=0)
        assert (one.force >= 0).all() and one.kkt < 1e-12


@pytest.mark.serial
def test_reference_in_one_unknown():
    """Two triangles, Γ0 around the upper one: by hand, f |T| / 3 on each facet of Γ1."""
    points = np.array([[[0, 0], [1, 0], [0, 1.0]]])
    cells = reference.Cells(
        points,
        np.array([[0, 1, 2]]),
        {part: np.array(facets) for part, facets in ((1, [2]), (2, [0, 1]), (3, []))},
    )
    data = reference.Data(
        f=lambda x, y: -6.0 + 0 * x,
        g=lambda x, y: 0 * x,
        obstacle=lambda x, y: 0 * x,
        dirichlet=lambda x, y: 0 * x,
        coefficient=lambda x, y: 1 + 0 * x,
    )
    found = reference.Discrete(cells, data).solve()
    assert found.active.all() and np.isclose(found.force[0], 6 * 0.5 / 3)


def test_a_tenth_of_a_force_is_seen():
    """What the program finds is judged, and a perturbed force is judged wrong."""
    case = solves._stiff("test", solves.RECTANGLE, solves._aslant, 10.0, 2)
    verdict = case.run([True])[0]
    assert not (verdict.refused or verdict.fault or verdict.facets)
    assert verdict.error < 1e-5 and verdict.proper


def test_quick_suite_passes(shared_tmp_path):
    out = shared_tmp_path / "table.md"
    names = "forces random bounds thin".split()
    status, printed = helpers.script(FOLDER, "--quick", "--out", out, "--only", *names)
    text = out.read_text()
    assert status == 0, text + printed
    assert "**no**" not in text
    for title in ("Contact forces", "Random problems", "Bounds and energies", "Thin cells"):
        assert title in text
    assert len(re.findall(r"\| yes \|", text)) == 4 + 2 + len(manufactured.CLASSES) + 4


@pytest.mark.serial
def test_no_bound_is_below_the_error_however_loose():
    """Cases that are hard to be sharp on; the suite itself says how sharp the bounds are."""
    group = sharpness.sharpness(20, True)
    told = [line for row in group.rows for line in row.failures]
    assert len(group.rows) >= 12
    assert not [line for line in told if "no bound" in line or "of the error" in line]
    assert all(row.passed for row in group.rows if "published" in row.name)


@pytest.mark.serial
def test_suite_fails_when_the_solver_stops_early(tmp_path):
    out = tmp_path / "table.md"
    options = ("-signorini_snes_atol", "1e-2", "-signorini_ksp_rtol", "0.3")
    result = helpers.start(FOLDER, "--quick", "--only", "forces", "--out", out, *options)
    assert result.returncode == 1
    assert "forces wrong" in out.read_text() or "refused" in out.read_text()


def test_a_bound_that_is_too_low_and_a_bracket_that_misses_are_told():
    made = manufactured.waves(np.random.default_rng(0))
    domain = made.polygon.mesh(0.15, COMM)
    solution = solve(made.problem(domain), domain)
    honest = bounds.judge(solution, made)
    assert honest.reason is None
    assert honest.energy_norm >= 1 and honest.h1 >= 1 and honest.misses < 0
    h1, energy_norm, J, _ = bounds.distances(solution, made)
    solution.certificate = replace(
        solution.certificate,
        bound_h1=0.99 * h1,
        bound_energy_norm=0.99 * energy_norm,
        energy=(J - 2.0, J - 1.0),
    )
    tally = bounds.Tally()
    tally.add(bounds.judge(solution, made), "forged")
    assert np.isclose(tally.outcomes[0].misses, 1.0, rtol=1e-3)
    row = tally.row("forged", "")
    assert not row.passed
    assert "1 bounds too low, 1 brackets miss" in row.worst


@pytest.mark.serial
def test_a_table_made_anew_leaves_the_others(tmp_path):
    def group(name, worst):
        return Group(name, name.upper(), "Passed.", [Row("a case", 1, worst, "known")])

    page, names = tmp_path / "page.md", ["first", "second", "third"]
    write([group("third", "3"), group("first", "1")], names, page)
    write([group("second", "2")], names, page)
    whole = document("\n".join(group(*each).lines()) for each in zip(names, "123", strict=True))
    assert page.read_text(encoding="utf-8") == whole
    write([group("second", "4")], names, page)
    assert page.read_text(encoding="utf-8") == whole.replace("| 2 |", "| 4 |")


@pytest.mark.serial
def test_make_verify_runs_all_groups():
    text = (Path(__file__).parents[2] / "Makefile").read_text(encoding="utf-8")
    (found,) = re.findall(r"^groups := (.*)$", text, re.MULTILINE)
    code = (Path(__file__).parents[2] / "verification" / "__main__.py").read_text(encoding="utf-8")
    assert found.split() == re.findall(r'^    "(\w+)": \w+\.\w+,$', code, re.MULTILINE)
