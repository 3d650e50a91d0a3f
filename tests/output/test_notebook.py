"""What a notebook shows of a solution."""

import base64
from xml.etree import ElementTree

import pytest
from helpers import on_a_slope
from mpi4py import MPI

from signorini_cr import plots

WORLD = MPI.COMM_WORLD


@pytest.mark.parametrize("dim", [2, 3])
def test_a_notebook_shows_a_table_and_a_picture(dim, monkeypatch):
    solution = on_a_slope(dim)
    # each rank for itself: nobody waits
    html = solution._repr_html_() if WORLD.rank == 0 else None
    assert "certificate" not in solution.__dict__
    certificate = solution.certificate
    if html is None:
        return
    page = ElementTree.fromstring(f"<p>{html}</p>")
    rows = {row.find("th").text: row.find("td").text for row in page.iter("tr")}
    assert rows["cells"] == str(solution.cells)
    assert float(rows["contact force"]) == pytest.approx(solution.contact.force, rel=1e-5)
    assert float(rows["energy J(u_h)"]) == pytest.approx(solution.energy, rel=1e-8)
    assert rows["error bound"].startswith("not asked for")
    pictures = [image.attrib["src"] for image in page.iter("img")]
    assert len(pictures) == (1 if dim == 2 and WORLD.size == 1 else 0)
    for source in pictures:
        data = base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True)
        assert data.startswith(b"\x89PNG") and data.endswith(b"IEND\xaeB`\x82")
    monkeypatch.setattr(plots, "can_draw", lambda comm: False)
    again = solution._repr_html_()
    assert "<img" not in again
    assert f'<td style="text-align:right">{certificate.bound_h1:.3g}</td>' in again


@pytest.mark.serial
def test_it_says_why_there_is_no_bound():
    solution = on_a_slope(2, element="P1")
    reason = solution.certificate.reason
    assert f"none: {reason}" in solution._repr_html_()
