"""Certificates where κ is a tensor."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints, create_rectangle, meshtags
from helpers import tagged
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    Material,
    Problem,
    Robin,
    force,
    means,
    solve_levels,
)

BOTTOM, RIGHT, TOP, LEFT = 1, 2, 3, 4
WEST, EAST = 1, 2


def turned(angle, ratio, size=1.0):
    """A symmetric matrix with the determinant size², its eigenvalues 1 : ratio."""
    axis = np.array([np.cos(angle), np.sin(angle)])
    return size / np.sqrt(ratio) * (np.eye(2) + (ratio - 1.0) * np.outer(axis, axis))


def root(matrix):
    eigenvalues, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(eigenvalues) @ vectors.T


def square(n=8, image=None):
    """The unit square with contact below, two materials left and right; or its image."""
    mesh = create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [1.0, 1.0]], [n, n])

    def sides(x, y):
        return np.select([y < 1e-9, x > 1 - 1e-9, y > 1 - 1e-9], [BOTTOM, RIGHT, TOP], LEFT)

    parts = tagged(mesh, sides)
    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    east = compute_midpoints(mesh, 2, cells)[:, 0] > 0.5
    tags = meshtags(mesh, 2, cells, np.where(east, EAST, WEST).astype(np.int32))
    if image is not None:
        mesh.geometry.x[:, :2] = mesh.geometry.x[:, :2] @ image.T
    return Domain.from_tags(
        mesh,
        parts,
        contact=BOTTOM,
        dirichlet=TOP,
        right=RIGHT,
        left=LEFT,
        cell_tags=tags,
        materials={"west": WEST, "east": EAST},
    )


def as_ufl(matrix):
    return lambda x: ufl.as_matrix(matrix.tolist())


@pytest.mark.parametrize(
    ("angle", "ratio", "reaction"), [(0.3, 4.0, 30.0), (1.2, 300.0, 0.0), (2.5, 1e4, 0.0)]
)
def test_a_tensor_is_a_number_on_the_image(angle, ratio, reaction):
    """∇·(κ∇u) is kΔu where (κ/k)^{-1/2} x stands for x, k² = det κ: so is all that is certain."""
    kappa = turned(angle, ratio, size=2.5)
    image = np.linalg.inv(root(kappa / 2.5))
    back = np.linalg.inv(image)
    conditions = {"right": Robin(0.0), "left": Dirichlet(0.0)}

    def obstacle(x):
        return -0.05 - 0.1 * x[0]

    def on_image(x):
        return obstacle([float(back[0, 0]) * x[0] + float(back[0, 1]) * x[1]])

    found = []
    for matrix, coefficient, alpha in (
        (None, as_ufl(kappa), obstacle), (image, 2.5, on_image)
    ):  # fmt: skip
        problem = Problem(
            f=-4.0,
            coefficient=coefficient,
            reaction=reaction,
            obstacle=alpha,
            conditions=conditions,
        )
        domain = square(4, matrix)
        *_, solution = solve_levels(problem, domain, 3)
        made = solution.certificate
        if matrix is None:
            ends = made.made.least, made.made.most
            assert np.allclose(np.array(ends).T, np.linalg.eigvalsh(kappa))
        found.append(
            [
                made.bound_energy_norm,
                made.bound_companion,
                *made.energy,
                *(made.parts[share] for share in ("flux", "companion", "contact")),
                solution.contact.force,
                np.sqrt(MPI.COMM_WORLD.allreduce(made.indicators.sum())),
                *means.mean(solution, "east"),
            ]
        )
    assert np.allclose(*found, rtol=1e-5, atol=1e-7 * abs(found[0][0]))
    if reaction == 0.0:
        assert found[0][6] > 0.0 and solution.contact.force > 0.0


class Across:
    """u = (x − ½) s(y) + y², in contact below: values and fluxes are the same on both sides of ½.

    That is so if κ_xx s + 2 κ_xy y is; the pressure is 1.
    """

    def __init__(self, west, east):
        self.sides = west, east

    def slope(self, x, kappa):
        west = self.sides[0]
        rise = 2.0 * (west[0, 1] - kappa[0, 1]) / kappa[0, 0]
        steep = west[0, 0] / kappa[0, 0] + rise * x[1]
        return steep, (x[0] - 0.5) * rise + 2.0 * x[1]

    def here(self, datum):
        return lambda x: ufl.conditional(
            ufl.lt(x[0], 0.5), *(ufl.as_ufl(datum(x, kappa)) for kappa in self.sides)
        )

    def u(self, x):
        return self.here(lambda x, kappa: (x[0] - 0.5) * self.slope(x, kappa)[0] + x[1] ** 2)(x)

    def g(self, x):
        def below(x, kappa):
            a, b = self.slope(x, kappa)
            return -(kappa[0, 1] * a + kappa[1, 1] * b) - 1.0

        return self.here(below)(x)

    def load(self, kappa):
        rise = 2.0 * (self.sides[0][0, 1] - kappa[0, 1]) / kappa[0, 0]
        return -2.0 * float(kappa[0, 1] * rise + kappa[1, 1])

    def problem(self):
        west, east = self.sides
        return Problem(
            dirichlet=self.u,
            conditions={
                "contact": Contact(self.u, g=self.g),
                "right": Dirichlet(self.u),
                "left": Dirichlet(self.u),
            },
            f=self.load(west),
            coefficient=as_ufl(west),
            materials={"east": Material(coefficient=as_ufl(east), f=self.load(east))},
        )

    def errors(self, solution):
        """In the energy norm and in H1, by UFL and its quadrature, which is exact here."""
        mesh = solution.domain.mesh
        x = ufl.SpatialCoordinate(mesh)
        total = np.zeros(2)
        for tag, kappa in zip((WEST, EAST), self.sides, strict=True):
            off = ufl.as_vector(self.slope(x, kappa)) - ufl.grad(solution.u)
            cells = solution.domain.materials.where("west" if tag == WEST else "east")
            there = fem.Function(fem.functionspace(mesh, ("DG", 0)))
            there.x.array[: len(cells)] = cells
            for i, weight in enumerate((kappa, np.eye(2))):
                weight = fem.Constant(mesh, weight)
                square = there * ufl.inner(weight * off, off) * ufl.dx
                total[i] += fem.assemble_scalar(fem.form(square))
        return np.sqrt(mesh.comm.allreduce(total))


ACROSS = pytest.mark.parametrize(("first", "second"), [(3.0, 20.0), (1.0, 40.0)])


def errors_across(first, second, levels):
    """In the energy norm and in H1, mesh by mesh; each is below its bound."""
    case = Across(turned(0.7, first), turned(1.9, second, size=10.0))
    errors = []
    for solution in solve_levels(case.problem(), square(), levels):
        made = solution.certificate
        errors.append(case.errors(solution))
        ratios = np.array([made.bound_energy_norm, made.bound_h1]) / errors[-1]
        assert np.all(ratios >= 1.0) and ratios[0] < 1.35
    return errors


@ACROSS
def test_bounds_across_materials(first, second):
    coarse, fine = errors_across(first, second, 2)
    assert np.all(fine < coarse)


@pytest.mark.slow
@ACROSS
def test_rates_and_bounds_across_materials(first, second):
    *_, coarse, fine = errors_across(first, second, 4)
    assert np.allclose(coarse / fine, 2.0, rtol=0.05)


def test_bounds_of_a_tensor_with_waves():
    """u = sin(x + 2y), above the obstacle: f by hand."""

    def kappa(x):
        wave = 0.4 * ufl.sin(3.0 * x[0] + x[1])
        return ufl.as_matrix([[2.0 + wave, 0.5 - wave], [0.5 - wave, 1.0 + wave]])

    def load(x):
        wave, rise = 0.4 * ufl.sin(3.0 * x[0] + x[1]), 0.4 * ufl.cos(3.0 * x[0] + x[1])
        phase = x[0] + 2.0 * x[1]
        # κ∇u = cos(phase) (3 − wave, 2.5 + wave)
        bend = -ufl.sin(phase) * ((3.0 - wave) + 2.0 * (2.5 + wave))
        return -bend - ufl.cos(phase) * (-3.0 * rise + rise)

    def u(x):
        return ufl.sin(x[0] + 2.0 * x[1])

    def pulled(x):
        return -ufl.cos(x[0]) * (2.5 + 0.4 * ufl.sin(3.0 * x[0]))

    sides = {"right": Dirichlet(u), "left": Dirichlet(u), "contact": Contact(-9.0, g=pulled)}
    problem = Problem(f=load, coefficient=kappa, dirichlet=u, conditions=sides)
    for solution in solve_levels(problem, square(), 2):
        mesh = solution.domain.mesh
        x = ufl.SpatialCoordinate(mesh)
        off = ufl.grad(u(x)) - ufl.grad(solution.u)
        norm2of = ufl.inner(kappa(x) * off, off) * ufl.dx(metadata={"quadrature_degree": 8})
        error = np.sqrt(mesh.comm.allreduce(fem.assemble_scalar(fem.form(norm2of))))
        assert 1.0 <= solution.certificate.bound_energy_norm / error < 1.3
    t, weights = np.polynomial.legendre.leggauss(20)
    y = 0.5 + 0.5 * t
    through = np.cos(1.0 + 2.0 * y) * (3.0 - 0.4 * np.sin(3.0 + y))
    exact = 0.5 * weights @ (through * y * (1.0 - y))
    found = force.flux(solution, "right", weight=lambda x: x[1] * (1.0 - x[1]))
    assert found.lower <= exact <= found.upper and found.upper - found.lower < 0.2 * abs(exact)


def test_a_tensor_that_varies_too_much():
    """From one side of a cell to the other κ turns by a right angle."""
    problem = Problem(
        coefficient=lambda x: ufl.conditional(
            ufl.lt(x[0], 0.4), ufl.as_matrix([[1.0, 0.0], [0.0, 1e4]]), as_ufl(np.eye(2))(x)
        ),
        f=1.0,
        conditions={"right": Dirichlet(0.0), "left": Dirichlet(0.0)},
    )
    *_, solution = solve_levels(problem, square(), 1)
    assert solution.certificate.bound_h1 is None
    assert "varies too much" in solution.certificate.reason


def test_every_way_to_give_a_tensor():
    """Numbers, a Constant, Functions of degree 0, products: the same bounds; Bessel's has none."""
    kappa, domain = turned(0.4, 5.0), square()
    constant = fem.Constant(domain.mesh, kappa)
    function = fem.Function(fem.functionspace(domain.mesh, ("DG", 0, (2, 2))))
    function.x.array[:] = np.tile(kappa.ravel(), len(function.x.array) // 4)
    half = ufl.as_matrix(root(kappa).tolist())
    ways = [as_ufl(kappa), lambda x: constant, lambda x: function, lambda x: half * half.T]
    ways.append(lambda x: as_ufl(kappa)(x) * (1.0 + ufl.bessel_J(1, x[0]) ** 2))
    bounds = []
    for way in ways:
        problem = Problem(
            f=-2.0,
            obstacle=-0.05,
            coefficient=way,
            conditions={"right": Dirichlet(0.0), "left": Dirichlet(0.0)},
        )
        *_, solution = solve_levels(problem, domain, 1)
        bounds.append(solution.certificate.bound_energy_norm)
    assert np.allclose(bounds[1:-1], bounds[0], rtol=1e-9)
    assert bounds[-1] is None and "computable" in solution.certificate.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kappa", "wanted"),
    [
        ([[2.0, 0.5], [0.5, 1.0]], [1.244, 1.287, 1.276, 1.075, 1.030]),
        ([[10.0, 3.0], [3.0, 1.0]], [1.812, 2.840, 3.259, 2.833, 2.170]),
    ],
)
def test_a_tensor_and_a_large_reaction(kappa, wanted):
    """Cells are thin in the tensor's measure, and not as sharp as others where they miss κ/c."""
    tensor = ufl.as_matrix(kappa)

    def u(x):
        return ufl.cos(np.pi * x[0]) * ufl.exp(x[1]) + 0.3 * x[0] * x[1]

    def flow(x):
        return ufl.dot(tensor, ufl.grad(u(x)))

    problem = Problem(
        f=lambda x: 1e4 * u(x) - ufl.div(flow(x)),
        coefficient=lambda x: tensor,
        reaction=1e4,
        conditions={
            "contact": Contact(u, g=lambda x: -flow(x)[1] - 1.0 - x[0]),
            **{part: Dirichlet(u) for part in ("dirichlet", "left", "right")},
        },
    )
    found = []
    for solution in solve_levels(problem, square(4), 5):
        mesh = solution.domain.mesh
        e = u(ufl.SpatialCoordinate(mesh)) - solution.u
        dx = ufl.dx(metadata={"quadrature_degree": 8})
        energy = (ufl.inner(ufl.dot(tensor, ufl.grad(e)), ufl.grad(e)) + 1e4 * e**2) * dx
        norm2 = MPI.COMM_WORLD.allreduce(fem.assemble_scalar(fem.form(energy)))
        found.append(solution.certificate.bound_energy_norm / np.sqrt(norm2))
    assert found == pytest.approx(wanted, rel=0.01) and min(found) > 1.0
