"""Domains with a slit, whose faces have facets at the same places; pieces that touch."""

from collections.abc import Callable

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx.mesh import (
    Mesh,
    MeshTags,
    compute_midpoints,
    create_mesh,
    exterior_facet_indices,
    meshtags,
)
from mpi4py import MPI

from signorini_cr import Contact, Domain, InputError, Neumann, Problem, solve_adaptive, solve_levels
from signorini_cr.data.consistency import doubts
from signorini_cr.fem.problem import Forms
from signorini_cr.mesh.domain import facet_entities
from signorini_cr.restart import Restart
from signorini_cr.verification.exact import S1

COMM = MPI.COMM_WORLD
OUTSIDE, UNDER, OVER = 1, 2, 3


def made(squares: list[tuple[int, int, int]], width: float) -> Mesh:
    """Cut squares into triangles; those of another layer have nodes of their own on y = 1.

    Args:
        squares: Column, row and layer.
        width: Of each.

    Returns:
        The mesh.
    """
    numbers: dict[tuple[float, ...], int] = {}
    cells = []
    for i, j, layer in squares:
        corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        keys = [
            (x, y, layer if 0.5 < x * width < 1.5 and y * width == 1 else 0) for x, y in corners
        ]
        a, b, c, d = (numbers.setdefault(key, len(numbers)) for key in keys)
        cells += [(a, b, c), (a, c, d)]
    points = np.array([key[:2] for key in numbers]) * width
    here = slice(None) if COMM.rank == 0 else slice(0, 0)
    triangle = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    return create_mesh(COMM, np.array(cells, np.int64)[here], x=points[here], e=triangle)


def tagged(mesh: Mesh, value: Callable[..., np.ndarray]) -> tuple[Mesh, MeshTags]:
    """Give exterior facets the value of their midpoints and the middles of their cells."""
    mesh.topology.create_connectivity(1, 2)
    facets = exterior_facet_indices(mesh.topology)
    cells = facet_entities(mesh, facets)[:, 0]
    values = value(compute_midpoints(mesh, 1, facets), compute_midpoints(mesh, 2, cells))
    values = values.astype(np.int32)
    return mesh, meshtags(mesh, 1, facets, values)


def slit(n: int) -> Domain:
    """(0, 2) × (0, 2) without the points of y = 1, 0.5 ≤ x ≤ 1.5; n squares a side."""
    width = 2.0 / n
    squares = [(i, j, int(j * width >= 1)) for i in range(n) for j in range(n)]

    def value(at, inside):
        on_it = np.isclose(at[:, 1], 1.0) & (np.abs(at[:, 0] - 1.0) < 0.5)
        return np.where(on_it, np.where(inside[:, 1] < 1.0, UNDER, OVER), OUTSIDE)

    mesh, tags = tagged(made(squares, width), value)
    return Domain.from_tags(mesh, tags, dirichlet=OUTSIDE, parts=(UNDER, OVER))


def pull(x):
    return 6.0 * ufl.exp(-20.0 * (x[0] - 0.7) ** 2)


@pytest.mark.parametrize("adaptive", [False, True])
def test_faces_of_a_slit_are_told_apart_by_a_restart(adaptive: bool) -> None:
    """A flux into one face: u jumps, and cells are refined at that one."""
    conditions = {UNDER: Neumann(pull), OVER: Neumann(0.0)}
    problem, domain = Problem(f=-1.0, conditions=conditions), slit(4)
    solve, count = (solve_adaptive, 6) if adaptive else (solve_levels, 3)
    whole, restart = list(solve(problem, domain, levels=count)), None
    for each in whole:
        restart = Restart.of(each, restart, adaptive=adaptive)
    restart = COMM.bcast(restart)
    for (fine, *_), level in zip(restart.meshes(domain), whole[1:], strict=True):
        assert fine.mesh.topology.index_map(2).size_global == level.cells
    (again,) = solve(problem, domain, levels=count, restart=restart)
    assert again.cells == whole[-1].cells
    kept = restart.function(again.u.function_space, 0).x.array
    assert again.u.x.array == pytest.approx(kept, abs=1e-8)
    assert again.energy == pytest.approx(whole[-1].energy, rel=1e-10)


@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])
def test_a_slit_through_which_nothing_flows_is_told(scale: float) -> None:
    """Not so one that has data, nor a boundary with the outside behind it."""

    def said(*values: float) -> list[str]:
        domain = slit(4)
        domain.mesh.geometry.x[:] *= scale
        conditions = dict(zip((UNDER, OVER), map(Neumann, values), strict=True))
        problem = Problem(f=-1.0, conditions=conditions)
        return doubts(Forms(problem, domain.mesh, parts=domain.parts), domain)

    (both,), (one,) = said(0.0, 0.0), said(0.0, 1.0)
    at = f"({0.75 * scale:.10g}, {scale:.10g})"
    assert f"on both sides of 4 facets of its boundary, as at {at}: a slit" in both
    assert "on both sides of 2 facets" in one and said(1.0, 1.0) == []
    whole = S1.structured(4)
    assert doubts(Forms(Problem(f=-1.0), whole.mesh, parts=whole.parts), whole) == []


def test_vertices_on_a_slit_are_not_told_apart() -> None:
    problem = Problem(f=-1.0, conditions={UNDER: Neumann(pull), OVER: Neumann(0.0)})
    (solution,) = solve_levels(problem, slit(8), 1, "P1")
    restart = COMM.bcast(Restart.of(solution, None, adaptive=False))
    with pytest.raises(InputError, match="nodes of P1 at the same place"):
        restart.function(solution.u.function_space, 0)


def test_contact_on_both_faces_of_a_slit() -> None:
    """It begins and ends on each face by itself, and they are passed one after the other."""
    conditions = {UNDER: Contact(-0.02), OVER: Contact(-0.5)}
    *_, solution = solve_levels(Problem(f=-1.0, conditions=conditions), slit(8), 2)
    table, found = solution.contact.table(), solution.contact.transitions
    if COMM.rank == 0:
        under = table["y"] == 1.0
        assert under.all() and set(table["part"]) == {0}
        # once round: on the lower face to the left or to the right, on the upper one back
        steps = np.diff(table["arc_length"])
        assert steps == pytest.approx(table["length"][0])
        turns = np.sign(np.diff(table["x"]))
        assert np.abs(turns).sum() >= len(turns) - 2
        assert np.count_nonzero(np.diff(turns[turns != 0])) <= 2
        active = table["active"]
        changes = np.count_nonzero(active != np.roll(active, 1))
        assert 0 < changes == len(found)
    assert 0 < solution.contact.number_active < 16


def test_two_squares_that_touch() -> None:
    """Each has a part of its own, whatever the number of ranks."""
    squares = [(i + k, j + k, 0) for k in (0, 4) for i in range(4) for j in range(4)]

    def value(at, _):
        return np.where(np.isclose(at[:, 0], 1.0) | np.isclose(at[:, 1], 1.0), 1, 2)

    mesh, tags = tagged(made(squares, 0.25), value)
    domain = Domain.from_tags(mesh, tags, contact=1, dirichlet=2)
    problem = Problem(f=lambda x: -20.0 * (x[0] - x[1]) - 6.0, obstacle=-0.1)
    *_, solution = solve_levels(problem, domain, 2)
    table = solution.contact.table()
    if COMM.rank == 0:
        for number, upper in enumerate((False, True)):
            part = table["part"] == number
            inside = np.maximum(table["x"], table["y"])[part] > 1.0
            assert np.all(inside == upper) and part.sum() == 16
            assert np.diff(table["arc_length"][part]) == pytest.approx(0.125)
