# %% [markdown]
# # A dam whose wet part nobody knows
#
# **Aim.** A dam of sand stands between two waters. Know how much seeps through, how high the
# sand is wet, and at which height the water comes out above the lower one; and check all of it
# against Polubarinova-Kochina's closed form, the standard of such computations.
#
# **Mathematics.** The dam is a rectangle on rock, $0 < x < L$, with water $H$ high at $x = 0$
# and $h$ high at $x = L$. Where it is wet the head $u$ satisfies
# $-\nabla\cdot(\kappa\nabla u) = 0$, with $u = H$ and $u = h$ below the waters. Above the lower one
#
# $$u \le y, \qquad \lambda = \kappa\,\partial_\nu u \le 0, \qquad \lambda\,(u - y) = 0$$
#
# on the face, as on every face that seeps. The wet part ends at a free surface, which no water
# passes and on which the pressure is that of the air: $\kappa\,\partial_\nu u = 0$ *and* $u = y$.
# Only for the true surface can both be had.
#
# Run it alone or on several ranks; the picture goes to `demo-output` or to the folder named:
#
#     mpirun -n 2 python3 demos/demo_dam.py [FOLDER]

# %%
from pathlib import Path

import numpy as np
from study import ENDS, Study, canvas, comm, levels_wanted

# isort: split
from dolfinx import fem  # behind study, which finds MPI for the wheels
from scipy.integrate import quad
from scipy.optimize import root
from scipy.special import ellipk, ellipkm1

from signorini_cr import (
    Contact,
    Dirichlet,
    Neumann,
    Polygon,
    Problem,
    force,
    solve,
    solve_levels,
)
from signorini_cr.app.problemfile import load
from signorini_cr.output.units import Units

study = Study("demo_dam", "A dam whose wet part nobody knows")
LENGTH, HIGH, LOW = 16.0, 24.0, 4.0  # L, H and h in m; κ is 1 m/d

# %% [markdown]
# ## The closed form
# With the complete elliptic integral $K(m)$ of the parameter $m$, $s = \sin\varphi$ and
# $c = \cos\varphi$, Polubarinova-Kochina has, for two numbers $0 < \alpha < \beta < 1$ and a
# length $C$,
#
# $$L = C\int_0^{\pi/2}\frac{K(\alpha + (\beta - \alpha)s^2)\,d\varphi}
#                          {\sqrt{1 - \alpha - (\beta - \alpha)s^2}},
# \qquad h = C\int_0^{\pi/2}\frac{\sqrt\alpha\,K(\alpha s^2)\,s\,d\varphi}
#                          {\sqrt{(1 - \alpha s^2)(\beta - \alpha s^2)}},$$
#
# the exit point at the height $e$, and the free surface as a curve with the parameter $\psi$,
#
# $$e = h + C\int_0^{\pi/2}\frac{K(c^2)\,s\,c\,d\varphi}
#                          {\sqrt{(1 - (1 - \alpha)s^2)(1 - (1 - \beta)s^2)}},$$
#
# $$x = L - C\int_0^\psi\frac{K(s^2)\,s\,d\varphi}{\sqrt{(1 - \alpha s^2)(1 - \beta s^2)}},
# \qquad y = e + C\int_0^\psi\frac{K(c^2)\,s\,d\varphi}{\sqrt{(1 - \alpha s^2)(1 - \beta s^2)}}.$$
#
# At $\psi = \pi/2$ it is at $x = 0$ and $y = H$. The three equations for $L$, $h$ and $H$ give
# $\alpha$, $\beta$ and $C$. What flows is
#
# $$\frac{Q}{\kappa} = C\int_0^{\pi/2}\left(
# \frac{K(s^2)\,s\,c}{\sqrt{(1 - (1 - \alpha)s^2)(1 - (1 - \beta)s^2)}}
# + \frac{\sqrt\alpha\,K(1 - \alpha s^2)\,s}{\sqrt{(1 - \alpha s^2)(\beta - \alpha s^2)}}
# \right)d\varphi,$$
#
# through the seepage face and below the lower water. By Charny's theorem it is
# $\kappa(H^2 - h^2)/2L$, Dupuit's formula: that and $x(\pi/2) = 0$ are two checks of what is
# written here, as neither goes into the equations.


# %%
def integral(values, end=0.5 * np.pi):
    """From 0 to `end` of a function of sin φ and cos φ."""
    return quad(lambda angle: values(np.sin(angle), np.cos(angle)), 0.0, end, epsabs=1e-12)[0]


class ClosedForm:
    """Polubarinova-Kochina's solution for one dam; κ is 1.

    Attributes:
        exit: Height of the exit point.
        discharge: Through all of the dam.
        seeping: What of it leaves above the lower water.
    """

    def __init__(self, length, high, low):
        """Find α, β and C."""
        self.length = length

        def off(unknown):
            self.take(unknown)
            return self.low - low, self.surface(0.5 * np.pi)[1] - high

        found = root(off, (-1.0, 1.0), tol=1e-13)
        assert found.success, found.message

    def take(self, unknown):
        """Set all that follows from two numbers, β = 1/(1 + exp(−unknown[0])) the first."""
        b, share = 1.0 / (1.0 + np.exp(-unknown))
        a = b * share
        self.parameters = a, b
        width = integral(
            lambda s, c: ellipk(a + (b - a) * s**2) / ((1 - a) - (b - a) * s**2) ** 0.5
        )
        self.scale = scale = self.length / width

        def seeps(s, c):
            return scale * s * c / ((1 - (1 - a) * s**2) * (1 - (1 - b) * s**2)) ** 0.5

        def below(s):
            return scale * a**0.5 * s / ((1 - a * s**2) * (b - a * s**2)) ** 0.5

        self.low = integral(lambda s, c: ellipk(a * s**2) * below(s))
        self.exit = self.low + integral(lambda s, c: ellipkm1(s**2) * seeps(s, c))
        self.seeping = integral(lambda s, c: ellipk(s**2) * seeps(s, c))
        self.discharge = self.seeping + integral(lambda s, c: ellipk(1 - a * s**2) * below(s))

    def surface(self, end):
        """The point of the free surface at ψ."""
        a, b = self.parameters

        def weight(s):
            return self.scale * s / ((1 - a * s**2) * (1 - b * s**2)) ** 0.5

        x = self.length - integral(lambda s, c: ellipk(s**2) * weight(s), end)
        return x, self.exit + integral(lambda s, c: ellipkm1(s**2) * weight(s), end)


shapes = [(LENGTH, HIGH, LOW), (5.0, 10.0, 2.0), (10.0, 10.0, 2.0), (162.0, 322.0, 84.0)]
forms = [ClosedForm(*shape) for shape in shapes]
charny = [(high**2 - low**2) / (2.0 * length) for length, high, low in shapes]
study.table(
    "Polubarinova-Kochina's exit point and discharge for dams of several shapes, and Charny's.",
    {
        "$L$": ("{:g}", [length for length, _, _ in shapes]),
        "$H$": ("{:g}", [high for _, high, _ in shapes]),
        "$h$": ("{:g}", [low for _, _, low in shapes]),
        "exit": ("{:.4f}", [form.exit for form in forms]),
        "discharge": ("{:.6f}", [form.discharge for form in forms]),
        "Charny's": ("{:.6f}", charny),
    },
)
for form, flow in zip(forms, charny, strict=True):
    assert abs(form.discharge - flow) < 1e-8 * flow
    assert abs(form.surface(0.5 * np.pi)[0]) < 1e-8 * form.length
exact, dupuit = forms[0], charny[0]
curve = np.array([exact.surface(angle) for angle in np.linspace(0.5 * np.pi, 1e-6, 120)])

# %% [markdown]
# ## The trial surfaces
# The wet part is taken to be the polygon below a polyline through $(x_i, y_i)$, which no water
# passes; on it the inequality is solved as always. Where $u$ isn't $y$ on the polyline, it moves:
# $y_i := u$ there. It begins at the top of the dam, and comes down; the points are closer
# where the surface is steep. At the exit point $u$ is extrapolated from the last two facets.

# %%
NODES, SMALL = 32, 0.01  # of the polyline; where |u − y| is small, in m
problem = Problem(
    conditions={
        "above": Dirichlet(HIGH),
        "below": Dirichlet(LOW),
        "face": Contact(upper=lambda x: x[1]),
        "rock": Neumann(),
        "surface": Neumann(),
    }
)


def wet(x, y):
    """The polygon below a polyline, which runs from the left to the right."""
    corners = [(0.0, 0.0), (LENGTH, 0.0), (LENGTH, LOW)]
    return Polygon(
        [*corners, *zip(x[::-1], y[::-1], strict=True)],
        ("rock", "below", "face", *["surface"] * (len(x) - 1), "above"),
        names=tuple(problem.conditions),
    )


def heads(solution, x):
    """The head on the surface, at points of these x: between facets' midpoints, and beyond."""
    domain, space = solution.domain, solution.u.function_space
    domain.mesh.topology.create_connectivity(1, 2)
    facets = domain.facets(domain.parts["surface"])
    dofs = fem.locate_dofs_topological(space, 1, facets)
    mine = space.tabulate_dof_coordinates()[dofs, 0], solution.u.x.array[dofs]
    middles, values = np.concatenate(comm.allgather(np.array(mine)), axis=1)
    order = np.argsort(middles)
    middles, values = np.append(0.0, middles[order]), np.append(HIGH, values[order])
    slope = (values[-1] - values[-2]) / (middles[-1] - middles[-2])
    end = values[-1] + slope * (LENGTH - middles[-1])
    return np.interp(x, np.append(middles, LENGTH), np.append(values, end))


x = LENGTH * (1.0 - np.linspace(1.0, 0.0, NODES + 1) ** 1.5)
y = np.full_like(x, HIGH)
trials, rows = [], []
for _ in range(40):
    solution = solve(problem, wet(x, y).mesh(1.5))
    u = heads(solution, x)
    trials.append(y)
    rows.append((np.abs(u - y).max(), y[-1], force.flux(solution, "above").value))
    if rows[-1][0] < SMALL:
        break
    y = np.minimum.accumulate(u)
off, exits, flows = np.array(rows).T
shown = np.unique(np.append(np.arange(0, len(rows), 4), len(rows) - 1))
study.table(
    "The trial surfaces: how far $u$ is from $y$ there, in m, their end, and the discharge.",
    {
        "step": ("{}", shown),
        "$|u - y|$": ("{:.3f}", off[shown]),
        "end": ("{:.2f}", exits[shown]),
        "discharge": ("{:.3f}", flows[shown]),
    },
)
assert off[-1] < SMALL
case = load(Path(__file__).parent.parent / "meshes" / "dam.toml")  # has the last one
assert np.abs(case.domain.vertices[3:] - np.stack([x, y], axis=1)[::-1]).max() < 2 * SMALL

# %% [markdown]
# ## The discharge, certified on the last domain
# The interval is that of the inequality on the last polygon. How far that is from the dam's own
# discharge is known as well, as Charny's proof goes through on any polygon, where $u$ isn't $y$:
# the derivative of $\int_0^{y(x)} u\,dy$ is $-Q/\kappa + u\,y'(x)$, and with the seepage face
# wet up to its end
#
# $$\frac{Q}{\kappa} = \frac{H^2 - h^2}{2L} + \frac{1}{L}\int_0^L (u - y)\,y'(x)\,dx.$$

# %%
found = []
for solution in solve_levels(problem, wet(x, y).mesh(1.5), levels_wanted(5)):
    found.append((solution.cells, *force.flux(solution, "above")))
cells, values, lower, upper = map(np.array, zip(*found, strict=True))
lower, upper = study.intervals(
    "The discharge below the last surface, in m² a day.",
    "discharge",
    (cells, values, lower, upper),
    3,
)
fine = np.linspace(0.0, NODES, 16 * NODES + 1)
x_fine, y_fine = (np.interp(fine, np.arange(NODES + 1), each) for each in (x, y))
beyond = np.trapezoid(heads(solution, x_fine) - y_fine, y_fine) / LENGTH
study.tell(f"Charny's: {dupuit} m² a day, and {beyond:.4f} as the surface isn't quite the true one")
assert np.all(lower <= dupuit + beyond) and np.all(dupuit + beyond <= upper)
assert abs(values[-1] - dupuit - beyond) < 1e-3 * solution.h * dupuit

# %% [markdown]
# ## Against the closed form
# The surface, where the water comes out, and how much of it does above the lower water. The last
# has no interval: the two parts of the face meet, and what passes one of them is no bounded
# functional of $u$.

# %%
away = np.abs(y - np.interp(x, *curve.T))
seeps = -solution.contact.force
study.table(
    "What was found, and Polubarinova-Kochina's.",
    {
        "": ("{}", ["exit point, m", "seeps above the lower water, m²/d", "discharge, m²/d"]),
        "found": ("{:.3f}", [y[-1], seeps, values[-1]]),
        "closed form": ("{:.3f}", [exact.exit, exact.seeping, exact.discharge]),
    },
)
study.table(
    "The free surface, in m.",
    {
        "$x$": ("{:.2f}", x[::4]),
        "found": ("{:.2f}", y[::4]),
        "closed form": ("{:.2f}", np.interp(x, *curve.T)[::4]),
    },
)
study.tell(f"the surfaces are {away.max():.3f} m apart, at most")
assert away.max() < 0.05
assert abs(y[-1] - exact.exit) < 0.05
assert abs(seeps - exact.seeping) < 0.01 * exact.seeping


# %%
def draw(field, beside, table):
    """The closed form on the head, and the surfaces on the way."""
    places = np.linspace(0.0, LENGTH, 8, endpoint=False)  # none on the exit point
    dots = np.stack([places, np.interp(places, *curve.T)], axis=1)
    field.plot(*dots.T, "o", color=canvas.RED, markersize=6, zorder=5, clip_on=False)
    field.annotate(
        "closed form\n(Polubarinova-\nKochina)", dots[5], xytext=(6, 10),
        textcoords="offset points", color=canvas.RED, fontsize=13,
    )  # fmt: skip
    for k, trial in enumerate(trials):
        beside.plot(x, trial, color=canvas.BLUE, alpha=0.35 if k < len(trials) - 1 else 1.0)
        if k < 4:
            beside.annotate(f"{k}", (x[-1], trial[-1]), xytext=(4, -4), textcoords="offset points")
    beside.plot(*curve.T, "--", color=canvas.RED)
    beside.set_xlim(0.0, LENGTH)
    beside.set_xlabel("$x$ in m", fontsize=13)
    beside.set_ylabel("$y$ in m", fontsize=13)
    beside.set_title("Trial surfaces 0, 1, 2, …; dashed: the closed form", fontsize=13)
    beside.figure.get_layout_engine().set(wspace=0.06)  # from the bar of colours
    beside.grid(alpha=0.3)


study.field(
    "dam.png",
    "The head in the wet part of the dam, and the surfaces on the way to the last one.",
    solution,
    draw,
    units=Units(x="m", u="m", names={"u": "head"}),
    title=f"The dam seeps up to {y[-1]:.1f} m; the lower water ends at {LOW:g} m",
    size=(12.0, 6.0),
    words={"contact": "seeps", "no contact": "", ENDS: "exit point"},
    ncols=2,
)
study.finish()
