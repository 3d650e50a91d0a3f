"""Displays of a solution in a notebook."""

import base64
import json
from xml.etree import ElementTree

import pytest
from helpers import DEMOS, on_a_slope
from mpi4py import MPI

from signorini_cr import plots
from signorini_cr.rounding import at_most, digits_of

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
    assert rows["contact force"] == f"{solution.contact.force:.4g}"
    assert rows["energy J(u_h)"] == f"{solution.energy:.4g}"
    assert ("length in contact" in rows, "area in contact" in rows) == (dim == 2, dim == 3)
    assert rows["error bound"].startswith("not asked for")
    pictures = [image.attrib["src"] for image in page.iter("img")]
    assert len(pictures) == (1 if dim == 2 and WORLD.size == 1 else 0)
    for source in pictures:
        data = base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True)
        assert data.startswith(b"\x89PNG") and data.endswith(b"IEND\xaeB`\x82")
    monkeypatch.setattr(plots, "can_draw", lambda comm: False)
    again = solution._repr_html_()
    assert "<img" not in again
    low, high = certificate.energy
    for told in (at_most(certificate.bound_h1), digits_of(solution.energy, high - low)):
        assert f'<td style="text-align:right">{told}</td>' in again


@pytest.mark.serial
def test_it_says_why_there_is_no_bound():
    solution = on_a_slope(2, element="P1")
    reason = solution.certificate.reason
    assert f"none: {reason}" in solution._repr_html_()


NOTEBOOK = DEMOS / "slope.ipynb"


@pytest.mark.serial
def test_the_notebook_begins_with_us():
    """DOLFINx from pip finds its MPI no sooner."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    first = next("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    assert first.startswith("import signorini_cr")


@pytest.mark.slow
@pytest.mark.serial
def test_the_cells_of_the_notebook_run():
    """As plain Python, where there is no Jupyter; they end in assertions of their own."""
    pytest.importorskip("matplotlib")
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names = {"__name__": "__main__"}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            exec("".join(cell["source"]), names)
    names["plt"].close("all")
    assert names["finest"].certificate.bound_h1 <= 0.05 < names["certificate"].bound_h1


@pytest.mark.serial
def test_jupyter_runs_the_notebook_and_shows_what_it_promises(monkeypatch):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    monkeypatch.delenv("MPLBACKEND", raising=False)  # Jupyter's own
    nbclient.NotebookClient(notebook, timeout=200).execute()
    shown = [
        set(output.get("data", {})) | {output.get("name", "")}
        for cell in notebook.cells
        for output in cell.get("outputs", ())
    ]
    assert sum("text/html" in each for each in shown) == 1  # the solution
    assert sum("image/png" in each for each in shown) == 2  # along Γ1, and on two Axes
    assert not any("stderr" in each for each in shown)
