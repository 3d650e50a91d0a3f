"""The companion solved for around some points: as good as on the whole mesh, on any ranks."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import create_rectangle, exterior_facet_indices, meshtags
from helpers import HELD_ALL_ROUND, of_gradients
from mpi4py import MPI
from petsc4py import PETSc

from signorini_cr import Polygon, Problem, exact, solve_levels
from signorini_cr.compat import cell_nodes
from signorini_cr.estimate import best, companion, nearest
from signorini_cr.estimate.certificate import certify
from signorini_cr.estimate.functional import Slopes
from signorini_cr.fem.cells import Cells
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, Domain
from signorini_cr.mesh.families import structured

pytestmark = pytest.mark.ranks

WORLD = MPI.COMM_WORLD
CORNERS = Polygon(
    [[0, 0], [3, -0.4], [3.6, 1.1], [1.2, 1.4], [0.2, 2.0]],
    ["contact", "contact", "dirichlet", "neumann", "dirichlet"],
    holes=[Polygon([[1, 0.5], [1.7, 0.4], [1.3, 0.9]], ["contact", "neumann", "dirichlet"])],
)
PUSHED = Problem(
    f=lambda x: 12 * ufl.sin(5 * x[0]) - 5, g=lambda x: x[1] - 1, dirichlet=lambda x: 0.2 + x[1]
)


def cells_of(n, stretched=False, comm=WORLD):
    domain = structured(HELD_ALL_ROUND, n, comm, jitter=0.2)
    V = fem.functionspace(domain.mesh, ("CR", 1))
    cells = Cells(domain, V, (DIRICHLET,))
    if stretched:
        turned = np.array([[0.8, 0.3], [0.3, (1 + 0.09) / 0.8]])
        cells = Cells(
            domain, V, (DIRICHLET,), stretch=np.broadcast_to(turned, (cells.number, 2, 2)).copy()
        )
    return cells


def places(cells):
    """Coordinates of the vertices, shape (vertices, 2)."""
    mesh = cells.domain.mesh
    x = np.empty((cells.vertices.max(initial=-1) + 1, 2))
    x[cells.vertices.T] = mesh.geometry.x[cell_nodes(mesh)[: cells.number], :2]
    return x


@pytest.mark.parametrize("layers", [0, 1, 3])
def test_layers_of_cells_around_vertices(layers):
    """What is in reach does not depend on ranks: on one, by one cell after the other."""

    def start(cells):
        size = cells.domain.mesh.topology.index_map(0)
        chosen = np.zeros(size.size_local + size.num_ghosts, dtype=bool)
        at = places(cells)
        for corner in ([0.0, 0.0], [1.0, 0.0]):
            chosen[: len(at)] |= np.hypot(*(at - corner).T) < 1e-9
        return chosen

    alone = cells_of(10, comm=MPI.COMM_SELF)
    expected = start(alone)
    for _ in range(layers):
        hit = [row for row in alone.vertices.T if expected[row].any()]
        for row in hit:
            expected[row] = True
    inside = {tuple(np.round(x, 9)) for x in places(alone)[expected]}
    cells = cells_of(10)
    reached = cells.around(start(cells), layers)
    at = places(cells)
    mine = {tuple(np.round(x, 9)) for x in at[reached[: len(at)]]}
    assert set().union(*WORLD.allgather(mine)) == inside
    assert mine == {tuple(np.round(x, 9)) for x in at} & inside


@pytest.mark.parametrize("kappa", ["constant", "random", "tensor"])
def test_a_small_system_has_the_same_solution(kappa, monkeypatch):
    """Near one corner, where few ranks have cells; on a mesh of these cells, and on the whole."""
    cells = cells_of(12, kappa == "tensor")
    rng = np.random.default_rng(WORLD.rank)
    kappa = np.array(2.0) if kappa == "constant" else rng.uniform(1, 3, cells.number)
    excess = rng.normal(size=(3, cells.number))
    slopes = Slopes.of(of_gradients(cells, kappa), excess, np.zeros(len(cells.exterior)))
    at = places(cells)
    size = cells.domain.mesh.topology.index_map(0)
    loose = np.zeros(size.size_local + size.num_ghosts)
    loose[: len(at)] = np.hypot(*at.T) < 0.3
    loose = cells.share(loose, 0) > 0.0
    free = np.zeros(len(cells.exterior))
    for facet, (j, k) in zip(cells.facets, cells.others, strict=True):
        free[facet[loose[cells.vertices[j]] | loose[cells.vertices[k]]]] = 1.0
    free = cells.share(free) > 0.0
    assert 0 < WORLD.allreduce(loose.sum()) < WORLD.allreduce(loose.size) / 4
    made, submesh = [], nearest.compat.submesh
    noted = lambda *all_: made.append(submesh(*all_)) or made[-1]  # noqa: E731
    monkeypatch.setattr(nearest.compat, "submesh", noted)
    small = nearest.nearest(cells, kappa, slopes, loose, free)
    assert len(made) == 1
    monkeypatch.setattr(nearest, "LARGEST", 0.0)
    whole = nearest.nearest(cells, kappa, slopes, loose, free)
    assert len(made) == 1
    scale = max(WORLD.allgather(np.abs(whole[0]).max(initial=0.0)))
    for one, other in zip(small, whole, strict=True):
        assert np.abs(one - other).max(initial=0.0) < 1e-6 * scale
    assert not small[0][~loose].any() and not small[1][~free].any()


def test_multigrid_of_petsc_on_thin_cells(monkeypatch):
    """GAMG is in every PETSc: it gets to the end in time, and leaves alone what is not free."""
    mesh = create_rectangle(WORLD, [(-1, 0), (1, 1)], [5, 75])
    mesh.topology.create_connectivity(1, 2)
    rim = exterior_facet_indices(mesh.topology)
    domain = Domain(mesh, meshtags(mesh, 1, rim, np.full_like(rim, CONTACT)))
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    rng = np.random.default_rng(WORLD.rank)
    excess = rng.normal(size=(3, cells.number))
    slopes = Slopes.of(of_gradients(cells, np.array(1.0)), excess, np.zeros(len(cells.exterior)))
    size = cells.domain.mesh.topology.index_map(0)
    on_rim = np.zeros(size.size_local + size.num_ghosts)
    for side in cells.sides.values():
        on_rim[side.ends] = 1.0
    loose, free = cells.share(on_rim, 0) == 0.0, ~cells.exterior
    monkeypatch.setitem(nearest.COMPANION, "pc_type", PETSc.PC.Type.GAMG)
    values, heights = nearest.nearest(cells, np.array(1.0), slopes, loose, free)
    assert not values[~loose].any() and not heights[~free].any()
    after = Slopes.of(of_gradients(cells, np.array(1.0)), excess + values[cells.vertices], heights)
    for over, mine, before, left in (
        (cells.over_vertices, loose, slopes.vertices, after.vertices),
        (cells.over_facets, free, slopes.facets, after.facets),
    ):
        scale = max(WORLD.allgather(np.abs(before).max(initial=0.0)))
        assert np.abs(over(left)[mine]).max(initial=0.0) < 1e-7 * scale


def test_the_foremost_hold_what_they_are_to_hold():
    """And without those of the least class they would not."""
    cells = cells_of(4)
    values = np.random.default_rng(WORLD.rank).uniform(size=200) ** 9
    limit = best._limit(cells, values)
    everyones = np.concatenate(WORLD.allgather(values))
    part = best.FOREMOST * everyones.sum()
    assert everyones[everyones > limit].sum() >= part
    assert everyones[everyones > 2**0.25 * limit].sum() < part
    assert best._limit(cells, 0.0 * values) == 0.0


@pytest.fixture(scope="module")
def around_corners():
    *_, solution = solve_levels(PUSHED, CORNERS.mesh(0.08, WORLD), 3)
    return solution


@pytest.mark.slow
def test_corners_take_small_systems(around_corners, monkeypatch):
    """Much is gained at single points: by systems of a few unknowns, as by those of all."""
    sizes, solve_for = [], best.nearest

    def noted(cells, kappa, slopes, loose, free, masses):
        mine = loose[: cells.owned_vertices()].sum() + free[: cells.owned_facets()].sum()
        sizes.append(cells.total(float(mine))[0])
        return solve_for(cells, kappa, slopes, loose, free, masses)

    monkeypatch.setattr(best, "nearest", noted)
    monkeypatch.setattr(companion, "PROMISE", 0.0)
    local = certify(around_corners)
    small = sizes.copy()
    sizes.clear()
    monkeypatch.setattr(best, "LARGEST", -1.0)
    whole = certify(around_corners)
    assert 1 <= len(small) <= best.ROUNDS
    assert max(small) < 0.15 * max(sizes)
    assert local.bound_h1 <= 1.005 * whole.bound_h1
    monkeypatch.setattr(companion, "PROMISE", np.inf)
    assert whole.bound_h1 < 0.9 * certify(around_corners).bound_h1


@pytest.mark.slow
def test_admissible_where_it_is_solved_for_around_corners(around_corners, monkeypatch):
    monkeypatch.setattr(companion, "PROMISE", 0.0)
    solution = around_corners
    v = certify(solution).companion
    ds = ufl.Measure("ds", solution.domain.mesh, subdomain_data=solution.domain.tags)
    x = ufl.SpatialCoordinate(solution.domain.mesh)
    wrong = ufl.max_value(-v, 0.0) * ds(1) + (v - 0.2 - x[1]) ** 2 * ds(2)
    assert WORLD.allreduce(fem.assemble_scalar(fem.form(wrong))) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("example", ["L", "D"])
def test_around_a_corner_ranks_make_no_difference(example, monkeypatch):
    monkeypatch.setattr(companion, "PROMISE", 0.0)
    example, parts = getattr(exact, example), []
    for comm in (MPI.COMM_SELF, WORLD):
        *_, solution = solve_levels(example.problem, example.structured(12, comm), 3)
        parts.append(certify(solution).parts)
    for part in ("flux", "companion"):
        assert np.isclose(parts[0][part], parts[1][part], rtol=1e-6)
