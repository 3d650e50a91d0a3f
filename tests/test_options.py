"""PETSc's options on the command line of a script."""

import re
import subprocess
from pathlib import Path

import pytest
from helpers import ROOT, command, start, undrawn_command
from petsc4py import PETSc

from signorini_cr.options import PREFIX, take

pytestmark = pytest.mark.slow

SCRIPT = """
import sys
import numpy as np
import signorini_cr as scr
square = scr.Polygon([[0, 0], [1, 0], [1, 1], [0, 1]], ("contact", *["dirichlet"] * 3))
solution = scr.solve(scr.Problem(f=-1.0), square.mesh(0.5))
print("steps", solution.iterations.newton, sys.argv[1:])
"""


CASE = """[domain]
vertices = [[0, 0], [1, 0], [1, 1], [0, 1]]
size = 0.5
boundary = ["contact", "neumann", "dirichlet", "neumann"]
[data]
f = "-2 - x"
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
    more = "-signorini_snes_monitor", "-signorini_ksp_rtol", "1e-3"
    told = run(tmp_path, "--out", "folder", *more)
    assert (told.returncode, told.stderr) == (0, "")
    steps = int(re.search(r"^steps (\d+)", told.stdout, re.MULTILINE)[1])
    norms = [line for line in told.stdout.splitlines() if "SNES Function norm" in line]
    assert len(norms) == steps + 1
    wrong = run(tmp_path, "-signorini_snes_type", "newtontr")
    assert wrong.returncode != 0 and "InputError" in wrong.stderr


@pytest.mark.serial
def test_options_without_the_prefix_are_told(tmp_path):
    """They do not reach the solver, nor PETSc; a script's own words are its own."""
    own = ["-n", "3", "-v", "-f", "in.msh", "-info", "-mat_file", "a", "--ksp_view", "-pc"]
    plain = run(tmp_path, *own)
    assert (plain.returncode, plain.stderr) == (0, "") and "SNES" not in plain.stdout
    result = run(tmp_path, "-snes_monitor", "-ksp_rtol", "1e-3", "-log_view", ":x.txt")
    assert result.returncode == 0 and "SNES Function norm" not in result.stdout
    solver, petsc = result.stderr.splitlines()
    write = "-signorini_snes_monitor, -signorini_ksp_rtol"
    assert solver.endswith(f"-snes_monitor, -ksp_rtol did not reach the solver; write {write}")
    assert "-log_view did not reach PETSc; set PETSC_OPTIONS='-log_view :x.txt'" in petsc


@pytest.mark.serial
def test_options_that_petsc_has_are_no_alarm(tmp_path, monkeypatch):
    """Given at its start, set by the script, or by the environment; some solver may use them."""
    begin = "import sys, signorini_cr, petsc4py\npetsc4py.init(sys.argv)\n"
    words = ["-log_view", f":{tmp_path / 'x.txt'}", "-ksp_view"]
    (tmp_path / "init.py").write_text(begin + SCRIPT)
    done = start(tmp_path / "init.py", *words)
    assert "signorini_cr: warning" not in done.stderr and (tmp_path / "x.txt").exists()
    later = SCRIPT + "from petsc4py import PETSc\nPETSc.Options()['ksp_view'] = None\n"
    (tmp_path / "later.py").write_text(later)
    assert "signorini_cr: warning" not in start(tmp_path / "later.py", "-ksp_view").stderr
    monkeypatch.setenv("PETSC_OPTIONS", f"-log_view :{tmp_path / 'y.txt'}")
    assert run(tmp_path, "-log_view").stderr == "" and (tmp_path / "y.txt").exists()


@pytest.mark.serial
def test_a_misspelt_option_of_the_command_is_told(tmp_path):
    """By PETSc, once nobody has asked for it: to look for its name would count as use."""
    (tmp_path / "case.toml").write_text(CASE)
    words = "solve", "case.toml", "--out", "out", "--quiet"
    done = undrawn_command(*words, "-signorini_smother", "jacobi", cwd=tmp_path)
    assert done.returncode == 0 and "name:-signorini_smother" in done.stdout + done.stderr
    done = undrawn_command(*words, "-signorini_smoother", "jacobi", cwd=tmp_path)
    assert done.returncode == 0 and "WARNING" not in done.stdout + done.stderr


@pytest.mark.serial
def test_options_that_petsc_cannot_start_with(tmp_path, monkeypatch):
    """From the command line and from the environment: its words, and a message of ours."""
    (tmp_path / "some.opt").write_bytes(bytes(range(256)))
    words = "solve", ROOT / "meshes" / "s1.toml", "--out", tmp_path / "out"
    runs = [command(*words, "-options_file", tmp_path / "some.opt", cwd=tmp_path)]
    monkeypatch.setenv("PETSC_OPTIONS", "-options_file /nowhere")
    runs += [command(*words, cwd=tmp_path)]
    for done in runs:
        assert done.returncode == 2 and "Traceback" not in done.stderr
        assert "signorini-cr: PETSc cannot start, error code" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.serial
def test_a_misspelt_option_is_told(tmp_path):
    result = run(tmp_path, "-signorini_snes_monitr")
    assert result.returncode == 0
    assert "name:-signorini_snes_monitr" in result.stdout + result.stderr


@pytest.mark.serial
def test_an_option_that_petsc_refuses_ends_the_run(tmp_path):
    """That of the bounds' linear systems as well, which come after u_h: no bounds were told."""
    (tmp_path / "case.toml").write_text(CASE)
    for name in ("signorini_bottom_pc_type", "signorini_estimate_ksp_type"):
        done = command("solve", "case.toml", "--out", "out", f"-{name}", "foo", cwd=tmp_path)
        assert done.returncode == 2 and "PETSc refuses an option" in done.stderr, done.stdout
        assert not (tmp_path / "out" / "report.json").exists()
