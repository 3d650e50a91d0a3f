"""The test problems: their data fit together, and the reference figures come out."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

from signorini_cr import Material, exact, families, norms, solve, solve_levels
from signorini_cr.data.consistency import doubts
from signorini_cr.errors import InputError
from signorini_cr.fem.problem import Forms, as_expression
from signorini_cr.fem.space import facet_measures
from signorini_cr.mesh.domain import CONTACT, DIRICHLET, NEUMANN
from signorini_cr.mesh.refinement import refine

COMM = MPI.COMM_WORLD
KNOWN = [name for name, example in exact.ALL.items() if example.problem.exact is not None]


def measures(domain, degree=12):
    """Volume and boundary measures; the latter knows the parts."""
    metadata = {"quadrature_degree": degree}
    return (
        ufl.Measure("dx", domain.mesh, metadata=metadata),
        ufl.Measure("ds", domain.mesh, metadata=metadata, subdomain_data=domain.tags),
    )


def integrate(form):
    return COMM.allreduce(fem.assemble_scalar(fem.form(form)))


@pytest.mark.parametrize("name", KNOWN)
def test_data_fit_together(name):
    """−Δu = f, u = u_D, ∂ₙu = g and the conditions (1.4) on Γ1 with λ = ∂ₙu."""
    example = exact.ALL[name]
    problem, domain = example.problem, example.structured(6)
    dx, ds = measures(domain)
    x, n = ufl.SpatialCoordinate(domain.mesh), ufl.FacetNormal(domain.mesh)
    u = as_expression(problem.exact, x)
    pressure = as_expression(example.pressure, x)
    flux, gap = ufl.dot(ufl.grad(u), n), u - as_expression(problem.obstacle, x)
    wrong = (flux - pressure) ** 2 + ufl.min_value(pressure, 0.0) ** 2
    wrong += ufl.min_value(gap, 0.0) ** 2 + (gap * pressure) ** 2
    form = wrong * ds(CONTACT)
    if problem.f is not None:
        form += (ufl.div(ufl.grad(u)) + as_expression(problem.f, x)) ** 2 * dx
    if problem.dirichlet is not None:
        form += (u - as_expression(problem.dirichlet, x)) ** 2 * ds(DIRICHLET)
    if problem.g is not None:
        form += (flux - as_expression(problem.g, x)) ** 2 * ds(NEUMANN)
    assert integrate(form) < 1e-20
    # There is contact, and there is a gap: else nothing would have been tested
    assert integrate((gap + pressure) * ds(CONTACT)) > 1e-3


@pytest.mark.parametrize("name", [n for n in KNOWN if exact.ALL[n].energy is not None])
def test_energy(name):
    """J(u) = ½∫|∇u|² − ∫fu − ∫gu; next to r = 0 the quadrature is less exact for D."""
    example = exact.ALL[name]
    domain = example.structured(12)
    dx, ds = measures(domain, 16)
    x, n = ufl.SpatialCoordinate(domain.mesh), ufl.FacetNormal(domain.mesh)
    u = as_expression(example.problem.exact, x)
    f = -ufl.div(ufl.grad(u)) if example.problem.f is None else as_expression(example.problem.f, x)
    energy = (0.5 * ufl.inner(ufl.grad(u), ufl.grad(u)) - f * u) * dx
    energy -= ufl.dot(ufl.grad(u), n) * u * ds(NEUMANN)
    tolerance = {"S1": 1e-7, "S1 Neumann": 1e-7, "D": 5e-3, "I": 3e-4}.get(name, 1e-5)
    assert integrate(energy) == pytest.approx(example.energy, rel=tolerance)


def test_s1_has_the_norm_of_twice_its_energy():
    domain = exact.S1.structured(12)
    u = as_expression(exact.S1.problem.exact, ufl.SpatialCoordinate(domain.mesh))
    squared = integrate(ufl.inner(ufl.grad(u), ufl.grad(u)) * measures(domain)[0])
    assert squared == pytest.approx(0.97175522532, rel=1e-6)


def levels(name, n, number, **family):
    example = exact.ALL[name]
    found = []
    for solution in solve_levels(example.problem, example.structured(n, **family), number):
        found.append((solution.errors or (None, None), solution.energy, solution))
    h1 = [errors[0] for errors, _, _ in found]
    return h1, [energy for _, energy, _ in found], [solution for *_, solution in found]


@pytest.mark.slow
def test_reference_figures_of_s1():
    """Errors, energies from below and the error of the pressure, to the digits known."""
    h1, energies, solutions = levels("S1", 8, 5)
    assert np.allclose(h1, [0.1786, 0.0898, 0.0450, 0.0225, 0.0112], rtol=0, atol=1.01e-4)
    assert np.allclose(
        energies, [-0.492476, -0.487563, -0.486302, -0.485984, -0.485904], rtol=0, atol=1.01e-6
    )
    pressure = [norms.pressure_error(solution, exact.S1.pressure) for solution in solutions]
    assert np.allclose(pressure, [0.066, 0.035, 0.0184, 0.0096, 0.0050], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_reference_figures_of_e():
    _, energies, _ = levels("E", 16, 4)
    assert np.allclose(energies, [-0.462937, -0.462065, -0.461833, -0.461774], rtol=0, atol=1.01e-6)


@pytest.mark.slow
def test_reference_figures_with_facet_means():
    """The reference takes u_D at midpoints: means change an error by a share of O(h²)."""
    for name, expected in (
        ("A", [0.1724, 0.0870, 0.0436, 0.0218]),
        ("B", [0.0870, 0.0438, 0.0219, 0.0110]),
        ("D", [0.176, 0.126, 0.0896, 0.0636]),
    ):
        assert np.allclose(levels(name, 8, 4)[0], expected, rtol=0.02), name


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_variants_of_s1_have_its_solution(element):
    domain = exact.S1.structured(8)
    plain = solve(exact.S1.problem, domain, element)
    raised = solve(exact.S1_RAISED.problem, domain, element)
    neumann = solve(exact.S1_NEUMANN.problem, exact.S1_NEUMANN.structured(8), element)
    # α is affine: V_h has it, and everything is shifted by it
    assert raised.errors == pytest.approx(plain.errors, rel=1e-5)
    assert raised.contact.force == pytest.approx(plain.contact.force, rel=1e-5)
    assert neumann.errors == pytest.approx(plain.errors, rel=0.1)


def test_a_new_solution_is_one_call():
    pair = exact.from_pair(
        lambda t: exact.positive(t - 0.3) ** 2,
        lambda t: exact.positive(0.3 - t) ** 2,
        lambda x: 2.0 - x[1] ** 2,
    )
    solutions = list(solve_levels(pair.problem, pair.mesh(0.35), 3))
    h1 = [solution.errors[0] for solution in solutions]
    assert np.all(abs(norms.rates([s.h for s in solutions], h1)[-2:] - 1.0) < 0.05)
    assert np.allclose(solutions[-1].contact.transitions[:, 0], 0.3, atol=0.15)


def waves(x):
    return ufl.sin(2.0 * x[0] + 1.0) * ufl.cosh(x[1]) + 0.5 * x[1] * x[0] ** 2


def tensor(x):
    return ufl.as_matrix([[2.0 + x[0], 0.5], [0.5, 1.0 + x[1]]])


def on_edges(floor, *others):
    return dict(zip(exact.EDGES, (floor, *others), strict=True))


MIXED, HELD = ("robin", "neumann", "dirichlet"), ("neumann", "dirichlet", "dirichlet")
NO_DIRICHLET = ("robin", "neumann", "robin")
LINE = {"line": 0.4, "coefficient": 2.0}
LOSS = {"loss": 3.0, "external": 0.7}
MADE = {
    "below": (on_edges("below", *MIXED), {}),
    "below, c, b": (on_edges("below", *MIXED), {"reaction": 2.0, **LOSS}),
    "above, b": (on_edges("above", *MIXED), LOSS),
    "above, c": (on_edges("above", *HELD), {"reaction": 2.0}),
    "between": (on_edges("between", *HELD), {}),
    "between, c, b": (on_edges("between", *MIXED), {"reaction": 2.0, **LOSS}),
    "between, no Γ0, c": (on_edges("between", *NO_DIRICHLET), {"reaction": 2.0}),
    "below, no Γ0, b": (on_edges("below", *NO_DIRICHLET), LOSS),
    "below and between": (
        on_edges("below", "neumann", "robin", "between"),
        {"switch": lambda x: 1.0 - 2.0 * x[0] - 2.0 * x[1], **LOSS},
    ),
    "tensor, b": (on_edges("below", *MIXED), {"coefficient": tensor, **LOSS}),
    "tensor, between, c": (on_edges("between", *HELD), {"coefficient": tensor, "reaction": 2.0}),
    "line, b": (on_edges("below", *MIXED), {**LINE, **LOSS, "east": Material(20.0)}),
    "line, between, c": (
        on_edges("between", *HELD),
        {**LINE, "reaction": 2.0, "east": Material(0.1, reaction=7.0)},
    ),
}


@pytest.mark.parametrize("name", MADE)
def test_each_term_and_condition_converges_as_theory_says(name):
    kinds, data = MADE[name]
    u = waves
    if "line" in data:
        u = exact.kinked(waves, data["line"], data["coefficient"], data["east"].coefficient)
    example = exact.made(u, kinds, **data)
    domain = example.mesh(0.25)
    forms = Forms(example.problem, domain.mesh, "CR", domain.parts, domain.materials)
    assert doubts(forms, domain) == []
    solutions = list(solve_levels(example.problem, domain, 3))
    h, h1, l2 = np.array([(s.h, *s.errors) for s in solutions]).T
    assert norms.rates(h, h1)[-1] == pytest.approx(1.0, abs=0.03)
    assert norms.rates(h, l2)[-1] == pytest.approx(2.0, abs=0.1)
    table = solutions[-1].contact.table()
    pressure = COMM.bcast(table["pressure"] if COMM.rank == 0 else None)
    # there is contact, and there is none, on both sides if there are two
    for kind, sign in ("below", 1), ("above", -1), ("between", 1), ("between", -1):
        assert kind not in kinds.values() or (sign * pressure > 0.1).any()
    assert (pressure == 0.0).any()
    certificate = solutions[-1].certificate
    if certificate.bound_h1 is not None:
        assert h1[-1] <= certificate.bound_h1


def test_harmonic_roots_need_contact_of_the_right_sign():
    with pytest.raises(ValueError, match=r"3/2, 7/2, 11/2"):
        exact.root(2.5)
    assert exact.root(1.5).energy == pytest.approx(exact.B.energy)


def test_what_needs_a_solution_says_so():
    with pytest.raises(ValueError, match="solution of E is not known"):
        exact.raised(exact.E, lambda x: x[0])


def vertices(domain):
    """All vertices of a mesh, on every rank, sorted."""
    points = np.concatenate(COMM.allgather(domain.mesh.geometry.x[:, :2]))
    return np.unique(np.round(points, 12), axis=0)


FAMILY = [{}, {"shift": 0.31}, {"jitter": 0.2, "seed": 3}]


@pytest.mark.parametrize("family", FAMILY, ids=str)
@pytest.mark.parametrize("name", ["S1", "D", "E", "L"])
def test_structured_domains(name, family):
    example = exact.ALL[name]
    if name in "DL" and "shift" in family:
        with pytest.raises(InputError, match="vertex of the polygon"):
            example.structured(4, **family)
        return
    domain = example.structured(4, **family)
    area, sides = {"E": (1.0, 4.0), "L": (3.0, 8.0)}.get(name, (2.0, 6.0))
    dx, _ = measures(domain, 1)
    assert integrate(fem.Constant(domain.mesh, 1.0) * dx) == pytest.approx(area)
    lengths = [
        COMM.allreduce(facet_measures(domain.mesh, domain.facets(part))[1].sum())
        for part in (CONTACT, DIRICHLET, NEUMANN)
    ]
    contact, neumann = {"S1": (2, 0), "D": (1, 0), "E": (1, 2), "L": (2, 4)}[name]
    assert np.allclose(lengths, [contact, sides - contact - neumann, neumann])
    cells = domain.mesh.topology.index_map(2).size_global
    assert cells == {"E": 32, "L": 96}.get(name, 64)


@pytest.mark.parametrize("family", FAMILY, ids=str)
def test_meshes_do_not_depend_on_the_ranks(family):
    alone = exact.S1.structured(5, MPI.COMM_SELF, **family)
    points = np.unique(np.round(alone.mesh.geometry.x[:, :2], 12), axis=0)
    assert np.array_equal(vertices(exact.S1.structured(5, **family)), points)


def test_refining_gives_the_next_structured_mesh():
    fine, _ = refine(exact.L.structured(2))
    assert np.array_equal(vertices(fine), vertices(exact.L.structured(4)))


def test_the_mapped_mesh_has_the_critical_point_inside_a_facet():
    for n in (4, 8, 15):
        x = vertices(exact.S1.structured(n, shift=0.31))
        on_contact = np.sort(x[x[:, 1] == 0.0, 0])
        assert len(on_contact) == 2 * n + 1
        assert np.abs(on_contact).min() > 0.02 / n


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n": 0}, "1 square or more"),
        ({"n": 4, "shift": 0.5}, "keep triangles upright"),
        ({"n": 4, "jitter": 0.3}, "keep triangles upright"),
    ],
)
def test_mistakes_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        exact.S1.structured(**arguments)


def test_polygons_that_squares_do_not_fit():
    slanted = families.Polygon([[0, 0], [1, 0], [0, 1]], ["contact", "dirichlet", "dirichlet"])
    with pytest.raises(InputError, match="don't lie on squares"):
        families.structured(slanted, 4)
