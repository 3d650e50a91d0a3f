# %% [markdown]
# # Meshes that adapt, and stop when the error is certified
#
# **Aim.** Ask for an error and get a mesh that has it: on an L-shape, on a polygon with a hole and
# two contact parts, and on a problem whose only trouble is the end of the contact zone, far from
# all corners.
#
# **Mathematics.** The certificate bounds the broken error (1.6) by a sum over cells,
#
# $$\|\nabla_h(u - u_h)\|^2 \lesssim \sum_T \left( \|y - \nabla u_h\|_T^2 + \|\nabla(v - u_h)\|_T^2
#   + \dots \right),$$
#
# $y$ an equilibrated flux and $v \in K$ a conforming companion. `solve_adaptive` marks the fewest
# cells that hold half of the sum, halves their sides, and starts from the solution it has. It ends
# when the *bound* is below the tolerance: the error is then below it as well.
#
# Run it alone or on several ranks; the pictures go to `demo-output` or to the folder named:
#
#     mpirun -n 2 python3 demos/demo_adaptive.py [FOLDER]

# %%
import numpy as np
from study import Study, canvas, levels_wanted, name_curves

from signorini_cr import Polygon, Problem, exact, plots, solve_adaptive, solve_levels
from signorini_cr.output.report import level_record, table_header, table_row
from signorini_cr.rounding import at_most

study = Study("demo_adaptive", "Meshes that adapt, and stop when the error is certified")
# The limit for a quick look is that of the other demos: each level less is a factor of 4
size = 4 ** (8 - levels_wanted(8))
max_dofs = max(100_000 // size, 2_000)
VISIBLE = 4_000  # degrees of freedom of a mesh whose cells can be told apart


def show(solutions, title):
    """Print one row a mesh; keep all bounds, the last solution, and the last that can be seen."""
    first, small, rows = None, None, []
    for solution in solutions:
        record = level_record(solution)
        first = first or record
        rows.append((solution.dofs, solution.certificate.bound_h1))
        if solution.dofs <= VISIBLE:
            small = solution
        if len(rows) == 1:
            study.tell(f"\n{title}\n{table_header(first)}")
        study.tell(table_row(record, first))
    return np.array(rows), solution, small


# %% [markdown]
# ## The three domains
# The hole has a contact edge of its own; the obstacle is bent.

# %%
HOLE = Polygon(
    [[-1, -1], [1, -1], [1, 1], [-1, 1]],
    ["contact", "neumann", "dirichlet", "neumann"],
    holes=[
        Polygon(
            [[-0.4, 0.1], [0.3, -0.2], [0.5, 0.3], [-0.2, 0.5]],
            ["contact", "neumann", "neumann", "neumann"],
        )
    ],
)
PRESS = Problem(f=-1.0, obstacle=lambda x: -0.4 - 0.3 * x[0] ** 2)

CASES = {
    "L-shape": (exact.L.problem, lambda: exact.L.mesh(0.4)),
    "hole, two contact parts": (PRESS, lambda: HOLE.mesh(0.4)),
    "critical point": (exact.S1.problem, lambda: exact.S1.mesh(0.4)),
}
curves, finest, small = {}, {}, {}
for name, (problem, mesh) in CASES.items():
    curves[name, "adaptive"], finest[name], small[name] = show(
        solve_adaptive(problem, mesh(), max_dofs=max_dofs), f"{name}, adaptive"
    )
    levels = 1 + int(np.log(max_dofs / curves[name, "adaptive"][0, 0]) / np.log(4))
    curves[name, "uniform"], *_ = show(solve_levels(problem, mesh(), levels), f"{name}, uniform")

# %% [markdown]
# ## Where the error sits
# On the L-shape at the corner and where the boundary condition changes; on the polygon with the
# hole at all corners and ends of contact; with the critical point nearly everywhere alike, as
# $u \in H^{5/2-\varepsilon}$ needs no help.

# %%
for name, solution in finest.items():
    file = "adaptive-" + name.split()[0].strip(",").lower()
    plots.plot_solution(solution, study.folder / f"{file}-solution.png", name)
    study.show(f"{file}-solution.png", f"{name}: the solution.")
    plots.plot_mesh(small[name].domain, study.folder / f"{file}-mesh.png", name)
    study.show(f"{file}-mesh.png", f"{name}: a mesh that adapted.")
    plots.plot_error(small[name], study.folder / f"{file}-error.png", name)
    study.show(f"{file}-error.png", f"{name}: where the error sits.")


def draw(axes):
    """Bounds against degrees of freedom."""
    colours = dict(zip(CASES, (canvas.BLUE, canvas.RED, canvas.YELLOW), strict=True))
    for (name, kind), rows in curves.items():
        style = "o-" if kind == "adaptive" else "s--"
        axes.loglog(*rows.T, style, color=colours[name], markersize=5)
    dofs = np.array([1e3, max_dofs])
    slopes = {"$N^{-1/2}$": 0.6 * dofs**-0.5, "$N^{-1/3}$": 0.25 * dofs ** (-1 / 3)}
    for line in slopes.values():
        axes.loglog(dofs, line, ":", color="black")
    axes.set_xlabel("number $N$ of degrees of freedom", fontsize=13)
    axes.set_ylabel(r"certified bound of $\|\nabla_h(u-u_h)\|$", fontsize=13)
    axes.grid(which="both", alpha=0.25)
    axes.set_title("Meshes that adapt do not mind corners", fontsize=14)
    named = {f"{name}, {kind}": rows.T for (name, kind), rows in curves.items()}
    named |= {power: (dofs, line) for power, line in slopes.items()}
    name_curves(axes, named, [*(colours[name] for name, _ in curves), "black", "black"])


study.picture(
    "adaptive-convergence.png",
    "Certified bounds on adaptive and on uniform meshes.",
    draw,
    size=(8.5, 6.0),
)

# %% [markdown]
# ## Check
# The adaptive bounds fall like $N^{-1/2}$ on all three, the uniform ones on the L-shape like
# $N^{-1/3}$; a tolerance is met.

# %%
for (name, kind), rows in curves.items():
    late = rows[rows[:, 0] > 0.01 * max_dofs]
    slope = np.polyfit(*np.log(late).T, 1)[0]
    study.tell(
        f"{name}, {kind}: bound {at_most(rows[-1, 1])} with {rows[-1, 0]:.0f}, slope {slope:.2f}"
    )
    if kind == "adaptive":
        assert abs(slope + 0.5) < 0.08, (name, slope)
    elif name == "L-shape":
        assert abs(slope + 1 / 3) < 0.06, (name, slope)

*_, last = solve_adaptive(exact.S1.problem, exact.S1.mesh(0.4), tolerance=0.1)
assert last.errors[0] <= last.certificate.bound_h1 <= 0.1
study.finish()
