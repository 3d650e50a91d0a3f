# %% [markdown]
# # A wall that lets the tide in, not out
#
# **Aim.** Behind a quay wall with flap valves, know how high the water in the ground stands, when
# the valves are open, and how much comes in.
#
# **Mathematics.** With the level $u$, the transmissivity $\kappa$ and the part $c$ of the ground
# that water can fill, $c\,\partial_t u - \nabla\cdot(\kappa\nabla u) = 0$; on the wall, with the
# tide $\alpha(t)$ in front of it,
#
# $$u \ge \alpha, \qquad \lambda = \kappa\,\partial_\nu u \ge 0, \qquad \lambda\,(u - \alpha) = 0:$$
#
# where a valve is open both levels are the same, and water comes in; where the level behind is
# higher, nothing passes. It is the semipermeable wall of Duvaut and Lions, whose fluid is the
# ground water here.
#
# Run it alone or on several ranks; the pictures go to `demo-output` or to the folder named:
#
#     mpirun -n 2 python3 demos/demo_wall.py [FOLDER]

# %%
from pathlib import Path

import numpy as np
import ufl
from study import Study, canvas, comm, levels_wanted, name_curves

# isort: split
from dolfinx import fem  # behind study, which finds MPI for the wheels

from signorini_cr import (
    Contact,
    Neumann,
    Polygon,
    Problem,
    force,
    solve_in_time,
    solve_levels,
)
from signorini_cr.app.problemfile import load
from signorini_cr.output.strip import chosen, moment
from signorini_cr.rounding import interval

study = Study("demo_wall", "A wall that lets the tide in, not out")
levels, finer = levels_wanted(3), levels_wanted(5)
case = load(Path(__file__).parent.parent / "meshes" / "wall.toml")
PERIOD, TIDE = 12.42, 2.0  # h and m
CAPACITY, LEAK = 0.2, 0.04  # 1 and m/h
AREA = 80 * 50 - 388  # m², without the cellar


class Totals:
    """Integrals of the solutions on one mesh, the form compiled once; collective."""

    def __init__(self, solution, integrand):
        """Make the form, `integrand` of u and the domain."""
        self.u = fem.Function(solution.u.function_space)
        self.form = fem.form(integrand(self.u, solution.domain))

    def of(self, solution):
        """The integral for this solution."""
        self.u.x.array[:] = solution.u.x.array
        return comm.allreduce(fem.assemble_scalar(self.form))


def stored(u, domain):
    """Return what the ground holds above the sea's mean, in m³, as a form."""
    return CAPACITY * u * ufl.dx(domain.mesh)


def leaked(u, domain):
    """Return what goes to the land, in m³/h, as a form."""
    ds = ufl.Measure("ds", domain.mesh, subdomain_data=domain.tags)
    return LEAK * u * ds(domain.parts["land"])


# %% [markdown]
# ## Three tides and a quarter
# The ground begins at the sea's mean level.

# %%
rows, moments, held, lost = [], [], None, None
for time, solution in case.steps(case.mesh(), levels):
    held = held or Totals(solution, stored)
    lost = lost or Totals(solution, leaked)
    rows.append((time, solution.contact.force, held.of(solution), lost.of(solution)))
    if len(rows) in chosen(case.time.steps):
        moments.append(moment(time, solution))
times, inflow, volume, leak = np.array(rows).T
study.strip(
    "wall-strip.png",
    "The level in the ground, and where the wall is open.",
    moments,
    units=case.units,
    title="Where the ground fills sooner, on the left, the wall shuts first",
    words={
        r"of $\Gamma_1$ in contact": "of the wall open",
        "no contact": "wall shut",
        "contact": "wall open",
    },
)


def draw(levels_of, flows):
    """The tide and the level behind the wall, and what comes in."""
    fine = np.linspace(0.0, times[-1], 500)
    tide, mean = TIDE * np.sin(2 * np.pi * fine / PERIOD), volume / (CAPACITY * AREA)
    levels_of.plot(fine, tide, "--", color=canvas.BLUE)
    levels_of.plot(times, mean, color=canvas.RED, linewidth=2.5)
    levels_of.set_ylabel("level in m", fontsize=13)
    levels_of.set_title("The tide comes in, and stays", fontsize=16)
    flows.fill_between(times, inflow, color=canvas.BLUE, alpha=0.35)
    flows.plot(times, inflow, color=canvas.BLUE)
    flows.set_ylabel("comes in, in m³/h", fontsize=13)
    flows.set_xlabel("time in h", fontsize=13)
    for axes in (levels_of, flows):
        axes.grid(alpha=0.3)
        axes.set_xlim(0.0, times[-1])
    named = {"the tide": (fine, tide), "behind the\nwall, mean": (times, mean)}
    name_curves(levels_of, named, [canvas.BLUE, canvas.RED])


study.picture("wall.png", "The tide, the level behind the wall, and what comes in.", draw,
              panels=2, size=(11.0, 3.4))  # fmt: skip

# %% [markdown]
# ## Check: nothing is lost
# What has come in is there, or has leaked: in every step
# $(3V_n - 4V_{n-1} + V_{n-2})/(2\Delta t) = \int\lambda - \int 0.04\,u$.

# %%
step, before = times[1] - times[0], np.concatenate([[0.0], volume])
growth = np.diff(before) / step
growth[1:] = (3 * before[2:] - 4 * before[1:-1] + before[:-2]) / (2 * step)
off = np.abs(growth - (inflow - leak)).max()
study.tell(f"balance: off by {off:.1e} m³/h of {inflow.max():.0f}")
assert off < 1e-6 * inflow.max()
assert np.all(inflow > -1e-9)

# %% [markdown]
# ## High water for ever
# The sea at 2 m, always: what comes in then leaks, and the certified flux is an interval. No tide
# that stays below that level lifts the ground water above the one found here, as solutions of such
# problems keep the order of their data.

# %%
case.time.clock.value = PERIOD / 4
*_, solution = solve_levels(case.problem, case.mesh(), finer)
steady, low, high = force.flux(solution, "quay")
study.tell(f"high water for ever: {steady:.4f} m³/h, in {interval(low, high)}")
assert low <= steady <= high
assert abs(steady - Totals(solution, leaked).of(solution)) < 1e-6 * steady

*_, (_, late) = solve_in_time(
    case.problem, case.mesh(), end=1e5, steps=10, capacity=CAPACITY, levels=finer
)
study.tell(f"after 11 years of it: {late.contact.force:.4f} m³/h")
assert abs(late.contact.force - steady) < 1e-5 * steady
assert volume.max() < Totals(solution, stored).of(solution)

# %% [markdown]
# ## Check: the wave of the tide
# In ground without end, of one $\kappa$, the tide $A\cos\omega t$ makes the wave
# $u = A e^{-kx}\cos(\omega t - kx)$ with $k^2 = \omega c/2\kappa$ (Ferris, 1952). Its inflow
# $\sqrt2\,\kappa A k\cos(\omega t + \pi/4)$ is that of our wall for as long as it is not negative:
# the wall closes an eighth of a period **after** high water, and in the half period till then it
# has let in $2\sqrt2\,\kappa A k/\omega$ a metre.

# %%
KAPPA, WIDTH, STEPS = 18.0, 5.0, 90
omega = 2 * np.pi / PERIOD
k = np.sqrt(omega * CAPACITY / (2 * KAPPA))
strip = Polygon(
    [[0, 0], [150, 0], [150, WIDTH], [0, WIDTH]],
    ["side", "side", "side", "wall"],
    names=("side", "wall"),
).mesh(WIDTH)
t = fem.Constant(strip.mesh, 0.0)
problem = Problem(
    coefficient=KAPPA,
    conditions={
        "wall": Contact(TIDE * ufl.cos(omega * t - 3 * np.pi / 4)),
        "side": Neumann(),
    },
)
rows, held = [], None
for time, solution in solve_in_time(
    problem, strip, end=0.75 * PERIOD, steps=STEPS, scheme="bdf2", capacity=CAPACITY, levels=3,
    initial=lambda x: TIDE * ufl.exp(-k * x[0]) * ufl.cos(-3 * np.pi / 4 - k * x[0]), time=t,
):  # fmt: skip
    held = held or Totals(solution, stored)
    rows.append((time, solution.contact.force / WIDTH, held.of(solution) / WIDTH))
times, inflow, volume = np.array(rows).T
greatest = np.sqrt(2) * KAPPA * TIDE * k
wave = np.where(times < PERIOD / 2, greatest * np.sin(omega * times), 0.0)
error = np.abs(inflow - wave).max() / greatest
closed = times[inflow > 1e-6 * greatest][-1]
end = CAPACITY * TIDE / (np.sqrt(2) * k)  # minus as much when the wall opens
filled = volume[times > PERIOD / 2]
study.tell(f"open till {closed:.3f} h, theory {PERIOD / 2:.3f} h; inflow off by {error:.2%};")
study.tell(f"then {filled[-1]:.4f} m² above the mean, theory {end:.4f} m²")
assert error < 0.01
assert abs(closed - PERIOD / 2) < 1.5 * PERIOD * 0.75 / STEPS
assert np.ptp(filled[20:]) < 1e-8 * end  # the scheme's own memory is gone by a third a step
assert abs(filled[-1] - end) < 0.005 * 2 * end
study.finish()
