"""Every figure of a certificate, integrated anew from its flux and its companion."""

import time
from dataclasses import replace
from types import SimpleNamespace

import basix
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from dolfinx.mesh import (
    compute_midpoints,
    create_box,
    create_unit_cube,
    exterior_facet_indices,
    meshtags,
)
from helpers import HELD_ALL_ROUND, SQUARE
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    InputError,
    Neumann,
    Polygon,
    Problem,
    Robin,
    solve,
    solve_levels,
)
from signorini_cr.compat import cell_nodes
from signorini_cr.data.diffusion import diffusion
from signorini_cr.diffusion import Diffusion
from signorini_cr.estimate import certificate as module
from signorini_cr.estimate import cusps
from signorini_cr.estimate.certificate import certify
from signorini_cr.estimate.force import force_interval, indicator, made_of
from signorini_cr.force import force_bounds
from signorini_cr.means import mean
from signorini_cr.mesh.families import structured
from signorini_cr.multigrid.hierarchy import NestedMesh
from signorini_cr.vi.level import Level

WORLD = MPI.COMM_WORLD
CONTACT, DIRICHLET, NEUMANN = 1, 2, 3


class Pointwise:
    """Values and gradients of functions at the points of a rule in each owned cell."""

    def __init__(self, mesh):
        self.mesh, d = mesh, mesh.topology.dim
        self.number = mesh.topology.index_map(d).size_local
        self.corners = mesh.geometry.x[cell_nodes(mesh)[: self.number], :d]
        edges = self.corners[:, 1:] - self.corners[:, :1]
        self.volume = np.abs(np.linalg.det(edges)) / (2 if d == 2 else 6)
        inverse = np.linalg.inv(edges)  # [:, i, k]: derivative of ξ_k by x_i
        self.gradients = np.concatenate([-inverse.sum(axis=2)[:, :, None], inverse], axis=2)
        i, j = np.triu_indices(d + 1, 1)
        self.h = np.linalg.norm(self.corners[:, i] - self.corners[:, j], axis=2).max(axis=1)
        self.inverse = inverse

    def points(self, reference):
        hats = np.column_stack([1 - reference.sum(axis=1), reference])
        return np.einsum("pi,nik->knp", hats, self.corners)

    def field(self, function):
        """A function's dofs in each cell, and their element; collective."""
        shape = function.ufl_shape
        W = fem.functionspace(self.mesh, ("DG", 2 if shape else 3, shape))
        broken = fem.Function(W)
        broken.interpolate(function)
        local = broken.x.array.reshape(-1, *(shape or (1,)))[W.dofmap.list[: self.number]]
        return W.element.basix_element, local

    def __call__(self, field, reference, which=slice(None)):
        """Values, shape (n, p, values), and gradients, shape (n, p, d, values)."""
        element, local = field
        table = element.tabulate(1, reference)[..., 0]
        values = np.einsum("pa,nab->npb", table[0], local[which])
        slopes = np.einsum("nik,kpa,nab->npib", self.inverse[which], table[1:], local[which])
        return values, slopes

    def facets(self, domain, part):
        """Cells and local numbers of the owned cells' facets."""
        d = self.mesh.topology.dim
        self.mesh.topology.create_connectivity(d - 1, d)
        to_cells = self.mesh.topology.connectivity(d - 1, d)
        to_facets = self.mesh.topology.connectivity(d, d - 1)
        found = [(to_cells.links(facet)[0], facet) for facet in domain.tags.find(part)]
        own = [(cell, facet) for cell, facet in found if cell < self.number]
        return [(cell, to_facets.links(cell).tolist().index(facet)) for cell, facet in own]


def smallest_curl(gradients, local, reference, weights):
    """Root of the mean of |∇ψ|², ψ = λ_j λ_k (1 + β λ_i) with the best β, i the local vertex."""
    hats = np.column_stack([1 - reference.sum(axis=1), reference])
    i, (j, k) = local, [one for one in range(3) if one != local]
    a, b, c = (hats[:, [one]] for one in (i, j, k))
    by_a, by_b, by_c = gradients.T[[i, j, k]]
    bump = c * by_b + b * by_c
    bubble = a * bump + b * c * by_a
    squares = [
        weights @ (p * q).sum(axis=1) for p, q in ((bump,) * 2, (bump, bubble), (bubble,) * 2)
    ]
    return np.sqrt(squares[0] - squares[1] ** 2 / squares[2])


def figures(solution, certificate, f, g=None, kappa=1.0, obstacle=0.0, carried=False, phi=None):
    """Compute the certificate's figures where f and g are affine and κ is constant on the cells.

    Each cell has at most one facet on Γg. With `carried` the flux balances all of f and g. Where κ
    varies within cells they are least values. The force is bounded with the weight φ.
    """
    mesh = solution.domain.mesh
    at, d = Pointwise(mesh), mesh.topology.dim
    reference, weights = basix.make_quadrature(
        getattr(basix.CellType, mesh.topology.cell_name()), 8
    )
    weights = weights / weights.sum()
    fields = [at.field(one) for one in (solution.u, certificate.flux, certificate.companion)]

    def integral(values):
        return at.volume * (values @ weights)

    def data(one, x):
        return one(x) if callable(one) else np.full(x.shape[1:], float(one))

    x = at.points(reference)
    K = data(kappa, x)
    k = K.mean(axis=1)
    (_, du), (y, dy), (_, dv) = (at(one, reference) for one in fields)
    u, v = (at(one, reference)[0][..., 0] for one in (fields[0], fields[2]))
    p, b = y - K[..., None] * du[..., 0], K[..., None] * (dv - du)[..., 0]
    rest = data(f, x)
    rest = rest - (rest @ weights)[:, None]
    # y − κ∇u_h = slope x + steady is the gradient of a quadratic, up to what y has beyond
    slope = dy.trace(axis1=2, axis2=3)[:, 0] / d
    apart = y - k[:, None, None] * du[..., 0]
    steady = apart[:, 0] - slope[:, None] * np.moveaxis(x, 0, -1)[:, 0]

    divergence = dy.trace(axis1=2, axis2=3) @ weights
    assert np.allclose(divergence, -data(f, x) @ weights, rtol=1e-6, atol=1e-6)

    def potential(cells, x):
        square = 0.5 * slope[cells] * (x**2).sum(axis=0)
        return square + np.einsum("ni,inp->np", steady[cells[:, 0]], x)

    everywhere = np.arange(at.number)[:, None]
    poincare = 1 / 3.8317059702 if d == 2 else 1 / np.pi
    pp, bb, pb = (integral((s * t).sum(axis=2) / K) for s, t in ((p, p), (b, b), (p, b)))
    of_f = poincare * at.h * np.sqrt(integral(rest**2))
    of_flux = integral(rest * potential(everywhere, x)) / k
    of_companion = integral(rest * (v - u))
    energy = integral(K * (dv**2).sum(axis=(2, 3)) / 2 - data(f, x) * v)
    on_edge, contact, force = np.zeros((3, at.number))
    if phi is not None:
        phi = at.field(phi)
        weight, slopes = (one[..., 0] for one in at(phi, reference))
        force = 0.5 * integral(((b - p) * slopes).sum(axis=2) - rest * weight)
        steep = integral(K * (slopes**2).sum(axis=2))
    points, facet_weights = basix.make_quadrature(
        basix.CellType.interval if d == 2 else basix.CellType.triangle, 8
    )
    facet_weights = facet_weights / facet_weights.sum()
    for part in (NEUMANN, CONTACT):
        for cell, local in at.facets(solution.domain, part):
            hats = np.column_stack([1 - points.sum(axis=1), points])
            hats = np.insert(hats, local, 0.0, axis=1)[:, 1:]
            normal = -at.gradients[cell, :, local]
            measure = d * at.volume[cell] * np.linalg.norm(normal)
            normal = normal / np.linalg.norm(normal)
            where = at.points(hats)[:, cell][:, None]
            (u_F,), (y_F,), (v_F,) = (at(one, hats, [cell])[0] for one in fields)
            if part == CONTACT:
                assert facet_weights @ (y_F @ normal) > -1e-9
                above = v_F[:, 0] - data(obstacle, where)[0]
                contact[cell] += measure * facet_weights @ ((y_F @ normal) * above)
                force[cell] += measure * facet_weights @ (y_F @ normal)
            elif g is not None:
                values = data(g, where)[0]
                assert np.isclose(facet_weights @ (y_F @ normal - values), 0.0, atol=1e-6)
                off = values - facet_weights @ values
                c = poincare * at.h[cell]
                c = np.sqrt(measure / at.volume[cell] * c * (c + 2 * at.h[cell] / d))
                on_edge[cell] = c * np.sqrt(measure * facet_weights @ off**2)
                if d == 2:  # g is affine: the curl of a cubic has its flux
                    small = smallest_curl(at.gradients[cell], local, reference, weights)
                    small *= np.sqrt(3.0 * at.volume[cell] * facet_weights @ off**2) * measure
                    on_edge[cell] = min(on_edge[cell], small)
                rise = potential(np.array([[cell]]), where)[0] / k[cell]
                of_flux[cell] += measure * facet_weights @ (off * rise)
                change = measure * facet_weights @ (off * (v_F - u_F)[:, 0])
                of_companion[cell] += change if d == 2 else 0.0
                if phi is not None:
                    weight_F = at(phi, hats, [cell])[0][0, :, 0]
                    force[cell] -= 0.5 * measure * facet_weights @ (off * weight_F)
                energy[cell] -= measure * facet_weights @ (values * v_F[:, 0])
    loose, load = 0.0, (of_f + on_edge) ** 2 / k
    if carried:
        load = of_f = on_edge = of_flux = of_companion = np.zeros(at.number)
    if d == 3:  # by Cauchy and Schwarz, and g for itself
        load, of_flux = of_f**2 / k, of_f * np.sqrt(pp / k)
        loose = np.sqrt(WORLD.allreduce(np.sum(on_edge**2 / k)))
    spread = np.maximum(1 / K.min(axis=1) - 1 / k, 1 / k - 1 / K.max(axis=1))
    lengths = [np.sqrt(integral((field**2).sum(axis=2))) for field in (apart, du[..., 0])]
    of_flux = of_flux + (of_f + on_edge) * spread * (lengths[0] + k * lengths[1])
    far = pp + bb + load + 2 * of_flux - 2 * (pb + of_companion)
    near = pp + bb + load + 2 * of_flux + 2 * (pb + of_companion)
    total = dict(far=far, near=near, contact=contact, pp=pp, bb=bb, load=load, energy=energy)
    total |= dict(neumann=on_edge**2 / k, of_gradients=near / K.min(axis=1), force=force)
    total |= dict(steepness=integral(K * (dv**2).sum(axis=(2, 3))))
    if phi is not None:
        total |= dict(steep=steep)
    total = {name: WORLD.allreduce(values.sum()) for name, values in total.items()}
    far, near = np.sqrt(total["far"]) + loose, np.sqrt(total["near"])
    radius = loose / 2 + np.sqrt(far**2 / 4 + total["contact"])
    least = WORLD.allreduce(K.min(initial=np.inf), op=MPI.MIN)
    bound = near / 2 + radius
    of_gradients = np.sqrt(total["of_gradients"]) / 2 + radius / np.sqrt(least)
    return SimpleNamespace(
        bound=bound,
        bound_h1=min(of_gradients, bound / np.sqrt(least)),
        bound_companion=far / 2 + np.sqrt(far**2 / 4 + total["contact"]),
        energy=(total["energy"] - far**2 / 2 - total["contact"], total["energy"]),
        parts={
            "flux": np.sqrt(total["pp"]),
            "companion": np.sqrt(total["bb"]),
            "contact": np.sqrt(max(total["contact"], 0.0)),
            "load": np.sqrt(total["load"]),
            "neumann": np.sqrt(total["neumann"]),
            "boundary": 0.0,
        },
        indicators=pp + bb + of_f**2 / k + on_edge**2 / k + contact,
        total=total,
        least=least,
        force=total["force"],
        reach=(radius + loose) * np.sqrt(total.get("steep", 0.0)),
    )


def agrees(certificate, found, rtol=1e-7):
    """All of the certificate is what was found, up to what the solver left."""
    assert certificate.reason is None
    assert certificate.parts["solver"] < 1e-7 * certificate.bound_energy_norm
    assert np.isclose(certificate.bound_energy_norm, found.bound, rtol=rtol)
    assert np.isclose(certificate.bound_h1, found.bound_h1, rtol=rtol)
    assert np.isclose(certificate.bound_companion, found.bound_companion, rtol=rtol)
    assert np.allclose(certificate.energy, found.energy, rtol=rtol)
    for name, value in found.parts.items():
        assert np.isclose(certificate.parts[name], value, rtol=rtol, atol=1e-6), name
    assert np.allclose(certificate.indicators, found.indicators, rtol=rtol, atol=1e-12)


# Γ1 is below, Γg on the right of the unit square; the load is carried by Γ1 on the left


def load(x):
    return -25 + 40 * x[0] - 10 * x[1]


def flow(x):
    return 0.4 - 3 * x[1]


def given(x):
    return 0.1 + 0.2 * x[0] - 0.1 * x[0] * x[1]


def bowl(x):
    return 0.1 * x[0] ** 2 - 0.05


def left(x):
    return ufl.conditional(ufl.lt(x[0], 0.5), 7.0, 0.5)


def left_by_numpy(x):
    return np.where(x[0] < 0.5, 7.0, 0.5)


def square(n=4, jitter=0.2, comm=WORLD):
    polygon = Polygon(SQUARE.vertices, ("contact", "neumann", "dirichlet", "dirichlet"))
    return structured(polygon, n, comm, jitter=jitter)


def again(solution, certificate, kappa=1.0, f=load, g=flow, obstacle=bowl, **more):
    kappa = left_by_numpy if kappa is left else kappa
    return figures(solution, certificate, f, g, kappa, obstacle, **more)


@pytest.mark.parametrize(
    "kappa, jitter", [(1.0, 0.2), (0.4, 0.2), (left, 0.0)], ids=["one", "constant", "jump"]
)
def test_affine_data(kappa, jitter):
    heavy = lambda x: 6 * load(x)  # noqa: E731
    problem = Problem(f=heavy, g=flow, dirichlet=given, obstacle=bowl, coefficient=kappa)
    *_, solution = solve_levels(problem, square(2, jitter), 2)
    began = time.perf_counter()
    certificate = certify(solution)
    assert 0.0 < certificate.seconds <= time.perf_counter() - began
    found = again(solution, certificate, kappa, heavy)
    agrees(certificate, found)
    assert found.parts["contact"] > 0.01


def test_a_constant_load():
    solution = solve(Problem(f=-12.0, obstacle=bowl), square())
    certificate = certify(solution)
    found = again(solution, certificate, f=-12.0, g=0.0)
    agrees(certificate, found)
    assert found.parts["contact"] > 0.05


@pytest.mark.parametrize("sweeps", [0, 5])
def test_other_companions(sweeps):
    problem = Problem(f=load, g=flow, dirichlet=given, obstacle=bowl)
    solution = solve(problem, square())
    certificate = certify(solution, sweeps)
    agrees(certificate, again(solution, certificate))


def test_conforming_solution():
    heavy = lambda x: 6 * load(x)  # noqa: E731
    problem = Problem(f=heavy, g=flow, dirichlet=given, obstacle=bowl, coefficient=left)
    domain = square(jitter=0.0)
    solution = solve(problem, domain, "P1")
    certificate = certify(solution, flux_from=solve(problem, domain))
    agrees(certificate, again(solution, certificate, left, heavy))


def sheared(n):
    domain = square(n, 0.0)
    domain.mesh.geometry.x[:, 0] += 50 * domain.mesh.geometry.x[:, 1]
    return domain


def test_thin_cells(monkeypatch):
    """f and g are carried as a whole."""
    monkeypatch.setattr(cusps, "HOLDS", np.inf)
    data = {"f": lambda x: 1 + x[0] / 25 - 2 * x[1], "g": lambda x: 0.3 + x[1] / 4}
    solution = solve(Problem(**data, obstacle=-0.001, coefficient=2.0), sheared(8))
    certificate = certify(solution)
    assert certificate.made.beyond is not None and certificate.made.cusps is None
    found = again(solution, certificate, 2.0, *data.values(), -0.001, carried=True)
    agrees(certificate, found, 1e-6)
    # No bump of ω that is free could bring y nearer to the middle
    mesh, u = solution.domain.mesh, solution.u
    W = fem.functionspace(mesh, ("Lagrange", 2))
    curl = ufl.as_vector([(by := ufl.grad(ufl.TestFunction(W)))[1], -by[0]])
    off = certificate.flux - ufl.grad(u + certificate.companion)  # half of κ = 2
    pull = fem.assemble_vector(fem.form(ufl.inner(off, curl) * ufl.dx))
    pull.scatter_reverse(InsertMode.add)
    held = fem.Function(W)
    for dim in (0, 1):  # ω is 0 at vertices, and given on Γ1 and Γg
        mesh.topology.create_connectivity(dim, 2)
        found = [solution.domain.tags.find(part) for part in (CONTACT, NEUMANN)]
        vertices = np.arange(mesh.topology.index_map(0).size_local, dtype=np.int32)
        entities = np.concatenate(found) if dim else vertices
        held.x.array[fem.locate_dofs_topological(W, dim, entities)] = 1.0
    held.x.scatter_reverse(InsertMode.add)
    owned = slice(W.dofmap.index_map.size_local)
    pull, free = np.abs(pull.array[owned]), held.x.array[owned] == 0.0
    largest, scale = (
        WORLD.allreduce(values.max(initial=0.0), op=MPI.MAX) for values in (pull[free], pull)
    )
    assert largest < 1e-6 * scale


def test_data_that_are_not_affine_on_thin_cells(monkeypatch):
    """What f and g have beyond affine functions is bounded, and is little."""
    monkeypatch.setattr(cusps, "HOLDS", np.inf)
    data = {
        "f": lambda x: 1 + x[0] / 25 - 2 * x[1] + x[1] ** 2,
        "g": lambda x: 0.3 + x[1] ** 2 / 4,
    }
    solution = solve(Problem(**data, obstacle=-0.001, coefficient=2.0), sheared(8))
    certificate = certify(solution)
    assert certificate.made.thirds is not None
    found = again(solution, certificate, 2.0, *data.values(), -0.001, carried=True)
    assert found.bound < certificate.bound_energy_norm < 1.1 * found.bound
    (low, high), width = certificate.energy, np.ptp(found.energy)
    assert found.energy[1] <= high <= found.energy[1] + 1e-3 * width
    assert low <= found.energy[0] <= low + 0.2 * width


def test_a_cubic_solution_on_thin_cells(monkeypatch):
    """Its values on the boundary need no lifting."""
    monkeypatch.setattr(cusps, "HOLDS", np.inf)
    domain = structured(HELD_ALL_ROUND, 8)
    domain.mesh.geometry.x[:, 0] += 50 * domain.mesh.geometry.x[:, 1]
    f = lambda x: -6 * x[0] / 51**3 - 2 + 6 * x[1]  # noqa: E731
    u_D = lambda x: (x[0] / 51) ** 3 + x[1] ** 2 - x[1] ** 3  # noqa: E731
    solution = solve(Problem(f=f, dirichlet=u_D, obstacle=-9.0), domain)
    certificate = certify(solution)
    assert certificate.made.thirds is not None
    agrees(certificate, again(solution, certificate, 1.0, f, 0.0, -9.0, carried=True), 1e-6)


@pytest.mark.parametrize("f, g", [(-30.0, 0.0), (load, flow)], ids=["constant", "affine"])
def test_a_coefficient_that_varies(f, g):
    """What quadrature may miss is added, and is little."""
    kappa = lambda x: 2 + x[0] * x[1] / 5  # noqa: E731
    solution = solve(Problem(f=f, g=g, obstacle=bowl, coefficient=kappa), square(8))
    certificate = certify(solution)
    found = again(solution, certificate, kappa, f, g)
    for name in ("flux", "companion", "contact", "load", "neumann"):
        assert np.isclose(certificate.parts[name], found.parts[name], rtol=0.01, atol=1e-9)
    for name in ("bound_energy_norm", "bound_h1", "bound_companion"):
        value, low = getattr(certificate, name), getattr(found, name.replace("_energy_norm", ""))
        assert low <= value * (1 + 1e-9) and value <= 1.01 * low
    (low, high), width = certificate.energy, np.ptp(found.energy)
    assert found.energy[0] - 0.02 * width <= low <= found.energy[0]
    assert found.energy[1] <= high <= found.energy[1] + 0.02 * width


@pytest.mark.parametrize("noise", [1e-3, 0.1])
def test_what_a_solver_leaves_is_carried_away(noise):
    """Afterwards y balances the load as if it had been solved."""
    solution = solve(Problem(f=-12.0, obstacle=bowl), square(8))
    u, fixed = solution.u, solution.level.system.dirichlet
    rng = np.random.default_rng(2)
    change = noise * rng.standard_normal(u.function_space.dofmap.index_map.size_local)
    u.x.array[: len(change)] += change
    u.x.array[fixed] = 0.0
    u.x.scatter_forward()
    certificate = certify(solution)
    at, y = Pointwise(solution.domain.mesh), certificate.flux
    _, dy = at(at.field(y), np.full((1, 2), 1 / 3))
    assert np.allclose(dy[:, 0].trace(axis1=1, axis2=2), 12.0, atol=1e-9)
    found = again(solution, certificate, 1.0, -12.0, 0.0)
    assert np.isclose(certificate.bound_h1, found.bound_h1, rtol=1e-7)
    assert certificate.parts["solver"] > noise
    assert np.allclose(certificate.energy, found.energy, rtol=1e-7)


def test_what_a_coarse_rule_misses_of_the_load_is_carried_by_the_flux():
    """y has the means of f and g, whatever rule u_h was found with."""
    data = {"f": lambda x: 3 * x[0] ** 2 - x[1] ** 3, "g": lambda x: 5 * x[1] ** 4}
    solution = solve(Problem(**data, quadrature_degree=1), square())
    known = module._equilibrated(solution, solution)
    cells, flux, side = known.cells, known.flux, known.segments.side
    mean = known.certain.load.mean
    assert np.allclose(flux.left, flux.excess.sum(axis=0) + cells.volume * mean, atol=1e-12)
    through = flux.excess - 2 * cells.apply(known.w, slice(0, cells.number))
    (low, high) = (solution.domain.mesh.geometry.x[:, 1][i] for i in _nodes(cells, side))
    expected = np.abs(high**5 - low**5)
    assert np.allclose(through[side.local, side.cells], expected, rtol=1e-6)


def _nodes(cells, side):
    """The nodes at the ends of some facets."""
    nodes = cell_nodes(cells.domain.mesh)
    return nodes[side.cells[:, None], cells.others[side.local]].T


@pytest.mark.parametrize("kappa", [2.0, left])
def test_how_the_bound_is_put_together(kappa, monkeypatch):
    """With made-up shares of rounding, of liftings, of what is missed, of what a solver left."""
    left_over, rounding, hidden, hidden_energy = 0.07, 0.05, 0.03, 0.02
    lift, lift_energy, lift_far, lift_near = 0.01, 0.025, 0.035, 0.045
    share = 1.0 if WORLD.rank == 0 else 0.0
    made_up = {
        "unbalanced": left_over,
        "rebalance": 0.0,
        "_rounding": rounding,
        "_hidden": (hidden, hidden_energy),
        "_lifted": tuple(share * one for one in (lift, lift_energy, lift_far, lift_near)),
    }
    for name, value in made_up.items():
        monkeypatch.setattr(module, name, lambda *_, value=value: value)
    quadrature = {"far": 0.02, "near": 0.03, "slack": 0.04, "energy_slack": 0.015}
    integrate = module.integrate

    def unsure(*arguments):
        sums = integrate(*arguments)
        for name, value in quadrature.items():
            setattr(sums.totals, name, getattr(sums.totals, name) + share * value)
        return sums

    complete = module._complete

    def unknown_above(known, *others):
        """Double the upper bound of κ, which makes no difference to gradients."""
        bounds = known.kappa.bounds
        known.kappa.bounds = replace(bounds, high=2 * bounds.high)
        complete(known, *others)

    monkeypatch.setattr(module, "integrate", unsure)
    monkeypatch.setattr(module, "_complete", unknown_above)
    solution = solve(Problem(f=-12.0, obstacle=bowl, coefficient=kappa), square(4, 0.0))
    certificate = certify(solution)
    found = again(solution, certificate, kappa, -12.0, 0.0)
    total, least = found.total, found.least
    loose = left_over + hidden + rounding
    far = np.sqrt(total["far"] + lift_far + 0.02 + 2 * 0.04) + loose
    near = np.sqrt(total["near"] + lift_near + 0.03 + 2 * 0.04) + rounding
    rest = np.sqrt(far**2 / 4 + total["contact"])
    bound = near / 2 + loose / 2 + rest
    bound_h1 = np.sqrt(total["of_gradients"]) / 2
    bound_h1 += (rounding / 2 + loose / 2 + rest) / np.sqrt(least)
    assert np.isclose(certificate.bound_energy_norm, bound, rtol=1e-7)
    assert np.isclose(certificate.bound_h1, min(bound_h1, bound / np.sqrt(least)), rtol=1e-7)
    assert np.isclose(certificate.bound_companion, far / 2 + rest + np.sqrt(lift), rtol=1e-7)
    slack = lift_energy + hidden_energy + 0.015
    slack += rounding * (2 * np.sqrt(total["steepness"]) + rounding)
    low = total["energy"] - slack - far**2 / 2 - total["contact"]
    assert np.allclose(certificate.energy, (low, total["energy"] + slack), rtol=1e-7)
    for name, value in {"load": hidden, "boundary": np.sqrt(lift), "solver": left_over}.items():
        assert np.isclose(certificate.parts[name], value)
    reach = bound - near / 2 + loose + np.sqrt(lift) / 2
    made = certificate.made
    assert np.isclose(made.reach, reach, rtol=1e-7)
    assert np.isclose(made.loose_and_lift, loose + np.sqrt(lift), rtol=1e-7)
    # the ball's radius squared is what the two products on Γ1 and the distance from κ∇u add up to
    assert np.isclose(made.complementary, rest**2, rtol=1e-7)
    assert np.isclose(made.above, total["contact"], rtol=1e-7)
    assert np.isclose(made.missed, 0.0) and not made.on_contact_alone
    assert np.isclose(
        WORLD.allreduce(sum(made.forces.values())), WORLD.allreduce(made.contact.sum())
    )


def test_force():
    polygon = Polygon(
        [[0, 0], [1, 0], [1, 1], [0.5, 1.5], [0, 1]],
        ("contact", "neumann", "dirichlet", "dirichlet", "neumann"),
    )
    data = {"f": lambda x: -9 + 3 * x[0], "g": lambda x: 0.4 - x[1]}
    problem = Problem(**data, obstacle=bowl, coefficient=2.0)
    solution = solve(problem, polygon.mesh(0.12))
    certificate, made = solution.certificate, made_of(solution)
    of_contact = made, made.cells(), diffusion(solution.level.data).forms.bounded
    found = again(solution, certificate, 2.0, *data.values(), phi=indicator(*of_contact))
    agrees(certificate, found)
    _, low, high = force_interval(*of_contact)
    assert np.isclose((low + high) / 2, found.force, rtol=1e-6)
    assert np.isclose((high - low) / 2, found.reach, rtol=1e-6)
    # There is contact all along, and a dual solution tells more
    lower, upper = force_bounds(solution)
    assert low <= lower <= upper <= high and upper - lower < 0.4 * (high - low)
    # A cusp pulls at a cell's vertices: half of ∫ κ∇ψ·∇φ
    pull = SimpleNamespace(at=np.array([0]), pulls=lambda _: (np.full((3, 1), 0.02), None))
    object.__setattr__(certificate.made, "cusps", pull)
    phi = indicator(*of_contact)
    change = 0.01 * phi.x.array[phi.function_space.dofmap.list[0]].sum()
    middle = sum(force_interval(*of_contact)[1:]) / 2
    assert np.isclose(middle, found.force + WORLD.allreduce(change), rtol=1e-6)


@pytest.mark.serial
def test_tetrahedra():
    mesh = create_box(MPI.COMM_SELF, [(0, 0, 0), (1, 1, 1)], (2, 3, 2))
    mesh.topology.create_connectivity(2, 3)
    facets = exterior_facet_indices(mesh.topology)
    _, y, z = compute_midpoints(mesh, 2, facets).T
    parts = np.where(z < 1e-9, CONTACT, np.where(y > 1 - 1e-9, NEUMANN, DIRICHLET))
    domain = Domain.from_tags(mesh, meshtags(mesh, 2, facets, parts.astype(np.int32)))
    data = {"f": lambda x: 3 + x[0] - 9 * x[2], "g": lambda x: x[0] - 2 * x[2]}
    low, rim = lambda x: x[0] - x[1] - 9, lambda x: 0.1 + x[0] / 5 - x[2]
    problem = Problem(**data, dirichlet=rim, obstacle=low, coefficient=2.0)
    level = Level((NestedMesh(Diffusion(problem, mesh), domain),))
    u = fem.Function(level.V)
    u.x.array[:] = np.linalg.solve(level.system.A[:, :], level.system.b)
    solution = SimpleNamespace(level=level, u=u, element="CR", domain=domain)
    certificate = certify(solution)
    agrees(certificate, again(solution, certificate, 2.0, *data.values(), low))
    with pytest.raises(InputError, match="for d = 2 only"):
        force_bounds(SimpleNamespace(level=level, certificate=certificate))
    for curved in ({"dirichlet": lambda x: x[0] ** 2}, {"obstacle": lambda x: x[0] ** 2 - 9}):
        level = Level((NestedMesh(Diffusion(Problem(**data, **curved), mesh), domain),))
        solution.level, solution.u = level, fem.Function(level.V)
        assert "affine on the facets" in certify(solution).reason


@pytest.mark.serial
@pytest.mark.parametrize("c", [0.0, 30.0])
@pytest.mark.parametrize("cells", [2, 4])
def test_a_strong_loss_takes_up_what_quadrature_misses(cells, c):
    """Facets of tetrahedra are cut a few times only, where b u_ext is far from polynomials."""
    b, kappa = 1e9, 2.0
    mesh = create_unit_cube(MPI.COMM_SELF, cells, cells, cells)
    mesh.topology.create_connectivity(2, 3)
    x, _, z = compute_midpoints(mesh, 2, exterior_facet_indices(mesh.topology)).T
    parts = np.where(np.abs(x - 0.5) > 0.5 - 1e-9, 1, np.where(z > 1 - 1e-9, 2, 3))
    tags = meshtags(mesh, 2, exterior_facet_indices(mesh.topology), parts.astype(np.int32))
    domain = Domain.from_tags(mesh, tags, cold=1, lossy=2, rest=3)

    def exact(x):
        return ufl.sin(np.pi * x[0]) * ufl.exp(x[1]) * ufl.cos(1.3 * x[2] + 0.2 * x[1])

    conditions = {"cold": Dirichlet(0.0), "lossy": Robin(coefficient=b), "rest": Neumann()}
    problem = Problem(exact=exact, coefficient=kappa, reaction=c, conditions=conditions)
    level = Level((NestedMesh(Diffusion(problem, mesh, parts=domain.parts), domain),))
    u_h = fem.Function(level.V)
    u_h.x.array[:] = np.linalg.solve(level.system.A[:, :], level.system.b)
    certificate = certify(SimpleNamespace(level=level, u=u_h, element="CR", domain=domain))

    u, n, on = exact(ufl.SpatialCoordinate(mesh)), ufl.FacetNormal(mesh), {"quadrature_degree": 10}
    dx, ds = ufl.dx(mesh, metadata=on), ufl.Measure("ds", mesh, subdomain_data=tags, metadata=on)
    off, flux = u - u_h, kappa * ufl.inner(ufl.grad(u), n)
    f = c * u - kappa * ufl.div(ufl.grad(u))

    def energy(v):
        return (kappa * ufl.inner(ufl.grad(v), ufl.grad(v)) + c * v**2) * dx + b * v**2 * ds(2)

    square = fem.assemble_scalar(fem.form(energy(off)))
    work = f * u * dx + flux * u * ds(3) + (flux * u + b * u**2) * ds(2)
    least = fem.assemble_scalar(fem.form(0.5 * energy(u) - work))
    assert np.sqrt(square) <= certificate.bound_energy_norm < 2.5 * np.sqrt(square)
    assert certificate.energy[0] <= least <= certificate.energy[1]


def pressed(f=-1.0, rule=4):
    """A rectangle with insulated sides that lies on an obstacle."""
    sides = ("floor", "wall", "wall", "wall")
    polygon = Polygon([[0, 0], [2, 0], [2, 1], [0, 1]], sides, names=("floor", "wall"))
    conditions = {"floor": Contact(0.0), "wall": Neumann()}
    return Problem(f=f, quadrature_degree=rule, conditions=conditions), polygon


def test_contact_alone_holds_the_domain():
    """u = y²/2 − y above 0 for f = −1: contact everywhere, the force is 2."""
    problem, polygon = pressed()
    exact = lambda x: x[1] ** 2 / 2 - x[1]  # noqa: E731
    for solution in solve_levels(problem, polygon.mesh(0.4), 3):
        certificate, x = solution.certificate, ufl.SpatialCoordinate(solution.domain.mesh)
        off = ufl.grad(solution.u - exact(x))
        square = WORLD.allreduce(fem.assemble_scalar(fem.form(ufl.inner(off, off) * ufl.dx)))
        assert np.sqrt(square) <= certificate.bound_energy_norm <= 1.1 * np.sqrt(square)
        low, high = certificate.energy  # ½∫|∇u|² − ∫ f u = −½ ∫ (y − 1)² over the rectangle
        assert low <= -1 / 3 <= high
        low, high = force_bounds(solution)
        assert low <= 2.0 * (1 + 1e-12) and high >= 2.0 * (1 - 1e-12) and high - low < 1e-6
        _, low, high = solution.flux("floor", weight=lambda x: ufl.sin(x[0]))
        assert low <= 1 - np.cos(2.0) <= high and high - low < 0.1
        with pytest.raises(InputError, match="how high it is"):
            mean(solution)


def test_contact_alone_with_a_load_that_is_enclosed():
    """What quadrature misses of f goes to where there is contact."""
    problem, polygon = pressed(lambda x: -ufl.exp(x[1]) - ufl.sin(x[0]) ** 2, rule=2)
    solution = solve(problem, polygon.mesh(0.2))
    exact = 2 * (np.e - 1) + 1 - np.sin(4) / 4
    low, high = force_bounds(solution)
    assert low <= exact <= high and high - low < 0.1
    assert solution.certificate.parts["solver"] < 0.1 * solution.certificate.bound_energy_norm


def test_contact_that_does_not_press_holds_nothing():
    """A solver that never began has no forces, and no bound."""
    problem, polygon = pressed()
    solution = solve(problem, polygon.mesh(0.3))
    solution.u.x.array[:] = 1.0
    assert "no contact whose force" in certify(solution).reason


def test_forces_that_may_be_less_hold_less(monkeypatch):
    """What contact may have to give up, a weak loss being a dear way out, does not keep u on α."""
    walls = {side: Robin(coefficient=1e-9) for side in ("left", "right")}
    problem = Problem(f=-2.0, conditions=walls | {"floor": Contact(0.0), "top": Contact(0.0)})
    monkeypatch.setattr(module, "DEAR", -1.0)
    carry, widths = module.carried_to_contact, []
    for part in (0.0, 0.6):

        def more(cells, flux, *rest, part=part):
            norm, change = carry(cells, flux, *rest)
            return norm, change + part / 2 * flux.contact  # for what is left and for what is missed

        monkeypatch.setattr(module, "carried_to_contact", more)
        solution = solve(problem, structured(SQUARE, 12, comm=WORLD))
        _, low, high = solution.flux("floor")  # u is y² − y, nearly
        assert solution.certificate.made.on_contact_alone
        assert low <= 1.0 <= high
        widths.append(high - low)
    assert widths[1] > 1.2 * widths[0]


@pytest.mark.parametrize("height", [0.0, 0.3])
def test_obstacles_that_meet_or_cross(height):
    """They meet in a point, where rounding is allowed for; or cross where nothing looks."""

    def low(x):
        return height * ufl.exp(-1e6 * (x[0] - 0.511) ** 2)

    def high(x):  # (x − 0.37)²
        return x[0] ** 2 - 0.74 * x[0] + 0.1369

    conditions = {"floor": Contact(low, upper=high), "top": Dirichlet(0.0)}
    problem = Problem(f=-1.0, conditions=conditions | {"left": Neumann(), "right": Neumann()})
    certificate = solve(problem, structured(SQUARE, 3)).certificate
    assert (certificate.bound_h1 is None) == (height > 0.0), certificate.reason
    assert height == 0.0 or "nowhere above the upper bound" in certificate.reason


@pytest.mark.parametrize("of_g", [False, True])
def test_what_is_missed_of_f_or_g_alone_is_kept_for_intervals(of_g):
    """A wave of one of them, the other a number."""
    wave = lambda x: ufl.exp(2.0 * x[0] - 3.0 * x[1])  # noqa: E731
    solution = solve(Problem(f=1.0, g=wave) if of_g else Problem(f=wave, g=1.0), square(jitter=0.0))
    at = solution.domain.mesh.geometry.x[cell_nodes(solution.domain.mesh)].mean(axis=1)
    missed = np.broadcast_to(solution.certificate.made.missed, len(at))  # a number without Γg
    west = missed[at[:, 0] < 0.5]
    assert WORLD.allreduce(missed.sum()) > 0.0
    assert (WORLD.allreduce(west.sum()) == 0.0) == of_g  # Γg is on the right
