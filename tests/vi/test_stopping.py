"""Contact forces and sets against an independent solution, whatever the coefficient does.

The reference is made here from nothing but the mesh: Crouzeix-Raviart matrices in NumPy's long
doubles, the primal-dual active set method with sparse direct solves, and refinement of each with
residuals in long doubles, so that it is right where a residual in doubles is lost in rounding.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import basix
import basix.ufl
import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse
import scipy.sparse.linalg
import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints, create_mesh, exterior_facet_indices, meshtags
from helpers import SQUARE, integral
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    InputError,
    Neumann,
    NotConverged,
    Polygon,
    Problem,
    Robin,
    Solution,
    solve,
    solve_levels,
)
from signorini_cr.compat import cell_nodes
from signorini_cr.mesh.families import structured
from signorini_cr.mesh.refinement import refine

pytestmark = pytest.mark.slow

LONG = np.longdouble
Function = Callable[..., object]  # of x, y and numpy or ufl


@dataclass
class Data:
    """A problem for both: each function takes x, y and the module that it shall use."""

    coefficient: Function = lambda x, y, on: 1.0
    f: Function = lambda x, y, on: -3.0
    g: Function = lambda x, y, on: 0.0
    obstacle: Function = lambda x, y, on: -0.3 + 0.1 * on.cos(9 * x)
    dirichlet: Function = lambda x, y, on: 0.0

    def problem(self) -> Problem:
        def of(function):
            return lambda x: function(x[0], x[1], ufl) + 0.0 * x[0]

        names = ("coefficient", "f", "g", "obstacle", "dirichlet")
        return Problem(**{name: of(getattr(self, name)) for name in names})


@dataclass
class Reference:
    """Midpoints of the contact facets, their forces (0 where there is no contact).

    Of these facets, which lie on a line, the gap at the midpoints and at both ends, in the order of
    the ends' x.
    """

    midpoints: npt.NDArray[np.float64]
    forces: npt.NDArray[np.float64]
    ends: npt.NDArray[np.float64]
    gaps: npt.NDArray[np.float64]

    @property
    def transitions(self) -> npt.NDArray[np.float64]:
        """Places of a zero gap in free facets beside active ones, or the vertices between."""
        order = np.argsort(self.midpoints[:, 0])
        x, gaps, active = self.ends[order], self.gaps[order], self.forces[order] > 0
        found = []
        for i in np.flatnonzero(active[1:] != active[:-1]):
            free, end = (i, 2) if active[i + 1] else (i + 1, 0)
            middle, at_end = gaps[free, 1], gaps[free, end]
            way = middle / (middle - at_end) if at_end < 0 < middle else 1.0
            found.append(x[free].mean() + way * (x[free, end // 2] - x[free].mean()))
        return np.array(found)


def number(on, at, value):
    """For UFL a Constant: data that differ by numbers alone are compiled once."""
    return value if on is np else fem.Constant(ufl.domain.extract_unique_domain(at), value)


def where(on, condition, a, b):
    if on is np:
        return np.where(condition, a, b)
    return ufl.conditional(condition, number(on, condition, a), b)


def reference(domain: Domain, part: Callable[[npt.NDArray], npt.NDArray], data: Data) -> Reference:
    """Solve on the mesh of a domain that lives on one process.

    Args:
        domain: Mesh.
        part: The letter c, d or n for midpoints of boundary facets, shape (n, 2).
        data: The problem.
    """
    mesh = domain.mesh
    points, cells = mesh.geometry.x[:, :2], np.asarray(cell_nodes(mesh))
    on_cell, weights = basix.make_quadrature(basix.CellType.triangle, 4)
    on_facet, facet_weights = basix.make_quadrature(basix.CellType.interval, 4)
    weights, facet_weights = 2 * weights, facet_weights
    hats = np.vstack([1 - on_cell.sum(axis=1), on_cell.T])
    corners = points[cells]
    sides = np.stack([corners[:, i - 1] - corners[:, i - 2] for i in range(3)], 1).astype(LONG)
    area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) / 2
    x, y = np.moveaxis(np.einsum("iq,mic->mqc", hats, corners), 2, 0)
    kappa = (data.coefficient(x, y, np) + 0 * x) @ weights
    local = np.einsum("mic,mjc->mij", sides, sides) * (kappa / area)[:, None, None]
    loads = ((data.f(x, y, np) + 0 * x)[:, None] * (1 - 2 * hats) * weights).sum(axis=2)
    pairs = np.sort([cells[:, [i - 2, i - 1]] for i in range(3)], axis=2)
    ends, dofs, count = np.unique(
        pairs.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True
    )
    dofs, number = dofs.reshape(3, -1).T, len(ends)
    b = np.zeros(number, LONG)
    np.add.at(b, dofs, loads * area[:, None])
    midpoints = points[ends].mean(axis=1)
    parts = np.full(number, "i")
    parts[count == 1] = part(midpoints[count == 1])
    first, second = points[ends[:, 0]], points[ends[:, 1]]
    x, y = np.moveaxis(first[:, None] + on_facet * (second - first)[:, None], 2, 0)
    means = {
        name: (getattr(data, name)(x, y, np) + 0 * x) @ facet_weights
        for name in ("g", "obstacle", "dirichlet")
    }
    length = np.hypot(*(second - first).T)
    b += np.where(parts == "n", means["g"] * length, 0)
    fixed, contact = parts == "d", np.flatnonzero(parts == "c")

    row, column = np.repeat(dofs, 3, axis=1).ravel(), np.tile(dofs, (1, 3)).ravel()
    A = scipy.sparse.csc_matrix((local.ravel().astype(float), (row, column)), (number, number))
    diagonal = A.diagonal()

    order = np.argsort(row, kind="stable")
    begins = np.searchsorted(row[order], np.arange(number))
    value, columns = local.ravel()[order], column[order]

    def residual(u):  # rows add up to zero
        return np.add.reduceat(value * (u[columns] - u[row[order]]), begins) - b

    def ends_of(facets, u, middle):
        """Of facets the ends' x, ascending, and the gaps there and between."""
        cell, local = (np.array(x) for x in zip(*[np.argwhere(dofs == f)[0] for f in facets]))
        at_vertices = u[dofs[cell]].sum(axis=1, keepdims=True) - 2 * u[dofs[cell]]
        which = np.stack([(local + 1) % 3, (local + 2) % 3], axis=1)
        x, y = np.moveaxis(points[np.take_along_axis(cells[cell], which, axis=1)], 2, 0)
        gap = np.take_along_axis(at_vertices, which, axis=1) - data.obstacle(x, y, np)
        order = np.argsort(x, axis=1)
        x, gap = (np.take_along_axis(each, order, axis=1) for each in (x, gap))
        return x, np.column_stack([gap[:, 0], middle, gap[:, 1]]).astype(float)

    u = np.where(fixed, means["dirichlet"], 0).astype(LONG)
    active = np.zeros(len(contact), dtype=bool)
    for _ in range(60):
        held = fixed.copy()
        held[contact[active]] = True
        u[contact[active]] = means["obstacle"][contact[active]]
        free = np.flatnonzero(~held)
        scale = 1 / np.sqrt(diagonal[free])
        D = scipy.sparse.diags(scale)
        lu = scipy.sparse.linalg.splu((D @ A[free][:, free] @ D).tocsc())
        for _ in range(60):
            r = residual(u)[free]
            size = np.abs(r).max() or LONG(1)
            step = size * scale * lu.solve((scale * r / size).astype(float))
            u[free] -= step
            if np.abs(step).max() <= 1e-16 * np.abs(u).max():
                break
        else:
            raise AssertionError("the reference's refinement does not converge")
        force = residual(u)[contact]
        indicator = force - diagonal[contact] * (u[contact] - means["obstacle"][contact])
        if np.array_equal(indicator > 0, active):
            forces = np.where(active, force, 0).astype(float)
            middle = u[contact] - means["obstacle"][contact]
            return Reference(midpoints[contact], forces, *ends_of(contact, u, middle))
        active = indicator > 0
    raise AssertionError("the reference's active set does not settle")


RECTANGLE = [[-1, 0], [1, 0], [1, 1], [-1, 1]]
SIDES = ["contact", "neumann", "dirichlet", "neumann"]


def rectangle_part(x):
    return np.where(x[:, 1] == 0, "c", np.where(x[:, 1] == 1, "d", "n"))


def halves(contrast: float) -> Data:
    """Stiff on the left, where u_D varies, and contact on the right alone."""
    return Data(
        coefficient=lambda x, y, on: where(on, x < 0.05 - 0.13 * y, contrast, 1.0),
        dirichlet=lambda x, y, on: x / 5,
    )


def disc(contrast: float) -> Data:
    """A stiff disc that nothing but the soft part around it holds."""
    return Data(
        coefficient=lambda x, y, on: where(
            on, (x - 0.1) ** 2 + (y - 0.45) ** 2 < 0.09, contrast, 1.0
        ),
        dirichlet=lambda x, y, on: x / 5,
    )


def board(contrast: float) -> Data:
    """Squares like those of a board, contact in both kinds."""
    return Data(
        coefficient=lambda x, y, on: where(
            on, on.sin(2 * np.pi * (x + 0.07)) * on.sin(2 * np.pi * (y + 0.03)) > 0, contrast, 1.0
        ),
        f=lambda x, y, on: -20 + 10 * on.sin(3 * x),
    )


def bottom(contrast: float) -> Data:
    """A stiff strip that lies on the obstacle."""
    return Data(
        coefficient=lambda x, y, on: where(on, y < 0.2 + 0.05 * x, contrast, 1.0),
        f=lambda x, y, on: -9.0,
        obstacle=lambda x, y, on: -0.3 - 0.01 * x**2,
    )


def compare(solution: Solution, expected: Reference) -> float:
    """The forces' errors, summed up, in parts of their sum; the sets must be the same."""
    contact, comm = solution.contact, MPI.COMM_WORLD
    middle = contact.midpoints[:, None, :2]
    nearest = np.linalg.norm(middle - expected.midpoints, axis=2).argmin(axis=1)
    forces = expected.forces[nearest]
    assert np.array_equal(contact.active, forces > 0)
    assert comm.allreduce(len(forces)) == len(expected.forces)
    wrong = comm.allreduce(float(np.abs(contact.pressure * contact.measure - forces).sum()))
    total = expected.forces.sum()
    assert contact.force == pytest.approx(total, rel=1e-6)
    return wrong / total


def solutions(data: Data, levels: int, **options) -> list[Solution]:
    return list(solve_levels(data.problem(), coarsest(), levels, **options))


@cache
def coarsest() -> Domain:
    return Polygon(RECTANGLE, SIDES).mesh(0.25)


@cache
def mesh_alone(levels: int) -> Domain:
    """The same mesh as in `solutions`, on each process whole."""
    domain = Polygon(RECTANGLE, SIDES).mesh(0.25, MPI.COMM_SELF)
    for _ in range(1, levels):
        domain, _ = refine(domain)
    return domain


@cache
def expected(data: Callable[[float], Data], contrast: float) -> Reference:
    """The reference on the third mesh."""
    return reference(mesh_alone(3), rectangle_part, data(contrast))


CASES = [(halves, 10.0**k) for k in (2, 4, 6, 7, 8)]
CASES += [(data, contrast) for data in (disc, board, bottom) for contrast in (1e4, 1e8)]
BEYOND = [(data, contrast) for data in (halves, disc, board, bottom) for contrast in (1e10, 1e12)]


@pytest.mark.parametrize("nested", [True, False], ids=["nested", "cold"])
@pytest.mark.parametrize(("data", "contrast"), CASES)
def test_forces_are_right_whatever_the_contrast(data, contrast, nested):
    solution = solutions(data(contrast), 3, nested=nested)[-1]
    assert compare(solution, expected(data, contrast)) < 1e-6
    assert solution.contact.kkt.force_error < 1e-6
    assert solution.contact.kkt.residual < 1e-8


@pytest.mark.parametrize(
    ("data", "contrast"), [(halves, 1e2), (halves, 1e4), (halves, 1e6), (halves, 1e8)]
)
def test_contact_ends_where_the_reference_says(data, contrast):
    """In the facets that the active set names, and there where the reference's u meets α."""
    found, length = solutions(data(contrast), 3)[-1].contact.transitions, 2 / 32
    wanted = expected(data, contrast).transitions
    assert len(found) == len(wanted) > 0
    assert np.abs(np.sort(found[:, 0]) - np.sort(wanted)).max() < 1e-6 * length


@pytest.mark.parametrize(("data", "contrast"), BEYOND)
def test_beyond_they_are_right_or_refused(data, contrast):
    try:
        solution = solutions(data(contrast), 3)[-1]
    except NotConverged as error:
        assert "lost in rounding" in error.reason or "last digit of the data" in error.reason
        assert (data, contrast) in ((board, 1e12), (bottom, 1e12), (board, 1e10))
        return
    assert compare(solution, expected(data, contrast)) < 1e-6


def test_nothing_touches():
    """No contact: no force and no pressure, not even rounding; the gap is the reference's."""
    data = Data(
        coefficient=lambda x, y, on: where(on, x < 0.05, 1e6, 1.0),
        obstacle=lambda x, y, on: -5.0,
        dirichlet=lambda x, y, on: x / 5,
    )
    contact = solutions(data, 3)[-1].contact
    assert contact.force == 0.0 and contact.number_active == 0
    assert np.all(contact.pressure == 0.0)
    kkt = contact.kkt
    assert kkt.min_pressure == kkt.complementarity == kkt.force_error == 0.0
    assert kkt.min_gap > 2.0


def test_touching_without_a_force():
    """u = x solves the equations and lies on the obstacle everywhere: all signs are rounding."""
    data = Data(
        f=lambda x, y, on: 0.0,
        g=lambda x, y, on: where(on, x > 0, 1.0, -1.0),
        obstacle=lambda x, y, on: x,
        dirichlet=lambda x, y, on: x,
    )
    for solution in solutions(data, 3):
        assert abs(solution.contact.force) < 1e-12
        assert np.abs(solution.contact.pressure).max(initial=0.0) < 1e-12
        assert solution.iterations.newton <= 3


@pytest.mark.parametrize(
    ("size", "stiff", "shift"),
    [(1.0, 1e12, 0.0), (1.0, 1e-12, 0.0), (1e6, 1.0, 0.0), (1e-6, 1.0, 0.0), (1.0, 1.0, 1e2)],
)
def test_units_make_no_difference(size, stiff, shift):
    """κ and f by one factor, the geometry by another, and a constant added to u_D and α."""
    plain = halves(1e4)
    data = Data(
        coefficient=lambda x, y, on: stiff * plain.coefficient(x / size, y / size, on),
        f=lambda x, y, on: -3.0 * stiff / size**2,
        obstacle=lambda x, y, on: shift + plain.obstacle(x / size, y / size, on),
        dirichlet=lambda x, y, on: shift + x / size / 5,
    )
    domain = Polygon(RECTANGLE, SIDES).mesh(0.25)
    domain.mesh.geometry.x[:] *= size
    *_, solution = solve_levels(data.problem(), domain, 3)
    of = expected(halves, 1e4)
    scaled = replace(of, midpoints=size * of.midpoints, forces=stiff * of.forces)
    assert compare(solution, scaled) < 1e-6


def test_who_loosens_the_tolerance_gets_it(options):
    """Forces are then known as roughly as the rest, and the report says so."""
    usual = solutions(halves(1.0), 3)[-1]
    options("snes_atol", 1e-2 * usual.level.system.residual_scale)
    rough = solutions(halves(1.0), 3)[-1]
    assert rough.iterations.linear < usual.iterations.linear
    assert usual.contact.kkt.residual < 1e-8 < rough.contact.kkt.residual < 1e-1
    options("snes_atol", 1e3 * usual.level.system.residual_scale)
    start = solutions(halves(1.0), 3)[-1]
    assert start.iterations.newton == 0 and start.contact.kkt.residual > 1e-8
    assert start.contact.kkt.force_error == np.inf  # not 0: no step has measured it


def two_squares():
    """The one to the right has no Dirichlet facet; contact is below."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [2, 0], [3, 0], [3, 1], [2, 1]], float)
    cells = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=np.int64)
    comm = MPI.COMM_WORLD
    if comm.rank > 0:
        corners, cells = corners[:0], cells[:0]
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    mesh = create_mesh(comm, cells, x=corners, e=element)
    mesh.topology.create_connectivity(1, 2)
    exterior = exterior_facet_indices(mesh.topology)
    x, y, _ = compute_midpoints(mesh, 1, exterior).T
    values = np.where(y == 0.0, 1, np.where((y == 1.0) & (x < 1.5), 2, 3)).astype(np.int32)
    return Domain.from_tags(mesh, meshtags(mesh, 1, exterior, values))


@pytest.mark.parametrize("f", [0.0, 1.0], ids=["no net force", "pulled away"])
def test_a_piece_that_nothing_holds_is_named(f):
    with pytest.raises(
        InputError,
        match=r"around \(2\.\d+, 0\.\d+\) has no Dirichlet facet, no loss of heat, no reaction",
    ):
        list(solve_levels(Problem(f=f, obstacle=-0.1), two_squares(), 3))


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_a_net_force_that_quadrature_makes_is_none(element):
    """That of sin 2πx, and of a flux against it; what is there is seen behind what oscillates."""
    edges = ["floor", "neumann", "neumann", "neumann"]
    domain = Polygon(SQUARE.vertices, edges, names=("floor",)).mesh(0.3)
    floor = {"floor": Contact(0.0)}
    wave = lambda x: 3.0 * ufl.sin(2.0 * np.pi * x[0])  # noqa: E731
    for data in ({"f": wave}, {"f": lambda x: -ufl.exp(x[0]), "g": (np.e - 1.0) / 3.0}):
        with pytest.raises(InputError, match="∫g that can't be told from 0: only one below 0"):
            solve(Problem(conditions=floor, **data), domain, element)
    weight = Problem(f=lambda x: wave(x) - 1e-3, conditions=floor)
    assert solve(weight, domain, element).contact.force == pytest.approx(1e-3, rel=0.01)


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("slope", [0.0, 0.5, -3.0])
def test_a_piece_pressed_onto_the_obstacle(slope, element, nested):
    """Its weight, 2, is what the obstacle bears, be it flat or touched at one end."""
    problem = Problem(
        f=lambda x: ufl.conditional(x[0] > 1.5, -2.0, 0.0),
        obstacle=lambda x: ufl.conditional(x[0] > 1.5, 5.0 + slope * x[0], -1.0),
    )
    for solution in solve_levels(problem, two_squares(), 4, element, nested=nested):
        contact = solution.contact
        assert contact.force == pytest.approx(2.0, rel=1e-7)
        assert contact.kkt.min_gap >= 0.0 and contact.kkt.min_pressure >= -1e-7
        assert contact.kkt.residual < 1e-7
    of_piece = contact.number // 2
    if slope == 0.0:  # u = 5 + y² − 2 y
        assert contact.number_active == of_piece
        far = np.abs(contact.pressure[contact.active] - 2.0).max(initial=0.0)
        assert far < (1e-6 if element == "CR" else 0.2)
        energy = -2.0 / 3.0 * 2.0 + 2.0 * 5.0 + 2.0 / 3.0  # ∫ 2 u + ½ ∫ |u'|²
        assert solution.energy == pytest.approx(energy, rel=1e-2)
    if slope == -3.0:
        assert 0 < contact.number_active < of_piece
        assert contact.midpoints[contact.active, 0].max(initial=2.0) < 2.6
    if element == "CR":
        low, high = solution.certificate.energy
        assert high - low < 0.5 and (slope != 0.0 or low <= energy <= high)


@pytest.mark.parametrize("scale", [1.0, 1e6, 1e10])
def test_a_part_that_presses_little_is_known_as_well(scale):
    """Two contact parts, 24 heights of the strip apart: they know of each other by e^{−24π}.

    So the forces on the right are those that there are with nothing on the left, facet by facet,
    however much presses there; so it is where α has a peak at one end of a single part.
    """
    corners = [[0, 0], [2, 0], [8, 0], [14, 0], [14, 0.25], [0, 0.25]]
    parts = ["contact", "neumann", "contact", "neumann", "dirichlet", "neumann"]
    domain = Polygon(corners, parts).mesh(0.25)

    def right(height):
        def alpha(x):
            return ufl.conditional(
                ufl.lt(x[0], 5.0),
                height * (x[0] - 0.7) if height else -9.0,
                -0.02 - 0.002 * (x[0] - 8.0),
            )

        *_, solution = solve_levels(Problem(f=-1.0, obstacle=alpha), domain, 3)
        contact = solution.contact
        there = contact.midpoints[:, 0] > 5.0
        total = MPI.COMM_WORLD.allreduce(float((contact.pressure * contact.measure)[~there].sum()))
        return contact.active[there], (contact.pressure * contact.measure)[there], total

    alone, expected, nothing = right(0.0)
    active, forces, much = right(scale)
    assert nothing == 0.0 and much > scale
    assert np.array_equal(active, alone)
    wrong, whole = (
        MPI.COMM_WORLD.allreduce(float(np.abs(f).sum())) for f in (forces - expected, expected)
    )
    assert whole > 0.1 and wrong < 2e-6 * whole


def block(contrast: float, height: float = 100.0) -> Data:
    """A stiff block that rests on the obstacle, all of it high up."""
    return Data(
        coefficient=lambda x, y, on: where(on, y < 0.3, contrast, 1.0),
        obstacle=lambda x, y, on: height - 0.3 + 0.1 * on.cos(9 * x),
        dirichlet=lambda x, y, on: height + x / 5,
    )


def block_below(contrast: float) -> Data:
    return block(contrast, 0.0)


def right_or_refused(problem: Data, expected: Reference, may_refuse: bool) -> None:
    try:
        solution = solutions(problem, 3)[-1]
    except NotConverged as error:
        assert may_refuse and "last digit of the data" in error.reason
        return
    assert compare(solution, expected) < 1e-6
    assert 0.0 < solution.contact.kkt.force_error < 1e-6


@pytest.mark.parametrize("contrast", [1e4, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13])
@pytest.mark.parametrize("data", [block, block_below])
def test_a_stiff_block_on_the_obstacle(data, contrast):
    """The split between two facets hangs on 1e-16 C u of α; what doubles hide besides is found."""
    may_refuse = contrast > (1e8 if data is block else 1e10)
    right_or_refused(data(contrast), expected(data, contrast), may_refuse)


@pytest.mark.parametrize("force", [1e-1, 1e-2, 1e-6, 1e-8, 1e-9, 1e-12])
def test_forces_that_are_small_beside_u(force):
    """Means of α are known to 1e-11: to the sixth digit of a force of 1e-2, and hardly of 1e-8."""
    data = Data(
        f=lambda x, y, on: -number(on, x, force),
        obstacle=lambda x, y, on: 1e5 + number(on, x, force) * (0.05 * on.cos(9 * x) - 0.1),
        dirichlet=lambda x, y, on: 1e5,
    )
    found = reference(mesh_alone(3), rectangle_part, data)
    right_or_refused(data, found, may_refuse=force < 1e-2)


@pytest.mark.parametrize("contrast", [1.0, 1e6])
def test_far_from_the_obstacle_nothing_is_in_doubt(contrast):
    data = Data(
        coefficient=lambda x, y, on: where(on, x < 0.05, contrast, 1.0),
        f=lambda x, y, on: -1e-9,
        obstacle=lambda x, y, on: 99999.0,
        dirichlet=lambda x, y, on: 1e5,
    )
    contact = solutions(data, 3)[-1].contact
    assert contact.force == contact.kkt.force_error == contact.number_active == 0


@pytest.mark.parametrize("height", [0.0, 100.0])
def test_touching_is_no_force(height):
    """u = u_D = α on Γ1, with flows along it, and none through it."""

    def slope(x, y, on):
        return height + x / 5

    data = Data(f=lambda x, y, on: 0.0, obstacle=slope, dirichlet=slope)
    sides = ["contact", "dirichlet", "dirichlet", "dirichlet"]
    domain = Polygon(RECTANGLE, sides).mesh(0.25)
    for solution in solve_levels(data.problem(), domain, 3):
        contact = solution.contact
        assert contact.force == 0.0 and np.all(contact.pressure == 0.0)
        assert contact.number_active == 0 and contact.kkt.force_error < 1e-6


def test_an_offset_is_taken_off():
    """What is solved for is u less what the data have in common, whoever asks gets u."""
    solution = solutions(block(1e4), 1)[-1]
    system = solution.level.system
    assert system.offset == pytest.approx(100.0)
    table = solution.contact.table()
    if table is not None:
        assert np.all(np.abs(table["u"] - 100.0) < 1.0)
        assert np.all(table["u"][table["active"]] == table["obstacle"][table["active"]])
    assert solutions(block(1e4, 0.2), 1)[-1].level.system.offset == 0.0


def soft_beside_a_loss(soft: float, b: float):
    """Strips of κ = 1 and of something soft, b u lost above, contact below and on the left."""
    names = ("floor", "right", "top", "left")
    polygon = Polygon([[0, 0], [2, 0], [2, 1], [0, 1]], names, names=names)
    domain = polygon.mesh(0.3)
    kappa = fem.Function(fem.functionspace(domain.mesh, ("DG", 0)))
    across = lambda x: np.sin((0.2642 * x[0] + 0.9645 * x[1]) / 0.1215)  # noqa: E731
    kappa.interpolate(lambda x: np.where(across(x) > 0.3, soft, 1.0))
    upper = lambda x: 0.15 + 0.15 * x[0] + 0.2 * x[1]  # noqa: E731
    conditions = {
        "floor": Contact(lambda x: -0.05 + 0.2 * x[0] - 0.1 * x[1], upper=upper),
        "right": Dirichlet(lambda x: x[0] / 5),
        "top": Robin(coefficient=b, external=-0.2),
        "left": Contact(upper=upper),
    }
    return Problem(f=-30.0, coefficient=kappa, conditions=conditions), domain


def test_what_hangs_on_zeros_of_the_matrix_is_refused():
    """b ∫ φ_i φ_j is 0 by symmetry, and 1e-16 b|F| in floating point: 1e-3 of what is soft.

    Residual and last step know nothing of it; who assembles in another order finds other forces.
    """
    problem, domain = soft_beside_a_loss(3e-7, 1.7e7)
    with pytest.raises(NotConverged, match="hangs on the last digit of the data"):
        solve(problem, domain)
    for soft, b in ((1e-2, 1e8), (3e-7, 1e3)):
        assert solve(*soft_beside_a_loss(soft, b)).iterations.force_error < 1e-6


def test_what_a_loss_has_in_rows_and_their_neighbours():
    """b|F| in the three rows of a facet's cell."""
    conditions = {name: Neumann() for name in SQUARE.names} | {"right": Robin(coefficient=7.0)}
    problem = Problem(f=1.0, conditions=conditions)
    level = solve(problem, SQUARE.mesh(0.5, MPI.COMM_SELF)).level
    found, cells = level.system.masses(), level.data.cells
    side = cells.sides[level.domain.parts["right"]]
    expected = np.zeros(len(found))
    np.add.at(expected, cells.facets[:, side.cells], 7.0 * 0.5)
    assert len(side.cells) == 2 and np.allclose(found, expected, atol=1e-12)
    plain = Problem(f=1.0, conditions=conditions | {"right": Dirichlet()})
    assert solve(plain, SQUARE.mesh(0.5, MPI.COMM_SELF)).level.system.masses() is None


# ---- where u falls off by many orders of magnitude


@pytest.mark.parametrize("value, stiff", [(1.0, 100.0), (300.0, 1e6), (0.3, 1e2)])
def test_a_constant_that_is_pressed(value, stiff):
    """u is α, whatever κ, and all of −g is force; what flows is rounding."""
    conditions = {"floor": Contact(value, g=-8.0), "left": Dirichlet(value)}
    kappa = lambda x: ufl.conditional(ufl.lt(x[0], 0.5), 1.0, stiff)  # noqa: E731
    conditions |= {"right": Neumann(), "top": Neumann()}
    problem = Problem(coefficient=kappa, conditions=conditions)
    for solution in solve_levels(problem, SQUARE.mesh(0.3, MPI.COMM_WORLD), 3):
        assert np.allclose(solution.u.x.array, value, rtol=1e-9)
        assert solution.contact.force == pytest.approx(8.0, rel=1e-9)


@pytest.mark.parametrize("bounds", [("obstacle",), ("upper",)])
@pytest.mark.parametrize("value, c", [(0.0, 0.0), (0.3, 0.0), (300.0, 0.0), (0.3, 1.0)])
def test_what_touches_without_pressing(value, c, bounds):
    """A plane, or with a reaction a constant: u is the bound below, without a force."""

    def u(x):
        return value + (0.0 if c else 0.1) * x[0]

    conditions = {"floor": Contact(**dict.fromkeys(bounds, u)), "left": Dirichlet(u)}
    conditions["right"] = Neumann() if c else Dirichlet(u)
    conditions["top"] = Robin(u, coefficient=1.0) if c else Neumann()
    problem = Problem(f=c * value, reaction=c, conditions=conditions)
    for solution in solve_levels(problem, structured(SQUARE, 4, MPI.COMM_WORLD), 3):
        x = solution.u.function_space.tabulate_dof_coordinates().T
        assert np.allclose(solution.u.x.array, u(x), atol=1e-9)
        assert abs(solution.contact.force) < 1e-12 * max(1.0, value)


FALLS = {
    "presses": lambda x: ufl.conditional(x[0] < 1.3, 0.0, -1.0),
    "lifts": lambda x: ufl.conditional(x[0] < 1.3, 0.0, 1.0),
    "both": lambda x: ufl.conditional(x[0] < 1.3, 0.0, ufl.sin(9.0 * x[0])),
    "ramp": lambda x: ufl.max_value(x[0] - 1.3, 0.0),
}


def fin(f: Function, c: float, comm: MPI.Comm) -> list[Solution]:
    """u is at rest on α = 0 but where f is, and like exp(−√c s) at the distance s from there."""
    sides = ("floor", "right", "top", "left")
    polygon = Polygon([[0, 0], [3, 0], [3, 1], [0, 1]], sides, names=sides)
    conditions = {"floor": Contact(0.0), **dict.fromkeys(sides[1:], Neumann())}
    problem = Problem(f=f, reaction=c, conditions=conditions)
    return list(solve_levels(problem, polygon.mesh(0.25, comm), 3))


@pytest.mark.parametrize("c", [1e4, 1e6, 1e8])
@pytest.mark.parametrize("name", FALLS)
def test_forces_that_fall_off_without_end(name, c):
    """Against a direct active set method; what is below 1e-20 of the most is nothing."""
    for solution, alone in zip(
        fin(FALLS[name], c, MPI.COMM_WORLD), fin(FALLS[name], c, MPI.COMM_SELF), strict=True
    ):
        system, V = alone.level.system, alone.u.function_space
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        form = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx + c * u * v * ufl.dx
        A, b, bounded = fem.assemble_matrix(fem.form(form)).to_scipy(), system.chi, system.bounded
        active = np.zeros(len(b), dtype=bool)
        for _ in range(40):
            free, x = ~active, np.zeros(len(b))
            x[free] = scipy.sparse.linalg.spsolve(A[free][:, free].tocsc(), b[free])
            push = A @ x - b
            wanted = np.zeros_like(active)
            wanted[bounded] = np.where(active, push > 0.0, x < 0.0)[bounded]
            if (wanted == active).all():
                break
            active = wanted
        forces = np.where(active, push, 0.0)[bounded]
        most = (abs(A) @ np.abs(x)).max()
        assert (wanted == active).all() or np.abs(forces).max() < 1e-12 * most
        assert solution.contact.force == pytest.approx(forces.sum(), rel=1e-6, abs=1e-20 * most)
        assert solution.contact.number_active >= np.count_nonzero(forces > 1e-12 * most)
        assert solution.contact.kkt.force_error < 1e-6


@pytest.mark.parametrize("held_by", ["reaction", "spring", "air"])
@pytest.mark.parametrize("weak", [1e-3, 1e-6, 1e-10])
def test_what_little_holds_u_against_the_loads_is_in_balance_with_them(held_by, weak):
    """With v = 1: weak ∫ u_h = ∫ f = 2.5, over Ω or a side. And −u'' = 3x − 1.5 but for O(weak)."""
    sides = {name: Neumann() for name in SQUARE.names}
    sides["floor"] = Contact(-0.3, coefficient=weak if held_by == "spring" else 0.0)
    if held_by == "air":
        sides["right"] = Robin(coefficient=weak, external=20.0)
    reaction = weak if held_by == "reaction" else 0.0
    problem = Problem(f=lambda x: 1.0 + 3.0 * x[0], reaction=reaction, conditions=sides)
    errors = []
    for solution in solve_levels(problem, SQUARE.mesh(0.25, MPI.COMM_WORLD), 4):
        domain, kkt = solution.domain, solution.contact.kkt
        mesh, over = domain.mesh, ufl.dx
        if held_by != "reaction":
            side = domain.parts["floor" if held_by == "spring" else "right"]
            over = ufl.Measure("ds", mesh, subdomain_data=domain.tags)(side)
        lost = weak * integral((solution.u - (20.0 if held_by == "air" else 0.0)) * over)
        assert lost == pytest.approx(2.5, rel=1e-9)
        assert kkt.residual <= 1e-8 and solution.contact.number_active == 0
        if held_by == "reaction":
            x = ufl.SpatialCoordinate(mesh)[0]
            flow = ufl.as_vector([1.5 * (x - x**2), 0.0])
            square = integral(ufl.inner(*[ufl.grad(solution.u) - flow] * 2) * ufl.dx)
            errors.append(np.sqrt(square))
            bound = 1.001 * solution.certificate.bound_h1
            assert errors[-1] <= bound
            assert weak < 1e-9 or bound <= 4.0 * errors[-1]  # u itself has few digits of its slope
    assert len(errors) == 0 or errors[-2] / errors[-1] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("far", [-1e3, -1e9, -1e16, 1e12])
@pytest.mark.parametrize("size", [1.0, 1e-9])
def test_an_obstacle_that_is_far_away_changes_nothing(far, size):
    """u has the mean of f where c is 1 and nothing flows; so it is wherever nothing is in touch."""
    names = ["contact", "neumann"]

    def last(bound):
        domain = Polygon(SQUARE.vertices, ["contact", *3 * ["neumann"]], names=names).mesh(0.25)
        held = Contact(bound) if bound < 0.0 else Contact(None, upper=bound)
        conditions = {"contact": held, "neumann": Neumann()}
        problem = Problem(lambda x: size * x[0], reaction=1.0, conditions=conditions)
        *_, solution = solve_levels(problem, domain, 2)
        return solution

    near, distant = last(-1.0 * size), last(far)
    assert distant.contact.number_active == 0
    assert distant.energy == pytest.approx(near.energy, rel=1e-10)
    mean = distant.mean("domain")
    exact = size * float(np.mean(SQUARE.vertices[:, 0]))
    assert mean.value == pytest.approx(exact, rel=1e-9, abs=1e-10 * size)
    assert mean.lower <= exact + 1e-15 * size and exact - 1e-15 * size <= mean.upper
    assert distant.certificate.bound_h1 == pytest.approx(near.certificate.bound_h1, rel=1e-6)


def test_a_contrast_beyond_all_numbers():
    """κ 10²⁰⁰ beside 10⁻²⁰⁰: u on the soft side is 10²⁰⁰ times that of 1, forces stay."""
    sides = ("contact", "dirichlet", "neumann", "neumann")
    domain = Polygon([(0, 0), (1, 0), (1, 1), (0, 1)], sides).mesh(0.3)
    found = []
    for size in (1e10, 1e100, 1e200):

        def kappa(x, size=size):
            return ufl.conditional(ufl.gt(x[0], 0.8), size, 1 / size)

        solution = solve(Problem(f=-2.0, coefficient=kappa, obstacle=-1.0), domain)
        lowest = MPI.COMM_WORLD.allreduce(float(solution.u.x.array.min()), op=MPI.MIN)
        found.append((solution.contact.force, lowest / size))
    assert np.allclose(found, found[0], rtol=1e-8, atol=0.0)
