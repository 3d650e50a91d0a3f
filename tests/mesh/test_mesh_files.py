"""Damaged mesh files, and those of what no mesh can be: refused with the place, never believed."""

from pathlib import Path

import mesh_mutations
import numpy as np
import pytest
from helpers import MESHES

from signorini_cr.errors import InputError
from signorini_cr.mesh import mshfile
from signorini_cr.mesh.domain import PARTS, USUAL
from signorini_cr.mesh.gmshmesh import read

pytestmark = pytest.mark.serial


@pytest.fixture(scope="module")
def texts(tmp_path_factory) -> list[bytes]:
    pytest.importorskip("gmsh")
    return mesh_mutations.sources(tmp_path_factory.mktemp("sources"))


ONCE_WRONG = (4954, 5981, 6245, 6569, 6570, 7503, 7525, 8326, 8574, 9137, 9594, 1001018, 1005862)
"""Seeds of meshes that were taken though triangles overlapped."""


@pytest.mark.parametrize("first", [*range(0, 200, 50), 1_000_000, 1_000_050])
def test_damaged_files_are_refused_or_are_meshes(first: int, texts, tmp_path: Path) -> None:
    for seed in range(first, first + 50):
        result, words = mesh_mutations.outcome(
            tmp_path / "mesh.msh", mesh_mutations.mutated(texts, seed)
        )
        assert result != "wrong", f"seed {seed}: {words}"


@pytest.mark.parametrize("seed", ONCE_WRONG)
def test_overlaps_that_were_once_overlooked(seed: int, texts, tmp_path: Path) -> None:
    data = mesh_mutations.mutated(texts, seed)
    assert mesh_mutations.outcome(tmp_path / "mesh.msh", data)[0] == "refused"


def test_the_four_formats_say_the_same(texts, tmp_path: Path) -> None:
    found = []
    for data in texts:
        (tmp_path / "mesh.msh").write_bytes(data)
        found.append(read(tmp_path / "mesh.msh", PARTS, USUAL))
    for raw in found:
        assert mesh_mutations.faults(raw) == []
        assert np.allclose(raw.points, found[0].points, rtol=0, atol=1e-15)
        assert np.array_equal(np.sort(raw.triangles, axis=0), np.sort(found[0].triangles, axis=0))
        assert np.bincount(raw.labels).tolist() == [0, 8, 14]


@pytest.mark.parametrize("name", ["signorini.msh", "signorini-2.2.msh"])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_line_cut_in_two_is_named(name: str, share: float, tmp_path: Path) -> None:
    """Such a file made gmsh fault, which no program survives."""
    lines = (MESHES / name).read_text().split("\n")
    begin, end = lines.index("$Nodes"), lines.index("$EndNodes")
    at = max(range(begin, end), key=lambda i: len(lines[i]))
    cut = int(share * len(lines[at]))
    lines[at : at + 1] = [lines[at][:cut], lines[at][cut:]]
    path = tmp_path / "cut.msh"
    path.write_text("\n".join(lines))
    with pytest.raises(
        InputError, match=rf"section \$Nodes: in line {at + 1} .* expected"
    ) as found:
        read(path, PARTS, USUAL)
    assert str(found.value).startswith(f"{path}: ")


@pytest.mark.parametrize("count", [2**31 - 1, 2**62, -1])
@pytest.mark.parametrize("which", range(4))
def test_a_count_that_is_wrong_takes_no_memory(count, which, texts, tmp_path: Path) -> None:
    """In all four formats; what is announced is compared with what is there first."""
    data, binary = texts[which], which > 1
    at = data.index(b"$Nodes\n") + 7
    if binary and which == 2:
        data = data[: at + 8] + int(count).to_bytes(8, "little", signed=True) + data[at + 16 :]
    else:
        end = data.index(b"\n", at)
        words = data[at:end].split()
        words[-3 if len(words) == 4 else 0] = str(count).encode()
        data = data[:at] + b" ".join(words) + data[end:]
    path = tmp_path / "mesh.msh"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"section \$Nodes"):
        read(path, PARTS, USUAL)


SQUARE = ["0 0", "1 0", "1 1", "0 1"]
FILES = {  # points, triangles (from 1), what is said of it; contact from 1 to 2, Dirichlet 2 to 3
    "folded over": (
        ["0 0", "1 0", "1 1", "0.9 0.2"], ["1 2 3", "1 3 4"],
        "triangles overlap at the facet from",
    ),
    "the same triangle twice": (
        SQUARE, ["1 2 3", "1 2 3"], r"triangles are there twice, as the one at \(0, 0\)",
    ),
    "a hanging node": (
        [*SQUARE, "0.5 0.5", "1 2"], ["1 2 3", "1 5 4", "5 3 4", "4 3 6"],
        "ends in that from",
    ),
    "pieces on one another": (
        [*SQUARE, "0.7 0.2", "0.8 0.2", "0.7 0.3"], ["1 2 3", "1 3 4", "5 6 7"],
        "lies on another one",
    ),
    "boundaries that cross": (
        [*SQUARE, "0.5 -0.5", "2 -0.5", "0.5 0.5"], ["1 2 3", "1 3 4", "5 6 7"],
        "crosses",
    ),
    "a sheet over another": (
        [*SQUARE, "0 0", "1 0", "1 1", "0 1"], ["1 2 3", "1 3 4", "5 6 7", "5 7 8"], "overlaps",
    ),
    "far away": ([*SQUARE[:3], "0 1e200"], ["1 2 3", "1 3 4"], "node 4 lies at"),
    "far from the others": (
        [*SQUARE[:3], "0 3e7"], ["1 2 3", "1 3 4"],
        r"triangle at \(0, 0\) is 3e\+07 times as long as it is high: up to 1e\+06 times",
    ),
    "in a line": ([*SQUARE[:3], "2 2"], ["1 2 3", "1 3 4"], "triangle at .0, 0. has no area"),
    "a number that is none": ([*SQUARE[:3], "0 nan"], ["1 2 3", "1 3 4"], "in line 14"),
}  # fmt: skip


def written(path: Path, points: list[str], triangles: list[str], facets: list[str]) -> Path:
    nodes = [f"{i} {x} 0" for i, x in enumerate(points, 1)]
    elements = [*facets, *(f"2 2 3 3 {t}" for t in triangles)]
    rows = [f"{i} {e}" for i, e in enumerate(elements, 1)]
    names = ['1 1 "contact"', '1 2 "dirichlet"']
    sections = {"PhysicalNames": names, "Nodes": nodes, "Elements": rows}
    text = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat"]
    for name, found in sections.items():
        text += [f"${name}", str(len(found)), *found, f"$End{name}"]
    path.write_text("\n".join(text) + "\n")
    return path


@pytest.mark.parametrize("name", FILES)
def test_what_no_mesh_can_be(name: str, tmp_path: Path) -> None:
    points, triangles, words = FILES[name]
    path = written(tmp_path / "m.msh", points, triangles, ["1 2 1 1 1 2", "1 2 2 2 2 3"])
    with pytest.raises(InputError, match=words):
        read(path, PARTS, USUAL)


def test_curves_that_no_line_is_of_are_told(tmp_path: Path) -> None:
    """Names are saved with or without what they are names of."""
    path = written(tmp_path / "mesh.msh", SQUARE, ["1 2 3", "1 3 4"], [])
    with pytest.raises(InputError, match="the physical curve 'contact' has no line in the file"):
        read(path, PARTS, USUAL)


def test_slits_and_pieces_that_touch_are_meshes(tmp_path: Path) -> None:
    """A square with a slit from its middle to the right, the points on it twice."""
    points = ["0 0", "1 0", "1 0.5", "1 1", "0 1", "0.5 0.5", "1 0.5"]
    triangles = ["1 2 6", "2 3 6", "7 4 6", "4 5 6", "5 1 6"]
    labels = ["1 2 1 1 3 6", "1 2 1 1 7 6", "1 2 2 2 5 1"]
    raw = read(written(tmp_path / "slit.msh", points, triangles, labels), PARTS, USUAL)
    assert mesh_mutations.faults(raw) == []
    assert (len(raw.points), len(raw.triangles), len(raw.facets)) == (7, 5, 3)
    corner = ["0 0", "1 0", "1 1", "2 1", "2 2"]
    labels = ["1 2 1 1 1 2", "1 2 2 2 2 3", "1 2 2 2 4 5"]
    raw = read(written(tmp_path / "touch.msh", corner, ["1 2 3", "3 4 5"], labels), PARTS, USUAL)
    assert len(raw.triangles) == 2


def test_other_byte_order_and_crlf(texts, tmp_path: Path) -> None:
    path = tmp_path / "m.msh"
    path.write_bytes(texts[0].replace(b"\n", b"\r\n"))
    assert len(read(path, PARTS, USUAL).triangles) == 74
    big = b"$MeshFormat\n4.1 1 8\n" + (1).to_bytes(4, "big") + b"\n$EndMeshFormat\n"
    block = np.array([1, 3, 1, 3], ">i8").tobytes() + np.array([2, 1, 0], ">i4").tobytes()
    nodes = block + np.array([3, 1, 2, 3], ">i8").tobytes() + np.eye(3).astype(">f8").tobytes()
    block = np.array([1, 1, 1, 1], ">i8").tobytes() + np.array([2, 1, 2], ">i4").tobytes()
    cells = block + np.array([1, 1, 1, 2, 3], ">i8").tobytes()
    path.write_bytes(
        big + b"$Nodes\n" + nodes + b"\n$EndNodes\n$Elements\n" + cells + b"\n$EndElements\n"
    )
    found = mshfile.read(path)
    assert found.points.tolist() == np.eye(3).tolist()
    assert found.elements(2).tolist() == [[1, 2, 3]]
