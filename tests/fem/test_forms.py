"""Forms of the user's own: solved as such, and refused in words where they make no sense."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

from signorini_cr import (
    Contact,
    Dirichlet,
    Form,
    InputError,
    Material,
    Neumann,
    Polygon,
    Problem,
    Robin,
    norms,
    solve,
    solve_adaptive,
    solve_levels,
)
from signorini_cr.data import admissible

EDGES = ["floor", "right", "top", "left"]
SQUARE = Polygon([[-1, 0], [1, 0], [1, 1], [-1, 1]], EDGES, names=EDGES)
WALLS = {"right": Dirichlet(0.0), "top": Dirichlet(0.0), "left": Dirichlet(0.0)}


def laplace_density(u, v):
    return ufl.inner(ufl.grad(u), ufl.grad(v))


def laplace(u, v, dx, ds):
    return laplace_density(u, v) * dx


def tensor():
    return ufl.as_matrix([[2.0, 0.5], [0.5, 1.0]])


def anisotropic(u, v, dx, ds):
    """A tensor, a weighted mass, and a mass on one wall."""
    x = ufl.SpatialCoordinate(ufl.domain.extract_unique_domain(v))
    bulk = ufl.inner(tensor() * ufl.grad(u), ufl.grad(v)) + (2.0 + x[0]) * u * v
    return bulk * dx(degree=4) + 3.0 * u * v * ds("right")


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_rates_with_contact_on_half_of_the_floor(element):
    """λ = max(x, 0)² and u − α = max(−x, 0)²: complementary, and u is any smooth function."""

    def u(x):
        return ufl.cos(x[0]) * (1.0 + x[1] ** 2 + x[0] * x[1])

    def conormal(x, n):
        return ufl.dot(tensor() * ufl.grad(u(x)), ufl.as_vector(n))

    def floor(x):
        return conormal(x, (0.0, -1.0)) - ufl.max_value(x[0], 0.0) ** 2

    problem = Problem(
        form=Form(anisotropic),
        f=lambda x: -ufl.div(tensor() * ufl.grad(u(x))) + (2.0 + x[0]) * u(x),
        exact=u,
        conditions={
            "floor": Contact(lambda x: u(x) - ufl.max_value(-x[0], 0.0) ** 2, g=floor),
            "right": Neumann(lambda x: conormal(x, (1.0, 0.0)) + 3.0 * u(x)),
            "top": Dirichlet(),
            "left": Dirichlet(),
        },
    )
    found = list(solve_levels(problem, SQUARE.mesh(0.35), 3, element))
    h, h1, l2 = np.array([(s.h, *s.errors) for s in found]).T
    assert norms.rates(h, h1)[-1] == pytest.approx(1.0, abs=0.05)
    assert norms.rates(h, l2)[-1] == pytest.approx(2.0, abs=0.15)
    assert found[-1].contact.force == pytest.approx(1.0 / 3.0, abs=0.02)
    assert found[-1].contact.length == pytest.approx(1.0, abs=0.1)
    assert found[-1].iterations.linear < 30
    certificate = found[-1].certificate
    assert certificate.bound_h1 is None
    assert element == "P1" or "user's own" in certificate.reason


def test_the_models_form_as_ones_own():
    """κ = 3 in two ways, and a load of one's own for f and g."""
    conditions = WALLS | {"floor": Contact(-0.01), "right": Neumann(0.4)}
    given = Problem(coefficient=3.0, f=-1.0, reaction=2.0, conditions=conditions)
    own = Problem(
        form=Form(
            lambda u, v, dx, ds: 3.0 * laplace(u, v, dx, ds),
            lambda v, dx, ds: -1.0 * v * dx + 0.4 * v * ds("right"),
        ),
        reaction=2.0,
        conditions=WALLS | {"floor": Contact(-0.01), "right": Neumann()},
    )
    domain = SQUARE.mesh(0.4)
    for theirs, ours in zip(*(solve_levels(p, domain, 3) for p in (given, own)), strict=True):
        assert ours.u.x.array == pytest.approx(theirs.u.x.array, abs=1e-9)
        assert ours.contact.force == pytest.approx(theirs.contact.force, rel=1e-7)
        assert ours.energy == pytest.approx(theirs.energy, rel=1e-9)


def test_functions_of_degree_0_go_along():
    domain = SQUARE.mesh(0.4)
    k = fem.Function(fem.functionspace(domain.mesh, ("DG", 0)))
    k.interpolate(lambda x: 1.0 + 9.0 * (x[0] > 0.0))
    walls = WALLS | {"floor": Contact(-0.02)}
    own = Form(lambda u, v, dx, ds: k * ufl.inner(ufl.grad(u), ufl.grad(v)) * dx)
    *_, ours = solve_levels(Problem(form=own, f=-1.0, conditions=walls), domain, 3)
    *_, theirs = solve_levels(Problem(coefficient=k, f=-1.0, conditions=walls), domain, 3)
    assert ours.contact.force == pytest.approx(theirs.contact.force, rel=1e-7)


def test_tensors_of_degree_0_go_along():
    """Like the matrix of what their entries are, which are scalars; the error's bound, too."""
    domain = SQUARE.mesh(0.4)
    cells = {shape: fem.functionspace(domain.mesh, ("DG", 0, shape)) for shape in ((), (2, 2))}
    whole = fem.Function(cells[2, 2])
    whole.interpolate(lambda x: np.stack([2 + x[0], 0.2 * x[1], 0.2 * x[1], 1 + x[1] ** 2]))
    rows = whole.x.array.reshape(-1, 4)
    entries = [fem.Function(cells[()]) for _ in range(4)]
    for i, entry in enumerate(entries):
        entry.x.array[:] = rows[:, i]
    k = ufl.as_matrix([entries[:2], entries[2:]])
    walls = WALLS | {"floor": Contact(-0.02)}
    data = {"f": -1.0, "conditions": walls}
    form = Form(lambda u, v, dx, ds: ufl.inner(whole * ufl.grad(u), ufl.grad(v)) * dx)
    ours, own, theirs = (
        list(solve_levels(Problem(**data, **each), domain, 3))
        for each in ({"coefficient": whole}, {"form": form}, {"coefficient": k})
    )
    for one, two, three in zip(ours, own, theirs, strict=True):
        assert one.contact.force == pytest.approx(three.contact.force, rel=1e-7)
        assert two.contact.force == pytest.approx(three.contact.force, rel=1e-7)
        for name in ("bound_h1", "energy"):
            bounds = (getattr(each.certificate, name) for each in (one, three))
            assert next(bounds) == pytest.approx(next(bounds), rel=1e-6)


HALVES = {"left": [[-1, 0], [0, 0], [0, 1], [-1, 1]], "right": [[0, 0], [1, 0], [1, 1], [0, 1]]}


@pytest.mark.parametrize("named", [("left", "right"), ("right",)])
def test_dx_of_a_material(named):
    """κ and f of two materials, or of one and the rest, on meshes that are refined."""
    kappa, load = {"left": 3.0, "right": 0.25}, {"left": -1.0, "right": 2.0}
    polygons = {name: HALVES[name] for name in named}
    domain = Polygon(SQUARE.vertices, EDGES, names=EDGES, materials=polygons).mesh(0.4)
    rest = {} if len(named) == 2 else {"coefficient": kappa["left"], "f": load["left"]}
    materials = {name: Material(coefficient=kappa[name], f=load[name]) for name in named}
    conditions = WALLS | {"floor": Contact(-0.02)}

    def total(datum, density, dx):
        """One for each material; or for all of the domain, and what a material has more."""
        if len(named) == 2:
            return sum(datum[name] * density * dx(name, degree=2) for name in named)
        more = (datum["right"] - datum["left"]) * density
        return datum["left"] * density * dx + more * dx(degree=2)("right")

    own = Form(
        lambda u, v, dx, ds: total(kappa, laplace_density(u, v), dx),
        lambda v, dx, ds: total(load, v, dx),
    )
    given = Problem(**rest, materials=materials, conditions=conditions)
    with_form = Problem(form=own, conditions=conditions)
    for element in ("CR", "P1"):
        both = (solve_levels(p, domain, 3, element) for p in (given, with_form))
        for theirs, ours in zip(*both, strict=True):
            A, B = theirs.level.system.A, ours.level.system.A
            b, c = theirs.level.system.b, ours.level.system.b
            assert (A - B).norm() <= 1e-13 * A.norm()
            assert c == pytest.approx(b, rel=1e-12, abs=1e-13)
            assert ours.u.x.array == pytest.approx(theirs.u.x.array, abs=1e-9)
            assert ours.contact.force == pytest.approx(theirs.contact.force, rel=1e-7)


def test_tags_of_ones_own_are_not_taken_for_the_numbers_of_names():
    """In either, 1 is the number of something."""
    halves = Polygon(SQUARE.vertices, EDGES, names=EDGES, materials=HALVES).mesh(0.5)
    for kind in ("dx", "ds"):
        own = ufl.Measure(kind, halves.mesh, subdomain_data=halves.tags)
        form = Form(lambda u, v, dx, ds, own=own: laplace(u, v, dx, ds) + u * v * own(1))
        with pytest.raises(InputError, match=f"a has {kind} over the subdomain 1"):
            solve(Problem(form=form, conditions=WALLS | {"floor": Contact(0.0)}), halves)


def nowhere(u, v, dx, ds):
    x = ufl.SpatialCoordinate(ufl.domain.extract_unique_domain(v))
    return ufl.ln(-1.0 - x[0] ** 2) * u * v * dx


@pytest.mark.parametrize(
    ("form", "said"),
    [
        (Form(lambda u, v, dx, ds: u.dx(0) * v * dx + laplace(u, v, dx, ds)), "not a\\(v, u\\)"),
        (Form(lambda u, v, dx, ds: -1.0 * laplace(u, v, dx, ds)), "not above 0"),
        (Form(nowhere), "not finite"),
        (Form(lambda u, v, dx, ds: u**2 * v * dx), "not linear"),
        (Form(lambda u, v, dx, ds: 3.0), "a UFL form is needed"),
        (Form(lambda u, v: u * v), "a makes no form: .*2 positional arguments"),
        (Form(lambda u, v, dx, ds: v * ufl.grad(u) * dx), "a makes no form: "),
        (Form(lambda u, v, dx, ds: u * v * dx("rock")), "called 'rock'; there are none"),
        (Form(lambda u, v, dx, ds: ufl.avg(u) * ufl.avg(v) * ufl.dS), "interior_facet"),
        (Form(lambda u, v, dx, ds: u.dx(0).dx(0) * v.dx(1).dx(1) * dx), "second order"),
        (Form(lambda u, v, dx, ds: u * v * ds("roof")), "called 'roof'"),
        (Form(lambda u, v, dx, ds: laplace(u, v, dx, ds) + u * v * ufl.ds), "a has ds over the"),
        (Form(lambda u, v, dx, ds: laplace(u, v, dx, ds) + u * v * dx(3)), "called 3"),
        (Form(lambda u, v, dx, ds: u * v * ufl.dx(3)), "a has dx over the"),
        (Form(lambda u, v, dx, ds: u.dx(0) * v.dx(0) * dx), "not above 0"),
        (Form(laplace, lambda v, dx, ds: v * v * dx), "linear"),
        (Form(laplace, lambda v, dx, ds: 2.0), "load returns 2.0"),
    ],
)
def test_what_can_not_work_is_refused(form, said):
    problem = Problem(form=form, conditions=WALLS | {"floor": Contact(0.0)})
    with pytest.raises(InputError, match=said):
        solve(problem, SQUARE.mesh(0.5))


@pytest.mark.parametrize("walls", [WALLS, WALLS | {"right": Neumann(), "left": Neumann()}])
@pytest.mark.parametrize(("element", "looked_at"), [("CR", True), ("P1", True), ("CR", False)])
def test_what_is_below_0_for_some_u_only_is_refused(walls, element, looked_at, monkeypatch):
    """∇u·∇v − k u v where k is a little above or below the least eigenvalue; CG tells it, too.

    That of −Δ is π²/4 for u = 0 at the top, and π²/2 with the sides, which are 2 apart.
    """
    if not looked_at:
        monkeypatch.setattr(admissible, "FACTORISED", 0)
    least = np.pi**2 / (2.0 if walls is WALLS else 4.0)
    for part in (0.9, 1.1, 12.0):
        k = part * least
        form = Form(lambda u, v, dx, ds, k=k: laplace(u, v, dx, ds) - k * u * v * dx)
        problem = Problem(form=form, f=-1.0, conditions=walls | {"floor": Contact(-99.0)})
        if part < 1.0:
            assert solve(problem, SQUARE.mesh(0.2), element).iterations.newton > 0
            continue
        with pytest.raises(InputError, match="not above 0 for all u that vanish on the dirichlet"):
            solve(problem, SQUARE.mesh(0.2), element)


def test_constants_need_no_energy():
    """What has none for them only, on each piece, is held by an obstacle."""
    walls = dict.fromkeys(WALLS, Neumann())
    problem = Problem(form=Form(laplace), f=-1.0, conditions=walls | {"floor": Contact(0.0)})
    assert solve(problem, SQUARE.mesh(0.3)).contact.force == pytest.approx(2.0)


def test_a_function_on_another_mesh_is_refused():
    other = SQUARE.mesh(0.5).mesh
    k = fem.Function(fem.functionspace(other, ("DG", 0)))
    form = Form(lambda u, v, dx, ds: k * laplace_density(u, v) * dx)
    problem = Problem(form=form, conditions=WALLS | {"floor": Contact(0.0)})
    with pytest.raises(InputError, match="mesh"):
        solve(problem, SQUARE.mesh(0.3))


def test_a_form_has_no_coefficient_and_no_bound_to_go_by():
    floor = WALLS | {"floor": Contact(-0.1)}
    steel = {"steel": [[-1, 0], [0, 0], [0, 1], [-1, 1]]}
    domain = Polygon(SQUARE.vertices, EDGES, names=EDGES, materials=steel).mesh(0.5)
    for more in ({"coefficient": 2.0}, {"materials": {"steel": Material(coefficient=2.0)}}):
        with pytest.raises(InputError, match="takes the coefficient's place"):
            solve(Problem(form=Form(laplace), conditions=floor, **more), domain)
    problem = Problem(form=Form(laplace), f=-1.0, conditions=floor)
    with pytest.raises(InputError, match="user's own"):
        list(solve_adaptive(problem, SQUARE.mesh(0.5), tolerance=0.1))


def test_a_loss_of_heat_beside_ones_own_form():
    """Robin and contact with a loss add to it what they add to any other."""
    walls = {"right": Robin(1.0, coefficient=2.0), "top": Neumann(), "left": Neumann()}
    conditions = walls | {"floor": Contact(0.0, coefficient=5.0, external=-1.0)}
    ours = solve(Problem(form=Form(laplace), conditions=conditions), SQUARE.mesh(0.25))
    theirs = solve(Problem(conditions=conditions), SQUARE.mesh(0.25))
    assert ours.contact.force == pytest.approx(theirs.contact.force, rel=1e-9)
