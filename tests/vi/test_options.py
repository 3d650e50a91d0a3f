"""PETSc's options on the command line of a script."""

import subprocess
from pathlib import Path

import pytest
from helpers import start
from petsc4py import PETSc

from signorini_cr.options import PREFIX, take

SCRIPT = """
import sys
import numpy as np
import signorini_cr as scr
square = scr.Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], ("contact", *["dirichlet"] * 3))
solution = scr.solve(scr.Problem(f=-1.0), square.mesh(0.5))
print("steps", solution.iterations.newton, sys.argv[1:])
"""


@pytest.fixture
def database():
    """Options, of which none with the tests' name is left afterwards."""
    options = PETSc.Options()
    yield options
    for name in ("test_a", "test_b", "test_c"):
        options.delValue(PREFIX + name)


def test_words_under_the_prefix_become_options(database):
    database.setValue(f"{PREFIX}test_c", "mine")
    words = "in.msh -test_a 1 --out -signorini_test_a -1e-3 -signorini_test_b --quiet".split()
    take([*words, "-signorini_test_c", "theirs", "-signorini_test_a", "2.5"])
    assert database.getReal(f"{PREFIX}test_a") == 2.5  # the last one counts, as with PETSc
    assert database.hasName(f"{PREFIX}test_b")
    assert database.getString(f"{PREFIX}test_c") == "mine"
    assert not database.hasName("test_a")


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    (folder / "my.py").write_text(SCRIPT)
    return start(folder / "my.py", *words)


@pytest.mark.serial
def test_options_of_a_script_reach_the_solver(tmp_path):
    plain = run(tmp_path)
    assert (plain.returncode, plain.stderr) == (0, "")
    told = run(tmp_path, "--out", "folder", "-signorini_snes_monitor")
    steps = int(plain.stdout.split()[1])
    norms = [line for line in told.stdout.splitlines() if "SNES Function norm" in line]
    assert len(norms) == steps + 1
    wrong = run(tmp_path, "-signorini_snes_type", "newtontr")
    assert wrong.returncode != 0 and "InputError" in wrong.stderr


@pytest.mark.serial
def test_a_misspelt_option_is_told(tmp_path):
    result = run(tmp_path, "-signorini_snes_monitr")
    assert result.returncode == 0
    assert "name:-signorini_snes_monitr" in result.stdout + result.stderr
