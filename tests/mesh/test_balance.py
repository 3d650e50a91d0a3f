"""Adaptive meshes shared out anew: the same cells, parents on other ranks, the same solutions."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from dolfinx import fem
from helpers import areas, corners
from mpi4py import MPI

from signorini_cr import Domain, Polygon, Problem, Solution, solve_adaptive
from signorini_cr.compat import cell_nodes
from signorini_cr.mesh import balance as module
from signorini_cr.mesh.balance import balance
from signorini_cr.mesh.materials import Materials
from signorini_cr.mesh.refinement import refine_marked
from signorini_cr.multigrid.parents import Parents
from signorini_cr.restart import Restart
from signorini_cr.verification.norms import distance

pytestmark = pytest.mark.ranks

COMM = MPI.COMM_WORLD
SQUARE = Polygon(
    [[-1, 0], [1, 0], [1, 1], [-1, 1]], ["contact", "dirichlet", "neumann", "dirichlet"]
)
PROBLEM = Problem(
    f=-3.0, obstacle=lambda x: 0.1 * x[0] - 0.2, coefficient=lambda x: 1.0 + x[0] ** 2
)


def together(table: np.ndarray) -> np.ndarray:
    """The rows of all ranks, in order."""
    rows = np.concatenate(COMM.allgather(table))
    return rows[np.lexsort(rows.T)]


def labelled(domain: Domain) -> np.ndarray:
    """Midpoints of tagged facets, and their values."""
    mesh = domain.mesh
    ends = mesh.topology.connectivity(1, 0).array.reshape(-1, 2)[domain.tags.indices]
    node = np.empty(mesh.topology.connectivity(2, 0).array.max(initial=-1) + 1, dtype=int)
    node[mesh.topology.connectivity(2, 0).array] = cell_nodes(mesh).ravel()
    return np.column_stack(
        [mesh.geometry.x[node[ends], :2].sum(axis=1), domain.tags.values.astype(float)]
    )


def into_a_corner() -> tuple[Domain, Domain, np.ndarray]:
    """The last two meshes that grow where x and y are small, as they are shared out at first."""
    fine = SQUARE.mesh(0.5)
    for _ in range(5):
        coarse = fine
        fine, parent = refine_marked(coarse, corners(coarse.mesh).sum(axis=2).min(axis=1) < -0.7)
    return coarse, fine, parent


def test_the_same_cells_in_the_same_parents():
    coarse, fine, parent = into_a_corner()
    share = fine.mesh.topology.index_map(2)
    if COMM.size > 1:
        assert COMM.allreduce(share.size_local, MPI.MAX) * COMM.size > 1.3 * share.size_global
    moved, place, exchange = balance(fine, parent)
    assert (exchange is None) == (COMM.size == 1)
    number = COMM.allgather(len(corners(moved.mesh)))
    assert max(number) - min(number) <= COMM.size
    cells = corners(coarse.mesh)
    families = [
        np.column_stack([corners(domain.mesh).reshape(-1, 6), its.reshape(-1, 6)])
        for domain, its in (
            (fine, cells[parent]),
            (moved, (cells if exchange is None else exchange.fetch(cells))[place]),
        )
    ]
    assert np.array_equal(together(families[0]), together(families[1]))
    assert np.array_equal(together(labelled(fine)), together(labelled(moved)))


def test_balanced_meshes_stay():
    fine, parent = refine_marked(SQUARE.mesh(0.25), [])
    assert balance(fine, parent) == (fine, parent, None)


def test_children_are_put_together_on_other_ranks():
    coarse, fine, parent = into_a_corner()
    moved, place, exchange = balance(fine, parent)
    parents = Parents(coarse.mesh, moved.mesh, place, exchange)
    theirs, own = (areas(domain.mesh) for domain in (coarse, moved))
    assert parents.collected(own) == pytest.approx(theirs, rel=1e-13)
    smallest = parents.collected(own, np.minimum)
    at_once = Parents(coarse.mesh, fine.mesh, parent).collected(areas(fine.mesh), np.minimum)
    assert smallest == pytest.approx(at_once, rel=1e-13)


def test_what_cells_have_moves_with_them():
    """Materials, and a Function that is constant on the coarse cells."""
    coarse, fine, parent = into_a_corner()
    left = (corners(fine.mesh)[:, :, 0].mean(axis=1) < 0).astype(np.int32)
    moved, _, _ = balance(replace(fine, materials=Materials({"left": 1}, left)), parent)
    centres = corners(moved.mesh)[:, :, 0].mean(axis=1)
    assert np.array_equal(moved.materials.of_cells, centres < 0)
    of_cells = fem.Function(fem.functionspace(coarse.mesh, ("DG", 0)))
    of_cells.x.array[of_cells.function_space.dofmap.list[:, 0]] = areas(coarse.mesh)
    tables = []
    for domain in (fine, moved):
        own = domain.own(of_cells)
        values = own.x.array[own.function_space.dofmap.list[:, 0]]
        tables.append(together(np.column_stack([corners(domain.mesh).reshape(-1, 6), values])))
    assert np.array_equal(*tables)


def test_a_refined_domain_keeps_no_coarser_mesh_alive():
    """But carries down to it what is constant on the cells of any of them."""
    first = SQUARE.mesh(0.5)
    second, _ = refine_marked(first, [0])
    of_cells = fem.Function(fem.functionspace(second.mesh, ("DG", 0)))
    of_cells.x.array[:] = 3.0
    third, _ = refine_marked(second, [0])
    assert np.all(third.own(of_cells).x.array == 3.0)
    left = [weakref.ref(each) for each in (first, first.mesh, second)]
    of_second = weakref.ref(second.mesh)
    del first, second
    gc.collect()
    assert [each() for each in left] == [None, None, None]
    assert of_second() is of_cells.function_space.mesh


def solved(limit: float, monkeypatch: pytest.MonkeyPatch, **more) -> list[Solution]:
    """Solutions on meshes that are shared out anew from such an imbalance on; 0 is always."""
    monkeypatch.setattr(module, "LIMIT", limit)
    return list(solve_adaptive(PROBLEM, SQUARE.mesh(0.5), levels=4, **more))


def test_solutions_do_not_depend_on_where_cells_are(monkeypatch):
    never, always = (solved(limit, monkeypatch) for limit in (np.inf, 0.0))
    for a, b in zip(never, always, strict=True):
        assert (a.cells, a.dofs) == (b.cells, b.dofs)
        assert a.energy == pytest.approx(b.energy, rel=1e-9)
        assert a.certificate.bound_h1 == pytest.approx(b.certificate.bound_h1, rel=1e-7)
        assert a.contact.force == pytest.approx(b.contact.force, rel=2e-7)
        assert a.contact.number_active == b.contact.number_active
        assert abs(a.iterations.linear - b.iterations.linear) <= 3
    distances = [distance(*each[-2:]) for each in (never, always)]
    assert distances[0] == pytest.approx(distances[1], rel=1e-6)


def test_a_run_goes_on_from_meshes_that_were_shared_out_anew(monkeypatch):
    whole = solved(0.0, monkeypatch)
    restart = None
    for solution in whole[:3]:
        restart = Restart.of(solution, restart, adaptive=True)
    restart = COMM.bcast(restart)
    if COMM.rank == 0:
        counts = [each.u.function_space.mesh.geometry.index_map().size_global for each in whole]
        assert [len(at) for at in restart.added] == np.diff(counts[:3]).tolist()
    for limit in (0.0, np.inf):
        first, second = solved(limit, monkeypatch, restart=restart)
        assert first.energy == pytest.approx(whole[2].energy, rel=1e-9)
        assert second.energy == pytest.approx(whole[3].energy, rel=1e-9)
        assert second.dofs == whole[3].dofs
