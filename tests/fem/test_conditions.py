"""Conditions say what they add: one more kind is solved right; data are sampled once a mesh."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import (
    compute_midpoints,
    create_unit_square,
    exterior_facet_indices,
    meshtags,
)
from helpers import SIDES, SQUARE
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Dirichlet,
    Domain,
    Form,
    InputError,
    Material,
    Neumann,
    Polygon,
    Problem,
    Robin,
    exact,
    solve,
    solve_levels,
)
from signorini_cr.data.quadrature import Trace
from signorini_cr.diffusion import Diffusion
from signorini_cr.fem.conditions import Condition
from signorini_cr.fem.layout import Layout
from signorini_cr.fem.problem import Forms
from signorini_cr.fem.space import ghosted_vector
from signorini_cr.means import mean
from signorini_cr.multigrid.hierarchy import NestedMesh, conforming
from signorini_cr.multigrid.transfer import inclusion
from signorini_cr.vi.level import Level

PARTS = ("contact", "neumann", "dirichlet", "dirichlet")


@dataclass(frozen=True, eq=False)
class Spring(Condition):
    """κ∂ₙu + 3 u = g."""

    g: object = 0.0
    uncertified = "there is a spring"

    @property
    def flux(self):
        return self.g

    @property
    def loss(self):
        return ufl.as_ufl(3.0)


def u(x):
    return ufl.sin(2.0 * x[0] + 1.0) * ufl.cosh(x[1]) + 1.0


SPRUNG = Problem(
    exact=u,
    obstacle=-10.0,
    conditions={"neumann": Spring(lambda x: 2.0 * ufl.cos(3.0) * ufl.cosh(x[1]) + 3.0 * u(x))},
)


@pytest.mark.slow
@pytest.mark.parametrize("element", ["CR", "P1"])
def test_another_kind_is_solved_right(element):
    domain = Polygon(SQUARE.vertices, PARTS).mesh(0.25)
    *_, coarse, fine = solve_levels(SPRUNG, domain, 4, element)
    assert coarse.errors and fine.errors
    h1, l2 = np.log2(np.array(coarse.errors) / np.array(fine.errors))
    assert h1 == pytest.approx(1.0, abs=0.03) and l2 == pytest.approx(2.0, abs=0.1)
    assert fine.iterations.linear <= 14
    certificate = solve(SPRUNG, domain).certificate
    assert certificate.bound_h1 is None and certificate.reason == "there is a spring"


def test_python_shows_what_was_given():
    for made, shown in (
        (Robin(coefficient=1), "Robin(coefficient=1)"),
        (Contact(u, upper=2.0), "Contact(obstacle=u, upper=2.0)"),
        (Neumann(), "Neumann()"),
        (Spring(1.0), "Spring(g=1.0)"),
        (Material(f=u), "Material(f=u)"),
        (Form(u), "Form(a=u)"),
        (Problem(conditions={"air": Robin()}), "Problem(conditions=['air'])"),
        (Problem(f=np.ones(2), g=0, quadrature_degree=4), "Problem(f=array([1., 1.]), g=0)"),
    ):
        assert repr(made) == shown


def test_terms_without_gradients_are_in_p1_and_in_the_sums_of_rows():
    domain = Polygon(SQUARE.vertices, PARTS).mesh(0.3)
    mesh = NestedMesh(Diffusion(SPRUNG, domain.mesh), domain)
    level, (operator, p1, dirichlet) = Level((mesh,)), conforming(mesh)
    product = level.system.A.ptap(inclusion(p1, Layout.of_space(level.V)).matrix())
    product.zeroRowsColumns(dirichlet + operator.matrix.getOwnershipRange()[0], 1.0)
    product.axpy(-1.0, operator.matrix)
    assert product.norm() <= 1e-12 * operator.matrix.norm()
    ones = np.ones_like(level.system.b)
    x, y = (ghosted_vector(level.V, array) for array in (ones, np.zeros_like(ones)))
    level.system.A.mult(x, y)
    assert np.allclose(level.system.row_sums(), y.array_r, atol=1e-12)
    held, fixed = (
        domain.mesh.comm.allreduce(len(dofs))
        for dofs in (level.system.dofs_that_hold(), level.system.dirichlet)
    )
    assert held > fixed


NAMES = ("floor", "air", "roof", "wall")


def waves(x):
    return ufl.sin(2.0 * x[0] + 1.0) * ufl.cosh(x[1]) + 1.0


def on_the_square(conditions, size=0.25, **data):
    """A problem with each edge a part of its own, and its domain."""
    domain = Polygon(SQUARE.vertices, NAMES, names=NAMES).mesh(size)
    return Problem(conditions=dict(zip(NAMES, conditions, strict=True)), **data), domain


@pytest.mark.slow
@pytest.mark.parametrize("element", ["CR", "P1"])
@pytest.mark.parametrize("c", [0.0, 30.0])
def test_all_kinds_at_once_converge_as_theory_says(element, c):
    """Robin, two contact parts with obstacles of their own, one of them touched, no Γ0.

    On the floor u is the obstacle, κ∂ₙu + 2 (u − 1) − g is 1.5 there; on the wall it is free.
    """

    def force(x):
        return -ufl.sin(2.0 * x[0] + 1.0) * ufl.sinh(x[1]) * 3.0 + 2.0 * (waves(x) - 1.0)

    problem, domain = on_the_square(
        (
            Contact(waves, coefficient=2.0, external=1.0, g=lambda x: force(x) - 1.5),
            Robin(coefficient=4.0, external=-1.0),
            Neumann(),
            Contact(-9.0, g=lambda x: -6.0 * ufl.cos(1.0) * ufl.cosh(x[1])),
        ),
        exact=waves,
        coefficient=3.0,
        reaction=c,
    )
    *_, coarse, fine = solve_levels(problem, domain, 4, element)
    h1, l2 = np.log2(np.array(coarse.errors) / np.array(fine.errors))
    assert h1 == pytest.approx(1.0, abs=0.03) and l2 == pytest.approx(2.0, abs=0.1)
    assert fine.contact.force == pytest.approx(1.5, rel=2e-3)
    assert fine.contact.active.sum() < len(fine.contact.active) or fine.domain.mesh.comm.size > 1
    if element == "CR":
        error, certificate = fine.errors[0], fine.certificate
        assert error < certificate.bound_h1 < 1.1 * error


def test_a_loss_on_all_sides_balances_the_load_exactly():
    """u = f / c where that suits all conditions; u = f |Ω| / (b |∂Ω|) is not far for small b.

    With b → 0 the mean of b u over the boundary is ∫ f: the energy's balance, by hand.
    """
    lossy = [Robin(coefficient=1e-6) for _ in range(3)]
    problem, domain = on_the_square((Contact(-1e9), *lossy), f=2.0)
    solution = solve(problem, domain)
    assert solution.u.x.array.min() == pytest.approx(2.0 / 3e-6, rel=1e-4)
    problem, domain = on_the_square(
        (Contact(-1.0), Neumann(), Neumann(), Neumann()), f=6.0, reaction=3
    )
    solution = solve(problem, domain)
    assert np.allclose(solution.u.x.array, 2.0, atol=1e-9)
    assert solution.certificate.bound_energy_norm < 1e-6


def test_a_stiff_spring_is_a_dirichlet_condition():
    """b → ∞: the same force as with u = u_ext, but for what the facets of the side resolve."""
    forces = []
    for side in (Dirichlet(0.5), Robin(coefficient=1e9, external=0.5)):
        problem, domain = on_the_square((Contact(0.0), side, side, side), 0.1, f=-9.0)
        forces.append(solve(problem, domain).contact.force)
    assert forces[0] > 0.5 and forces[1] == pytest.approx(forces[0], rel=5e-3)


@pytest.mark.parametrize("levels", [1, 3])
def test_numbers_may_be_constants_and_functions_of_degree_0(levels):
    """Losses of two walls, and a reaction: each way to give them has the same certificate."""
    domain = SQUARE.mesh(0.3)
    zero = fem.functionspace(domain.mesh, ("DG", 0))
    of_walls, everywhere = fem.Function(zero), fem.Function(zero)
    of_walls.interpolate(lambda x: np.where(x[0] < 0.5, 2.0, 5.0))
    everywhere.x.array[:] = 1.5
    half = fem.Constant(domain.mesh, 0.5)
    found = []
    for right, left, c in (
        (5.0, 2.0, 1.5),
        (of_walls, of_walls, everywhere),
        (10.0 * half, 4 * half, lambda x: 3.0 * half),
    ):
        conditions = {
            "floor": Contact(-0.1, coefficient=half if right is of_walls else 0.5),
            "right": Robin(1.0, coefficient=right),
            "top": Neumann(),
            "left": Robin(coefficient=left, external=-0.2),
        }
        *_, last = solve_levels(Problem(f=-3.0, reaction=c, conditions=conditions), domain, levels)
        inflow = mean(last, "top")
        bound = last.certificate.bound_energy_norm
        found.append([bound, *last.certificate.energy, inflow.lower, inflow.upper])
        assert inflow.lower < inflow.upper < inflow.lower + 0.1
    assert np.allclose(found[1:], found[0], rtol=1e-7)


def test_parts_and_conditions_must_match():
    flat = [Contact(0.0), Neumann(), Neumann(), Dirichlet()]
    problem, domain = on_the_square(flat)
    with pytest.raises(InputError, match="the part 'wall' of the boundary has none"):
        solve(replace(problem, conditions=dict(list(problem.conditions.items())[:3])), domain)
    with pytest.raises(InputError, match="no part of the boundary is called 'ground'"):
        solve(replace(problem, conditions={**problem.conditions, "ground": Neumann()}), domain)
    with pytest.raises(InputError, match="'wall' is 3; a Condition is needed, such as Contact"):
        solve(replace(problem, conditions={**problem.conditions, "wall": 3}), domain)
    for key, wrong in (("reaction", {"reaction": -1.0}), ("'air'", {})):
        conditions = problem.conditions | ({} if wrong else {"air": Robin(coefficient=-2.0)})
        with pytest.raises(InputError, match=f"{key}.* must not be below 0"):
            solve(replace(problem, conditions=conditions, **wrong), domain)
    jump = {**problem.conditions, "roof": Dirichlet(1.0)}
    with pytest.raises(InputError, match=r"at \(0, 1\) the dirichlet value jumps from 0 to 1"):
        solve(replace(problem, conditions=jump), domain)


def test_parts_of_the_users_own_by_tags():
    """Facet values by name; what nobody names is an error, and refinement keeps them."""
    mesh = create_unit_square(MPI.COMM_WORLD, 4, 4)
    facets = exterior_facet_indices_of(mesh)
    x = compute_midpoints(mesh, 1, facets)
    values = np.select([x[:, 1] < 1e-9, x[:, 0] > 1 - 1e-9, x[:, 1] > 1 - 1e-9], [7, 8, 9], 10)
    tags = meshtags(mesh, 1, facets, values.astype(np.int32))
    domain = Domain.from_tags(mesh, tags, floor=7, rest=(8, 9, 10))
    problem = Problem(f=-9.0, conditions={"floor": Contact(-0.1), "rest": Dirichlet()})
    *_, fine = solve_levels(problem, domain, 2)
    usual = Domain.from_tags(mesh, tags, contact=7, dirichlet=(8, 9, 10))
    *_, same = solve_levels(Problem(f=-9.0, obstacle=-0.1), usual, 2)
    assert fine.contact.force == pytest.approx(same.contact.force, rel=1e-9) and same.contact.force
    assert set(fine.domain.parts) == {"contact", "dirichlet", "neumann", "floor", "rest"}
    with pytest.raises(InputError, match=r"tagged 10, which stands for nothing"):
        Domain.from_tags(mesh, tags, floor=7, rest=(8, 9))
    with pytest.raises(InputError, match=r"no exterior facet is tagged rest \(value 5\)"):
        Domain.from_tags(mesh, tags, floor=7, rest=(5, 8, 9, 10))

    for facets, key in ({"floor": 7}, 7), ({"parts": [7]}, 7), ({"parts": [7]}, "7"):
        domain = Domain.from_tags(mesh, tags, dirichlet=(8, 9, 10), **facets)
        again = solve(Problem(f=-9.0, conditions={key: Contact(-0.1)}), domain)
        assert again.contact.force == pytest.approx(
            solve(Problem(f=-9.0, obstacle=-0.1), usual).contact.force
        )
        name = "floor" if "floor" in facets else "7"
        assert again.mean(7) == again.mean(name)
        top = again.flux(name, weight=lambda x: x[0] * (1.0 - x[0]))
        assert again.flux(7, weight=lambda x: x[0] * (1.0 - x[0])) == top
    said = r"stands for the facet value 8 alone; there are contact, dirichlet, neumann, 7 \(7\)"
    with pytest.raises(InputError, match=said):
        solve(Problem(conditions={7: Contact(), 8: Dirichlet()}), domain)
    with pytest.raises(InputError, match="the part '7' has two"):
        solve(Problem(conditions={7: Contact(), "7": Contact()}), domain)


def exterior_facet_indices_of(mesh):
    mesh.topology.create_connectivity(1, 2)
    return exterior_facet_indices(mesh.topology)


def test_boundary_data_are_sampled_once_a_mesh(monkeypatch):
    seen = []
    at = Trace.at

    def counted(self, *where):
        seen.append(id(self))
        return at(self, *where)

    monkeypatch.setattr(Trace, "at", counted)
    example = exact.S1_NEUMANN.problem
    problem = Problem(
        exact=example.exact,
        g=example.g or (lambda x: 0.0 * x[0]),
        obstacle=lambda x: 0.0 * x[0],
        dirichlet=lambda x: example.exact(x),
    )
    for solution in solve_levels(problem, exact.S1_NEUMANN.mesh(0.5), 2):
        assert solution.certificate.bound_h1 is not None
        assert len(seen) == len(set(seen)) > 1
        seen.clear()


@pytest.mark.parametrize("element", ["CR", "P1"])
def test_one_form_is_compiled_for_all_numbers(element):
    """The bilinear form of other numbers is the same library, and each matrix has its own."""
    domain = SQUARE.mesh(0.5)
    walls = {name: Dirichlet(0.0) for name in SIDES[:-1]}
    walls["floor"] = Contact(0.0)
    found, norms = set(), []
    for factor in (1.0, 3.0):
        conditions = walls | {"left": Robin(0.0, coefficient=0.7 * factor)}
        problem = Problem(coefficient=1.1 * factor, reaction=0.3 * factor, conditions=conditions)
        forms = Forms(problem, domain.mesh, element, domain.parts)
        found.add(forms.a._compiled.module.__name__)
        V = fem.functionspace(domain.mesh, (element if element == "CR" else "P", 1))
        matrix = assemble_matrix(forms.a.on(domain, [V, V]))
        matrix.assemble()
        norms.append(matrix.norm())
        matrix.destroy()
    assert len(found) == 1
    assert norms[1] == pytest.approx(3.0 * norms[0], rel=1e-12)


def test_a_kind_that_has_no_words_of_its_own_is_called_by_its_name():
    assert Spring.in_words({}, False, "κ") == "Spring: g = 0"
    assert Spring.in_words({"g": "x"}, "0", "κ") == "Spring: g = x"
