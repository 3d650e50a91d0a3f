"""Materials: data that are constant on cells of the coarsest mesh, on all that follow."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints, create_rectangle, exterior_facet_indices, meshtags
from mpi4py import MPI

from signorini_cr import (
    Contact,
    Domain,
    InputError,
    Material,
    Problem,
    norms,
    solve,
    solve_adaptive,
    solve_in_time,
    solve_levels,
)

pytestmark = pytest.mark.slow

BOTTOM, TOP, SIDES = 1, 2, 3
SOIL, ROCK = 5, 9


def layers(n=4, comm=MPI.COMM_WORLD, **more):
    """The unit square, of rock above y = ½; n is even."""
    mesh = create_rectangle(comm, [[0.0, 0.0], [1.0, 1.0]], [n, n])
    mesh.topology.create_connectivity(1, 2)
    facets = exterior_facet_indices(mesh.topology)
    y = compute_midpoints(mesh, 1, facets)[:, 1]
    parts = np.select([y < 1e-9, y > 1 - 1e-9], [BOTTOM, TOP], SIDES).astype(np.int32)
    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    above = compute_midpoints(mesh, 2, cells)[:, 1] > 0.5
    tags = meshtags(mesh, 2, cells, np.where(above, ROCK, SOIL).astype(np.int32))
    given = {"cell_tags": tags, "materials": {"rock": ROCK}} | more
    return Domain.from_tags(
        mesh, meshtags(mesh, 1, facets, parts), contact=BOTTOM, dirichlet=TOP, **given
    )


def layered(contrast):
    """κ∂u/∂y is continuous at y = ½, where u is 0; in contact all along Γ1."""

    def u(x):
        kappa = ufl.conditional(ufl.gt(x[1], 0.5), contrast, 1.0)
        return -(2.0 + ufl.cos(ufl.pi * x[0])) * ufl.sin(x[1] - 0.5) / kappa

    return Problem(exact=u, obstacle=u, materials={"rock": Material(coefficient=contrast)})


def series(problem, domain, adaptive, levels=4):
    if adaptive:
        return list(solve_adaptive(problem, domain, levels=levels, fraction=0.7))
    return list(solve_levels(problem, domain, levels))


@pytest.mark.parametrize("contrast", [1e-4, 7.0, 1e4])
def test_rates_and_bounds_across_an_interface(contrast):
    solutions = series(layered(contrast), layers(), adaptive=False)
    h1, l2 = np.array([solution.errors for solution in solutions]).T
    h = [0.5**solution.level.number for solution in solutions]
    assert norms.rates(h, h1)[-1] == pytest.approx(1.0, abs=0.03)
    assert norms.rates(h, l2)[-1] == pytest.approx(2.0, abs=0.1)
    for solution, error in zip(solutions, h1, strict=True):
        certificate = solution.certificate
        assert certificate.bound_h1 >= error
        # of the energy's norm, which the certificate is about
        assert certificate.bound_energy_norm <= 1.3 * energy_error(solution, contrast)


@pytest.mark.parametrize("touching", [True, False])
def test_bounds_hold_for_random_layers(touching):
    """Loads and κ that jump by up to 10⁸, in contact all along Γ1 or nowhere there."""
    domain = layers(6, materials={"soil": SOIL, "rock": ROCK})
    random = np.random.default_rng(1 + touching)
    names = ("soil", "rock", "mean", "wave", "steep")
    at = {name: fem.Constant(domain.mesh, 1.0) for name in names}

    def u(x):
        kappa = ufl.conditional(ufl.gt(x[1], 0.5), at["rock"], at["soil"])
        angle = (at["steep"] if touching else ufl.pi) * (x[1] - 0.5)
        return -(at["mean"] + at["wave"] * ufl.cos(ufl.pi * x[0])) * ufl.sin(angle) / kappa

    for _ in range(3):
        at["soil"].value, at["rock"].value = 10.0 ** random.uniform(-4.0, 4.0, 2)
        at["mean"].value, at["wave"].value = random.uniform(0.5, 1.0), random.uniform(-0.5, 0.5)
        at["steep"].value = random.uniform(0.1, 3.0)
        own = {name: Material(coefficient=float(at[name].value)) for name in ("soil", "rock")}
        problem = Problem(exact=u, obstacle=u if touching else -1.0, materials=own)
        for solution in solve_levels(problem, domain, 2):
            assert touching or solution.contact.force == 0.0
            certificate = solution.certificate
            assert certificate.bound_h1 >= solution.errors[0]
            low, high = certificate.energy
            assert low <= high


def energy_error(solution, contrast):
    """‖κ^½ ∇_h(u − u_h)‖."""
    x = ufl.SpatialCoordinate(solution.domain.mesh)
    kappa = ufl.conditional(ufl.gt(x[1], 0.5), contrast, 1.0)
    gap = ufl.grad(solution.problem.exact(x) - solution.u)
    form = fem.form(kappa * ufl.inner(gap, gap) * ufl.dx(metadata={"quadrature_degree": 6}))
    return solution.domain.mesh.comm.allreduce(fem.assemble_scalar(form).real) ** 0.5


@pytest.mark.parametrize("adaptive", [False, True])
def test_the_same_on_any_number_of_ranks(adaptive):
    problem = layered(1e4)
    shared = series(problem, layers(), adaptive)
    alone = series(problem, layers(comm=MPI.COMM_SELF), adaptive)
    for one, other in zip(shared, alone, strict=True):
        assert one.dofs == other.dofs
        assert one.errors == pytest.approx(other.errors, rel=1e-6)
        assert one.energy == pytest.approx(other.energy, rel=1e-8)
        assert one.certificate.bound_h1 == pytest.approx(other.certificate.bound_h1, rel=1e-4)


@pytest.mark.parametrize("adaptive", [False, True])
def test_children_consist_of_what_their_parents_do(adaptive):
    *_, last = series(layered(1e4), layers(), adaptive)
    mesh, materials = last.domain.mesh, last.domain.materials
    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    above = compute_midpoints(mesh, 2, cells)[:, 1] > 0.5
    assert np.array_equal(materials.where("rock")[cells], above)


@pytest.mark.parametrize("adaptive", [False, True])
def test_every_way_to_give_data_gives_the_same(adaptive):
    """By material, as a Function of degree 0, and as a function of x that jumps at the lines."""
    domain = layers(materials={"soil": SOIL, "rock": ROCK})
    common = {"obstacle": -0.02}
    of_soil, of_rock = {"coefficient": 2.0, "f": -1.0}, {"coefficient": 50.0, "f": -3.0}
    given = [
        Problem(materials={"soil": Material(**of_soil), "rock": Material(**of_rock)}, **common)
    ]
    by_cells, by_place = {}, {}
    for name, low in of_soil.items():
        high = of_rock[name]
        function = fem.Function(fem.functionspace(domain.mesh, ("DG", 0)))
        function.interpolate(lambda x, a=low, b=high: np.where(x[1] > 0.5, b, a))
        by_cells[name] = function
        by_place[name] = lambda x, a=low, b=high: ufl.conditional(ufl.gt(x[1], 0.5), b, a)
    given += [Problem(**by_cells, **common), Problem(**by_place, **common)]
    runs = [series(problem, domain, adaptive, 3) for problem in given]
    for several in zip(*runs, strict=True):
        assert len({solution.dofs for solution in several}) == 1
        bounds = [solution.certificate.bound_h1 for solution in several]
        assert bounds == pytest.approx([bounds[0]] * 3, rel=1e-5)
        low, high = several[0].certificate.energy
        for solution in several:
            assert solution.energy == pytest.approx(several[0].energy, rel=1e-9)
            assert solution.contact.force == pytest.approx(several[0].contact.force, rel=1e-6)
        assert low < high


def test_expressions_of_materials():
    """One that has no value elsewhere, beside a load that follows from the exact solution."""
    domain = layers()

    def u(x):
        return -(x[1] - 0.5) * ufl.conditional(ufl.gt(x[1], 0.5), 1.0 / (x[1] + 0.5), 1.0)

    # κ u' is −1 at the line from both sides, and ∂u/∂y = −1/(y + ½)² above
    own = Material(coefficient=lambda x: ufl.sqrt(x[1] - 0.4) / np.sqrt(0.1))
    problem = Problem(exact=u, obstacle=u, materials={"rock": own})
    solutions = series(problem, domain, adaptive=False)
    h1 = np.array([solution.errors[0] for solution in solutions])
    assert h1[-2] / h1[-1] > 1.95
    bounds = np.array([solution.certificate.bound_h1 for solution in solutions])
    assert np.all(bounds >= h1)
    assert bounds[-1] <= 1.5 * h1[-1]


def test_materials_in_time():
    """Step by step the same as with functions of x that jump at the lines."""
    domain = layers()

    def jump(low, high):
        return lambda x: ufl.conditional(ufl.gt(x[1], 0.5), high, low)

    common = {"obstacle": -0.02, "reaction": 1.0}
    rock = {"rock": Material(coefficient=50.0, f=-3.0)}
    given = (
        Problem(f=-1.0, materials=rock, **common),
        Problem(f=jump(-1.0, -3.0), coefficient=jump(1.0, 50.0), **common),
    )
    both = [solve_in_time(each, domain, end=0.1, steps=3, levels=2) for each in given]
    for (time, one), (_, other) in zip(*both, strict=True):
        assert time > 0.0
        assert one.energy == pytest.approx(other.energy, rel=1e-8)
        bounds = [solution.certificate.bound_h1 for solution in (one, other)]
        assert bounds[0] == pytest.approx(bounds[1], rel=1e-4)


@pytest.mark.parametrize("scheme", ["euler", "bdf2"])
def test_capacities_of_materials(scheme):
    """u = (1 + t)(2 + y) in soil: a load by hand; what rock takes up is four times as much."""
    mesh_time = {}

    def u(x):
        return (1.0 + mesh_time["t"]) * (2.0 + x[1])

    domain = layers()
    mesh_time["t"] = t = fem.Constant(domain.mesh, 0.0)
    problem = Problem(
        f=lambda x: 3.0 * (2.0 + x[1]) + 5.0 * u(x),
        reaction=5.0,
        dirichlet=u,
        conditions={"contact": Contact(lambda x: u(x) - 1.0, g=lambda x: -(1.0 + t))},
        materials={
            "rock": Material(
                capacity=12.0, reaction=7.0, f=lambda x: 12.0 * (2.0 + x[1]) + 7.0 * u(x)
            )
        },
    )
    steps = solve_in_time(
        problem,
        domain,
        end=1.0,
        steps=4,
        scheme=scheme,
        initial=lambda x: 2.0 + x[1],
        capacity=3.0,
        levels=2,
        time=t,
    )
    for time, solution in steps:
        x = ufl.SpatialCoordinate(solution.domain.mesh)
        off = ((1.0 + time) * (2.0 + x[1]) - solution.u) ** 2 * ufl.dx
        error = MPI.COMM_WORLD.allreduce(fem.assemble_scalar(fem.form(off)))
        assert np.sqrt(error) < 1e-7
        assert solution.certificate.bound_energy_norm < 1e-5
    rock = Problem(materials={"rock": Material(capacity=-2.0)})
    with pytest.raises(InputError, match="capacity of rock is -2"):
        next(solve_in_time(rock, domain, end=0.1, steps=3))


@pytest.mark.slow
@pytest.mark.parametrize(("soil", "rock"), [(3.0, 0.0), (0.0, 1e4), (1.0, 1e8)])
@pytest.mark.parametrize("adaptive", [False, True])
def test_rates_and_bounds_with_reactions_of_materials(soil, rock, adaptive):
    """u is smooth, in contact for x < ½ with the pressure ½ − x."""

    def u(x):
        return ufl.sin(2.0 * x[0] + x[1]) + x[1] ** 2

    def pressed(x):
        return ufl.max_value(0.5 - x[0], 0.0)

    conditions = {
        "contact": Contact(
            lambda x: u(x) - ufl.max_value(x[0] - 0.5, 0.0),
            g=lambda x: -ufl.cos(2.0 * x[0] + x[1]) - pressed(x),
        )
    }
    problem = Problem(
        exact=u,
        reaction=soil,
        conditions=conditions,
        materials={"rock": Material(reaction=rock)},
    )
    errors = []
    for solution in series(problem, layers(8), adaptive, 3):
        mesh = solution.domain.mesh
        made, x = solution.certificate, ufl.SpatialCoordinate(mesh)
        c = ufl.conditional(ufl.gt(x[1], 0.5), *(fem.Constant(mesh, each) for each in (rock, soil)))
        off = u(x) - solution.u
        rows = ufl.inner(ufl.grad(off), ufl.grad(off)), c * off**2
        squares = [
            mesh.comm.allreduce(
                fem.assemble_scalar(fem.form(row * ufl.dx(metadata={"quadrature_degree": 8})))
            )
            for row in rows
        ]
        errors.append(np.sqrt(squares[0]))
        assert made.bound_h1 >= errors[-1]
        assert 1.0 <= made.bound_energy_norm / np.sqrt(sum(squares)) < 1.3
    assert adaptive or np.isclose(errors[-2] / errors[-1], 2.0, rtol=0.05)


@pytest.mark.ranks
def test_what_a_strong_reaction_takes_up_is_that_of_one_rank():
    """Ranks that see a facet of the boundary, but not its cell, have no say about its flux."""

    def u(x):
        return ufl.sin(2.0 * x[0] + x[1])

    rock = Material(reaction=1e8, f=lambda x: 1e8 * u(x))
    problem = Problem(dirichlet=u, obstacle=-1.0, reaction=1.0, materials={"rock": rock})
    one, all_ranks = (
        solve(problem, layers(8, comm)).certificate.parts
        for comm in (MPI.COMM_SELF, MPI.COMM_WORLD)
    )
    assert one == pytest.approx(all_ranks, rel=1e-6)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"materials": {"rock": 6}}, r"no cell is tagged rock \(value 6\): .* are 5, 9"),
        ({"materials": {"a": 5, "b": [9, 5]}}, "5 stands for a and for b"),
        ({"cell_tags": None}, "need tags on cells"),
    ],
)
def test_tags_that_are_not_there(more, said):
    with pytest.raises(InputError, match=said):
        layers(**more)


def test_materials_that_are_not_there():
    with pytest.raises(InputError, match="none called 'sand'; there are: rock"):
        solve(Problem(materials={"sand": Material()}), layers())
    with pytest.raises(InputError, match="a Material is needed"):
        solve(Problem(materials={"rock": 3.0}), layers())
    with pytest.raises(InputError, match=r"coefficient: the value at \(.*\) is -1"):
        solve(Problem(materials={"rock": Material(coefficient=-1.0)}), layers())


def test_as_many_materials_as_there_are_formulas():
    """400, against one formula that holds their numbers."""
    given = layers(16)
    mesh, cells = given.mesh, given.mesh.topology.index_map(2)
    number = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    at = np.arange(cells.size_local, dtype=np.int32)
    numbers = ((at + cells.local_range[0]) % 400 + 1).astype(np.int32)
    number.x.array[number.function_space.dofmap.list[at, 0]] = numbers
    number.x.scatter_forward()
    names = {f"m{i}": i for i in range(1, 401)}
    tags = meshtags(mesh, 2, at, numbers)
    domain = Domain.from_tags(mesh, given.tags, cell_tags=tags, materials=names)
    own = {name: Material(f=lambda x, i=i: -1 - x[0] * i) for name, i in names.items()}
    many = solve(Problem(obstacle=-0.1, materials=own), domain)
    one = solve(Problem(obstacle=-0.1, f=lambda x: -1 - x[0] * number), domain)
    assert many.energy == pytest.approx(one.energy, rel=1e-12)
    assert many.certificate.parts == pytest.approx(one.certificate.parts, rel=1e-6, abs=1e-12)
