# %% [markdown]
# # Certified against true error
#
# **Aim.** See how near the guaranteed bound is to the error that it bounds, that the energy lies
# where the certificate says, and that the bound holds as well when the solver has not finished.
#
# **Mathematics.** With $v \in K$ and $y$ in $H(\mathrm{div})$, $-\mathrm{div}\,y = f$, and
# $y\cdot n \ge 0$ on $\Gamma_1$, the gap
#
# $$J(v) - D(y) = \tfrac12 \|\nabla v - y\|^2 + \int_{\Gamma_1} (y\cdot n)(v - \alpha)$$
#
# bounds the error of both. Both are made from $u_h$ at linear cost; `docs/certificate.md` has the
# proofs. No constant in the bound is unknown, and none is estimated.
#
# Run it alone or on several ranks; the picture goes to `demo-output` or to the folder named:
#
#     mpirun -n 2 python3 demos/demo_certificate.py [FOLDER]

# %%
import numpy as np
from study import COLOURS, Study, called, canvas, levels_wanted, name_curves

# isort: split
from petsc4py import PETSc  # behind study, which finds MPI for the wheels

from signorini_cr import exact, solve, solve_adaptive, solve_levels
from signorini_cr.rounding import at_most, interval

study = Study("demo_certificate", "Certified against true error")
levels = levels_wanted(7)
NAMES = ["S1", "A", "B", "C", "I", "D"]
if levels <= 3:  # the kinks of I, which have no end, take as long on few cells as on many
    NAMES.remove("I")

# %% [markdown]
# ## Uniform and adaptive meshes
# D is not in $H^2$: its error falls like $h^{1/2}$ only, on uniform meshes.

# %%
curves = {}
for name in NAMES:
    example = exact.ALL[name]
    runs = {
        "uniform": solve_levels(example.problem, example.structured(4), levels),
        "adaptive": solve_adaptive(
            example.problem, example.structured(4), max_dofs=160 * 4 ** (levels - 2)
        ),
    }
    for kind, solutions in runs.items():
        rows = []
        for solution in solutions:
            certificate, error = solution.certificate, solution.errors[0]
            low, high = certificate.energy
            rows.append((solution.dofs, error, certificate.bound_h1, low, high))
            assert error <= certificate.bound_h1
            if example.energy is not None:
                assert low <= example.energy <= high
        curves[name, kind] = np.array(rows)
        dofs, error, bound, low, high = curves[name, kind].T
        study.tell(
            f"{called(name):5s} {kind:9s} {dofs[0]:.0f} … {dofs[-1]:.0f} dofs, "
            f"error {error[-1]:.3e}, "
            f"bound/error {bound[0] / error[0]:.3f} … {bound[-1] / error[-1]:.3f}, "
            f"J in {interval(low[-1], high[-1])}"
        )

# %% [markdown]
# ## A solver that is stopped early
# The tolerances are loosened through PETSc's options, up to a solver that does nothing at all;
# whatever is left of the equations is a part of the bound.

# %%
options = PETSc.Options("signorini_")
stopped = []
for tolerance in (1e-9, 1e-5, 1e-4, 1e-3, 1e-2, 0.1):
    options["snes_atol"], options["ksp_rtol"] = tolerance, 0.3
    solution = solve(exact.S1.problem, exact.S1.structured(2 ** min(levels, 6)))
    error, certificate = solution.errors[0], solution.certificate
    residual = solution.contact.kkt.residual
    stopped.append((residual, error, certificate.bound_h1, certificate.parts["solver"]))
    assert error <= certificate.bound_h1
    study.tell(
        f"residual {residual:.1e}: error {error:.3e}, bound {at_most(certificate.bound_h1)}, "
        f"of which solver {certificate.parts['solver']:.1e}"
    )
for name in ("snes_atol", "ksp_rtol"):
    options.delValue(name)

# %% [markdown]
# ## Draw


# %%
def draw(upper, middle, lower):
    """Error and bound, their ratio, and the unfinished solutions."""
    bounds, quotients = {}, {}
    for name, colour in zip(NAMES, COLOURS, strict=False):
        for kind, style in (("uniform", "-"), ("adaptive", ":")):
            dofs, error, bound, *_ = curves[name, kind].T
            middle.semilogx(dofs, bound / error, style, color=colour, linewidth=1.8)
        dofs, error, bound, *_ = curves[name, "uniform"].T
        upper.loglog(dofs, error, "o", color=colour)
        upper.loglog(dofs, bound, "-", color=colour)
        bounds[called(name)], quotients[called(name)] = (dofs, bound), (dofs, bound / error)
    upper.set_title("The certified bound (lines) is never below the error (dots)", fontsize=14)
    upper.set_ylabel(r"$\|\nabla_h(u-u_h)\|$", fontsize=13)
    rough = 100 * (quotients["D"][1][-1] - 1)
    middle.set_title(
        f"It is soon a few percent above it; {rough:.0f} % for D, which is not in $H^2$,\n"
        "unless meshes adapt (dotted)",
        fontsize=14,
    )
    middle.set_ylabel("bound / error", fontsize=13)
    middle.set_ylim(1.0, 1.4)
    for axes in (upper, middle):
        axes.set_xlabel("degrees of freedom", fontsize=13)
    size, error, bound, _ = np.array(stopped).T
    lower.loglog(size, error, "o", color=canvas.BLUE)
    lower.loglog(size, bound, "-", color=canvas.BLUE)
    lower.set_title("It holds for a solver that is stopped early, too (S1)", fontsize=14)
    lower.set_xlabel("relative residual that the solver left", fontsize=13)
    lower.set_ylabel(r"$\|\nabla_h(u-u_h)\|$", fontsize=13)
    for axes in (upper, middle, lower):
        axes.tick_params(labelsize=11)
        axes.grid(which="major", alpha=0.3)
    name_curves(upper, bounds)
    name_curves(middle, quotients)
    name_curves(
        lower, {"error (dots)": (size, error), "bound (line)": (size, bound)}, [canvas.BLUE]
    )


study.picture(
    "certificate.png",
    "Errors and bounds, their quotients, and a solver that is stopped early.",
    draw,
    panels=3,
)

# %% [markdown]
# ## Check
# On uniform meshes the bound is at most 1.45 times the error, and the energy's bracket shrinks like
# $h^2$; both but for D, which is too rough.

# %%
for name in NAMES[:-1]:
    dofs, error, bound, low, high = curves[name, "uniform"].T
    assert np.all(bound[1:] <= 1.45 * error[1:]), name
    rate = np.log2((high - low)[-2] / (high - low)[-1])
    assert rate > 1.85, (name, rate)
study.finish()
