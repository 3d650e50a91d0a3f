"""The demos run as their users run them, alone and on two ranks, and leave what they promise.

A demo ends in assertions of its own, so that its exit status says whether its numbers are right.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

DEMOS = Path(__file__).parent.parent / "demos"
SECONDS = 600


def run(ranks, *arguments, levels=5):
    """Start a demo under mpirun, free of what this process's own MPI left in the environment."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not re.match(r"(PMIX|PMI_|PRTE_(?!MCA)|OMPI_(?!MCA|ALLOW))", name)
    }
    environment["SIGNORINI_DEMO_LEVELS"] = str(levels)
    return subprocess.run(
        ["mpirun", "-n", str(ranks), sys.executable, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )


@pytest.mark.serial
@pytest.mark.parametrize("ranks", [1, 2])
def test_demo_s1(ranks, tmp_path):
    result = run(ranks, DEMOS / "demo_s1.py", tmp_path)
    assert result.returncode == 0, result.stderr
    # One row per level, whatever the number of ranks
    rows = [line.split() for line in result.stdout.splitlines() if re.match(r"\s+\d+ ", line)]
    assert [int(row[0]) for row in rows] == [0, 1, 2, 3, 4]
    for name in ("solution", "contact", "convergence"):
        assert is_picture(tmp_path / f"s1-{name}.png")


@pytest.mark.serial
@pytest.mark.parametrize("ranks", [1, 2])
def test_all_studies(ranks, tmp_path):
    """Every demo in one go, as docs/studies.md is made; the page shows all the pictures."""
    result = run(ranks, DEMOS, tmp_path)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    page = (tmp_path / "studies.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"!\[[^]]*\]\(studies/([^)]*\.png)\)", page))
    assert shown == {path.name for path in (tmp_path / "studies").iterdir()}
    assert all(is_picture(tmp_path / "studies" / name) for name in shown)
    scripts = {path.name for path in DEMOS.glob("demo_*.py")}
    listed = {name for name in scripts if f"demos/{name}" in page}
    assert {"demo_s1.py", "demo_theorem_31.py", "demo_estimate.py"} <= listed
    assert len(shown) >= len(listed)


def is_picture(path):
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 10_000


@pytest.mark.serial
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("name", ["demo_theorem_31"])  # and those of test_certificate_demos.py
def test_demos_on_their_own(name, ranks, tmp_path):
    result = run(ranks, DEMOS / f"{name}.py", tmp_path, levels=4)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    pictures = list(tmp_path.glob("*.png"))
    assert pictures and all(is_picture(path) for path in pictures)


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
