"""The certificate's fields against given functions, by quadrature at points."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import basix
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints, create_box, exterior_facet_indices, meshtags
from helpers import HELD_ABOVE, SQUARE
from mpi4py import MPI

from signorini_cr import Domain, InputError, Polygon, Problem, solve
from signorini_cr.compat import cell_nodes
from signorini_cr.data.diffusion import diffusion
from signorini_cr.data.loads import Certain, Known, Segments, VolumeMoments
from signorini_cr.data.pieces import Pieces
from signorini_cr.data.quadrature import Between, OnParts
from signorini_cr.diffusion import Diffusion
from signorini_cr.estimate import certificate, cusps, duality, flux, force, pairing, weights
from signorini_cr.estimate.beyond import Beyond
from signorini_cr.estimate.companion import Companion, _at_vertices
from signorini_cr.estimate.curl import _pull
from signorini_cr.estimate.draft import Floors, kinked
from signorini_cr.estimate.functional import Functional, Masses
from signorini_cr.estimate.lifting import Lift, affine, gaps
from signorini_cr.estimate.sums import Sums, Totals
from signorini_cr.fem.cells import BoundaryFacets, Cells
from signorini_cr.fem.space import function_space
from signorini_cr.mesh.families import structured
from signorini_cr.multigrid.hierarchy import NestedMesh
from signorini_cr.vi.level import Level

DIRICHLET = 2


def square(n=2):
    return structured(HELD_ABOVE, n, MPI.COMM_SELF, jitter=0.2)


class Points:
    """Functions of cells at the points of a rule, and their integrals over the cells."""

    def __init__(self, cells, degree=10):
        points, weights_ = basix.make_quadrature(basix.CellType.triangle, degree)
        mesh = cells.domain.mesh
        self.cells, self.weights = cells, weights_ / weights_.sum()
        self.hats = np.column_stack([1 - points.sum(axis=1), points]).T
        self.corners = mesh.geometry.x[cell_nodes(mesh)[: cells.number], :2]
        if cells.stretch is not None:
            self.corners = np.einsum("nij,nkj->nki", cells.stretch, self.corners)
        inverse = np.linalg.inv(self.corners[:, 1:] - self.corners[:, :1])
        self.gradients = np.concatenate([-inverse.sum(axis=2)[:, None], inverse.swapaxes(1, 2)], 1)
        self.area = np.abs(np.linalg.det(self.corners[:, 1:] - self.corners[:, :1])) / 2
        self.x = np.einsum("iq,nik->nqk", self.hats, self.corners)

    def integral(self, values):
        return self.area * (values @ self.weights)

    def affine(self, c):
        """From values at the cells' vertices, shape (3, n)."""
        slope = np.einsum("in,nik->nk", c, self.gradients)[:, None]
        return c.T @ self.hats, np.repeat(slope, len(self.weights), axis=1)

    def of_facets(self, heights, cubic=False):
        """Bumps 4 λ_j λ_k, or cubics λ_j λ_k (λ_j − λ_k), j to k as the mesh counts vertices."""
        values, slopes = np.zeros(self.x.shape[:2]), np.zeros(self.x.shape)
        global_ = self.cells.vertices
        for i in range(3):
            height = heights[self.cells.facets[i]]
            j, k = (one for one in range(3) if one != i)
            a, b = self.hats[[j, k]]
            by_a, by_b = self.gradients[:, j, None], self.gradients[:, k, None]
            both, bend = a * b, a[:, None] * by_b + b[:, None] * by_a
            if cubic:
                height = np.where(global_[j] < global_[k], height, -height)
                bend = (a - b)[:, None] * bend + both[:, None] * (by_a - by_b)
                both = both * (a - b)
            scale = 1.0 if cubic else 4.0
            values += scale * height[:, None] * both
            slopes += scale * height[:, None, None] * bend
        return values, slopes

    def field(self, fluxes):
        """The Raviart-Thomas field with such fluxes out of the cells."""
        total = fluxes.sum(axis=0)[:, None, None] * self.x
        constant = np.einsum("in,nik->nk", fluxes, self.corners)[:, None]
        return (total - constant) / (2 * self.area)[:, None, None]


def sums_of(*pairs):
    return tuple(sum(parts) for parts in zip(*pairs, strict=True))


def psi(x):
    return 0.7 + x[..., 0] - 2 * x[..., 1] + 3 * x[..., 0] * x[..., 1]


def moments(at, values):
    """Compute the moments of a load from its values at the points."""
    mean = values @ at.weights
    off = values - mean[:, None]
    bumps = [4 * np.delete(at.hats, i, axis=0).prod(axis=0) for i in range(3)]
    rows = [(off * test) @ at.weights for test in (*at.hats, *bumps)]
    return VolumeMoments(mean, np.array(rows), off**2 @ at.weights)


def made_up(cells, seed):
    """v, u_h and a lifting, by random numbers."""
    rng = np.random.default_rng(seed)
    number, facets = cells.number, len(cells.exterior)
    none = np.zeros(0)
    return rng, SimpleNamespace(
        vertices=rng.normal(size=cells.vertices.max() + 1),
        bumps=rng.normal(size=facets),
        w=rng.normal(size=(3, number)),
        thirds=None,
        bubbles=None,
        cusps=None,
        within=None,
        lift=(none.astype(int), none, none, none),
        bounded=none.astype(int),
    )


# ---- integrals with a weight


@pytest.mark.serial
def test_a_weight_in_cells():
    """ψ times u_h and v where both are polynomials, and Cauchy and Schwarz where one is not."""
    domain = square()
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    at, there = Points(cells), np.arange(cells.number) < 3
    rng, made = made_up(cells, 1)
    load = moments(at, psi(at.x))
    found = pairing.in_cells(made, cells, Certain(load), there)
    v, _ = sums_of(at.affine(made.vertices[cells.vertices]), at.of_facets(made.bumps))
    assert np.isclose(found.total, at.integral(psi(at.x)).sum())
    assert np.isclose(found.of_u, at.integral(psi(at.x) * at.affine(made.w)[0]).sum())
    assert np.isclose(found.of_v, at.integral(psi(at.x) * v).sum())
    assert found.unsure == 0.0 and found.scale >= at.integral(np.abs(psi(at.x) * v)).sum()
    assert found.missed < 1e-13
    # ψ's mean is known up to `missed`, and ψ to `rough`
    missed = rng.uniform(size=cells.number)
    found = pairing.in_cells(made, cells, Certain(load, missed, 0 * missed), there)
    assert np.isclose(found.unsure, np.abs(v @ at.weights) @ missed)
    assert np.isclose(found.missed, missed.sum())
    # what only norms are known of: cubics and cusps against ψ − ψ_T, a lifting against ψ
    at_cusp, means = np.array([2, 5]), np.array([0.3, -0.4])
    heights = rng.normal(size=(4, 2))
    made.cusps = SimpleNamespace(at=at_cusp, means=means, heights=heights)
    of_cusps = means * (at.area * load.mean)[at_cusp]
    off = np.sqrt(at.integral((psi(at.x) - load.mean[:, None]) ** 2))
    found = pairing.in_cells(made, cells, Certain(load), there)
    assert np.isclose(found.of_v, at.integral(psi(at.x) * v).sum() + of_cusps.sum())
    largest = 0.5 * np.abs(heights).sum(axis=0)
    assert np.isclose(found.unsure, (off * np.sqrt(at.area))[at_cusp] @ largest)
    found = pairing.in_cells(made, cells, Certain(load, missed, 0 * missed), there)
    mean = v @ at.weights
    mean[at_cusp] += means
    expected = np.abs(mean) @ missed + (off * np.sqrt(at.area))[at_cusp] @ largest
    assert np.isclose(found.unsure, expected)
    made.cusps, made.thirds = None, np.zeros(len(cells.exterior))
    made.thirds[cells.facets[0, 3]] = -0.8
    found = pairing.in_cells(made, cells, Certain(load), there)
    cubic, _ = at.of_facets(made.thirds, cubic=True)
    assert np.isclose(found.of_v, at.integral(psi(at.x) * v).sum())
    assert np.isclose(found.unsure, off @ np.sqrt(at.integral(cubic**2)))
    assert abs(at.integral(psi(at.x) * cubic).sum()) <= found.unsure
    # the mean of λ_1 λ_2 λ_3 is 1/60; ψ − ψ_T is known to have no product but with what is rough
    made.thirds, made.bubbles = None, rng.normal(size=cells.number)
    bubble = made.bubbles[:, None] * at.hats.prod(axis=0)
    found = pairing.in_cells(made, cells, Certain(load), there)
    of_mean = load.mean[:, None] * (v + bubble) + (psi(at.x) - load.mean[:, None]) * v
    assert np.isclose(found.of_v, at.integral(of_mean).sum())
    assert np.isclose(found.unsure, off @ np.sqrt(at.integral(bubble**2)))
    assert abs(at.integral(psi(at.x) * (v + bubble)).sum() - found.of_v) <= found.unsure
    found = pairing.in_cells(made, cells, Certain(load, missed, 0 * missed), there)
    expected = np.abs((v + bubble) @ at.weights) @ missed + off @ np.sqrt(at.integral(bubble**2))
    assert np.isclose(found.unsure, expected)
    made.bubbles = None
    made.lift = np.array([1, 4]), None, np.array([0.2, 0.3]), None
    found = pairing.in_cells(made, cells, Certain(load, 0 * missed, missed), there).unsure
    made.lift = made.lift[0], None, np.zeros(2), None
    found -= pairing.in_cells(made, cells, Certain(load, 0 * missed, missed), there).unsure
    norms = np.sqrt(at.integral(psi(at.x) ** 2)) + missed
    assert 1.0 <= found / (norms[[1, 4]] @ [0.2, 0.3]) <= np.sqrt(2)


@pytest.mark.serial
@pytest.mark.parametrize("kind", ["vertices", "bump", "cubic", "bubble", "cusp"])
def test_what_v_has_beyond_its_mean_meets_what_is_rough(kind):
    """At least |v − v_T|, times |T|^{1/2} ‖ψ − q‖, and at most twice as much."""
    domain = square()
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    at, facet = Points(cells, 20), cells.facets[1, 3]
    rng, made = made_up(cells, 2)
    vertices, made.vertices, made.bumps = made.vertices, 0 * made.vertices, 0 * made.bumps
    rough = rng.uniform(size=cells.number)
    if kind == "vertices":
        made.vertices = vertices
        v, _ = at.affine(vertices[cells.vertices])
        off = np.abs(vertices[cells.vertices] - (v @ at.weights)).max(axis=0)
    elif kind == "bump":
        made.bumps[facet] = -0.7
        off = 0.7 * 2 / 3 * (cells.facets == facet).any(axis=0)
    elif kind == "cubic":
        made.thirds = np.zeros(len(cells.exterior))
        made.thirds[facet] = -0.7
        off = 0.7 / np.sqrt(108) * (cells.facets == facet).any(axis=0)  # s(1 − s)(1 − 2s) at most
    elif kind == "bubble":
        made.bubbles = np.zeros(cells.number)
        made.bubbles[4] = -0.7
        off = 0.7 / 27 * (np.arange(cells.number) == 4)
    else:
        heights, off = np.array([[0.0], [-0.7], [0.0], [0.0]]), np.zeros(cells.number)
        made.cusps = SimpleNamespace(at=np.array([4]), means=np.zeros(1), heights=heights)
        t = np.linspace(0, 1, 10001)
        off[4] = 0.7 * max((t**s - t).max() for s in cusps.EXPONENTS)
    load = VolumeMoments(np.ones(cells.number), None, None)
    found = pairing.in_cells(made, cells, Certain(load, 0 * rough, rough), rough > 0)
    truth = off @ (np.sqrt(at.area) * rough)
    limit = {"vertices": 2.0, "bump": 1.5, "cubic": 1.05, "bubble": 1.0, "cusp": 1.1}[kind]
    assert truth * (1 - 1e-12) <= found.unsure <= limit * truth * (1 + 1e-12)


@pytest.mark.serial
def test_rounding_of_weights():
    """In parts of ∫ |ψ| and of ∫ |ψ v|: exactly these where ψ and v are numbers."""
    domain = square()
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    _, made = made_up(cells, 3)
    made.vertices[:], made.bumps[:], there = -2.0, 0.0, np.ones(cells.number)
    load = VolumeMoments(np.full(cells.number, -3.0), None, None)
    found = pairing.in_cells(made, cells, Certain(load), there)
    assert np.isclose(found.missed, 3e-14, atol=0.0) and np.isclose(found.scale, 6.0)
    made.bumps[:] = 0.5
    assert np.isclose(pairing.in_cells(made, cells, Certain(load), there).scale, 7.5)


def on_sides(seed, g=lambda x: ufl.sin(4 * x[1]) - 0.3 + x[0]):
    """Values of g on two sides of the square, and what the facets' points are, by Gauss's rule."""
    level = solve(Problem(f=1.0, g=g), square(3)).level
    data = diffusion(level.data)
    cells, rng = data.cells, np.random.default_rng(seed)
    kappa = rng.uniform(0.5, 1, cells.number)
    edge = Segments.of(data.edges[0], cells, kappa, 1.0)
    return level, cells, kappa, edge, rng


class OnFacets:
    """Functions at Gauss's points of facets, shape (n, q)."""

    def __init__(self, cells, side):
        t, w = np.polynomial.legendre.leggauss(12)
        self.s, self.cells, self.side = (t + 1) / 2, cells, side
        nodes = cell_nodes(cells.domain.mesh)[side.cells]
        ends = np.array([[j for j in range(3) if j != i] for i in side.local])
        x = cells.domain.mesh.geometry.x[np.take_along_axis(nodes, ends, axis=1), :2]
        self.length = np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
        self.ends, self.weights = ends, w / 2
        self.x = x[:, :1] + self.s[:, None] * (x[:, 1:] - x[:, :1])

    def integral(self, values):
        return self.length * (values @ self.weights)

    def affine(self, c):
        first, second = (c[self.ends[:, i], self.side.cells, None] for i in (0, 1))
        return first * (1 - self.s) + second * self.s

    def bump(self, heights):
        return 4 * heights[self.side.dofs, None] * self.s * (1 - self.s)


@pytest.mark.serial
def test_a_weight_on_sides():
    _, cells, _, edge, rng = on_sides(4)
    _, made = made_up(cells, 5)
    zero = np.zeros(len(edge.loss))
    edge = replace(edge, missed=zero, rough=zero)
    on = OnFacets(cells, edge.facets)
    weight = np.sin(4 * on.x[..., 1]) - 0.3 + on.x[..., 0]
    u, v = on.affine(made.w), on.affine(made.vertices[cells.vertices]) + on.bump(made.bumps)
    found = pairing.on_side(made, cells, edge)
    assert np.isclose(found.total, on.integral(weight).sum(), rtol=1e-6)
    assert np.isclose(found.of_u, on.integral(weight * u).sum(), rtol=1e-5)
    assert np.isclose(found.of_v, on.integral(weight * v).sum(), rtol=1e-5)
    assert np.isclose(found.scale, on.integral(np.abs(weight * v)).sum(), rtol=0.02)
    assert np.isclose(found.missed, 1e-14 * on.integral(np.abs(weight)).sum(), rtol=0.02, atol=0.0)
    assert found.unsure == 0.0
    missed, rough = rng.uniform(size=(2, len(zero)))
    assert np.isclose(
        pairing.on_side(made, cells, replace(edge, missed=missed)).missed, missed.sum()
    )
    # ‖ψ‖_F ‖ℓ‖_F, where ℓ may come twice
    twice = edge.facets.dofs[[0, 3, 3]]
    made.bounded, made.lift = twice, (None, None, None, np.array([0.2, 0.3, 0.1]))
    norms = np.sqrt(on.integral(weight**2))
    found = pairing.on_side(made, cells, edge).unsure
    assert np.isclose(found, norms[[0, 3]] @ [0.2, 0.4], rtol=1e-5)
    rougher = replace(edge, rough=rough)
    extra = pairing.on_side(made, cells, rougher).unsure - edge_change(rougher, made)
    assert np.isclose(extra, (norms + rough)[[0, 3]] @ [0.2, 0.4], rtol=1e-5)
    made.lift = (None, None, None, np.zeros(3))
    made.thirds = rng.normal(size=len(cells.exterior))
    ways = cells.ways_between(*edge.facets.ends) * made.thirds[edge.facets.dofs]
    cubic = ways[:, None] * (on.s * (1 - on.s) * (1 - 2 * on.s))
    found = pairing.on_side(made, cells, edge)
    assert np.isclose(found.of_v, on.integral(weight * (v + cubic)).sum(), rtol=1e-5)
    assert found.unsure == 0.0
    extra = pairing.on_side(made, cells, rougher).unsure - edge_change(rougher, made)
    largest = np.abs(cubic).max(axis=1) * np.sqrt(on.length)
    assert largest @ rough <= extra <= 1.06 * largest @ rough


def edge_change(edge, made):
    return edge.change(made.vertices, made.bumps)


# ---- the form and the residual against P1


def by_points(made, cells, phi):
    """(A v − p', Aφ) and ‖Aφ‖², point by point."""
    at, on = Points(cells), OnFacets(cells, made.segments.facets)
    values, slopes = at.affine(phi)
    jump, bend = sums_of(
        at.affine(made.vertices[cells.vertices] - made.w), at.of_facets(made.bumps)
    )
    kappa, c = (
        np.broadcast_to(each, cells.number)[:, None] for each in (made.kappa, made.reaction)
    )
    total = at.integral(kappa * (bend * slopes).sum(axis=2) + c * jump * values)
    total -= at.integral((at.field(made.excess) * slopes).sum(axis=2))
    total -= at.area * (made.hats * phi).sum(axis=0)
    square_ = at.integral(kappa * (slopes**2).sum(axis=2) + c * values**2)
    means, loss = values @ at.weights, made.segments.loss[:, None]
    taken = np.zeros(cells.number, bool) if made.taken_up is None else made.taken_up
    total -= np.where(taken, made.left * means, 0.0)
    phi_on = on.affine(phi)
    jump_on = on.affine(made.vertices[cells.vertices] - made.w) + on.bump(made.bumps)
    g = np.sin(4 * on.x[..., 1]) - 0.3 + on.x[..., 0]
    g -= (g @ on.weights)[:, None]
    on_edge = on.integral((g - loss * jump_on) * phi_on)
    if made.shed is not None:
        on_edge += made.shed * (phi_on @ on.weights)
    return (
        total.sum() - on_edge.sum(),
        square_.sum() + on.integral(loss * phi_on**2).sum(),
        np.where(taken, 0.0, np.abs(made.left * means)),
    )


def vary(made, cells, phi, work, rng):
    """Let κ, c and b vary by given amounts; what becomes of (A v − p', Aφ), ‖Aφ‖² and is unsure."""
    at, on, edge = Points(cells), OnFacets(cells, made.segments.facets), made.segments
    (values, slopes), number = at.affine(phi), cells.number
    jump, bend = sums_of(
        at.affine(made.vertices[cells.vertices] - made.w), at.of_facets(made.bumps)
    )
    pull, (unsure, mean) = rng.normal(size=(3, number)), rng.uniform(1, 2, (2, number))
    made.within = duality.Within(pull, unsure, mean)
    kappa = np.broadcast_to(made.kappa, number)[:, None]
    own = bend + at.affine(made.w)[1]  # ∇v
    work += (pull * phi).sum() - at.integral(kappa * (own * slopes).sum(axis=2)).sum()
    off = (unsure * np.sqrt((slopes**2).sum(axis=2)[:, 0])).sum()
    more = rng.uniform(1, 2, number)
    made.most_reaction = made.reaction + more
    norms = at.integral(jump**2) * at.integral(values**2)
    off += (more * np.sqrt(norms)).sum()
    phi_on = on.affine(phi)
    jump_on = on.affine(made.vertices[cells.vertices] - made.w) + on.bump(made.bumps)
    less, there = edge.loss, edge.loss[edge.place]
    made.segments = replace(edge, between=np.stack([there, there + 3.0]))
    off += (3.0 * np.sqrt(on.integral(jump_on**2) * on.integral(phi_on**2))).sum()
    size = at.integral(mean[:, None] * (slopes**2).sum(axis=2)).sum()
    size += at.integral(np.broadcast_to(made.most_reaction, number)[:, None] * values**2).sum()
    return work, size + on.integral((less + 3.0)[:, None] * phi_on**2).sum(), off


@pytest.mark.serial
@pytest.mark.parametrize("reaction", [0.0, 3.0, "some"])
@pytest.mark.parametrize("lossy", [False, True])
@pytest.mark.parametrize("varies", [False, True])
def test_the_residual_against_affine_functions(reaction, lossy, varies):
    level, cells, kappa, edge, rng = on_sides(6)
    _, made = made_up(cells, 7)
    made.level, made.kappa = level, kappa
    some = np.where(rng.uniform(size=cells.number) < 0.5, 0.0, 2.0)
    made.reaction = made.most_reaction = some if reaction == "some" else np.array(reaction)
    # a cell in a corner has two facets, and one b for both in the form that finds φ
    alone = cells.exterior[cells.facets].sum(axis=0)[edge.facets.cells] == 1
    loss = rng.uniform(5, 9, len(edge.loss)) * alone * lossy
    assert 3 < np.sum(alone) < len(loss)
    made.segments = replace(edge, loss=loss)
    made.excess, made.left = rng.normal(size=(3, cells.number)), rng.normal(size=cells.number)
    hats = rng.normal(size=(3, cells.number))
    made.hats = hats - hats.mean(axis=0)
    made.taken_up = made.reaction > 0.0 if reaction == "some" else None
    made.shed = rng.normal(size=len(loss)) if lossy else None
    made.cells = lambda: cells
    phi = rng.normal(size=cells.vertices.max() + 1)[cells.vertices]
    work, size, slack = by_points(made, cells, phi)
    expected = 0.0
    if varies:
        work, size, expected = vary(made, cells, phi, work, rng)
    found, off, left = force.against(made, cells, phi)
    assert np.isclose(found, work, rtol=1e-5)
    # on facets in pieces the norms are those on the pieces
    assert 0.99 * expected <= off <= expected * (1 + 1e-9)
    assert np.allclose(left, slack)
    assert np.isclose(force.square(made, cells, phi), size)
    made.missed = np.array([0.125, 0.125])
    weighed = weights.Weighed(force=0.0, left=0.125, mean=0.5)
    assert np.isclose(force.unsure(made, phi, left), slack.sum() + 0.25 * np.abs(phi).max())
    expected = slack.sum() + 0.125 + 0.25 * (np.abs(phi).max() + 0.5)
    assert np.isclose(force.unsure(made, phi, left, weighed), expected)
    if varies:
        return
    # The function with given values that has the least ‖Aφ‖, by solving for it densely
    V = function_space(cells.domain.mesh, "P1")
    dofs = V.dofmap.list[: cells.number].T
    values = fem.Function(V)
    known = np.flatnonzero(V.tabulate_dof_coordinates()[:, 1] < 1e-9).astype(np.int32)
    values.x.array[known] = rng.normal(size=len(known))
    found = force.extended(values, known, made, cells).x.array
    units = np.eye(len(found))
    diagonal = [force.square(made, cells, one[dofs]) for one in units]
    both = [[force.square(made, cells, (one + two)[dofs]) for one in units] for two in units]
    matrix = (np.array(both) - np.add.outer(diagonal, diagonal)) / 2
    free = np.setdiff1d(np.arange(len(found)), known)
    pull = matrix[np.ix_(free, known)] @ values.x.array[known]
    best = values.x.array.copy()
    best[free] = -np.linalg.solve(matrix[np.ix_(free, free)], pull)
    assert np.array_equal(found[known], values.x.array[known])
    least, there = best @ matrix @ best, found @ matrix @ found
    assert least * (1 - 1e-12) <= there <= 1.001 * least
    assert np.allclose(found, best, atol=0.02 * np.abs(best).max())


# ---- weights of one's own


@pytest.mark.serial
def test_norm_of_what_a_weight_has_beyond_its_values_at_vertices():
    """(λ ‖∇ℓ‖² + c ‖ℓ‖²) on cells, the norms added up in a corner's, λ κ's largest eigenvalue."""
    _, cells, kappa, edge, rng = on_sides(8)
    made = SimpleNamespace(most=kappa, segments=edge)
    loss = rng.uniform(1, 2, len(edge.loss))
    made.segments = replace(edge, loss=loss)
    made.most_reaction = rng.uniform(1, 2, cells.number)
    side = edge.facets
    cell = side.cells[0]
    side = replace(side, cells=np.where(np.arange(len(loss)) < 2, cell, side.cells))
    steep, area, on_edge = rng.uniform(size=(3, len(loss)))
    lifted = Lift(steep, area, None, None, on_edge)
    rows = np.zeros((2, cells.number))
    for i, at in enumerate(side.cells):
        rows[:, at] += steep[i], area[i]
    expected = np.sum(kappa * rows[0] ** 2 + made.most_reaction * rows[1] ** 2) + loss @ on_edge**2
    assert np.isclose(weights._square(made, cells, side, lifted), expected)
    made.most, made.most_reaction = np.array(2.0), np.array(3.0)
    expected = np.sum(2.0 * rows[0] ** 2 + 3.0 * rows[1] ** 2) + loss @ on_edge**2
    assert np.isclose(weights._square(made, cells, side, lifted), expected)


@pytest.mark.serial
def test_the_range_of_a_weight():
    level, cells, _, edge, _ = on_sides(9)
    on, data = OnFacets(cells, edge.facets), diffusion(level.data)
    truth = np.sin(4 * on.x[..., 1]) - 0.3 + on.x[..., 0]
    low, high = weights.ranges(data.edges[0].g, cells, edge.facets)
    assert truth.min() - 0.5 <= low.min() <= truth.min()
    assert truth.max() <= high.max() <= truth.max() + 0.5 and (low <= high).all()
    number = data.compiled.trace(ufl.as_ufl(-2.5))
    assert all((each == -2.5).all() for each in weights.ranges(number, cells, edge.facets))
    # a weight on another mesh, alone or with this one's coordinates
    forms = data.forms
    other = fem.Function(fem.functionspace(square(2).mesh, ("Lagrange", 1)))
    for weight in (lambda _: other, lambda x: other + x[0]):
        with pytest.raises(InputError, match="another mesh"):
            weights.scalar(weight, forms, level.domain)
    assert weights.scalar(lambda x: x[0], forms, level.domain) == forms.x[0]


@pytest.mark.serial
def test_what_presses():
    """∫_F (y·n − g + b u_h) on facets: y's flux less what is known of it, and what b has shed."""
    _, cells, _, edge, rng = on_sides(10)
    through, shed = rng.normal(size=(3, cells.number)), rng.normal(size=len(edge.loss))
    made = SimpleNamespace(segments=edge, shed=None, through=lambda _: through)
    on = OnFacets(cells, edge.facets)
    known = on.integral(np.sin(4 * on.x[..., 1]) - 0.3 + on.x[..., 0])
    own = through[edge.facets.local, edge.facets.cells]
    assert np.allclose(weights.pressed(made, cells, edge.facets), own - known, rtol=1e-5, atol=1e-6)
    made.shed = shed
    found = weights.pressed(made, cells, edge.facets)
    assert np.allclose(found, own - known + shed, rtol=1e-5, atol=1e-6)
    free = cells.sides[DIRICHLET]
    assert np.allclose(weights.pressed(made, cells, free), through[free.local, free.cells])


@pytest.mark.serial
def test_a_weight_against_the_flux(monkeypatch):
    """Simpson's rule for ω, and sizes times sizes for what it has beyond; made-up liftings.

    Half of the curl of y's bumps, 4 h (1 − 2s)/|F|, meets ω's affine part unseen.
    """
    problem = Problem(f=-9.0, dirichlet=lambda x: x[0] / 4, obstacle=-0.3, coefficient=4.0)
    made = solve(problem, square(3)).certificate.made
    cells, rng = made.cells(), np.random.default_rng(28)
    condition = diffusion(made.level.data).forms.fixed[0]
    side = next(each for number, each in cells.sides.items() if number == condition.number)
    n, on = len(side.cells), OnFacets(cells, side)
    found = weights.Weight.of(made, cells, [condition], lambda x: x[0] ** 3 - 0.5)
    V = found.values.function_space
    x, y = V.tabulate_dof_coordinates()[:, :2].T
    assert np.allclose(found.values.x.array, np.where(y > 1 - 1e-9, x**3 - 0.5, 0.0))
    assert set(found.known) == set(np.flatnonzero((y > 1 - 1e-9) | (y < 1e-9)))
    assert found.scale == 0.5
    lifts = [Lift(*rng.uniform(size=(5, n))) for _ in range(2)]
    goals = []

    def lift(_, side_, trace, base, v, scale, goal, obstacle):
        assert base is None and not obstacle and scale == 0.5
        goals.append(goal)
        # of ω less its affine part, and less its quadratic part
        middle = np.sum(v.ends, axis=0) / 2 + v.height
        exact = np.sum(on.x[..., 0][:, [5, 6]], axis=1) / 2
        return lifts[np.allclose(middle, exact**3 - 0.5)]

    monkeypatch.setattr(weights, "lift", lift)
    made = replace(made, left=rng.normal(size=cells.number), taken_up=None)
    result = found.weighed(made, cells, 3.0)
    assert len(goals) == 2 and np.allclose(goals, 0.03 / 2)  # κ^{1/2} = 2
    pressure = made.through(cells)[side.local, side.cells] / on.length
    cubes = on.integral(on.x[..., 0] ** 3 - 0.5)  # Simpson's rule is exact
    assert np.isclose(result.force, pressure @ cubes)
    coarse, fine = lifts
    assert np.isclose(result.unsure, np.abs(pressure) @ fine.beyond)
    assert np.isclose(result.square, 4 * np.sum(coarse.steep**2))
    over = coarse.area / np.sqrt(cells.volume[side.cells])
    assert np.isclose(result.left, np.abs(made.left[side.cells]) @ over)
    assert np.isclose(result.mean, over.max()) and len(np.unique(side.cells)) == n
    assert -0.6 <= result.least <= -0.5
    taken = np.arange(cells.number) == side.cells[1]
    heights = rng.normal(size=len(cells.exterior))
    made = replace(made, taken_up=taken, beyond=Beyond(heights, None))
    result = found.weighed(made, cells, 3.0)
    assert np.isclose(result.left, np.delete(np.abs(made.left[side.cells]) * over, 1).sum())
    own = heights[side.dofs, None] * 4 * (1 - 2 * on.s) / on.length[:, None]
    ends = found.values.x.array[V.dofmap.list[side.cells[:, None], on.ends]]
    affine_ = ends[:, :1] * (1 - on.s) + ends[:, 1:] * on.s
    half = np.abs(on.integral(own * affine_)) / 2
    largest = 4 * np.abs(heights[side.dofs]) / on.length * np.sqrt(on.length) * coarse.edge
    expected = np.abs(pressure) @ fine.beyond + np.sum(half + largest)
    assert np.isclose(result.unsure, expected)
    # with a reason there is none, and a corner's cell has the sum of two
    lifts[1] = replace(lifts[1], reason="u_D jumps on a boundary facet")
    with pytest.raises(InputError, match="the weight jumps on a boundary facet"):
        found.weighed(made, cells, 3.0)


def test_signs_that_are_certain():
    """A force off one bound is not below 0, nor is it with a weight that is not; a flux may be.

    u is affine, so that u_h is u and only rounding is left, but for the weight's liftings.
    """
    sides = ("dirichlet", "contact", "dirichlet", "contact")
    domain = structured(Polygon(SQUARE.vertices, sides), 3, jitter=0.2)
    solution = solve(Problem(dirichlet=lambda x: 3 * x[1], obstacle=-9.0), domain)
    forms = diffusion(solution.level.data).forms
    bounded, fixed = list(forms.bounded), list(forms.fixed)
    made = force.made_of(solution)
    interval = partial(force.force_interval, made, made.cells())
    value, lower, upper = interval(bounded, lambda x: (x[1] * (1 - x[1])) ** 2)
    assert abs(value) < 1e-9 and lower == 0.0 <= upper < 1.0
    _, lower, upper = interval(bounded, lambda x: -((x[1] * (1 - x[1])) ** 2))
    assert -1.0 < lower < 0.0 < upper < 1.0
    # below 3 leaves, above 3 enters; ∫ x(1 − x) = 1/6, with a weight that is 0 at the corners
    for weight, exact in (
        (lambda x: x[0] * (1 - x[0]) * x[1], 0.5),
        (lambda x: x[0] * (1 - x[0]), 0),
    ):
        value, lower, upper = interval(fixed, weight)
        assert np.isclose(value, exact, atol=0.02) and lower <= exact <= upper < lower + 0.5
        assert lower < 0.0 or exact > 0.0
    # signs of the flux turned: the weight is negative
    value, lower, upper = interval(fixed, lambda x: -x[0] * (1 - x[0]) * x[1])
    assert np.isclose(value, -0.5, atol=0.02) and lower <= -0.5 <= upper < 0.0


# ---- the gap


def random_kappa(rng, number):
    low, high = rng.uniform(0.5, 1, number), rng.uniform(1, 3, number)
    kappa = SimpleNamespace(values=None, cut=None, tensor=None, varies=False, strips=None)
    kappa.bounds = Between.all_over(low, high)
    kappa.mean = low + rng.uniform(0.02, 0.98, number) * (high - low)
    return kappa


@pytest.mark.serial
@pytest.mark.parametrize("bent", [False, True])
def test_the_gap_with_a_reaction(bent):
    """c takes up what f has beyond its mean where that is cheaper, and what y lacks."""
    domain = square(3)
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    at, rng = Points(cells), np.random.default_rng(20)
    number, kappa = cells.number, random_kappa(rng, cells.number)
    c = np.exp(rng.uniform(0, 9, number))
    c[:3] = 0.0
    excess, w, P = rng.normal(size=(3, 3, number))
    bumps = rng.normal(size=len(cells.exterior)) * bent
    v = Companion(None, bumps, excess, None, None, None, None)
    taken_up, left = c > 0.0, rng.normal(size=number)
    steepness = at.integral((at.affine(w)[1] ** 2).sum(axis=2))
    y = SimpleNamespace(excess=P, beyond=None, taken_up=taken_up, left=left, steepness=steepness)
    f = psi(at.x) * rng.uniform(1, 2, number)[:, None]
    sums = duality.integrate(cells, kappa, w, moments(at, f), y, v, c)
    jump, off = sums_of(at.affine(excess), at.of_facets(bumps))
    u, du = at.affine(w)
    k, field = kappa.mean[:, None, None], at.field(P)
    pp, bb, pb = (at.integral(each.sum(axis=2)) for each in (field**2 / k, k * off**2, field * off))
    rest = f - (f @ at.weights)[:, None]
    norm, h2 = at.integral(rest**2), cells.lengths.max(axis=0)
    by_slope = h2 / 3.8317059702**2 * norm / kappa.bounds.low
    by_c = np.divide(norm, c, out=np.full(number, np.inf), where=c > 0)
    share, taken = np.minimum(by_slope, by_c), by_c < by_slope
    assert 3 < taken.sum() < number - 3
    apart = at.integral(c[:, None] * jump**2)
    given = np.divide(left**2, c * at.area, out=np.zeros(number), where=c > 0)
    assert np.allclose(sums.apart, apart)
    assert np.allclose(sums.zeroth, apart + given + np.where(taken, share, 0.0))
    assert np.allclose(sums.indicators, pp + bb + share + apart + given)
    # the field is the gradient of (s |x|²/2 − Σ P_i X_i·x) / (2 |T|)
    potential = 0.5 * P.sum(axis=0)[:, None] * (at.x**2).sum(axis=2)
    potential -= np.einsum("in,nik,nqk->nq", P, at.corners, at.x)
    potential /= (2 * at.area * kappa.mean)[:, None]
    of_p, of_b = (at.integral(rest * each) for each in (potential, jump))
    for row, sign in ((sums.middle, 1), (sums.across, -1)):
        more = np.where(taken, 0.0, share + 2 * (of_p + sign * of_b))
        assert np.allclose(row, pp + bb + 2 * sign * pb + more)
    totals, loose = sums.totals, np.where(taken_up, left, 0.0)
    assert np.isclose(totals.flux, pp.sum()) and np.isclose(totals.cross, pb.sum())
    assert np.isclose(totals.companion, np.sum(bb + apart))
    assert np.isclose(totals.load, np.sum(share + given))
    assert np.isclose(totals.load_flux, np.sum(of_p[~taken]))
    assert np.isclose(totals.load_companion, of_b.sum() + loose @ (jump @ at.weights))
    own = at.integral(c[:, None] * u**2 / 2)
    steep = at.integral((k * (du + off) ** 2).sum(axis=2))
    assert np.allclose(sums.steepness, steep)
    energy = steep / 2 + apart / 2 - own - at.integral(f * (u + jump))
    assert np.isclose(totals.energy, energy.sum())
    assert np.isclose(totals.energy_slack, 1e-14 * own.sum(), atol=0.0)
    assert totals.slack == totals.far == totals.near == 0.0


@pytest.mark.serial
@pytest.mark.parametrize("more", [False, True])
def test_the_gap_where_a_tensor_varies(more):
    """‖K^{-1/2}(y − K∇z)‖ by what K has beyond κ_T, where lengths are stretched."""
    domain = square()
    rng, V = np.random.default_rng(21), fem.functionspace(domain.mesh, ("CR", 1))
    number = Cells(domain, V, (DIRICHLET,)).number
    a = rng.normal(size=(number, 2, 2))
    cells = Cells(domain, V, (DIRICHLET,), stretch=a @ a.swapaxes(1, 2) + np.eye(2))
    at, mean = Points(cells), rng.uniform(1, 2, number)
    assert np.allclose(at.area, cells.volume)
    off = 0.2 * rng.normal(size=(len(at.weights), number, 2, 2))
    off += off.swapaxes(2, 3)
    off = 0.5 * off * mean[:, None, None]
    theta = np.abs(np.linalg.eigvalsh(off / mean[:, None, None])).max(axis=(0, 2))
    off *= np.minimum(1.0, 0.8 / theta)[:, None, None]
    theta, rough = np.minimum(theta, 0.8), rng.uniform(0.01, 0.1, number)
    rule = SimpleNamespace(weights=at.weights, hats=at.hats)
    kappa = SimpleNamespace(mean=mean, spread=theta, rough=rough, rule=rule, strips=None)
    kappa.apart = lambda *_: off
    P, w, excess, rise = rng.normal(size=(4, 3, number))
    rise -= rise.mean(axis=0)
    bumps, thirds, heights = rng.normal(size=(3, len(cells.exterior)))
    steepness = at.integral((at.affine(w)[1] ** 2).sum(axis=2))
    beyond = Beyond(heights, rise) if more else None
    y = SimpleNamespace(excess=P, beyond=beyond, steepness=steepness)
    v = Companion(None, bumps, excess, None, None, None, None, None, thirds if more else None)
    before = rng.uniform(size=(2, number))
    vv, far, near, energy = duality._of_tensor(
        cells, kappa, slice(0, number), y, v, w, (before[0], before[1])
    )
    _, du = at.affine(w)
    change = sums_of(at.affine(excess), at.of_facets(bumps))[1]
    field = at.field(P) + mean[:, None, None] * du
    if more:
        change = change + at.of_facets(thirds, cubic=True)[1]
        curl = at.of_facets(heights)[1]
        field = field + np.stack([curl[..., 1], -curl[..., 0]], axis=-1)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            way = (rise[j] - rise[i])[:, None] * (at.corners[:, j] - at.corners[:, i]) / 3
            field = field + way[:, None] * (at.hats[i] * at.hats[j])[:, None]
    K = mean[:, None, None, None] * np.eye(2) + off.swapaxes(0, 1)
    kappa.values = kappa.cut = None
    kappa.tensor = True
    load = VolumeMoments(rng.normal(size=number), None, None)
    sums = duality.integrate(cells, kappa, w, load, y, v)
    grown = []
    for gained, old, row, dz in (
        (far, before[0], sums.across, du + change),
        (near, before[1], sums.middle, du - change),
    ):
        F = field - np.einsum("nqij,nqj->nqi", K, dz)
        truth = at.integral(np.einsum("nqi,nqij,nqj->nq", F, np.linalg.inv(K), F))
        assert np.all(truth <= gained + old)
        norm = np.sqrt(at.integral((F**2).sum(axis=2)) / mean)
        steep = np.sqrt(at.integral((dz**2).sum(axis=2)) * mean)
        bound = (norm + 2 * rough * steep) ** 2 / (1 - theta)
        assert np.allclose(gained + old, bound) and np.allclose(row, bound)
        F = field - mean[:, None, None] * dz
        grown.append(np.sum(bound - at.integral((F**2).sum(axis=2)) / mean))
    dv = du + change
    assert np.allclose(vv, at.integral(np.einsum("nqi,nqij,nqj->nq", dv, K, dv)))
    assert np.allclose(energy, rough * mean * at.integral((dv**2).sum(axis=2)))
    assert np.allclose(sums.steepness, vv) and np.isclose(sums.totals.energy_slack, energy.sum())
    assert np.allclose((sums.totals.far, sums.totals.near), grown)
    # strips of a cell hold 36 times their part of what squares of quadratic fields hold in it
    lowest, high = rng.uniform(0.1, 1, number), rng.uniform(3, 9, number)
    kappa.strips, kappa.bounds = rng.uniform(0, 0.01, number), Between.all_over(lowest, high)
    _, more_far, more_near, more_energy = duality._of_tensor(
        cells, kappa, slice(0, number), y, v, w, (before[0], before[1])
    )
    of_y = 36 * kappa.strips * at.integral((field**2).sum(axis=2)) / lowest
    for gained, gained_with, dz in ((far, more_far, du + change), (near, more_near, du - change)):
        of_z = 36 * kappa.strips * at.integral((dz**2).sum(axis=2)) * high
        assert np.allclose(gained_with - gained, 4 * (of_y + of_z))
        assert gained is near or np.allclose(more_energy - energy, of_z / 2)
    within, wider = (
        duality._tensor_within(cells, replace_strips(kappa, strips), slice(0, number), v, w)
        for strips in (None, kappa.strips)
    )
    strips = 36 * kappa.strips * high
    steep = np.sqrt(cells.volume * at.integral((dv**2).sum(axis=2)))
    assert np.array_equal(wider[0], within[0])
    assert np.allclose(wider[1] - within[1], strips * steep)
    in_the_mean = np.linalg.norm(np.einsum("q,qnij->nij", at.weights, off), axis=(1, 2))
    expected = mean + 2 * rough * mean + strips + in_the_mean
    assert np.allclose(wider[2], np.minimum(expected, high))


def replace_strips(kappa, strips):
    """The same with other strips."""
    return SimpleNamespace(**{**vars(kappa), "strips": strips})


@pytest.mark.serial
@pytest.mark.parametrize("more", [False, True])
def test_quadrature_on_pieces(more):
    """The same as on whole cells, for polynomials; strips hold no more than polynomials can.

    A polynomial's largest square is Σ φ_i² at a vertex times its mean, φ_i orthonormal.
    """
    domain = square()
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    at, rng, number = Points(cells), np.random.default_rng(26), cells.number
    P, w, excess = rng.normal(size=(3, 3, number))
    bumps, heights = rng.normal(size=(2, len(cells.exterior)))
    y = SimpleNamespace(excess=P, beyond=Beyond(heights, None) if more else None)
    v = Companion(None, bumps, excess, None, None, None, None)
    k, errors = rng.uniform(1, 2, number), np.zeros((7, number))
    points = basix.make_quadrature(basix.CellType.triangle, 10)[0].T
    pairs = [(i, j) for i in range(3 if more else 2) for j in range((3 if more else 2) - i)]
    powers = np.array([points[0] ** i * points[1] ** j for i, j in pairs])
    vertex = np.array([float(i == j == 0) for i, j in pairs])
    largest = vertex @ np.linalg.solve((powers * at.weights) @ powers.T, vertex)
    errors[3] = 1e9
    errors[4], errors[5] = rng.uniform(size=(2, number))
    rule = SimpleNamespace(weights=at.weights, hats=at.hats)
    kappa = SimpleNamespace(values=np.tile(k, (len(at.weights), 1)), mean=k, rule=rule)
    whole = Pieces.of_cells(cells, np.array([1, 3, 6]))
    found = []
    for pieces in (whole[:0], whole, whole.halves(), whole.halves().halves()):
        pieces = pieces[np.argsort(pieces.parent, kind="stable")]
        inside = errors[:, pieces.parent]
        kappa.cut = SimpleNamespace(errors=errors, pieces=pieces, errors_inside=inside)
        kappa.inside = np.tile(k[pieces.parent], (len(at.weights), 1))
        part = slice(1, number)
        found.append(np.array(duality._by_quadrature(cells, kappa, part, y, v, w)))
        assert np.allclose(found[-1], found[0])
    u = at.affine(w)[1]
    off, field = sums_of(at.affine(excess), at.of_facets(bumps))[1], at.field(P)
    if more:
        curl = at.of_facets(heights)[1]
        field = field + np.stack([curl[..., 1], -curl[..., 0]], axis=-1)
    of_y = at.integral(((field + k[:, None, None] * u) ** 2).sum(axis=2))
    for row, dz in ((4, u + off), (5, u - off)):
        of_z = at.integral((dz**2).sum(axis=2))  # affine
        strips = 2 * (largest * errors[4] * of_y + 9 * errors[5] * of_z)
        assert np.allclose(found[0][row], strips[1:])
    assert np.isclose(largest, 36 if more else 9)
    # without R the products are bounded one by one, strips apart
    errors[1], errors[2:4] = np.inf, rng.uniform(size=(2, number))
    kappa.cut = SimpleNamespace(errors=errors, pieces=whole[:0], errors_inside=errors[:, :0])
    kappa.inside = np.empty((len(at.weights), 0))
    rows = duality._by_quadrature(cells, kappa, part, y, v, w)
    for row, dz in ((4, u + off), (5, u - off)):
        of_z = at.integral((dz**2).sum(axis=2))
        missed = (2 * errors[3] + largest * errors[4]) * of_y + (
            2 * errors[2] + 9 * errors[5]
        ) * of_z
        assert np.allclose(rows[row], missed[1:])
    of_v = at.integral(((u + off) ** 2).sum(axis=2))
    assert np.allclose(rows[6], ((errors[2] + 4.5 * errors[5]) * of_v)[1:])
    assert np.allclose(found[0][0], (at.integral((field**2).sum(axis=2)) / k)[1:])


def below(corners, normal, level):
    """Triangles that make up where normal·x < level in a triangle."""
    found, side = [], corners @ normal - level
    for k in range(3):
        a, b = side[k], side[(k + 1) % 3]
        if a < 0:
            found.append(corners[k])
        if a * b < 0:
            found.append(corners[k] + a / (a - b) * (corners[(k + 1) % 3] - corners[k]))
    return [np.array([found[0], *found[k : k + 2]]) for k in range(1, len(found) - 1)]


@pytest.mark.serial
@pytest.mark.parametrize("kind", ["waves", "jump", "tensor"])
def test_a_coefficient_against_affine_functions(kind):
    """∫_T κ∇v·∇λ_i, by a finer rule or on triangles on either side of the jump."""
    normal, level, high = np.array([1.0, 0.3]), 0.55, 40.0

    def waves(x):
        return 2.0 + np.sin(3.0 * x[..., 0] - 2.0 * x[..., 1])

    def kappa(x):
        wave = 2.0 + ufl.sin(3.0 * x[0] - 2.0 * x[1])
        if kind == "tensor":
            return ufl.as_matrix([[wave + 4.0, 0.1 * wave], [0.1 * wave, wave]])
        return wave if kind == "waves" else ufl.conditional(x[0] + 0.3 * x[1] < level, 1.0, high)

    made = solve(Problem(f=-9.0, coefficient=kappa), square(3)).certificate.made
    cells = made.cells()
    plain = Cells(made.level.domain, made.level.V, (DIRICHLET,))
    at = Points(plain)
    slope = sums_of(at.affine(made.vertices[plain.vertices]), at.of_facets(made.bumps))[1]
    tensor = waves(at.x)[..., None, None] * np.eye(2)
    if kind == "tensor":
        one = np.array([[1.0, 0.1], [0.1, 1.0]])
        tensor = waves(at.x)[..., None, None] * one + 4.0 * np.diag([1.0, 0.0])
    flow = np.einsum("nqij,nqj->nqi", tensor, slope)
    mean, largest = waves(at.x) @ at.weights, np.linalg.eigvalsh(tensor)[..., -1].max(axis=1)
    if kind == "jump":
        # ∇v is affine: its values at the corners of a cell, and so everywhere
        gram = (at.hats * at.weights) @ at.hats.T
        corners = np.linalg.solve(
            gram, np.einsum("iq,q,nqk->ink", at.hats, at.weights, slope).reshape(3, -1)
        )
        corners = corners.reshape(3, cells.number, 2)
        flow, mean = at.integral(slope.transpose(2, 0, 1)).T * high, np.full(cells.number, high)
        largest = np.full(cells.number, 1.0)
        for n in range(cells.number):
            to_hats = np.linalg.inv(np.vstack([at.corners[n].T, np.ones(3)]))
            for triangle in below(at.corners[n], normal, level):
                (x, y), (z, w) = triangle[1:] - triangle[0]
                area = abs(x * w - y * z) / 2
                hats = to_hats @ [*triangle.mean(axis=0), 1.0]
                flow[n] += (1.0 - high) * area * (hats @ corners[:, n])
                mean[n] += (1.0 - high) * area / at.area[n]
        assert (mean < 0.9 * high).sum() > 3 and ((mean > 1.1) & (mean < 0.9 * high)).sum() > 3
    else:
        flow = at.integral(flow.transpose(2, 0, 1)).T
    truth = np.einsum("nik,nk->in", at.gradients, flow)
    within, reach = made.within, np.sqrt((at.gradients**2).sum(axis=2)).T
    if kind == "tensor":  # lengths are stretched
        other = Points(cells)
        reach = np.sqrt((other.gradients**2).sum(axis=2)).T
        mean = np.sqrt(np.linalg.det(np.einsum("nqij,q->nij", tensor, at.weights)))
    noise = 1e-12 * np.abs(truth).max()
    assert (np.abs(within.pull - truth) <= within.unsure * reach + noise).all()
    assert (mean <= within.mean * (1 + 1e-12)).all() and (largest <= made.most * (1 + 1e-12)).all()
    unsure, more = {"waves": (0.02, 1.001), "jump": (0.02, 1.2), "tensor": (0.2, 2.5)}[kind]
    assert (within.unsure * reach).max() <= unsure * np.abs(truth).max()
    assert (within.mean <= more * mean).all()


@pytest.mark.serial
@pytest.mark.parametrize("more", [False, True])
def test_what_pulls_at_bumps_of_the_curl(more):
    """−∫ κ⁻¹ (y − κ∇(u_h + v)/2)·curl b_i on each cell."""
    domain = square()
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    at, rng, number = Points(cells), np.random.default_rng(31), cells.number
    kappa, (P, excess, rise) = rng.uniform(1, 3, number), rng.normal(size=(3, 3, number))
    bumps, heights = rng.normal(size=(2, len(cells.exterior)))
    rise -= rise.mean(axis=0)
    y = SimpleNamespace(excess=P, beyond=Beyond(heights, rise) if more else None)
    v = Companion(None, bumps, excess, None, None, None, None)
    off = at.field(P)
    if more:
        curl = at.of_facets(heights)[1]
        off = off + np.stack([curl[..., 1], -curl[..., 0]], axis=-1)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            way = (rise[j] - rise[i])[:, None] * (at.corners[:, j] - at.corners[:, i]) / 3
            off = off + way[:, None] * (at.hats[i] * at.hats[j])[:, None]
    change = sums_of(at.affine(excess), at.of_facets(bumps))[1]
    off = off - kappa[:, None, None] * change / 2
    found = _pull(cells, kappa, y, v)
    for i in range(3):
        for cell in range(number):
            unit = np.zeros(len(heights))
            unit[cells.facets[i, cell]] = 1.0
            curl = at.of_facets(unit)[1]
            curl = np.stack([curl[..., 1], -curl[..., 0]], axis=-1)
            expected = -at.integral((off * curl).sum(axis=2))[cell] / kappa[cell]
            assert np.isclose(found[i, cell], expected)
    # with κ a number, too
    assert np.allclose(_pull(cells, np.array(2.0), y, v), _pull(cells, 0 * kappa + 2.0, y, v))


@pytest.mark.serial
def test_what_b_takes_up_where_y_follows_it():
    """On thin cells y·n has the affine part, but where b is so strong that this would be dear."""
    _, cells, kappa, edge, _ = on_sides(34)
    on, low = OnFacets(cells, edge.facets), kappa[edge.facets.cells]
    length = on.length
    loss = np.array([0.0, 1e-6, 0.9, 1.1, 1e3, 1e-3]) * low / length
    given = np.array([False, False, True, True, True, False])
    edge = replace(edge, loss=loss, low=kappa)
    assert np.array_equal(edge.given, given)
    assert np.array_equal(edge.followed, [True, True, True, False, False, True])
    rest = np.sin(4 * on.x[..., 1]) - 0.3 + on.x[..., 0]
    rest -= (rest @ on.weights)[:, None]
    affine = 1.0 - 2.0 * on.s
    slope = 3.0 * (rest * affine) @ on.weights
    carried = rest - np.where([0, 0, 1, 0, 0, 0], slope, 0.0)[:, None] * affine
    for values, whether in ((rest, False), (carried, True)):
        truth = np.where(given, on.integral(values**2) / np.maximum(loss, 1e-300), 0.0)
        assert np.allclose(edge.taken(None, whether), truth, rtol=1e-6, atol=1e-12)
        squares = np.bincount(
            edge.place, edge.measure * (edge.weights @ edge.tau(whether) ** 2), minlength=6
        )
        assert np.allclose(squares, np.where(given, on.integral(values**2), 0.0), rtol=1e-6)


@pytest.mark.serial
@pytest.mark.parametrize("plain", [False, True])
def test_what_v_is_to_make_small(plain):
    """κ is steady where it does not vary; b |F| and t/b − u_h on facets with a b."""
    _, cells, kappa, edge, rng = on_sides(32)
    n, side = len(edge.loss), edge.facets
    loss = np.array([0.0, 0.01, 0.02, 50.0, 60.0, 0.0])
    edge, shed = replace(edge, loss=loss, low=kappa), rng.normal(size=n) * (loss > 0)
    varies = np.arange(cells.number) % 3 == 0
    of_cells = SimpleNamespace(
        mean=kappa * (1 + 1e-3 * varies),
        bounds=Between.all_over(kappa, kappa * (1 + 2e-3 * varies)),
    )
    # cells where c varies, or is more than κ/h², are not steady either
    reacts = np.arange(cells.number) % 5 * (not plain)
    low, high = (
        reacts * kappa / cells.diameter2 * each / 2.5 for each in (1.0, 1.0 + (reacts == 2))
    )
    c = SimpleNamespace(low=low, high=high)
    if plain:
        c.low = c.high = np.array(0.0)
    known = SimpleNamespace(
        cells=cells, kappa=of_cells, segments=edge, w=0, c=c, flux=SimpleNamespace(shed=shed)
    )
    found = certificate._functional(known, plain)
    masses = found.masses
    steady = ~varies & np.isin(reacts, [0, 1])
    assert np.array_equal(found.steady, steady) and masses.some == (not plain)
    assert np.array_equal(masses.side.dofs, side.dofs[1:5])
    assert np.allclose(masses.loss, loss[1:5] * OnFacets(cells, side).length[1:5])
    assert np.array_equal(masses.strong, [False, False, True, True])
    # where b takes up g − g_F, u_h + target is t/b: the quadratic nearest to that
    on = OnFacets(cells, side)
    g = np.sin(4 * on.x[..., 1]) - 0.3 + on.x[..., 0]
    g += (shed / on.length - g @ on.weights)[:, None]
    first, last, bump = masses.toward[:, :, None]
    near = first * (1 - on.s) + last * on.s + 4 * on.s * (1 - on.s) * bump
    powers = on.s[:, None] ** np.arange(3) * np.sqrt(on.weights)[:, None]
    for row, i in ((2, 3), (3, 4)):
        best = np.linalg.lstsq(powers, g[i] * np.sqrt(on.weights), rcond=None)[0]
        fitted = on.s[:, None] ** np.arange(3) @ best / loss[i]
        assert np.allclose(near[row], fitted, rtol=1e-4, atol=1e-6)
    assert not near[:2].any()


@pytest.mark.serial
def test_what_is_left_and_not_taken_up():
    left, none = np.array([1.0, 2.0, 3.0]), np.zeros(0)
    y = flux.Flux(none, none, none > 0, left, none)
    assert np.array_equal(y.unbalanced, left)
    y.taken_up = np.array([False, True, False])
    assert np.array_equal(y.unbalanced, [1.0, 0.0, 3.0])


@pytest.mark.serial
@pytest.mark.parametrize("reacts", [False, True])
def test_the_gap_on_sides(reacts):
    """g − g_F against the potentials of y and v; b‖v − u_h‖²_F, and what b takes up instead."""
    _, cells, _, edge, rng = on_sides(22)
    at, on, number = Points(cells), OnFacets(cells, edge.facets), cells.number
    kappa = random_kappa(rng, number)
    kappa.varies = True
    n, where = len(edge.loss), edge.facets.cells
    loss = np.array([0.0, 0.01, 0.02, 50.0, 60.0, 0.0])
    shed = rng.normal(size=n) * (loss > 0)
    edge = replace(edge, loss=loss, low=kappa.bounds.low)
    excess, w = rng.normal(size=(2, 3, number))
    _, made = made_up(cells, 23)
    variance = rng.uniform(size=number)
    rows = rng.uniform(size=(4, number))
    sums = Sums(*(row.copy() for row in rows))
    v = Companion(made.vertices, made.bumps, None, None, None, None, None)
    y = SimpleNamespace(excess=excess, beyond=None, shed=shed)
    load = SimpleNamespace(variance=variance)
    reaction = np.where(np.arange(number) % 2, 1e3, 0.1) if reacts else np.array(0.0)
    gap = duality.DualityGap(cells, kappa, w, load, y, v, reaction, reaction, sums)
    gap.add_edge(edge)
    assert sums.totals.loose == 0.0
    jump = on.affine(made.vertices[cells.vertices] - w) + on.bump(made.bumps)
    rest = np.sin(4 * on.x[..., 1]) - 0.3 + on.x[..., 0]
    rest -= (rest @ on.weights)[:, None]
    h = np.sqrt(cells.lengths.max(axis=0)[where])
    c = h / 3.8317059702
    strong = loss * on.length / at.area[where] * c * (c + h) > kappa.bounds.low[where]
    assert np.array_equal(strong, loss > 1.0)
    inverse = np.divide(1.0, loss, out=np.zeros(n), where=loss > 0)
    apart = loss * on.integral(jump**2)
    given = inverse * (np.where(strong, on.integral(rest**2), 0.0) + shed**2 / on.length)
    potential = 0.5 * excess.sum(axis=0)[where, None] * (on.x**2).sum(axis=2)
    potential -= np.einsum("in,nik,nqk->nq", excess[:, where], at.corners[where], on.x)
    potential /= (2 * at.area * kappa.mean)[where, None]
    of_p, of_b = (on.integral(rest * each) for each in (potential, jump))
    cell, sizes = edge.oscillation(False)
    square_ = sizes**2 / kappa.bounds.low[cell]
    norm = cells.lengths.max(axis=0) ** 0.5 / 3.8317059702 * np.sqrt(at.area * variance)
    if reacts:
        norm[at.area * variance * kappa.bounds.low < reaction * norm**2] = 0.0
        assert 0 < np.sum(norm[cell] == 0.0) < len(cell)
    more = (2 * norm[cell] * sizes + sizes**2) / kappa.bounds.low[cell]
    spread = np.maximum(
        1 / kappa.bounds.low - 1 / kappa.mean, 1 / kappa.mean - 1 / kappa.bounds.high
    )
    field = np.sqrt(at.integral((at.field(excess) ** 2).sum(axis=2)))
    slope = np.sqrt(at.integral((at.affine(w)[1] ** 2).sum(axis=2)))
    slack = sizes * (spread * (field + kappa.mean * slope))[cell]
    changes = np.zeros((4, number))
    for i, one in enumerate(where):
        changes[0, one] += apart[i] + given[i]
        changes[1, one] += apart[i] + given[i]
        changes[2, one] += 2 * (of_p[i] + of_b[i]) * (not strong[i])
        changes[3, one] += 2 * (of_p[i] - of_b[i]) * (not strong[i])
    changes[0, cell] += square_
    changes[2:, cell] += more + 2 * slack
    assert np.allclose(sums.indicators, rows[0] + changes[0], rtol=1e-5)
    assert np.allclose(sums.zeroth, changes[1], rtol=1e-5)
    assert np.allclose(sums.middle, rows[2] + changes[2], rtol=1e-5, atol=1e-5)
    assert np.allclose(sums.across, rows[3] + changes[3], rtol=1e-5, atol=1e-5)
    totals, own = sums.totals, loss @ on.integral(on.affine(w) ** 2) / 2
    expected = {
        "companion": apart.sum(),
        "load": given.sum() + more.sum(),
        "neumann": square_.sum(),
        "load_flux": of_p[~strong].sum(),
        "load_companion": of_b.sum() + shed @ (jump @ on.weights),
        "slack": slack.sum(),
        "energy": apart.sum() / 2 - own,
    }
    for name, value in expected.items():
        assert np.isclose(getattr(totals, name), value, rtol=1e-4), name
    assert np.isclose(totals.energy_slack, 1e-14 * own, atol=0.0)


@pytest.mark.serial
def test_rounding_of_the_bracket():
    """In parts of ∫ κ|∇v|² and of |J(v)|, whatever the sign of that."""
    total, ball = Totals(energy=-3.0, steepness=2.0), certificate._Ball(0.0, 0.0, 0.0, 0.0)
    low, high = certificate._bracket(total, ball, 0.0, 0.0)
    assert np.isclose(high - low, 1e-13, rtol=0.01, atol=0.0) and low < -3.0 < high


# ---- v to begin with, and what contact carries


@pytest.mark.serial
@pytest.mark.parametrize("kind", ["number", "cells", "masses"])
def test_values_at_vertices_to_begin_with(kind):
    """Least squares: what it costs to leave u_h on cells, by κ and c, and t/b on facets."""
    domain = square(3)
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    rng, none = np.random.default_rng(24), BoundaryFacets.joined([], 2)
    w, side, some = rng.normal(size=(3, cells.number)), cells.sides[3], kind == "masses"
    side = side if some else none
    loss, toward = rng.uniform(1, 9, len(side.cells)), rng.normal(size=(3, len(side.cells)))
    c = rng.uniform(0, 90, cells.number) if some else np.array(0.0)
    masses = Masses(some, c, side, loss, toward, loss > 5)
    kappa = np.array(2.0) if kind == "number" else rng.uniform(1, 3, cells.number)
    functional = Functional(cells, w, kappa, np.array(True), masses)
    u_D = SimpleNamespace(side=none, ends=np.zeros((2, 0)))
    floors = SimpleNamespace(
        side=none,
        signs=np.zeros(0),
        at_vertices=(),
        facets=len(cells.exterior),
        kinked=np.zeros(0, dtype=bool),
    )
    y = SimpleNamespace(touching=np.zeros(0, dtype=bool), contact=np.zeros(0))
    found, _ = _at_vertices(functional, u_D, floors, y, False)
    rows, right = [], []
    weight = np.sqrt(kappa + c * cells.volume) * np.ones(cells.number)
    for cell in range(cells.number):
        for i in range(3):
            rows.append(weight[cell] * np.eye(len(found))[cells.vertices[i, cell]])
            right.append(weight[cell] * w[i, cell])
    for i, (cell, local) in enumerate(zip(side.cells, side.local, strict=True)):
        for end, to in zip([j for j in range(3) if j != local], toward[:2, i], strict=True):
            rows.append(np.sqrt(loss[i]) * np.eye(len(found))[cells.vertices[end, cell]])
            right.append(np.sqrt(loss[i]) * (w[end, cell] + to))
    assert np.allclose(found, np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0])


@pytest.mark.serial
def test_what_bounds_ask_of_v():
    """v is nowhere below the quadratic through α's three values, or not at the middle, and no more.

    The latter is so where v is drawn to t/b, and at kinks.
    """
    problem = Problem(f=1.0, obstacle=lambda x: ufl.sin(x[0] / 2))
    level = solve(problem, square(3)).level
    data = diffusion(level.data)
    cells, rng = data.cells, np.random.default_rng(33)
    bounds = OnParts.of(data.alpha, cells)
    side, strong = bounds.side, np.array([True, False, True])
    masses = Masses(True, np.array(0.0), side, np.ones(3), np.zeros((3, 3)), strong)
    floors = Floors.of(cells, bounds, masses)
    assert np.array_equal(floors.at_middle, strong) and not floors.kinked.any()
    assert floors.facets == len(cells.exterior)
    ((sign, limit),) = floors.at_vertices
    x = cells.domain.mesh.geometry.x
    nodes = cell_nodes(cells.domain.mesh)
    of_vertex = np.zeros(len(limit), dtype=int)
    of_vertex[cells.vertices] = nodes[: cells.number].T
    below = x[of_vertex, 1] < 1e-9
    assert sign == 1 and np.allclose(limit[below], np.sin(x[of_vertex, 0] / 2)[below])
    assert np.all(np.isneginf(limit[~below])) and below.sum() == 4
    v = np.where(below, limit, 0.0) + rng.uniform(size=len(limit))
    low, high = floors.heights(v)
    t = np.linspace(0, 1, 4001)
    for i, facet in enumerate(side.dofs):
        a, b = v[side.ends[:, i]]
        values = a * (1 - t) + b * t + 4 * t * (1 - t) * low[facet]
        (first, last), middle = bounds.ends[:, i], bounds.middle[i]
        bend = middle - (first + last) / 2
        above = values - (first * (1 - t) + last * t + 4 * t * (1 - t) * bend)
        assert np.isclose(above[2000] if strong[i] else above.min(), 0.0, atol=1e-6)
    others = np.delete(np.arange(floors.facets), side.dofs)
    assert np.all(np.isposinf(high)) and np.all(np.isneginf(low[others]))


@pytest.mark.serial
@pytest.mark.parametrize("place", [0.34, 0.4, 0.5, 0.6, 0.66])
@pytest.mark.parametrize("size", [1e-3, 1.0])
def test_kinks_are_seen(place, size):
    """Of an obstacle that is straight but for one, wherever in its facet this is."""
    problem = Problem(f=1.0, obstacle=lambda x: size * (2 + x[0] - abs(x[0] - place)))
    data = diffusion(solve(problem, square(3)).level.data)
    bounds = OnParts.of(data.alpha, data.cells)
    (part,) = bounds.parts
    there = np.abs(part.middle - part.ends.mean(axis=0)) > 1e-6 * size  # elsewhere it is straight
    assert np.array_equal(kinked(part), there) and there.sum() == 1


@pytest.mark.serial
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("c", [0.0, 0.5])
@pytest.mark.parametrize("sinks", [{}, {2: 7.0}])
def test_what_contact_carries(signed, c, sinks):
    """To facets with much of the force, cells with a c and sides with a b, by quadrature.

    Where no more than sizes are known, norms of the facets' own fields add up.
    """
    domain = square(3)
    V = fem.functionspace(domain.mesh, ("CR", 1))
    cells = Cells(domain, V, (), sinks)
    at, rng, side = Points(cells), np.random.default_rng(25), cells.sides[1]
    left, kappa = rng.uniform(1, 2, cells.number), rng.uniform(1, 3, cells.number)
    contact, touching = np.array([50.0, 60.0, 1.0]), np.array([True, True, True])
    y = SimpleNamespace(contact=contact, touching=touching)
    reaction = np.where(np.arange(cells.number) == 7, c, 0.0) if c else np.array(0.0)
    arguments = (kappa, side, reaction, signed)
    norm, change = flux.carried_to_contact(cells, y, left, *arguments)

    def norms(fluxes):
        return np.sqrt(at.integral((at.field(fluxes) ** 2).sum(axis=2)))

    def by_way(parts, takers):
        exits = [side.dofs[:2], *(cells.sides[part].dofs for part in parts)]
        fluxes, _ = flux._carry(cells, left, cells.layered(exits, takers), int(takers.sum()))
        inside = ~takers
        assert np.allclose(fluxes.sum(axis=0)[inside], -left[inside])
        units = [norms(np.outer(unit, np.ones(cells.number))) for unit in np.eye(3)]
        of_field = norms(fluxes) if signed else (np.abs(fluxes) * units).sum(axis=0)
        expected = np.sum(of_field**2 / kappa)
        for part in parts:
            on = OnFacets(cells, cells.sides[part])
            out = fluxes[cells.sides[part].local, cells.sides[part].cells]
            expected += np.sum(out**2 / (sinks[part] * on.length))
        if takers.any():
            kept = left[7] + fluxes[:, 7].sum()
            expected += kept**2 / (c * at.area[7])
        return expected, np.abs(fluxes[side.local, side.cells])[:2]

    takers = np.broadcast_to(reaction > 0, cells.number)
    by_all, by_contact = by_way(sinks, takers), by_way({}, np.zeros_like(takers))
    expected, through = by_all if by_all[0] <= by_contact[0] else by_contact
    assert np.isclose(norm, np.sqrt(expected))
    assert np.allclose(change[:2], through) and change[2] == 0.0
    if not c and not sinks:
        assert np.isclose(change.sum(), left.sum())
    # forces that are not enough, and what is not in contact
    y.contact = 1e-3 * contact
    assert np.isposinf(flux.carried_to_contact(cells, y, left, *arguments)[0])
    y.contact, y.touching = contact, ~touching
    norm, change = flux.carried_to_contact(cells, y, left, *arguments)
    assert not change.any() and np.isfinite(norm) == bool(c or sinks)


@pytest.mark.serial
def test_each_facets_force_must_carry_its_share():
    """What is left of the equation and what quadrature has missed, together, on each for itself."""
    domain = square(3)
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), ())
    rng, side, none = np.random.default_rng(26), cells.sides[1], np.array(0.0)
    by_facet = np.where(cells.facets == side.dofs[0], 20.0, 1.0).max(axis=0)  # else it has little
    left, missed = by_facet * rng.uniform(1, 2, cells.number), rng.uniform(0.5, 1, cells.number)
    kappa = rng.uniform(1, 3, cells.number)
    y = SimpleNamespace(contact=np.array([99.0, 99.0, 0.0]), touching=np.ones(3, bool))
    y.unbalanced = left
    parts = [
        flux.carried_to_contact(cells, y, amounts, kappa, side, none, signed)
        for amounts, signed in ((left, True), (missed, False))
    ]
    norm, change = (sum(rows) for rows in zip(*parts, strict=True))
    assert change[:2].min() > 5.0 and change[2] == 0.0
    of_kappa = SimpleNamespace(eigenvalues=SimpleNamespace(low=kappa))
    for factors, enough in (((1.01, 1.01), True), ((0.99, 1.01), False), ((1.01, 0.99), False)):
        y.contact = np.append(factors * change[:2], 0.0)
        found = certificate._carried_to_contact(cells, of_kappa, none, y, side, missed)
        assert np.isclose(found, norm if enough else np.inf)
        assert np.allclose(y.carried, change)


@pytest.mark.serial
def test_what_cells_with_a_reaction_carry():
    """‖κ^{-1/2} q‖ and what c takes up of what arrives; ∞ where nothing takes it."""
    domain = square(3)
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), ())
    at, rng = Points(cells), np.random.default_rng(29)
    left, kappa = rng.normal(size=cells.number), rng.uniform(1, 3, cells.number)
    reaction = np.where(np.isin(np.arange(cells.number), [7, 11]), 0.3, 0.0)
    found = flux._carried(cells, left, kappa, 0.0, reaction)
    fluxes, _ = flux._carry(cells, left, cells.layered([], reaction > 0), 2)
    squares = at.integral((at.field(fluxes) ** 2).sum(axis=2)) / kappa
    arrived = (left + fluxes.sum(axis=0))[[7, 11]]
    assert np.isclose(arrived.sum(), left.sum())
    expected = squares.sum() + np.sum(arrived**2 / (0.3 * at.area[[7, 11]]))
    assert np.isclose(found, np.sqrt(expected))
    assert np.isposinf(flux._carried(cells, left, kappa, 0.0, 0 * reaction))
    assert np.isposinf(flux._carried(cells, left, kappa, 0.0, np.array(0.3)))


@pytest.mark.serial
@pytest.mark.parametrize("kappa", [0.1, 1.0, 10.0])
def test_a_reaction_that_is_strong(kappa):
    """y need not balance the load from c h² = 3 κ on."""
    domain = square(3)
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    side, number = cells.sides[1], cells.number
    none, nothing = BoundaryFacets.joined([], 2), np.zeros(0)
    edge = Known(none, np.zeros((2, 0)), nothing, nothing > 0)
    for part, strong in ((0.99, False), (1.01, True)):
        c = np.array(part * 3 * kappa / cells.lengths.max())
        force_ = np.zeros(len(side.cells))
        y = flux.Flux(np.ones((3, number)), force_, force_ > 0, np.ones(number), None)
        found = flux.relax(cells, np.array(kappa), y, c, edge, side, force_ + 1.0)
        assert (found is not None) == strong == (not np.all(y.excess == 1.0))


@pytest.mark.serial
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("some", [False, True])
def test_forces_take_up_what_a_flux_is_bettered_by(sign, some):
    """No flux through a facet in contact could be better, and none changes next to cells with no c.

    Where a force would change its sign there is none, and b takes up what it does elsewhere.
    """
    domain = square(3)
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), (DIRICHLET,))
    at, rng, side = Points(cells), np.random.default_rng(30), cells.sides[1]
    number, kappa = cells.number, rng.uniform(1, 2, cells.number)
    c = np.full(number, 300.0)
    if some:
        c[[side.cells[2], 4]] = 0.0
    edge = Known(side, np.zeros((2, 3)), np.full(3, 9.0), np.ones(3, dtype=bool))
    touching = np.array([True, True, False])
    excess, left = rng.normal(size=(3, number)), rng.normal(size=number)
    excess[side.local[0], side.cells[0]] = 9.0 * sign
    excess[side.local[1], side.cells[1]] = -9.0 * sign
    length = OnFacets(cells, side).length
    for before, pulls in (
        (np.array([90.0, 80.0, 0.0]), False),
        (np.array([1e-3, 1e-3, 0.0]), True),
    ):
        y = flux.Flux(excess.copy(), before.copy(), touching, left.copy(), None)
        taken = flux.relax(cells, kappa, y, c, edge, side, np.full(3, sign))
        assert np.array_equal(taken, c > 0)
        change = y.excess - excess
        assert np.allclose(y.left, left + change.sum(axis=0))
        assert np.allclose(cells.over_facets(change)[~cells.exterior], 0.0)
        assert not np.any(change[:, c == 0]) or not some
        assert np.all(y.contact >= 0.0) and y.contact[1] > 0.0 and (y.contact[0] == 0.0) == pulls
        own = change[side.local, side.cells]
        assert np.allclose(own, sign * (y.contact - before) - y.shed)
        # b takes up what goes through facets without a force
        by_b = np.array([pulls, False, not some])
        assert np.all(np.abs(y.shed[by_b]) > 1e-4) and np.allclose(y.shed[~by_b], 0.0)

        def total(step, y=y, by_b=by_b):
            squares = at.integral((at.field(y.excess + step) ** 2).sum(axis=2)) / kappa
            rest = (y.left + step.sum(axis=0))[c > 0]
            lost = (y.shed - step[side.local, side.cells])[by_b]
            of_c = np.sum(rest**2 / (300.0 * at.area[c > 0]))
            return squares.sum() + of_c + np.sum(lost**2 / (9.0 * length[by_b]))

        least = total(np.zeros_like(excess))
        for i in range(2 if some else 3):
            for step in (1e-2, -1e-2):
                moved = np.zeros_like(excess)
                moved[side.local[i], side.cells[i]] = step
                assert total(moved) > least


@pytest.mark.serial
def test_forces_that_would_pull_once_others_are_let_go():
    """They are 0 as well, with nothing left to b: Γ1 all around, touched from either side."""
    domain = square(2)
    cells = Cells(domain, fem.functionspace(domain.mesh, ("CR", 1)), ())
    side, number = BoundaryFacets.joined(list(cells.sides.values()), 2), cells.number
    edge = Known(side, np.zeros((2, 8)), np.full(8, 9.0), np.ones(8, dtype=bool))
    touching, c, late = np.ones(8, dtype=bool), np.full(number, 3000.0), 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        excess, left = rng.normal(size=(3, number)), rng.normal(size=number)
        before, signs = rng.uniform(0, 1, 8), rng.choice([-1.0, 1.0], 8)
        y = flux.Flux(excess.copy(), before.copy(), touching, left.copy(), None)
        flux.relax(cells, np.ones(number), y, c, edge, side, signs)
        change = y.excess - excess
        own = change[side.local, side.cells]
        assert np.all(y.contact >= 0.0)
        assert np.allclose(own, signs * (y.contact - before) - y.shed)
        assert np.allclose(y.left, left + change.sum(axis=0))
        late += np.sum((y.contact == 0.0) & (y.shed == 0.0))
    assert late > 0


@pytest.mark.serial
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("curved", [False, True])
def test_how_far_v_is_off_its_bounds(sign, curved):
    """Not further than at any of many points, and nearly as far; a bound with no range says so."""
    level, cells, _, _, rng = on_sides(27)
    data, side = diffusion(level.data), cells.sides[1]
    x = data.forms.x
    bound = ufl.sin(3 * x[0]) - 0.4 if curved else ufl.as_ufl(-0.4)
    trace = data.compiled.trace(bound)
    vertices = rng.normal(size=cells.vertices.max() + 1) + 0.5 * sign
    bumps, thirds = rng.normal(size=(2, len(cells.exterior)))
    part = SimpleNamespace(trace=trace, sign=sign, side=lambda _: side)
    t = np.linspace(0, 1, 2001)
    nodes = cell_nodes(cells.domain.mesh)[side.cells]
    (first, last) = (
        cells.domain.mesh.geometry.x[nodes[np.arange(3), end], 0]
        for end in np.array([[j for j in range(3) if j != i] for i in side.local]).T
    )
    at = first[:, None] * (1 - t) + last[:, None] * t
    a, b = vertices[side.ends][:, :, None]
    ways = np.where(side.ends[0] < side.ends[1], 1.0, -1.0)[:, None]
    v = a * (1 - t) + b * t + 4 * t * (1 - t) * bumps[side.dofs, None]
    cubic = ways * t * (1 - t) * (1 - 2 * t) * thirds[side.dofs, None]
    alpha = np.sin(3 * at) - 0.4 if curved else -0.4
    for heights, more in ((None, 0.0), (thirds, cubic)):
        parts = SimpleNamespace(parts=[part, part] if heights is None else [part])
        found = gaps(cells, parts, vertices, bumps, heights).reshape(-1, 3)
        # bounds of either sign are given as those of s v
        above = sign * (v + more) - alpha
        most = 4 * np.abs(bumps) + (0 if heights is None else 3 * np.abs(thirds))
        # what second derivatives do, or for a curve what it does in a quarter of a facet
        rise = np.abs(np.diff(above)).max(axis=1) * 2000 / 4
        limit = rise if curved else most[side.dofs] / 64
        truth = above.min(axis=1)
        assert np.all(found <= truth + 1e-12) and np.all(truth - found <= limit + 1e-5)
        assert len(found) == len(parts.parts)
    part.trace = data.compiled.trace(1.0 + ufl.bessel_J(1, x[0]))
    assert np.all(np.isneginf(gaps(cells, parts, vertices, bumps, None)))


@pytest.mark.serial
@pytest.mark.parametrize("off", [0.0, 1e-3, -1e-3])
def test_tetrahedra_ask_for_data_that_v_is_not_below(off):
    mesh = create_box(MPI.COMM_SELF, [(0, 0, 0), (1, 1, 1)], (2, 2, 1))
    mesh.topology.create_connectivity(2, 3)
    facets = exterior_facet_indices(mesh.topology)
    parts = np.where(compute_midpoints(mesh, 2, facets)[:, 2] < 1e-9, 1, 2).astype(np.int32)
    domain = Domain.from_tags(mesh, meshtags(mesh, 2, facets, parts))
    # the other branch is nowhere on the mesh
    rise = lambda x: ufl.conditional(ufl.lt(x[0], 1.5), x[0] - 2 * x[1] - 9, 5.0)  # noqa: E731
    data = Diffusion(Problem(f=1.0, obstacle=rise), mesh)
    level = Level((NestedMesh(data, domain),))
    data = diffusion(level.data)
    alpha = data.alpha[0].seen_from(data.cells)
    v = alpha.ends.copy()
    v[1, 2] += off
    found = affine(data.cells, alpha.side(data.cells), alpha.trace, v, alpha.ends, 9.0)
    assert (found.reason is None) == (off >= 0.0)
    x = mesh.geometry.x[:, :2][cell_nodes(mesh)[alpha.side(data.cells).cells]]
    on_facet = np.array([[j for j in range(4) if j != i] for i in alpha.side(data.cells).local])
    middle = np.take_along_axis(x, on_facet[:, :, None], axis=1).mean(axis=1)
    assert np.allclose(found.least, middle @ [1, -2] - 9)
