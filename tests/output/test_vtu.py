"""solution.vtu, read as others read it: are its arrays the solution's?

Where meshio, VTK and PyVista are not installed, XML and base64 are read by hand alone;
`make readers` installs them.
"""

import base64
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from dolfinx import fem
from dolfinx.mesh import create_rectangle, create_unit_cube
from helpers import on_a_slope, slope
from mpi4py import MPI

from signorini_cr.compat import cell_nodes
from signorini_cr.fem.space import function_space
from signorini_cr.output.vtu import _encoded, write_solution, write_vtu

pytestmark = pytest.mark.ranks

WORLD = MPI.COMM_WORLD
LINE, TRIANGLE, TETRAHEDRON = 3, 5, 10
CORNERS = {LINE: 2, TRIANGLE: 3, TETRAHEDRON: 4}


@dataclass
class Grid:
    """A file's cells by VTK's number for their type, as points of shape (cells, corners, 3); and
    fields by the same number and name, of shape (cells, corners) or (cells,)."""

    corners: dict
    on_points: dict
    on_cells: dict


def grid(points, types, connectivity, on_points, on_cells):
    """A Grid, from arrays as VTK has them."""
    start = np.cumsum([0, *(CORNERS[each] for each in types)])
    nodes = {
        kind: np.array(
            [connectivity[start[k] : start[k + 1]] for k in np.flatnonzero(types == kind)]
        )
        for kind in np.unique(types)
    }
    return Grid(
        {kind: points[rows] for kind, rows in nodes.items()},
        {
            (kind, name): values[rows]
            for name, values in on_points.items()
            for kind, rows in nodes.items()
        },
        {
            (kind, name): values[types == kind]
            for name, values in on_cells.items()
            for kind in nodes
        },
    )


def by_hand(path: Path) -> Grid:
    (piece,) = ElementTree.parse(path).getroot().iterfind("UnstructuredGrid/Piece")
    found = {tag.tag: {} for tag in piece}
    for tag in piece:
        for array in tag:
            raw = base64.b64decode(array.text, validate=True)
            assert int.from_bytes(raw[:8], "little") == len(raw) - 8
            values = np.frombuffer(raw[8:], np.dtype(array.attrib["type"].lower()))
            found[tag.tag][array.attrib["Name"]] = values
    points, cells = found["Points"]["points"].reshape(-1, 3), found["Cells"]
    assert len(points) == int(piece.attrib["NumberOfPoints"])
    assert len(cells["types"]) == int(piece.attrib["NumberOfCells"])
    assert np.array_equal(cells["offsets"], np.cumsum([CORNERS[each] for each in cells["types"]]))
    return grid(
        points, cells["types"], cells["connectivity"], found["PointData"], found["CellData"]
    )


def by_meshio(path: Path) -> Grid:
    meshio = import_module("meshio")
    mesh = meshio.read(path)
    number = {"line": LINE, "triangle": TRIANGLE, "tetra": TETRAHEDRON}
    types = np.concatenate([np.full(len(each.data), number[each.type]) for each in mesh.cells])
    nodes = np.concatenate([each.data.ravel() for each in mesh.cells])
    on_cells = {name: np.concatenate(blocks) for name, blocks in mesh.cell_data.items()}
    return grid(mesh.points, types, nodes, mesh.point_data, on_cells)


def by_pyvista(path: Path) -> Grid:
    mesh = import_module("pyvista").read(path)
    nodes = mesh.cell_connectivity
    return grid(
        np.array(mesh.points), mesh.celltypes, nodes, dict(mesh.point_data), dict(mesh.cell_data)
    )


def by_vtk(path: Path) -> Grid:
    reader = import_module("vtkmodules.vtkIOXML").vtkXMLUnstructuredGridReader()
    to_numpy = import_module("vtkmodules.util.numpy_support").vtk_to_numpy
    reader.SetFileName(str(path))
    reader.Update()
    assert reader.GetErrorCode() == 0
    mesh = reader.GetOutput()

    def fields(data):
        arrays = (data.GetArray(k) for k in range(data.GetNumberOfArrays()))
        return {array.GetName(): to_numpy(array) for array in arrays}

    types = np.array([mesh.GetCellType(k) for k in range(mesh.GetNumberOfCells())])
    return grid(
        to_numpy(mesh.GetPoints().GetData()),
        types,
        to_numpy(mesh.GetCells().GetConnectivityArray()),
        fields(mesh.GetPointData()),
        fields(mesh.GetCellData()),
    )


READERS = {"hand": by_hand, "meshio": by_meshio, "vtk": by_vtk, "pyvista": by_pyvista}


@pytest.fixture(params=READERS)
def read(request):
    """A reader, which rank 0 calls; the others get its result."""
    missing = None
    if WORLD.rank == 0 and request.param != "hand":
        try:
            import_module(request.param)
        except ModuleNotFoundError as error:
            missing = str(error)
    if missing := WORLD.bcast(missing):
        pytest.skip(missing)

    def call(path: Path) -> Grid:
        return WORLD.bcast(READERS[request.param](path) if WORLD.rank == 0 else None)

    return call


@pytest.fixture(scope="module", params=[2, 3])
def solution(request):
    return on_a_slope(request.param)


def everyone(array):
    """The rows of all ranks, one after the other, as their pieces stand in the file."""
    return np.concatenate(WORLD.allgather(array))


def test_readers_find_the_fields_of_the_solution(read, solution, shared_tmp_path):
    write_solution(solution, shared_tmp_path / "solution.vtu")
    found = read(shared_tmp_path / "solution.vtu")
    mesh, contact, certificate = solution.domain.mesh, solution.contact, solution.certificate
    d = mesh.topology.dim
    inside, below = (TRIANGLE, LINE) if d == 2 else (TETRAHEDRON, TRIANGLE)
    owned = mesh.topology.index_map(d).size_local
    assert set(found.corners) == {inside, below}
    corners = mesh.geometry.x[cell_nodes(mesh)[:owned]]
    assert np.array_equal(found.corners[inside], everyone(corners))
    for name, function in (("u", solution.u_dg()), ("companion", certificate.companion)):
        at_corners = function.x.array[function.function_space.dofmap.list[:owned, : d + 1]]
        assert np.array_equal(found.on_points[inside, name], everyone(at_corners))
    shares = np.sqrt(everyone(certificate.indicators))
    assert np.array_equal(found.on_cells[inside, "indicator"], shares)
    assert np.all(found.on_cells[inside, "pressure"] == 0.0)
    assert np.all(found.on_cells[inside, "contact"] == 0)
    assert np.all(np.isnan(found.on_cells[inside, "obstacle"]))
    # Γ1: the facets' corners, the trace of u_h there, and what the solver found
    ends = found.corners[below]
    assert len(ends) == contact.number
    assert np.sort(ends, axis=1) == pytest.approx(np.sort(everyone(contact.vertices), axis=1))
    assert found.on_points[below, "u"].mean(axis=1) == pytest.approx(everyone(contact.u))
    gaps = np.sort(found.on_points[below, "u"] - slope(ends.T).T, axis=1)
    assert gaps == pytest.approx(np.sort(everyone(contact.gap_at_vertices), axis=1), abs=1e-14)
    for name in ("pressure", "contact", "obstacle"):
        wanted = everyone(getattr(contact, {"contact": "active"}.get(name, name)))
        assert np.array_equal(found.on_cells[below, name], wanted)
    assert np.all(found.on_cells[below, "indicator"] == 0.0)
    # v is in K: not below the obstacle, with which it agrees where there is contact
    above = found.on_points[below, "companion"] - slope(ends.T).T
    assert above.min() > -1e-13
    edges = ends[:, 1:] - ends[:, :1]
    measure = np.sqrt(np.linalg.det(edges @ edges.transpose(0, 2, 1))) / (d - 1)
    force = found.on_cells[below, "pressure"] @ measure
    assert force == pytest.approx(contact.force, rel=1e-12)


def test_shares_below_0_by_rounding_are_0(shared_tmp_path):
    """So they are where u_h is a constant beside v, on a coarse mesh."""
    found = on_a_slope(2)
    indicators = found.certificate.indicators
    indicators[::2] = -1e-33
    write_solution(found, shared_tmp_path / "solution.vtu")
    shares = WORLD.bcast(
        by_hand(shared_tmp_path / "solution.vtu").on_cells[TRIANGLE, "indicator"]
        if WORLD.rank == 0
        else None
    )
    assert np.array_equal(shares == 0.0, everyone(indicators) < 0.0)


def test_one_rank_writes_what_all_ranks_write(shared_tmp_path):
    write_solution(on_a_slope(2), str(shared_tmp_path / "all.vtu"))
    alone = shared_tmp_path / f"alone-{WORLD.rank}.vtu"
    write_solution(on_a_slope(2, MPI.COMM_SELF), alone)
    ours, mine = by_hand(shared_tmp_path / "all.vtu"), by_hand(alone)

    def sorted_by_place(found: Grid, kind: int) -> tuple:
        middles = found.corners[kind].mean(axis=1).round(9)
        order = np.lexsort(middles.T)
        inner = np.lexsort(found.corners[kind][order].round(9).transpose(2, 0, 1))
        fields = {
            name: np.take_along_axis(values[order], inner, axis=1)
            for (where, name), values in found.on_points.items()
            if where == kind
        }
        return middles[order], fields | {
            name: values[order] for (where, name), values in found.on_cells.items() if where == kind
        }

    for kind in (TRIANGLE, LINE):
        (places, fields), (own_places, own_fields) = (
            sorted_by_place(found, kind) for found in (ours, mine)
        )
        assert places == pytest.approx(own_places)
        assert set(fields) == set(own_fields)
        for name, values in fields.items():
            assert values == pytest.approx(own_fields[name], abs=1e-8, nan_ok=True), name


@pytest.mark.parametrize("dim", [2, 3])
def test_a_function_of_ones_own_is_written_as_it_is(dim, read, shared_tmp_path):
    rectangle = create_rectangle(WORLD, [[-1.0, 0.0], [1.0, 1.0]], [8, 4])
    mesh = rectangle if dim == 2 else create_unit_cube(WORLD, 2, 2, 2)
    u = fem.Function(function_space(mesh, "CR"))

    def wave(x):
        return np.sin(3 * x[0]) * np.cos(2 * x[1]) + x[2]

    u.interpolate(wave)
    u.x.scatter_forward()
    write_vtu(u, shared_tmp_path / "u.vtu", "height")
    found = read(shared_tmp_path / "u.vtu")
    kind = TRIANGLE if dim == 2 else TETRAHEDRON
    corners, values = found.corners[kind], found.on_points[kind, "height"]
    assert len(corners) == mesh.topology.index_map(dim).size_global
    # The cells fill the domain, and on the middle of each facet stands the facet's dof
    edges = (corners[:, 1:] - corners[:, :1])[:, :, :dim]
    volume = np.abs(np.linalg.det(edges)).sum() / (2 if dim == 2 else 6)
    assert volume == pytest.approx(2.0 if dim == 2 else 1.0)
    for opposite in range(dim + 1):
        middle = np.delete(corners, opposite, axis=1).mean(axis=1)
        means = np.delete(values, opposite, axis=1).mean(axis=1)
        assert means == pytest.approx(wave(middle.T))
    # The jumps are there
    places, at = corners.reshape(-1, 3).round(9), values.ravel()
    _, which = np.unique(places, axis=0, return_inverse=True)
    spread = max(np.ptp(at[which.ravel() == i]) for i in range(which.max() + 1))
    assert spread > 1e-3


def test_a_path_as_long_as_the_system_takes(shared_tmp_path):
    folder = shared_tmp_path.joinpath(*[100 * "x"] * 5)
    if WORLD.rank == 0:
        folder.mkdir(parents=True)
    u = on_a_slope(2).u
    write_vtu(u, folder / "u.vtu")
    write_vtu(u, shared_tmp_path / "u.vtu")
    if WORLD.rank == 0:
        assert (folder / "u.vtu").read_bytes() == (shared_tmp_path / "u.vtu").read_bytes()


def test_ranks_share_letters_whatever_each_of_them_has():
    """Base64 has four letters for three bytes, and a rank may have one byte or none."""
    random = np.random.default_rng(1)
    for _ in range(20):
        parts = [random.integers(0, 256, n, dtype=np.uint8) for n in random.integers(0, 5, 2 * 4)]
        mine = [parts[2 * WORLD.rank % 8], parts[(2 * WORLD.rank + 1) % 8]]
        shares, lengths = _encoded(WORLD, mine)
        for k in range(2):
            whole = b"".join(arrays[k].tobytes() for arrays in WORLD.allgather(mine))
            letters = bytearray(lengths[k])
            for each in WORLD.allgather(shares):
                start, data = each[k]
                letters[start : start + len(data)] = data
            wanted = len(whole).to_bytes(8, "little") + whole
            assert base64.b64decode(bytes(letters), validate=True) == wanted
