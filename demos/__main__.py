"""Make every table and figure of the studies again.

    mpirun -n 2 python3 demos [FOLDER]

writes FOLDER/studies.md and the pictures in FOLDER/studies (FOLDER is docs without an argument).
"""

from __future__ import annotations

import gc
import sys
import time
from pathlib import Path

import notebook
import study
from mpi4py import MPI

from signorini_cr.errors import on_root

DEMOS = (
    "demo_s1",
    "demo_theorem_31",
    "demo_theorem_32_33",
    "demo_theorem_34",
    "demo_outside",
    "demo_elements",
    "demo_facet_sets",
    "demo_pressure",
    "demo_estimate",
    "demo_families",
    "demo_quadrature",
)
"""In the order in which they are read."""

INTRODUCTION = """\
# The theory of the paper, verified

Each of the paper's statements has a study: a demo that anyone can run, a table and a picture. All
of this page is made by `make studies`, which runs

    mpirun -n {ranks} python3 demos docs

in {minutes:.1f} minutes of processor time of each rank; the finest meshes have
{dofs:,} degrees of freedom. Every demo ends in assertions, so that the page is there only if they
hold. The examples (S1, A, B, C 7/2, C 11/2, D, E, I, L) are those of `signorini_cr.exact`, where C
and C2 stand for C 7/2 and C 11/2; h is the largest diameter of a triangle, and rates are those
between a level and the one before it. [The method](method.md) has the formulas up to (2.2).

| statement | seen in |
|---|---|
| Theorem 3.1, $h^{{3/4}}$: the rates seen lie above this floor | [there](#{theorem_31}) |
| Theorems 3.2 and 3.3, finitely many critical points | [there](#{theorem_32_33}) |
| Theorem 3.4, infinitely many critical points | [there](#{theorem_34}) |
| outside the theory: u not in H² | [there](#{outside}) |
| the same rates as for the continuous element | [there](#{elements}) |
| the facet sets (2.2) | [there](#{facet_sets}) |
| the contact pressure, of which the paper says nothing | [there](#{pressure}) |
| the abstract estimate (1.11), with the terms (4.2) | [there](#{estimate}) |

## The examples

Γ1 is part of y = 0, and contact begins or ends at the origin unless said otherwise; r and θ are
polar coordinates there.

| name | u | what it is for |
|---|---|---|
| S1 | (1 − x²)(1 − y²) r^1.5 cos 1.5θ | the regularity that a point has where contact ends |
| A | x³ for x > 0, −y&#124;x&#124;³ for x < 0 | a pressure that fades slowly, hard on active sets |
| B, C 7/2, C 11/2 | r^s cos sθ, s = 3/2, 7/2, 11/2 | harmonic; u is not 0 on Γ0 |
| D | √r sin(θ/2) | not in H²; Γ0 and Γ1 meet at the origin, no contact |
| E | not known; f = 2π sin 2πx | the unit square |
| I | contact begins and ends at x = 1, ½, ⅓, … | infinitely many critical points |
| L | not known; f = 1 | a re-entrant corner |

## From figure to command

| figure | command |
|---|---|
{figures}

Each command takes the folder for its results as an argument; `SIGNORINI_DEMO_LEVELS=5` in the
environment makes a quick run on fewer meshes.
"""


def main() -> None:
    """Run all demos on all ranks and put their pages together."""
    comm = MPI.COMM_WORLD
    target = study.wanted_folder("docs")
    folder = target / "studies"
    sys.argv[1:] = [str(folder)]
    here = Path(__file__).parent
    began = time.process_time()
    pages = {}
    for name in DEMOS:
        start = time.perf_counter()
        pages[name] = notebook.run(here / f"{name}.py")
        gc.collect()
        if comm.rank == 0:
            print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    facts = {
        "ranks": comm.size,
        "minutes": comm.allreduce(time.process_time() - began, op=MPI.MAX) / 60,
        "dofs": study.most_dofs(),
    }

    def write() -> None:
        text = _put_together(pages, folder.name, facts)
        (target / "studies.md").write_text(text, encoding="utf-8")
        for name in DEMOS:  # their own pages, without prose
            (folder / f"{name}.md").unlink()

    on_root(comm, write)


def _put_together(
    pages: dict[str, tuple[str, list[str]]], folder: str, facts: dict[str, float]
) -> str:
    """Make one page of the demos' pages.

    Args:
        pages: Title and parts of each.
        folder: Where the pictures are, seen from the page.
        facts: Figures of the introduction.
    """
    bodies, figures, anchors = [], [], {}
    for name, (title, parts) in pages.items():
        kept = [c for c in title.lower() if c.isalnum() or c in " -_"]
        anchors[name.removeprefix("demo_")] = "".join(kept).replace(" ", "-")
        body = "\n\n".join(parts).replace("](", f"]({folder}/")
        bodies.append(f"## {title}\n\n{body}\n")
        figures += [
            f"| [{file}]({folder}/{file}) | `mpirun -n 2 python3 demos/{name}.py` |"
            for file in (part.split("](")[1].split(")")[0] for part in parts if part[:2] == "![")
        ]
    introduction = INTRODUCTION.format(figures="\n".join(figures), **facts, **anchors)
    return "\n".join([introduction, *bodies])


main()
