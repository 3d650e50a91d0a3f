"""Refined meshes: the same domain, nested, numbered as DOLFINx wants it on any number of ranks."""

import basix.ufl
import dolfinx.mesh
import numpy as np
import pytest
import ufl
from dolfinx import fem, la
from helpers import corners, integral, smallest_angle, stay, tagged
from mpi4py import MPI

from signorini_cr.compat import cell_nodes
from signorini_cr.errors import InputError
from signorini_cr.fem.problem import Problem
from signorini_cr.levels import solve_levels
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, NEUMANN, Domain, Polygon
from signorini_cr.mesh.refinement import SIMILAR, refine, refine_marked

pytestmark = pytest.mark.ranks

COMM = MPI.COMM_WORLD
SHAPES = {
    "rectangle": Polygon(
        [[-1, 0], [1, 0], [1, 1], [-1, 1]], ["contact", "dirichlet", "neumann", "dirichlet"]
    ),
    "hole": Polygon(
        [[-1, 0], [1, 0], [1, 1], [-1, 1]],
        ["contact", "dirichlet", "neumann", "dirichlet"],
        (Polygon([[0, 0.3], [0.4, 0.5], [0, 0.8]], ["contact", "neumann", "dirichlet"]),),
    ),
}


def own(mode: dolfinx.mesh.GhostMode, n: int) -> Domain:
    """(-1, 1) × (0, 1) as a user would make it: contact below, Dirichlet at the sides."""
    mesh = dolfinx.mesh.create_rectangle(COMM, [[-1, 0], [1, 1]], [2 * n, n], ghost_mode=mode)

    def values(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.select([np.isclose(y, 0), np.isclose(y, 1)], [CONTACT, NEUMANN], DIRICHLET)

    return Domain.from_tags(mesh, tagged(mesh, values))


@pytest.fixture(
    params=["rectangle", "hole", "few cells", "one cell", "own", "own, ghosts", "own, two cells"]
)
def domain(request) -> Domain:
    none, shared = dolfinx.mesh.GhostMode.none, dolfinx.mesh.GhostMode.shared_facet
    makers = {
        "rectangle": lambda: SHAPES["rectangle"].mesh(0.4),
        "hole": lambda: SHAPES["hole"].mesh(0.4),
        "few cells": lambda: SHAPES["rectangle"].mesh(2.2),
        "one cell": lambda: Polygon(
            [[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet", "neumann"]
        ).mesh(2**0.5),
        "own": lambda: own(none, 3),
        "own, ghosts": lambda: own(shared, 3),
        "own, two cells": lambda: own(shared, 1),
    }
    return makers[request.param]()


def geometry(domain: Domain) -> list[float]:
    """Area, lengths of the parts, and what Gauss' theorem makes of them."""
    mesh = domain.mesh
    x, n = ufl.SpatialCoordinate(mesh), ufl.FacetNormal(mesh)
    ds = ufl.Measure("ds", mesh, subdomain_data=domain.tags)
    forms = [1.0 * ufl.dx(mesh), 1.0 * ds, ufl.dot(x, n) * ds]
    forms += [(1.0 + x[0] * x[1]) * ds(part) for part in (CONTACT, DIRICHLET, NEUMANN)]
    return [integral(form, mesh.comm) for form in forms]


def cells_of(mesh: dolfinx.mesh.Mesh) -> int:
    return mesh.topology.index_map(2).size_local


def sides(mesh: dolfinx.mesh.Mesh) -> np.ndarray:
    x = corners(mesh)
    return np.roll(x, -1, axis=1) - x


def facets_by_cell(mesh: dolfinx.mesh.Mesh) -> np.ndarray:
    return mesh.topology.connectivity(2, 1).array.reshape(-1, 3)


def load_norms(mesh: dolfinx.mesh.Mesh) -> list[float]:
    """Norms of load vectors: they feel every wrong orientation, owner or global number."""
    x = ufl.SpatialCoordinate(mesh)
    norms = []
    for family, degree in (("CR", 1), ("P", 1), ("P", 3), ("RT", 1), ("RT", 2), ("N1curl", 1)):
        V = fem.functionspace(mesh, (family, degree))
        v = ufl.TestFunction(V)
        f = ufl.sin(3 * x[0]) + x[1] ** 2
        form = (ufl.inner(ufl.grad(f), v) if v.ufl_shape else f * v) * ufl.dx
        b = fem.assemble_vector(fem.form(form))
        b.scatter_reverse(la.InsertMode.add)
        norms.append(la.norm(b))
    return norms


def made_again(mesh: dolfinx.mesh.Mesh) -> dolfinx.mesh.Mesh:
    """The same mesh by DOLFINx's create_mesh."""
    nodes = mesh.geometry.index_map()
    cells = nodes.local_to_global(cell_nodes(mesh)[: cells_of(mesh)].ravel().astype(np.int32))
    return dolfinx.mesh.create_mesh(
        mesh.comm,
        cells=cells.reshape(-1, 3),
        x=mesh.geometry.x[: nodes.size_local, :2].copy(),
        e=basix.ufl.element("Lagrange", "triangle", 1, shape=(2,)),
        partitioner=stay,
    )


def test_cells_are_cut_alike(domain):
    """The corners of child k have the same barycentric coordinates in every parent: `SIMILAR`."""
    fine, parent = refine(domain)
    assert fine.descent[-1].pattern is SIMILAR
    here, below = (
        np.pad(d.mesh.geometry.x[:, :2], ((0, 0), (0, 1)), constant_values=1.0)[cell_nodes(d.mesh)]
        for d in (fine, domain)
    )
    found = np.linalg.solve(below[parent].swapaxes(1, 2), here.swapaxes(1, 2)).swapaxes(1, 2)
    assert np.abs(found.reshape(-1, 4, 3, 3) - SIMILAR).max(initial=0.0) < 1e-12


def test_refinement_keeps_the_domain(domain):
    before = geometry(domain)
    for level in range(1, 3):
        cells = domain.mesh.topology.index_map(2).size_global
        parts = [COMM.allreduce(len(domain.facets(part))) for part in (1, 2, 3)]
        domain, _ = refine(domain)
        topology = domain.mesh.topology
        assert topology.index_map(2).size_global == 4 * cells
        assert topology.index_map(2).num_ghosts == 0
        assert geometry(domain) == pytest.approx(before), level
        assert [COMM.allreduce(len(domain.facets(part))) for part in (1, 2, 3)] == [
            2 * number for number in parts
        ]
        exterior = dolfinx.mesh.exterior_facet_indices(topology)
        assert np.array_equal(np.sort(exterior), domain.tags.indices)


def test_numbers_of_entities_satisfy_euler(domain):
    """Red refinement: V' = V + E, E' = 2 E + 3 C, C' = 4 C, on all ranks together."""
    fine, _ = refine(domain)
    v, e, c = (domain.mesh.topology.index_map(d).size_global for d in range(3))
    topology = fine.mesh.topology
    assert [topology.index_map(d).size_global for d in range(3)] == [v + e, 2 * e + 3 * c, 4 * c]


def test_every_facet_knows_its_cells(domain):
    fine, _ = refine(refine(domain)[0])
    mesh = fine.mesh
    around, ends = mesh.topology.connectivity(1, 2), mesh.topology.connectivity(1, 0)
    of_cells, vertices = facets_by_cell(mesh), mesh.topology.connectivity(2, 0).array.reshape(-1, 3)
    # facet i is the one opposite vertex i
    for i in range(3):
        opposite = np.sort(np.delete(vertices, i, axis=1), axis=1)
        assert np.array_equal(np.sort(ends.array.reshape(-1, 2)[of_cells[:, i]], axis=1), opposite)
    pairs = np.stack([of_cells.ravel(), np.repeat(np.arange(len(of_cells)), 3)], axis=1)
    listed = np.stack(
        [np.repeat(np.arange(around.num_nodes), np.diff(around.offsets)), around.array], axis=1
    )
    assert np.array_equal(np.unique(pairs, axis=0), np.unique(listed, axis=0))
    assert len(pairs) == len(listed)
    # in the order of the global numbers, which is what orients facets alike on all ranks
    numbers = mesh.topology.index_map(0).local_to_global(ends.array.astype(np.int32))
    assert (np.diff(numbers.reshape(-1, 2), axis=1) > 0).all()


def test_children_make_up_their_parent(domain):
    fine, parent = refine(domain)
    assert np.array_equal(parent, np.repeat(np.arange(cells_of(domain.mesh)), 4))
    x, old = corners(fine.mesh), corners(domain.mesh)
    middle = 0.5 * (np.roll(old, -1, axis=1) + np.roll(old, 1, axis=1))  # opposite vertex i
    for k in range(3):
        assert np.allclose(x[k::4, k], old[:, k], atol=1e-14)
    assert np.allclose(x[3::4], middle, atol=1e-14)
    assert np.allclose(np.linalg.norm(sides(fine.mesh)[::4], axis=2) * 2,
                       np.linalg.norm(sides(domain.mesh), axis=2))  # fmt: skip


def test_load_vectors_match_those_of_create_mesh(domain):
    for _ in range(2):
        domain, _ = refine(domain)
    assert load_norms(domain.mesh) == pytest.approx(load_norms(made_again(domain.mesh)), rel=1e-12)


@pytest.mark.parametrize("shape", list(SHAPES))
def test_any_number_of_ranks_gives_the_same_mesh(shape: str):
    ours, alone = SHAPES[shape].mesh(0.4), SHAPES[shape].mesh(0.4, MPI.COMM_SELF)
    for _ in range(2):
        ours, alone = refine(ours)[0], refine(alone)[0]
        assert geometry(ours) == pytest.approx(geometry(alone), rel=1e-13)
        assert load_norms(ours.mesh) == pytest.approx(load_norms(alone.mesh), rel=1e-12)


@pytest.mark.parametrize("comm", [MPI.COMM_SELF, COMM], ids=["alone", "together"])
@pytest.mark.parametrize("shape", list(SHAPES))
def test_facets_that_are_given_are_those_that_are_found(shape: str, comm, monkeypatch):
    """Those of our own numbering and DOLFINx's, what lies between ranks with them; also on few
    cells, of which a rank has one, or none."""
    for size in (SHAPES[shape].diameter, 0.6):
        given = found = SHAPES[shape].mesh(size, comm)
        for _ in range(2):
            given, _ = refine(given)
            with monkeypatch.context() as patch:
                patch.setattr("signorini_cr.compat.can_take_facets", lambda: False)
                found, _ = refine(found)
            assert load_norms(given.mesh) == pytest.approx(load_norms(found.mesh), rel=1e-12)
            assert geometry(given) == pytest.approx(geometry(found), rel=1e-13)
            for one, other in zip(outside(given), outside(found), strict=True):
                assert np.allclose(one, other)


def outside(domain: Domain) -> list[np.ndarray]:
    """Midpoints of exterior facets, and of ghosts with those of the owners, in order."""
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 0)
    exterior = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    index_map = mesh.topology.index_map(1)
    number = index_map.size_local + index_map.num_ghosts
    middle = dolfinx.mesh.compute_midpoints(mesh, 1, np.arange(number, dtype=np.int32))
    seen = dolfinx.la.vector(index_map, bs=3)
    seen.array[: 3 * index_map.size_local] = middle[: index_map.size_local].ravel()
    seen.scatter_forward()
    assert np.allclose(seen.array.reshape(-1, 3), middle)
    rows = np.concatenate(mesh.comm.allgather(middle[exterior]))
    return [rows[np.lexsort(np.round(rows, 9).T)]]


@pytest.mark.parametrize("shape", SHAPES)
def test_neighbours_have_numbers_that_lie_close_together(shape: str):
    """A cell's vertices are about √n numbers apart, not n/2 as with corners before midpoints."""
    domain = SHAPES[shape].mesh(0.4)
    for _ in range(2):
        domain, _ = refine(domain)
    topology = domain.mesh.topology
    owned = topology.index_map(0).size_local
    vertices = topology.connectivity(2, 0).array.reshape(-1, 3)
    inside = vertices[(vertices < owned).all(axis=1)]
    assert np.ptp(inside, axis=1).mean() < 2.0 * np.sqrt(owned)


@pytest.mark.slow
def test_eight_levels_keep_the_angles():
    domain = SHAPES["rectangle"].mesh(2)
    angle, width = smallest_angle(domain.mesh), np.linalg.norm(sides(domain.mesh), axis=2)
    longest = COMM.allreduce(width.max(initial=0), op=MPI.MAX)
    for _ in range(8):
        domain, _ = refine(domain)
    assert smallest_angle(domain.mesh) == pytest.approx(angle, rel=1e-9)
    mesh = domain.mesh
    h = mesh.h(2, np.arange(cells_of(mesh), dtype=np.int32))
    assert COMM.allreduce(h.max(initial=0), op=MPI.MAX) == pytest.approx(longest / 2**8)


def test_what_cannot_be_refined():
    mesh = dolfinx.mesh.create_unit_cube(COMM, 2, 2, 2)
    mesh.topology.create_connectivity(2, 3)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    values = np.arange(len(facets), dtype=np.int32) % 2 + 1
    domain = Domain.from_tags(mesh, dolfinx.mesh.meshtags(mesh, 2, facets, values))
    for way in (refine, lambda d: refine_marked(d, [])):
        with pytest.raises(InputError, match="only triangles"):
            way(domain)
    with pytest.raises(InputError, match="only triangles"):  # before anything is solved
        next(solve_levels(Problem(f=1.0), domain, 2))


def curved_triangle() -> Domain:
    x = np.array([[0, 0], [1, 0], [0, 1], [0.6, 0.6], [0, 0.5], [0.5, 0]])
    root = COMM.rank == 0
    mesh = dolfinx.mesh.create_mesh(
        COMM,
        cells=np.arange(6 if root else 0, dtype=np.int64).reshape(-1, 6),
        x=x if root else x[:0],
        e=basix.ufl.element("Lagrange", "triangle", 2, shape=(2,)),
        partitioner=stay,
    )
    mesh.topology.create_connectivity(1, 2)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    values = np.arange(len(facets), dtype=np.int32) % 2 + 1
    return Domain(mesh, dolfinx.mesh.meshtags(mesh, 1, facets, values))


def test_curved_cells_are_refused():
    domain = curved_triangle()
    with pytest.raises(InputError, match="curved"):
        refine(domain)
    with pytest.raises(InputError, match="curved"):
        Domain.from_tags(domain.mesh, domain.tags)


# marked cells


def near(mesh: dolfinx.mesh.Mesh, point) -> np.ndarray:
    """Cells that have a point in them or are about as close to it as they are wide."""
    x = corners(mesh)
    distance = np.linalg.norm(x.mean(axis=1) - point, axis=1)
    return distance < np.linalg.norm(sides(mesh), axis=2).max(axis=1)


def test_marked_refinement_keeps_the_domain_and_the_angles(domain):
    before, angle = geometry(domain), smallest_angle(domain.mesh)
    for level in range(5):
        marked = near(domain.mesh, (0, 0))
        coarse = domain
        domain, parent = refine_marked(coarse, marked)
        assert geometry(domain) == pytest.approx(before), level
        exterior = dolfinx.mesh.exterior_facet_indices(domain.mesh.topology)
        assert np.array_equal(np.sort(exterior), domain.tags.indices)
        assert domain.mesh.topology.index_map(2).num_ghosts == 0
        assert len(parent) == cells_of(domain.mesh)
        # every child lies in its parent, and the children fill it
        x, old = corners(domain.mesh), corners(coarse.mesh)
        a, b = sides(coarse.mesh)[:, 0], -sides(coarse.mesh)[:, 2]
        det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        y = x - old[parent, 0][:, None, :]
        u = (y[..., 0] * b[parent, None, 1] - y[..., 1] * b[parent, None, 0]) / det[parent, None]
        v = (a[parent, None, 0] * y[..., 1] - a[parent, None, 1] * y[..., 0]) / det[parent, None]
        assert (np.minimum(np.minimum(u, v), 1 - u - v) > -1e-9).all()
        children = np.bincount(parent, minlength=len(old))
        assert (children >= 1).all()
        assert (children[marked] >= 4).all()
    assert smallest_angle(domain.mesh) >= angle / 2 - 1e-9  # longest-edge bisection
    fine, _ = refine(domain)
    assert geometry(fine) == pytest.approx(before)
    assert load_norms(fine.mesh) == pytest.approx(load_norms(made_again(fine.mesh)), rel=1e-12)


def test_marks_may_be_indices():
    domain = own(dolfinx.mesh.GhostMode.none, 4)
    marked = near(domain.mesh, (0.5, 0))
    by_truth, _ = refine_marked(domain, marked)
    by_index, _ = refine_marked(domain, np.flatnonzero(marked))
    numbers = [d.mesh.topology.index_map(2).size_global for d in (domain, by_truth, by_index)]
    assert numbers[0] < numbers[1] == numbers[2]


def test_no_marks_change_nothing():
    domain = own(dolfinx.mesh.GhostMode.none, 4)
    same, parent = refine_marked(domain, [])
    assert same.mesh.topology.index_map(2).size_global == 64
    assert np.array_equal(np.sort(parent), np.arange(cells_of(domain.mesh)))


def test_marked_refinement_is_local():
    """Every step adds a bounded number of cells around a point."""
    domain = own(dolfinx.mesh.GhostMode.none, 2)
    sizes = [16]
    for _ in range(8):
        domain, _ = refine_marked(domain, near(domain.mesh, (0, 0)))
        sizes.append(domain.mesh.topology.index_map(2).size_global)
    assert np.diff(sizes)[3:].max() < 60


@pytest.mark.parametrize(
    ("marks", "said"),
    [
        ([9999], "marked_cells: there is no cell 9999 on rank"),
        ([0, -1], "marked_cells: there is no cell -1 on rank"),
        ([2**32], "marked_cells: there is no cell 4294967296 on rank"),
        ([0.7], "marked_cells has values of the type float64"),
        (["0"], "marked_cells has values of the type <U1"),
        ([True], r"marked_cells has truth values of the shape \(1,\)"),
    ],
)
def test_marks_of_cells_that_are_not_there_are_refused_on_all_ranks(marks, said) -> None:
    domain = SHAPES["rectangle"].mesh(0.4)
    with pytest.raises(InputError, match=said):
        refine_marked(domain, marks if COMM.rank == COMM.size - 1 else [])


def test_marks_of_ghost_cells_do_not_count() -> None:
    domain = own(dolfinx.mesh.GhostMode.shared_facet, 3)
    cells = domain.mesh.topology.index_map(2)
    there = np.arange(cells.size_local + cells.num_ghosts)
    for marks in (there[cells.size_local :], there >= cells.size_local):
        fine, _ = refine_marked(domain, marks)
        assert fine.mesh.topology.index_map(2).size_global == cells.size_global
