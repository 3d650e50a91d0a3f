"""The demos run as their users run them, alone and on two ranks, and leave what they promise.

A demo ends in assertions of its own, so that its exit status says whether its numbers are right.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import (
    compute_midpoints,
    create_unit_square,
    meshtags,
)
from helpers import DEMOS, command, is_picture, script, start, tagged
from mpi4py import MPI

import signorini_cr
from signorini_cr import exact, solve_adaptive

pytestmark = pytest.mark.slow


COMM = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def studies(tmp_path_factory):
    """Every demo of the theory in one go, as docs/studies.md is made."""
    folder = COMM.bcast(tmp_path_factory.mktemp("studies"))
    status, printed = script(DEMOS, folder, SIGNORINI_DEMO_LEVELS="4")
    assert status == 0
    return folder, COMM.bcast(printed)


def test_the_page_shows_all_that_the_studies_drew(studies):
    folder, _ = studies
    page = (folder / "studies.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"!\[[^]]*\]\(studies/([^)]*\.png)\)", page))
    assert shown == {path.name for path in (folder / "studies").iterdir()}
    assert all(is_picture(folder / "studies" / name) for name in shown)
    listed = {path.name for path in DEMOS.glob("demo_*.py") if f"demos/{path.name}" in page}
    assert {"demo_s1.py", "demo_theorem_31.py", "demo_estimate.py"} <= listed
    assert len(shown) >= len(listed)


def test_the_first_demo_prints_a_row_a_level(studies):
    folder, printed = studies
    first = printed.split("demo_s1: ")[0].splitlines()
    rows = [line.split() for line in first if re.match(r"\s+\d+ ", line)]
    assert [int(row[0]) for row in rows] == [0, 1, 2, 3]
    drawn = {path.name for path in (folder / "studies").glob("s1-*.png")}
    assert drawn == {f"s1-{name}.png" for name in ("solution", "contact", "convergence")}


@pytest.mark.parametrize(
    ("demo", "pictures"),
    [
        (
            "demo_adaptive.py",
            {"adaptive-l-shape-error", "adaptive-hole-mesh", "adaptive-convergence"},
        ),
        ("demo_certificate.py", {"certificate"}),
        ("demo_frost.py", {"frost", "frost-night"}),
        ("demo_dam.py", {"dam"}),
        ("demo_seepage.py", {"seepage", "seepage-heads"}),
        ("demo_wall.py", {"wall", "wall-strip"}),
    ],
)
def test_demos_on_their_own(demo, pictures, shared_tmp_path):
    assert script(DEMOS / demo, shared_tmp_path, SIGNORINI_DEMO_LEVELS="3")[0] == 0
    assert {path.stem for path in shared_tmp_path.glob("*.png") if is_picture(path)} >= pictures


@pytest.mark.serial
def test_no_demo_is_left_out():
    """Each is made with the studies, or runs on its own."""
    text = (DEMOS / "__main__.py").read_text(encoding="utf-8")
    made = re.findall(r'"(\w+)"', re.search(r"^DEMOS = \((.*?)\)", text, re.M | re.S)[1])
    (alone,) = (mark.args[1] for mark in test_demos_on_their_own.pytestmark)
    tried = sorted([*made, *(Path(demo).stem for demo, _ in alone)])
    assert tried == sorted(path.stem for path in DEMOS.glob("demo_*.py"))


@pytest.mark.parametrize("demo", ["", "film.py", "demo_s1.py"])
@pytest.mark.parametrize(("option", "status"), [("--help", 0), ("--levels=2", 2)])
def test_an_option_is_no_folder(demo, option, status, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended, printed = script(DEMOS / demo, option)
    assert ended == status and not list(tmp_path.iterdir())
    assert printed.startswith("usage: ") is (COMM.rank == 0)


def test_the_film_has_a_frame_a_mesh(shared_tmp_path):
    image = pytest.importorskip("PIL.Image")
    assert script(DEMOS / "film.py", shared_tmp_path, SIGNORINI_DEMO_LEVELS="6")[0] == 0
    if COMM.rank == 0:
        path = shared_tmp_path / "adaptive.gif"
        *_, last = meshes = list(solve_adaptive(exact.L.problem, exact.L.mesh(0.5, MPI.COMM_SELF),
                                                max_dofs=500, fraction=0.3))  # fmt: skip
        assert last.dofs <= 500
        with image.open(path) as film:
            assert film.n_frames == len(meshes)
        assert path.stat().st_size < 1_000_000


def in_the_how_to(language, word):
    """The listing of docs/howto.md that has this word in it."""
    text = (DEMOS.parent / "docs" / "howto.md").read_text(encoding="utf-8")
    (found,) = (
        each for each in re.findall(rf"```{language}\n(.*?)```", text, re.S) if word in each
    )
    return found


def of_the_how_to(path, word):
    """Run the script of docs/howto.md that has this word in it; what this rank prints."""
    if COMM.rank == 0:
        path.write_text(in_the_how_to("python", word), encoding="utf-8")
    COMM.Barrier()
    status, printed = script(path)
    assert status == 0
    return printed


def test_the_script_of_the_documents_runs(shared_tmp_path, monkeypatch):
    monkeypatch.chdir(shared_tmp_path)
    printed = of_the_how_to(shared_tmp_path / "my.py", '"my.png"')
    if COMM.rank == 0:
        force, bound = map(float, printed.split())
        assert 0 < force < 6 and 0 < bound < 0.5  # the load is 6
        assert is_picture(shared_tmp_path / "my.png")


def test_the_script_that_draws_with_gmsh_runs(shared_tmp_path, monkeypatch):
    monkeypatch.chdir(shared_tmp_path)
    printed = of_the_how_to(shared_tmp_path / "plate.py", '"plate.msh"')
    domain = signorini_cr.read_gmsh(shared_tmp_path / "plate.msh")
    area = COMM.allreduce(fem.assemble_scalar(fem.form(fem.Constant(domain.mesh, 1.0) * ufl.dx)))
    assert 2 - 0.04 * np.pi < area < 2 - 0.035 * np.pi  # the hole's corners are on its circle
    if COMM.rank == 0:
        force, bound = map(float, printed.split())
        assert 0 < force < 3 * area and 0 < bound < 0.5


def test_the_adaptive_script_of_the_documents_runs(shared_tmp_path, monkeypatch):
    monkeypatch.chdir(shared_tmp_path)
    printed = of_the_how_to(shared_tmp_path / "top.py", '"top.vtu"')
    if COMM.rank > 0:
        assert printed == ""
        return
    *rows, last = printed.splitlines()
    bounds = [float(row.rpartition(" ")[2]) for row in rows]
    assert bounds == sorted(bounds, reverse=True) and bounds[-1] <= 0.25 < bounds[-2]
    lower, upper = map(float, re.findall(r"\d+\.\d+", last))
    assert lower < 11.9 and 12.3 < upper < lower + 2.0  # finer meshes leave 11.895 to 12.313
    assert (shared_tmp_path / "top.vtu").stat().st_size > 10_000


def test_robin_materials_and_two_contact_parts_take_ten_lines():
    listing = in_the_how_to("python", '"shelf": scr.Contact')
    assert len(listing.strip().splitlines()) <= 12  # ten of them code, but for brackets
    mesh = create_unit_square(COMM, 8, 8)

    def sides(x, y):
        return np.select([y < 1e-9, x < 1e-9, x > 1 - 1e-9], [1, 2, 3], 4)

    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    kinds = np.where(compute_midpoints(mesh, 2, cells)[:, 1] > 0.5, 7, 0)
    names = {
        "scr": signorini_cr,
        "mesh": mesh,
        "facet_tags": tagged(mesh, sides),
        "cell_tags": meshtags(mesh, 2, cells, kinds.astype(np.int32)),
    }
    exec(listing, names)
    solution, bound = names["solution"], names["bound"]
    assert names["force"] > 0.0 and solution.contact.kkt.min_gap > -1e-9
    table = solution.contact.table()
    if table is not None:
        on_bank = table["x"] < 1e-9
        assert table["obstacle"] == pytest.approx(np.where(on_bank, -0.1 * table["y"], 0.0))
        assert np.count_nonzero(on_bank) == 32 == len(on_bank) / 2
        assert (table["upper"][on_bank] == 0.5).all() and np.isnan(table["upper"][~on_bank]).all()
    assert 0 < bound < 0.5


@pytest.mark.serial
def test_the_gmsh_file_of_the_documents_is_read(tmp_path):
    (tmp_path / "dam.geo").write_text(in_the_how_to("text", "Physical"), encoding="utf-8")
    (tmp_path / "dam.toml").write_text(in_the_how_to("toml", "dam.msh"), encoding="utf-8")
    (line,) = re.findall(r"python3 -c '(.*?)'", in_the_how_to("sh", "import gmsh"), re.S)
    assert start("-c", line, cwd=tmp_path).returncode == 0
    done = command("solve", "dam.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "contact    u ≥ -0.3" in done.stdout
    assert "rock       κ = 4;" in done.stdout and "clay       κ = 0.5;" in done.stdout


@pytest.mark.serial
def test_a_demo_starts_as_its_users_start_it(tmp_path):
    done = start(DEMOS / "demo_seepage.py", tmp_path, ranks=2, SIGNORINI_DEMO_LEVELS="1")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    told = " ".join(done.stdout.split())
    assert told.endswith("demo_seepage.md and, beside it, seepage.png, seepage-heads.png")
    assert is_picture(tmp_path / "seepage.png")


@pytest.mark.serial
def test_demos_are_notebooks_too():
    """In py:percent format: cells of Markdown and of code, the aim first."""
    for path in DEMOS.glob("demo_*.py"):
        lines = path.read_text(encoding="utf-8").splitlines()
        assert lines[0] == "# %% [markdown]", path.name
        assert lines[1].startswith("# # "), path.name
        assert sum(line.startswith("# %%") for line in lines) >= 6, path.name


@pytest.mark.serial
def test_the_page_in_docs_is_whole():
    """Its pictures are there, and the commands that make them name demos that exist."""
    docs = DEMOS.parent / "docs"
    page = (docs / "studies.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"\]\((studies/[^)]*\.png)\)", page))
    assert shown and all(is_picture(docs / name) for name in shown)
    assert {path.name for path in (docs / "studies").iterdir()} == {Path(n).name for n in shown}
    named = set(re.findall(r"demos/(demo_\w+\.py)", page))
    assert named and all((DEMOS / name).exists() for name in named)
