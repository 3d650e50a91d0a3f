"""Data that jump inside cells: integrals against areas in closed form, slices against samples."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import (
    DiagonalType,
    compute_midpoints,
    create_unit_square,
    exterior_facet_indices,
    meshtags,
)
from helpers import HELD_ABOVE, SIDES, SQUARE
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    Material,
    Neumann,
    Polygon,
    Problem,
    Robin,
    solve,
    solve_levels,
)
from signorini_cr.compat import cell_nodes
from signorini_cr.data.diffusion import diffusion
from signorini_cr.data.jets import Boxes, Enclosure, lowered
from signorini_cr.data.loads import Certain

pytestmark = pytest.mark.slow

SIZE = 0.02
"""Of a bound, to which what is missed should be small."""


def sector(a, b, radius):
    """Signed area of what a triangle with a vertex at the origin has in a disc around it."""
    d = b - a
    cross = a[0] * b[1] - a[1] * b[0]
    # where the way from a to b enters and leaves the disc
    p, q = a @ d / (d @ d), (a @ a - radius**2) / (d @ d)
    root = np.sqrt(max(p * p - q, 0.0))
    first, last = (np.clip(t, 0.0, 1.0) for t in (-p - root, -p + root))
    if p * p <= q or first == last:
        first = last = 0.0

    def angle(s, t):
        u, v = a + s * d, a + t * d
        return np.arctan2(u[0] * v[1] - u[1] * v[0], u @ v)

    outside = angle(0.0, first) + angle(last, 1.0)
    return 0.5 * (radius**2 * outside + (last - first) * cross)


def in_disc(corners, centre, radius):
    """Area that triangles have in a disc, shape (cells,); corners of shape (cells, 3, 2)."""
    return np.array(
        [abs(sum(sector(x[i - 1], x[i], radius) for i in range(3))) for x in corners - centre]
    )


def enclosed(f, size=0.13):
    """Moments of f on a mesh of the unit square, and what they miss; also the cells' corners."""
    solution = solve(Problem(f=f, obstacle=-9.0), HELD_ABOVE.mesh(size, MPI.COMM_SELF))
    data = diffusion(solution.level.data)
    cells = data.cells
    found = Certain.of(data.compiled.f, data.of_f, cells, np.array(1.0), SIZE)
    mesh = solution.domain.mesh
    return found, cells.volume, mesh.geometry.x[cell_nodes(mesh)[: cells.number], :2]


@pytest.mark.serial
def test_a_triangle_and_a_disc():
    """The reference itself: a disc in a triangle, a triangle in a disc, half a disc."""
    corners = np.array([[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]])
    assert np.isclose(in_disc(corners, np.array([0.5, 0.5]), 0.2)[0], np.pi * 0.04)
    assert np.isclose(in_disc(corners, np.array([0.5, 0.5]), 9.0)[0], 2.0)
    assert np.isclose(in_disc(corners, np.array([0.8, 0.0]), 0.3)[0], np.pi * 0.045)
    assert in_disc(corners, np.array([3.0, 3.0]), 0.5)[0] == 0.0


@pytest.mark.serial
@pytest.mark.parametrize("seed", range(6))
def test_a_disc_anywhere(seed):
    """7 inside of a disc, −2 outside: the integral over each cell, and its square's."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.random(2), [0.02, 0.1, 0.5][seed % 3] * rng.uniform(0.5, 1.0)

    def f(x):
        inside = (x[0] - centre[0]) ** 2 + (x[1] - centre[1]) ** 2 < radius**2
        return ufl.conditional(inside, 7.0, -2.0)

    found, volume, corners = enclosed(f)
    part = in_disc(corners, centre, radius) / volume
    mean = 9.0 * part - 2.0
    off = volume * np.abs(found.load.mean - mean)
    assert (off <= found.missed + 1e-13).all()
    # q has the moments of the rule and f the true ones: their norms differ by ‖f − q‖ at most
    root = np.sqrt(volume)
    norm, exact = (
        root * np.sqrt(np.maximum(square, 0.0))
        for square in (found.load.variance + found.load.mean**2, 45.0 * part + 4.0)
    )
    assert (np.abs(norm - exact) <= found.rough + 1e-12).all()
    # and next to nothing is missed, in a load with the norm 2 at least
    assert found.missed.sum() < 2e-4 and np.sqrt((found.rough**2).sum()) < 0.05


@pytest.mark.serial
@pytest.mark.parametrize("slope", [0.0, 0.3, -1.7, 1e3])
def test_an_oblique_line_costs_a_cut(slope):
    """What is missed of a jump along a line is rounding, on any mesh."""
    below = lambda x: x[1] - 0.52 < slope * (x[0] - 0.47)  # noqa: E731
    found, _, _ = enclosed(lambda x: ufl.conditional(below(x), 3.0, -8.0))
    assert found.missed.sum() < 1e-9 and (found.rough**2).sum() < 1e-7


@pytest.mark.serial
def test_two_lines_that_cross():
    """A quadrant: each piece is on one side of both in the end."""
    inside = lambda x: ufl.And(x[0] + 0.2 * x[1] < 0.53, x[1] - 0.1 * x[0] < 0.31)  # noqa: E731
    found, volume, _ = enclosed(lambda x: ufl.conditional(inside(x), 1.0, 0.0))
    # (0, 0), (.53, 0), the crossing, (0, .31)
    y = (0.31 + 0.1 * 0.53) / 1.02
    x = 0.53 - 0.2 * y
    area = 0.5 * (0.53 * y + x * 0.31)
    assert abs(volume @ found.load.mean - area) <= found.missed.sum() + 1e-14
    assert found.missed.sum() < 1e-5


CURVES = {
    "circle": (lambda x: x[0] ** 2 + x[1] ** 2 - 1.0, lambda x: x[0] ** 2 + x[1] ** 2 - 1.0),
    "wave": (
        lambda x: ufl.sin(3 * x[0]) - x[1] + 0.2 * x[0] * x[1],
        lambda x: np.sin(3 * x[0]) - x[1] + 0.2 * x[0] * x[1],
    ),
    "saddle": (lambda x: x[0] * x[1] - 0.1, lambda x: x[0] * x[1] - 0.1),
}


@pytest.mark.serial
@pytest.mark.parametrize("name", CURVES)
def test_slices_hold_what_is_left_out(name):
    """Where a condition is decided up to a slice, few points of a triangle see the other branch."""
    symbolic, numeric = CURVES[name]
    mesh = HELD_ABOVE.mesh(0.5, MPI.COMM_SELF).mesh
    g = symbolic(ufl.SpatialCoordinate(mesh))
    expression = lowered(ufl.conditional(ufl.gt(g, 0.0), 1.0, 0.0))
    rng = np.random.default_rng(5)
    n, inner = 4000, 0.02
    corners = rng.uniform(-1.5, 1.5, (1, 2, n)) + 10.0 ** rng.uniform(-4, -0.5, n) * rng.normal(
        size=(3, 2, n)
    )
    # some as they are cut: with two corners on the curve, nearly
    for _ in range(40):
        step = 1e-6
        for corner in corners[:2, :, : n // 2]:
            at = numeric(corner)
            dx, dy = ((numeric(corner + step * np.eye(2)[k][:, None]) - at) / step for k in (0, 1))
            corner -= 0.5 * at * np.stack([dx, dy]) / (dx**2 + dy**2 + 1e-9)
    at = Enclosure(Boxes(corners.min(axis=0), corners.max(axis=0), corners=corners), inner=inner)
    jet, left_out = at(expression), at.left_out
    decided = jet.low == jet.high
    assert np.count_nonzero(decided & (left_out > 0)) > 50
    assert np.count_nonzero(decided[n // 2 :]) > n // 4
    samples = 2000
    hats = rng.dirichlet(np.ones(3), samples)
    hats = np.vstack([hats, inner + (1 - 3 * inner) * hats, np.eye(3) * (1 - 3 * inner) + inner])
    x = np.einsum("qc,cgn->gqn", hats, corners[..., decided])
    other = (numeric(x) > 1e-12) != (jet.low[decided] == 1.0)
    other &= np.abs(numeric(x)) > 1e-12
    assert not other[samples:].any()
    part = other[:samples].mean(axis=0)
    spread = np.sqrt(left_out[decided] / samples)
    assert (part <= left_out[decided] + 5 * spread + 5e-3 * (left_out[decided] > 0)).all()


@pytest.mark.serial
@pytest.mark.parametrize("datum", ["f", "g", "coefficient"])
def test_data_that_differ_on_a_null_set(datum):
    """The points of rules may lie on it; u = x² − y, f = −2 and g = 2 almost everywhere."""
    odd = {
        "f": lambda x: -2.0 + ufl.conditional(ufl.le((x[0] - x[1]) ** 2, 0.0), 100.0, 0.0),
        "g": lambda x: 2.0 + ufl.conditional(ufl.eq(x[1], 1 / 16), 1.0, 0.0),
        "coefficient": lambda x: ufl.conditional(ufl.eq(x[0], x[1]), 10.0, 1.0),
    }[datum]
    sides = ["contact", "neumann", "dirichlet", "dirichlet"]
    mesh = create_unit_square(MPI.COMM_SELF, 8, 8, diagonal=DiagonalType.left)
    polygon = Polygon(SQUARE.vertices, sides)
    mesh.topology.create_connectivity(1, 2)
    facets = exterior_facet_indices(mesh.topology)
    x, y = compute_midpoints(mesh, 1, facets)[:, :2].T
    near = np.array([y, 1 - x, 1 - y, x])
    values = np.array([polygon.parts[side] for side in sides])[near.argmin(axis=0)]
    tags = meshtags(mesh, 1, facets, values.astype(np.int32))
    parts = {side: polygon.parts[side] for side in set(sides)}
    domain = Domain.from_tags(mesh, tags, **parts)
    given = {"f": -2.0, "g": 2.0, "coefficient": 1.0} | {datum: odd}
    solution = solve(
        Problem(obstacle=lambda x: x[0] ** 2, dirichlet=lambda x: x[0] ** 2 - x[1], **given), domain
    )
    e = ufl.grad(solution.u) - ufl.as_vector([2 * ufl.SpatialCoordinate(mesh)[0], -1])
    error = np.sqrt(fem.assemble_scalar(fem.form(ufl.inner(e, e) * ufl.dx)))
    low, high = solution.certificate.energy
    assert error <= solution.certificate.bound_energy_norm
    assert low <= -1 / 6 <= high


HOLD = {
    "<=": lambda x, a: ufl.le(x[0], a),
    "==": lambda x, a: ufl.eq(x[0], a),
    "not >": lambda x, a: ufl.Not(ufl.gt(x[0], a)),
    "max": lambda x, a: ufl.eq(ufl.max_value(x[0] - a, 0.0), 0.0),
    "sign": lambda x, a: ufl.eq(ufl.sign(x[0] - a), 0.0),
}
"""Conditions that hold where x is a, on all of an edge."""


@pytest.mark.serial
@pytest.mark.parametrize("a", [0.1, 1 / 3, 0.7, 3.7])
@pytest.mark.parametrize("name", HOLD)
def test_data_that_differ_on_an_edge(name, a):
    """Rounding of a point's x must not decide: a datum that is 1 on the edge is the number 1.

    The problem that a weight and the data on the edge belong to is u = −0.1 − 1.4 y + 1.5 y², whose
    integral over it is −0.3; with g = 0.5 there J is that of the number 0.5.
    """
    polygon = Polygon(np.add(SQUARE.vertices, [a, 0.0]), SIDES, names=SIDES)

    def there(value):
        return lambda x: ufl.conditional(HOLD[name](x, a), value, 0.0)

    def solved(kind, value, levels=1):
        sides = {"right": Neumann(0.0), "top": Dirichlet(0.0), "floor": Contact(-0.1)}
        own = {
            "neumann": lambda: Neumann(value),
            "robin": lambda: Robin(coefficient=value, external=value),
            "contact": lambda: Contact(-5.0, g=value),
        }[kind]()
        problem = Problem(f=-3.0, conditions={**sides, "left": own})
        *_, finest = solve_levels(problem, polygon.mesh(0.25, MPI.COMM_SELF), levels)
        return finest

    plain = solved("neumann", 0.0)
    value, low, high = plain.integral("left", there(1.0))
    assert low <= -0.3 <= high and high - low < 0.2
    assert value == pytest.approx(plain.integral("left", 1.0)[0], rel=1e-12)
    zero, low, high = plain.integral("left", lambda x: 1.0 - there(1.0)(x))
    assert zero == 0.0 and low <= 0.0 <= high and high - low < 0.2
    for kind in ("neumann", "contact"):
        number, datum = (solved(kind, each) for each in (0.5, there(0.5)))
        assert datum.energy == pytest.approx(number.energy, rel=1e-10)
        assert datum.certificate.energy == pytest.approx(number.certificate.energy, rel=1e-6)
        assert datum.certificate.bound_h1 == pytest.approx(number.certificate.bound_h1, rel=1e-6)
    if name != "==":
        return
    # b is compiled, and what u_h solves may be otherwise; bounds hold
    low, high = solved("robin", there(0.5), 2).certificate.energy
    least, most = solved("robin", 0.5, 4).certificate.energy
    assert max(low, least) <= min(high, most)


@pytest.mark.serial
def test_a_strip_between_kinks():
    """|s| < w on a slant strip: |s| is affine on either side of s = 0, where cells are cut, too."""
    slope, width = 0.8, 0.003

    def strip(x):
        s = x[1] - 0.487 - slope * (x[0] - 0.513)
        return ufl.conditional(abs(s) < width, (1 - (s / width) ** 2) / width, 0.0)

    found, volume, _ = enclosed(strip)
    # in x from 0 to 1 the strip is in the square: ∫ (1 − (s/w)²)/w ds = 4/3
    assert abs(volume @ found.load.mean - 4 / 3) <= found.missed.sum() + 1e-12
    assert found.missed.sum() < 0.02


LAYERS = [(0.0, 1e-14, 1e-14), (1.0, 5e-14, 1e-14), (1e6, 5e-8, 1e-8), (1e9, 5e-5, 1e-5)]
"""Where the square begins, how thick a layer is there, and κ in it, which is 1 elsewhere."""


@pytest.mark.serial
@pytest.mark.parametrize("tensor", [False, True])
@pytest.mark.parametrize("start, width, inside", [*LAYERS, (1.0, 5e-14, 1e-4), (1.0, 5e-14, 1e4)])
def test_a_layer_that_is_thinner_than_strips_of_rounding(start, width, inside, tensor):
    """u is affine on both sides of it: resistances in a row give J and the mean."""
    corners = [[start, 0], [start + 1, 0], [start + 1, 1], [start, 1]]
    polygon = Polygon(
        corners, ("low", "right", "top", "left"), names=("low", "right", "top", "left")
    )
    sides = {"left": Dirichlet(0.0), "right": Dirichlet(1.0), "top": Neumann(0.0)}

    def kappa(x):
        k = ufl.conditional(ufl.lt(x[0], start + width), inside, 1.0)
        return ufl.as_matrix([[k, 0], [0, k]]) if tensor else k

    problem = Problem(coefficient=kappa, conditions={**sides, "low": Contact(-10.0)})
    solution = solve(problem, polygon.mesh(0.25, MPI.COMM_SELF))
    width = start + width - start  # as the numbers have it
    certificate, resistance = solution.certificate, width / inside + 1.0 - width
    if certificate.energy is None:
        assert tensor and inside < 1e-12 and certificate.reason
        return
    low, high = certificate.energy
    assert low <= 0.5 / resistance <= high
    mean = 1.0 - 0.5 * (1.0 - width) ** 2 / resistance - 0.5 * width
    assert solution.mean().lower <= mean <= solution.mean().upper
    # ∇u beside the layer, and in it, against that of u_h = x
    off = (1.0 / resistance - 1.0) ** 2 + width * (1.0 / (resistance * inside) - 1.0) ** 2
    assert certificate.bound_h1 >= np.sqrt(off)
    if 1e-5 < inside:
        assert certificate.bound_energy_norm < 2e-3


@pytest.mark.serial
@pytest.mark.parametrize("tensor", [False, True])
def test_layers_whose_ends_are_rounded_cost_nothing(tensor):
    """Vertices are not where x is 0.3, and bounds are those of a layer that is a material."""
    labels = ("contact", "neumann", "dirichlet", "neumann")
    layer = [[0, 0], [0.3, 0], [0.3, 1], [0, 1]]
    domain = Polygon(SQUARE.vertices, labels, materials={"layer": layer}).mesh(0.1, MPI.COMM_SELF)
    unit = ufl.as_matrix([[1, 0], [0, 1]]) if tensor else ufl.as_ufl(1.0)
    own = {"layer": Material(coefficient=1e4 * unit)}

    def kappa(x):
        return ufl.conditional(ufl.lt(x[0], 0.3), 1e4, 1.0) * unit

    first, second = (
        solve(Problem(f=-1.0, g=0.3, coefficient=k, materials=materials), domain).certificate
        for k, materials in ((kappa, {}), (unit, own))
    )
    assert first.bound_energy_norm == pytest.approx(second.bound_energy_norm, rel=1e-5)
    assert first.bound_h1 == pytest.approx(second.bound_h1, rel=1e-2)
    assert first.energy == pytest.approx(second.energy, rel=1e-6)


TENTS = {
    "far from the origin": (1e6, 5e-8, lambda x: ufl.max_value(0.0, 5 * (1e6 + 5e-8 - x) / 5e-8)),
    "near it": (1.0, 5e-14, lambda x: ufl.max_value(0.0, 5 * (1 + 5e-14 - x) / 5e-14)),
    "a step": (0.0, 1e-14, lambda x: ufl.conditional(ufl.lt(x, 1e-14), 5.0, 0.0)),
}


@pytest.mark.serial
@pytest.mark.parametrize("name", TENTS)
def test_an_obstacle_that_is_narrower_than_strips_of_rounding(name):
    """u is to be 5 at a corner, nearly: J of tents falls like 1/ln(1/width), not to 0.

    By brackets on fine meshes its inverse is 0.361 and 0.456 for those 0.05 and 0.01 wide.
    """
    start, width, tent = TENTS[name]
    corners = [[start, 0], [start + 1, 0], [start + 1, 1], [start, 1]]
    polygon = Polygon(corners, ("contact", "neumann", "dirichlet", "neumann"))
    certificate = solve(
        Problem(obstacle=lambda x: tent(x[0])), polygon.mesh(0.25, MPI.COMM_SELF)
    ).certificate
    if certificate.energy is None:
        assert "α" in certificate.reason
        return
    rate = (0.456 - 0.361) / np.log(5.0)
    assert certificate.energy[1] >= 0.8 / (0.361 + rate * np.log(0.05 / width))


@pytest.mark.serial
@pytest.mark.parametrize("at", [0.125, 0.03125])
@pytest.mark.parametrize("height", [0.1, 5.0])
def test_an_obstacle_with_a_step_where_facets_are_cut(at, height):
    """On either side it is smooth, but what brings v above it is of no finite energy."""
    labels = ("contact", "neumann", "dirichlet", "neumann")
    polygon = Polygon([[0, 0], [0.25, 0], [0.25, 0.25], [0, 0.25]], labels)

    def step(x):
        return ufl.conditional(ufl.lt(x[0], at), height, 0.05)

    brackets = []
    domain = polygon.mesh(0.25, MPI.COMM_SELF)
    for solution in solve_levels(Problem(obstacle=step), domain, levels=5):
        found, h = solution.certificate, 0.25 / 2**solution.level.number
        assert (found.energy is None) == (h > at)  # else a vertex is there
        assert "α jumps" in (found.reason or "α jumps")
        brackets += [found.energy] if found.energy else []
    lows, highs = zip(*brackets, strict=True)
    assert max(lows) <= min(highs)
