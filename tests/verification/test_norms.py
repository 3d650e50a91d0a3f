"""Norms and the paper's estimate, against what can be known of them without solving anything."""

from dataclasses import astuple, replace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Neumann,
    Polygon,
    Problem,
    exact,
    norms,
    solve,
    solve_levels,
    theory,
)
from signorini_cr.fem.space import facet_measures, function_space
from signorini_cr.mesh.domain import CONTACT

COMM = MPI.COMM_WORLD


def test_rates():
    h = [0.4, 0.2, 0.1]
    assert np.allclose(norms.rates(h, [3 * x**1.5 for x in h]), 1.5)
    assert np.isnan(norms.rates(h, [1.0, 0.0, 0.0])).all()


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_gradients_of_an_affine_function(element):
    mesh = exact.L.structured(3, jitter=0.2).mesh
    u = fem.Function(function_space(mesh, element))
    u.interpolate(lambda x: 2.0 - 3.0 * x[0] + 5.0 * x[1])
    gradients, areas = norms.cell_gradients(u)
    assert np.allclose(gradients, [-3.0, 5.0])
    assert COMM.allreduce(areas.sum()) == pytest.approx(3.0)


def test_errors_with_another_quadrature():
    solution = solve(exact.C.problem, exact.C.mesh(0.2))
    assert norms.errors(solution, 6) == pytest.approx(solution.errors)
    assert norms.errors(solution, 14) == pytest.approx(solution.errors, rel=1e-4)
    assert norms.errors(solution, 1)[0] != pytest.approx(solution.errors[0], rel=1e-3)


def test_distance_of_levels():
    """The triangle inequality, and for P1 the energy's."""
    coarse, fine = solve_levels(exact.D.problem, exact.D.structured(4), 2)
    distance = norms.distance(coarse, fine)
    assert distance < coarse.errors[0] + fine.errors[0]
    assert distance > coarse.errors[0] - fine.errors[0]
    with pytest.raises(ValueError, match="level after"):
        norms.distance(fine, coarse)
    problem = Problem(f=lambda x: 4.0 * x[0], obstacle=-0.02)
    coarse, fine = solve_levels(problem, exact.S1.structured(4), 2, "P1")
    assert 0 < coarse.contact.number_active < coarse.contact.number
    energy = 0.5 * norms.distance(coarse, fine) ** 2
    # K_H ⊂ K_h: J(u_H) − J(u_h) = ½‖u_H − u_h‖² + what the constraint holds back
    assert 0.0 < energy <= (coarse.energy - fine.energy) * (1 + 1e-6)


def test_pressure_error_of_a_known_difference():
    """On A the pressure is a cubic; without λ_h its norm is (∫_0^1 t⁶ dt)^½."""
    solution = solve(exact.A.problem, exact.A.structured(4))
    solution.contact.pressure[:] = 0.0
    assert norms.pressure_error(solution, exact.A.pressure) == pytest.approx(7**-0.5)


def test_interpolation_keeps_affine_functions_and_facet_means():
    domain = exact.S1.structured(4, jitter=0.2)
    affine = theory.interpolate(domain, lambda x: 1.0 + x[0] - 2.0 * x[1])
    points = affine.function_space.tabulate_dof_coordinates()
    assert np.allclose(affine.x.array, 1.0 + points[:, 0] - 2.0 * points[:, 1])
    square = theory.interpolate(domain, lambda x: x[0] ** 2)
    ends, _ = facet_measures(domain.mesh, domain.facets(CONTACT))
    means = (ends[:, 1, 0] ** 3 - ends[:, 0, 0] ** 3) / (3 * (ends[:, 1, 0] - ends[:, 0, 0]))
    middle = ends.mean(axis=1)
    found = [square.x.array[np.argmin(np.linalg.norm(points - point, axis=1))] for point in middle]
    assert np.allclose(found, means)


def test_interpolant_has_the_mean_gradient():
    """∇Π_h u is the mean of ∇u on each cell: Π_h u is the best approximation."""
    domain = exact.C.structured(4, jitter=0.2)
    interpolant = theory.interpolate(domain, exact.C.problem.exact)
    x = ufl.SpatialCoordinate(domain.mesh)
    dx = ufl.Measure("dx", domain.mesh, metadata={"quadrature_degree": 10})
    W = fem.functionspace(domain.mesh, ("DG", 0, (2,)))
    difference = ufl.grad(exact.C.problem.exact(x) - interpolant)
    cells = fem.assemble_vector(fem.form(ufl.dot(difference, ufl.TestFunction(W)) * dx))
    assert np.allclose(cells.array, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "family"),
    [("S1", {}), ("S1", {"shift": 0.31}), ("S1 Neumann", {}), ("A", {"shift": 0.31}), ("B", {})],
    ids=str,
)
def test_the_terms_of_the_estimate_add_up(name, family):
    """(1.11) with the constant 1, and what it loses."""
    example = exact.ALL[name]
    solution = solve(example.problem, example.structured(8, **family))
    terms = theory.abstract_estimate(solution, example)
    assert terms.error == pytest.approx(solution.errors[0] ** 2, rel=1e-4)
    inner = terms.interior + terms.dirichlet + terms.contact
    assert inner == pytest.approx(terms.consistency, abs=3e-4 * terms.error)
    assert terms.right_side - terms.slack == pytest.approx(terms.error, rel=3e-4)
    assert terms.slack > -1e-8
    assert 0.0 < terms.best < terms.error
    assert terms.contact == pytest.approx(terms.contact_bound + terms.contact_mixed)


def test_the_estimate_is_for_cr_with_a_known_solution():
    with pytest.raises(ValueError, match="exact solution"):
        theory.abstract_estimate(solve(exact.E.problem, exact.E.structured(4)), exact.E)
    with pytest.raises(ValueError, match="CR element"):
        theory.abstract_estimate(solve(exact.S1.problem, exact.S1.structured(4), "P1"), exact.S1)


def named(example, **conditions):
    """The same with names of its own for the parts of the boundary, given what holds on them."""
    names = {"contact": "floor", "dirichlet": "wall", "neumann": "side"}
    boundary = [names[part] for part in example.polygon.boundary]
    polygon = Polygon(example.polygon.vertices, boundary, names=tuple(dict.fromkeys(boundary)))
    held = {"floor": Contact(0.0), "wall": Dirichlet(), "side": Neumann()} | conditions
    conditions = {part: held[part] for part in dict.fromkeys(polygon.boundary)}
    problem = replace(example.problem, conditions=conditions)
    return replace(example, polygon=polygon, problem=problem)


@pytest.mark.parametrize("name", ["S1", "S1 Neumann"])
def test_the_theory_goes_by_what_holds_on_parts_and_not_by_their_names(name):
    usual, other = exact.ALL[name], named(exact.ALL[name])
    terms, judgements = [], []
    for example in (usual, other):
        solution = solve(example.problem, example.structured(8))
        terms.append(astuple(theory.abstract_estimate(solution, example)))
        judgements.append(theory.judge(solution, example))
    assert np.allclose(*terms, rtol=1e-9, atol=1e-13)
    assert judgements[0] == judgements[1] and judgements[0].bound > 0


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        (Contact(0.0, upper=9.0), "floor has an upper bound"),
        (Contact(0.0, g=1.0), "no flux beside an obstacle's"),
        (Contact(0.0, coefficient=1.0), "no loss of heat"),
    ],
)
def test_the_theory_is_of_the_papers_problem_alone(condition, words):
    example = named(exact.S1, floor=condition)
    with pytest.raises(ValueError, match=words):
        theory.abstract_estimate(solve(example.problem, example.structured(4)), example)
    stiff = replace(exact.S1, problem=replace(exact.S1.problem, coefficient=2.0))
    with pytest.raises(ValueError, match="κ = 1"):
        theory.abstract_estimate(solve(stiff.problem, stiff.structured(4)), stiff)


def gathered_sets(domain, example):
    """Left and right ends of all contact facets and the sets they are in, on every rank."""
    ends, _ = facet_measures(domain.mesh, domain.facets(CONTACT))
    rows = np.column_stack([np.sort(ends[:, :, 0], axis=1), theory.facet_sets(domain, example)])
    rows = np.concatenate(COMM.allgather(rows))
    return rows[np.argsort(rows[:, 0])].T


@pytest.mark.parametrize("name", ["S1", "A", "C2"])
def test_facet_sets_with_one_critical_point(name):
    left, right, sets = gathered_sets(exact.ALL[name].structured(8, shift=0.31), exact.ALL[name])
    expected = np.where(right <= 0, theory.BOUND, np.where(left >= 0, theory.FREE, theory.MIXED))
    assert np.array_equal(sets, expected)
    assert np.count_nonzero(sets == theory.MIXED) == 1


def test_facet_sets_with_infinitely_many_critical_points():
    """Contact begins and ends at 1/k: bound are the facets in [1/(2k), 1/(2k − 1)] and x < 0."""
    left, right, sets = gathered_sets(exact.I.structured(15), exact.I)
    far = left > 0.15
    left, right = np.where(far, left, 1.0), np.where(far, right, 1.0)
    piece = np.floor(1.0 / right + 1e-9), np.ceil(1.0 / left - 1e-9)
    inside = np.isclose(piece[1] - piece[0], 1.0)
    odd = piece[0] % 2 == 1
    expected = np.where(~inside, theory.MIXED, np.where(odd, theory.BOUND, theory.FREE))
    assert np.array_equal(sets[far], expected[far])
    assert np.all(sets[:15] == theory.BOUND)
    assert {0, 1, 2} == set(sets.astype(int))


def test_judgement_counts_every_facet():
    solution = solve(exact.C2.problem, exact.C2.structured(12, shift=0.31))
    found = theory.judge(solution, exact.C2)
    assert found.bound + found.mixed + found.free == 24
    assert found.active == solution.contact.number_active
    assert found.misjudged == found.missed + found.extra
    # λ ~ |x|^{9/2}: next to the critical point the discrete solution can't tell
    assert 1 <= found.misjudged <= 4
    solution = solve(exact.S1.problem, exact.S1.structured(12))
    assert theory.judge(solution, exact.S1).misjudged == 0
