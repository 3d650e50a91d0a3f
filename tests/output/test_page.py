"""The page of a run: complete, on its own, and fit for a narrow screen."""

from html.parser import HTMLParser

import pytest
from mpi4py import MPI

from signorini_cr.app.cli import main

FILE = """title = "price < 5 & more"
[domain]
vertices = [[0, 0], [1, 0], [1, 1], [0, 1]]
boundary = ["contact", "dirichlet", "dirichlet", "dirichlet"]
size = 0.5
[data]
f = "-1"
obstacle = "-0.01"
"""


class Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.links, self.text, self.metas, self.tags = [], [], "", [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag == "meta":
            self.metas.append(dict(attrs).get("name"))
        elif tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_the_page_holds_everything_and_points_nowhere(shared_tmp_path):
    pytest.importorskip("matplotlib")
    path, folder = shared_tmp_path / "case.toml", shared_tmp_path / "out"
    if MPI.COMM_WORLD.rank == 0:
        path.write_text(FILE, encoding="utf-8")
    MPI.COMM_WORLD.Barrier()
    words = ["solve", str(path), "--out", str(folder), "--levels", "2", "--html", "--quiet"]
    assert main(words) == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    assert len(reader.links) == 4
    assert all(link.startswith("data:image/png;base64,") for link in reader.links)
    assert not reader.tags & {"script", "link", "iframe", "object"} and "url(" not in page
    assert "viewport" in reader.metas and "max-width:100%" in page
    for part in (
        FILE,
        "signorini-cr solve",
        "--levels 2",
        "dolfinx",
        "certified: ",
        "equation   −Δu = -1",
        " % wide",
    ):
        assert part in reader.text
