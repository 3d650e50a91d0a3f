"""Tools that benchmarks and demos share, and the picture in ARCHITECTURE.md."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from helpers import ROOT, start

import signorini_cr

PACKAGE = Path(signorini_cr.__file__).parent

pytestmark = [pytest.mark.slow, pytest.mark.serial]


def load(name):
    """The names of a file that is no module of a package."""
    return runpy.run_path(str(ROOT / name))


@pytest.mark.parametrize("file", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda f: f.stem)
def test_benchmarks_can_be_imported(file, monkeypatch):
    """Importing one starts nothing, and one has what its command line in the docstring says."""
    monkeypatch.syspath_prepend(str(file.parent))
    for name in ("execv", "execve", "system"):
        monkeypatch.setattr(f"os.{name}", None)
    before = set(sys.modules)
    try:
        runpy.run_path(str(file), run_name="imported")
    finally:
        for name in {"harness", "cases"} & (set(sys.modules) - before):
            del sys.modules[name]


def test_results_are_published_on_demand_only(monkeypatch):
    harness = load("benchmarks/harness.py")
    parser = harness["command_line"]("Title.\n\nMore.", cases=["a", "b"], dofs=1e5, repeats=3)
    assert harness["PUBLISHED"] == ROOT / "benchmarks" / "results"
    assert parser.parse_args([]).out == Path("benchmark-out")
    assert parser.parse_args(["--out", "x"]).out == Path("x")
    assert parser.parse_args(["--publish"]).out == harness["PUBLISHED"]
    with pytest.raises(SystemExit):
        parser.parse_args(["--publish", "--out", "x"])
    assert vars(parser.parse_args([])) == {
        "cases": ["a", "b"], "dofs": 1e5, "repeats": 3, "out": Path("benchmark-out"),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "kept"), [("one_solve", "ranks-1.csv"), ("two_ranks", "two_ranks.json")]
)
def test_pictures_are_drawn_anew_without_measurements(name, kept, tmp_path):
    """From what is kept; the table, which has the day of the measurements, stays as it is."""
    shutil.copy(ROOT / "benchmarks" / "results" / kept, tmp_path)
    done = start(ROOT / "benchmarks" / f"{name}.py", "--out", tmp_path, "--cases")
    assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {kept, f"{name}.png"}


def test_every_case_of_one_solve_is_in_its_picture(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    names = load("benchmarks/one_solve.py")
    drawn = [name for alike in names["ALIKE"].values() for name in alike]
    assert sorted(drawn) == sorted(names["cases"]())
    for name in ("harness", "cases"):
        sys.modules.pop(name)


@pytest.mark.parametrize("name", ["pcmg", "submatrix"])
def test_the_cycle_and_what_it_is_compared_with(name, tmp_path):
    """A cycle of PCMG, whatever its transfers are, has the same result as the program's."""
    few = "--cases", "S1", "--dofs", "2e4", "--repeats", "1"
    done = start(ROOT / "benchmarks" / f"{name}.py", *few, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / f"{name}.md").read_text().splitlines()
    if name == "pcmg":
        differences = [float(each.split("|")[-2]) for each in lines[2:4]]
        assert max(differences) < 1e-13


def test_turns_and_medians():
    harness = load("benchmarks/harness.py")
    calls = []

    def action(name):
        calls.append(name)
        return {"seconds": float(len(calls) ** 2)}

    actions = {name: lambda name=name: action(name) for name in "ab"}
    found = harness["in_turns"](actions, repeats=3)
    assert calls == list("abababab")
    assert [run["seconds"] for run in found["a"]] == [9.0, 25.0, 49.0]
    assert harness["medians"](found["b"]) == {"seconds": 36.0}


def test_tables_are_kept_as_their_rows_come(tmp_path, capsys):
    harness, path = load("benchmarks/harness.py"), tmp_path / "new" / "table.md"

    def rows():
        yield ["a", "1"]
        assert "| a | 1 |" in path.read_text()
        yield ["b", "2"]

    harness["tabulate"](("case", "figure"), rows(), path)
    lines = path.read_text().splitlines()
    assert lines[:4] == ["| case | figure |", "|---|---:|", "| a | 1 |", "| b | 2 |"]
    assert re.fullmatch(
        r"Last measured on: .+, \d+ cores, Python 3\.\S+, \d{4}-\d\d-\d\d", lines[-1]
    )
    assert capsys.readouterr().out.splitlines() == lines[:4]


DEMO = '''# %% [markdown]
# # Title
#
# **Aim.** First.
#
# Second.

# %%
class Study:
    """Keeps parts as the real one does."""

    def __init__(self):
        self.title, self.parts = "A study", []


study = Study()


def later():
    """Called two cells below."""
    study.parts.append("table of later")


# %% [markdown]
# ## Only a heading

# %%
study.parts.append("one")
study.parts.append("two")

# %% [markdown]
# ## Check
# All is well.

# %%
later()
failed = 1 / ZERO
'''


def test_pages_have_prose_and_results_in_their_order(tmp_path):
    """A part stands behind the cell that made it, wherever in the file the call is written."""
    notebook, script = load("demos/notebook.py"), tmp_path / "demo.py"
    script.write_text(DEMO.replace("1 / ZERO", "1 / 1"))
    title, page = notebook["run"](script)
    assert title == "A study"
    prose = "**Aim.** First.\n\nSecond."
    assert page == [prose, "one", "two", "### Check\nAll is well.", "table of later"]


def test_a_failing_cell_names_its_line(tmp_path):
    notebook, script = load("demos/notebook.py"), tmp_path / "demo.py"
    script.write_text(DEMO)
    with pytest.raises(NameError) as raised:
        notebook["run"](script)
    assert raised.traceback[-1].lineno + 1 == 1 + DEMO[: DEMO.index("failed")].count("\n")


def test_the_picture_of_the_streets_has_their_arrows():
    """Otherwise: `./container/run python3 docs/architecture.py`, and look at it."""
    drawn = (ROOT / "docs" / "architecture.svg").read_text(encoding="utf-8")
    arrows = load("docs/architecture.py")["read"](PACKAGE)
    found = set(re.findall(r'id="([\w ]+) &gt; ([\w ]+)"', drawn))
    assert found == arrows


def test_streets_are_drawn_from_the_top_to_the_bottom():
    names = load("docs/architecture.py")
    order = names["floors"](arrows := names["read"](PACKAGE))
    assert order[-1] == names["GROUND"] and order[-2] == "mesh"
    assert all(order.index(here) < order.index(there) for here, there in arrows)


def test_the_architecture_is_read_in_some_minutes():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80 and len(text.split()) <= 1250
