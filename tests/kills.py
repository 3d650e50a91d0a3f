"""Runs that are ended from outside, each from a seed, and a look at what they leave.

    container/run python3 tests/kills.py --count 60 --seed 0 --ranks 1 2 3 4

prints for each kind of end how many runs there were and with which status they ended, and the seeds
of those that hung, lost a finished level, could not be resumed, or left anything but whole files of
one run.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import helpers
import numpy as np
from dolfinx import jit
from mpi4py import MPI

from signorini_cr.output.checkpoint import read_checkpoint
from signorini_cr.output.files import STAGE, check_writable
from signorini_cr.output.report import FILES

CASE = """[domain]
vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
boundary = ["contact", "dirichlet", "dirichlet", "dirichlet"]
size = 0.25
[data]
f = -3
obstacle = "0.1*x - 0.2"
[refine]
levels = 9
"""
STEPS = 40
SEARCHED = 4
"""Steps of a run whose mesh is searched for."""
CASES = {
    "uniform": CASE,
    "adaptive": CASE.replace("levels = 9", 'mode = "adaptive"\nlevels = 20'),
    "time": CASE.replace("f = -3", 'f = "-3 - 20*sin(5*t)"').replace("levels = 9", "levels = 2")
    + f'[time]\nend = 2\nsteps = {STEPS}\nscheme = "bdf2"\n',
    "search": CASE.replace("f = -3", 'f = "-3 - 20*sin(5*t)"')
    + f'mode = "adaptive"\n[time]\nend = 0.5\nsteps = {SEARCHED}\n',
}
"""On a sequence of meshes, on meshes that adapt, in steps in time, on meshes sought for these."""
PATIENCE = 5.0
"""Seconds until all processes of a run are gone."""


class End(NamedTuple):
    """The end of a run.

    Attributes:
        kind: Ranks, signal, who got it, and of which case the run was.
        status: Of mpirun or of the one process.
        levels: How many levels, or steps, the report has; -1 where the results of the former run
            are left.
        faults: What should not have been.
    """

    kind: str
    status: int
    levels: int
    faults: list[str]


def family(pid: int) -> list[int]:
    """A process and all its descendants."""
    found = [pid]
    for parent in found:
        try:
            for task in Path(f"/proc/{parent}/task").iterdir():
                found += [int(word) for word in (task / "children").read_text().split()]
        except OSError:
            pass
    return found


def alive(pid: int) -> bool:
    """Tell whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def ranks_of(pids: list[int]) -> list[int]:
    """Those of the processes that run the command."""
    found = []
    for pid in pids:
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"signorini_cr" in words and b"mpirun" not in words[0] and b"prte" not in words[0]:
            found.append(pid)
    return found


def own_cache(folder: Path) -> Path:
    """A cache folder that has all forms compiled so far, and whose damage harms nobody."""
    cache = folder / "cache"
    if not cache.exists():
        forms = Path(jit.get_options()["cache_dir"])
        (cache / "fenics").mkdir(parents=True)
        for path in forms.glob("libffcx_*"):
            if (forms / (path.name.split(".")[0] + ".c.cached")).exists():
                (cache / "fenics" / path.name).symlink_to(path)
        for path in forms.parent.glob("*"):  # fonts, for one, which take seconds to list
            if path != forms:
                (cache / path.name).symlink_to(path)
    return cache


def finished(report: dict[str, Any]) -> int:
    """Count the levels of a report, or the meshes that were tried and steps."""
    return len(report.get("times", report["levels"])) + len(report.get("search", []))


def levels_in(out: Path) -> int:
    """Count the levels, or meshes that were tried and steps, in the report."""
    try:
        return finished(json.loads((out / "report.json").read_text()))
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def killed(
    folder: Path, seed: int, counts: Sequence[int] = (1, 2), kinds: Sequence[str] = ("uniform",)
) -> End:
    """Start a run on one of some numbers of ranks, end it at a random moment, look around.

    Args:
        folder: Where.
        seed: What all is drawn from.
        counts: Numbers of ranks to choose from.
        kinds: Keys of `CASES` to choose from.
    """
    kind = str(np.random.default_rng([seed, 1]).choice(kinds))
    random = np.random.default_rng(seed)
    ranks = int(random.choice(counts))
    number = signal.Signals(random.choice([signal.SIGINT, signal.SIGTERM, signal.SIGKILL]))
    target = "one" if ranks == 1 else str(random.choice(["mpirun", "one rank", "all ranks"]))
    moment = float(random.uniform(0, 3)) if random.random() < 0.3 else None
    wanted, more = int(random.integers(1, 8)), float(random.uniform(0, 0.2))
    out, case = folder / f"out-{seed}", folder / "case.toml"
    case.write_text(CASES[kind])
    if kind == "time":  # steps are shorter than levels
        wanted *= 4
    new = bool(np.random.default_rng([seed, 2]).integers(3) == 0)  # what has not been there yet
    if not new:
        out.mkdir()
        for name in FILES:
            (out / name).write_text("former")
    solve = [sys.executable, "-m", "signorini_cr", "solve", str(case), "--out", str(out)]
    launch = ["mpirun", "-n", str(ranks)] if ranks > 1 else []
    clean = helpers.clean_environment(XDG_CACHE_HOME=str(own_cache(folder)))
    run = subprocess.Popen(
        [*launch, *solve],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=clean,
        start_new_session=True,
    )
    began = time.monotonic()
    while run.poll() is None and time.monotonic() - began < 60:
        late = time.monotonic() - began > moment if moment is not None else False
        if late or (moment is None and levels_in(out) >= wanted):
            break
        time.sleep(0.01)
    time.sleep(more)
    everyone, done = family(run.pid), levels_in(out)
    own = ranks_of(everyone)
    hit = {"one rank": own[-1:], "all ranks": own}.get(target, [run.pid]) or [run.pid]
    for pid in hit:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            pass
    sent, faults = time.monotonic(), []
    while any(map(alive, everyone)) and time.monotonic() - sent < PATIENCE:
        time.sleep(0.01)
    for pid in filter(alive, everyone):
        what = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
        faults.append(f"process {pid} is still there: {what}")
        os.kill(pid, signal.SIGKILL)
    said = run.communicate(timeout=30)[0]
    begun = "cli.py" in said  # before that it is Python that is interrupted
    if "Traceback" in said and begun:
        faults.append(f"traceback: {said[-600:]}")
    levels, more_faults = _left(out, new)
    if max(levels, 0) < done:
        faults.append(f"{done} levels were finished, {levels} are left")
    if target != "mpirun" and done and number != signal.SIGKILL:
        if run.returncode not in (128 + number, 0):
            faults.append(f"status {run.returncode}")
        # on several ranks mpirun may end all before it has read that
        if ranks == 1 and run.returncode and "finished and kept in" not in said:
            faults.append(f"nothing is said of what is kept: {said[-600:]}")
    if levels > 0 and random.random() < 0.3:
        again = [*solve, "--resume", "-q"]
        all_of_it = {"time": STEPS, "search": 9 + SEARCHED}.get(kind, levels + 1)
        again += [] if kind in ("time", "search") else ["--levels", str(all_of_it)]
        # a minute longer where a killed one has left a form half compiled
        more_run = subprocess.run(again, capture_output=True, text=True, env=clean, timeout=180)
        if more_run.returncode or levels_in(out) < all_of_it:
            faults.append(f"not resumed, status {more_run.returncode}: {more_run.stderr[-600:]}")
    return End(
        f"{ranks} {number.name} {target} {kind}", run.returncode, levels, faults + more_faults
    )


def _left(out: Path, new: bool) -> tuple[int, list[str]]:
    """Count the levels kept, and find what is wrong with the folder; `new` if it was not there."""
    faults = []
    looked = time.monotonic()
    check_writable(out)  # as the next run does
    while any(out.glob(STAGE + "*")) and time.monotonic() - looked < PATIENCE:
        time.sleep(0.1)  # a process that is gone may have threads that are not, with its locks
        check_writable(out)
    there = {path.name for path in out.iterdir()} if out.exists() else set()
    fields = {path.name for path in out.glob("step_*.vtu")}
    if strange := sorted(there - set(FILES) - fields):
        faults.append(f"left over: {strange}")
    if any(path.name.startswith(STAGE) for path in out.parent.iterdir()):
        faults.append("left over beside the folder")
    former = {name for name in there & set(FILES) if (out / name).read_bytes() == b"former"}
    if former == set(FILES):
        return -1, faults
    if former and "report.json" in there:
        faults.append(f"of a former run: {sorted(former)}")
    if "report.json" not in there:
        return 0, faults if new else [*faults, "no report"]
    report = json.loads((out / "report.json").read_text())
    what, table = ("times", "times.csv") if "times" in report else ("levels", "levels.csv")
    number = len(report[what])
    if number:  # while a mesh is searched for there are no steps
        with (out / table).open() as file:
            rows = list(csv.DictReader(file))
        if not number <= len(rows) <= number + 1:
            faults.append(f"{number} {what} in the report, {len(rows)} in the table")
    elif (out / table).exists():
        faults.append(f"no {what} in the report, and a table of some")
    if what == "times" and len(fields) < number:
        faults.append(f"{number} steps in the report, {len(fields)} fields")
    if (out / "solution.vtu").exists() and not report["complete"]:
        faults.append("a field beside a report that is not complete")
    found = read_checkpoint(out, MPI.COMM_SELF)
    if found is None or finished({"levels": [], **found[1]}) < finished(report):
        faults.append("nothing to resume from")
    return finished(report), faults


def main() -> None:
    """Count the ends and show those that are wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2], help="numbers of ranks")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    arguments = parser.parse_args()
    # or each run would begin by compiling the program's source, and be seconds late
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    counts: Counter[tuple[str, int]] = Counter()
    wrong = kept = 0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.seed, arguments.seed + arguments.count):
            end = killed(Path(folder), seed, arguments.ranks, arguments.cases)
            counts[end.kind, end.status] += 1
            kept += end.levels > 0
            if end.faults:
                wrong += 1
                print(f"seed {seed} ({end.kind}): {'; '.join(end.faults)}", flush=True)
    for (kind, status), count in sorted(counts.items()):
        print(f"{kind:32} status {status:4} {count:5}")
    print(f"{arguments.count} runs, {kept} with levels kept, {wrong} wrong")


if __name__ == "__main__":
    main()
