"""The page of a run: complete, on its own, and fit for a narrow screen."""

import html
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser

import browser
import pytest
from mpi4py import MPI

from signorini_cr.app.cli import main
from signorini_cr.output.meanings import OF_STEPS
from signorini_cr.output.report import FILES

pytestmark = pytest.mark.slow

COMM = MPI.COMM_WORLD

FILE = """title = "price < 5 & more"
[domain]
vertices = [[0, 0], [1, 0], [1, 1], [0, 1]]
boundary = ["contact", "dirichlet", "dirichlet", "dirichlet"]
size = 0.5
[data]
f = "-1 - 0.001*x - 0.001*y - 0.001*x*y - 0.001*x*x"
obstacle = "-0.01"
"""
TIME = """[time]
end = 1
steps = 7
[units]
x = "m"
time = "h"
"""
VOID = {"meta", "img", "input"}


class Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.links, self.text, self.metas, self.tags = [], [], "", [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag == "meta":
            self.metas.append(dict(attrs).get("name"))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def page(shared_tmp_path):
    """Solves a file and gives the path of its page."""
    pytest.importorskip("matplotlib")

    def solve(text, *more):
        path, folder = shared_tmp_path / "case.toml", shared_tmp_path / "out"
        if COMM.rank == 0:
            path.write_text(text, encoding="utf-8")
        COMM.Barrier()
        assert main(["solve", str(path), "--out", str(folder), "--html", "--quiet", *more]) == 0
        return folder / "report.html"

    return solve


def read(path):
    text = path.read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(text)
    assert reader.open == []
    assert all(link.startswith("data:image/png;base64,") for link in reader.links)
    assert not reader.tags & {"script", "link", "iframe", "object"} and "url(" not in text
    assert "viewport" in reader.metas and "max-width:100%" in text
    reader.text = reader.text.replace("\u00a0", " ")
    return reader


def test_the_page_holds_everything_and_points_nowhere(page):
    path = page(FILE, "--levels", "2")
    assert {each.name for each in path.parent.iterdir()} <= set(FILES)
    reader = read(path)
    assert len(reader.links) == 4 and {"ul", "li"} <= reader.tags
    assert ("./container/run " in reader.text) is ("SIGNORINI_CR_SUITE" in os.environ)
    assert "Bounds of the levels" in reader.text
    assert "The mesh, the finest whose cells can be told apart, and" in reader.text
    for part in (
        FILE,
        "signorini-cr solve",
        "--levels 2",
        "dolfinx",
        "Certified:\n‖∇_h(u − u_h)‖ is at most ",
        "−Δu = -1 - 0.001*x - 0.001*y - 0.001*x*y - 0.001*x*x",  # not folded
        " % wide",
    ):
        assert part in reader.text


def test_the_page_says_that_errors_are_known(page):
    reader = read(page(FILE + '[exact]\nu = "-0.01 + y"\n', "--levels", "2"))
    assert "Errors and bounds of the levels" in reader.text


def test_the_page_of_a_run_in_time(page):
    path = page(FILE + TIME, "--levels", "2")
    reader = read(path)
    assert len(reader.links) == 4  # the strip, mesh, the end's solution and contact
    for part in (
        FILE + TIME,
        "signorini-cr solve",
        "dolfinx",
        "in 7 steps of euler",
        "Certified: in no step is ",
        "The last step's own problem, certified:\n‖∇_h(u − u_h)‖ is at most ",
        "s for 7 steps",
        "series.pvd opens the fields of all steps",
        "time: t at its end in h",
    ):
        assert part in reader.text
    text = path.read_text(encoding="utf-8")
    (table,) = re.findall("<table>.*?</table>", text)
    head, *rows = table.split("<tr>")[1:]
    names = [html.unescape(name).split(",")[0] for name in re.findall("<th>(.*?)</th>", head)]
    assert names == list(OF_STEPS) and len(rows) == 7
    assert "time, h" in html.unescape(head)


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.serial
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here; make browser has one")
@pytest.mark.parametrize("more", ["", TIME], ids=["levels", "steps"])
def test_a_browser_shows_it_on_a_phone_and_on_a_desk(more, page, tmp_path):
    for frame in browser.frames(page(FILE + more, "--levels", "2")):
        command = [CHROMIUM, *browser.FLAGS.split(), f"--user-data-dir={tmp_path / frame.stem}"]
        done = subprocess.run(
            [*command, frame.as_uri()], capture_output=True, text=True, timeout=120, check=True
        )
        assert browser.complaints(frame, done.stdout) == []
