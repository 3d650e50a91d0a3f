# %% [markdown]
# # A Signorini problem with a known solution
#
# **Aim.** Solve the paper's problem on a sequence of meshes, see where there is contact, and see
# the error fall like $h$ in the broken norm (1.6) and like $h^2$ in $L^2$.
#
# **Mathematics.** On $\Omega = (-1, 1) \times (0, 1)$ with $\Gamma_1 = \{y = 0\}$ and $u = 0$ on
# the rest, $\Gamma_0$, the solution sought satisfies
#
# $$-\Delta u = f, \qquad u \ge 0, \quad \partial_\nu u \ge 0, \quad u\,\partial_\nu u = 0
#   \quad\text{on } \Gamma_1. \tag{1.4}$$
#
# With $f$ chosen to suit it is $u = (1 - x^2)(1 - y^2)\, r^{3/2} \cos(3\theta/2)$: in contact for
# $x < 0$ and free for $x > 0$, with the regularity to expect where contact ends. The
# Crouzeix–Raviart function $u_h$ respects the obstacle at the midpoints of the facets on
# $\Gamma_1$ (1.7) and solves the discrete variational inequality (1.8).
#
# Run it alone or on several ranks; the pictures go to `demo-output` or to the folder named:
#
#     mpirun -n 2 python3 demos/demo_s1.py [FOLDER]

# %%
import textwrap

import numpy as np
from study import Study, comm, levels_wanted

from signorini_cr import exact, plots, solve_levels
from signorini_cr.output.report import level_record, table_header, table_row
from signorini_cr.output.tables import certificate_lines, legend, markdown_table

study = Study("demo_s1", "S1 on unstructured meshes")
levels = levels_wanted(6)
study.tell(
    """−Δu = f on (−1, 1) × (0, 1), u = 0 on three sides; on the fourth, y = 0, u may
touch 0 and not cross it: u ≥ 0, ∂u/∂n ≥ 0, and one of them is 0.
"""
)

# %% [markdown]
# ## Solve
# The coarsest mesh comes from gmsh; each of the others cuts every triangle into four, and is
# solved from where the one below it ended.

# %%
domain = exact.S1.mesh(0.25)
records = []
for solution in solve_levels(exact.S1.problem, domain, levels):
    records.append(level_record(solution, records[-1] if records else None))
    if len(records) == 1:
        study.tell(table_header(records[0]))
    study.tell(table_row(records[-1], records[0]))
study.parts.append(markdown_table(records).strip())
study.tell("\n" + textwrap.fill(legend(records[0]), 80) + "\n")
head, *figures = certificate_lines(records[-1])
study.tell(textwrap.fill(head, 80))
for figure in figures:
    study.tell(textwrap.fill(figure, 80, initial_indent="  ", subsequent_indent="    "))

# %% [markdown]
# ## Look
# The first picture shows $u_h$ and the facets in contact, the second $u_h$ and the pressure
# $\lambda_h$ along $\Gamma_1$, the third the errors.

# %%
plots.plot_solution(solution, study.folder / "s1-solution.png", "S1")
study.show("s1-solution.png", "u_h of S1 on the finest mesh, in contact for x < 0.")
plots.plot_contact(solution, study.folder / "s1-contact.png", "S1")
study.show("s1-contact.png", "S1: u_h and the pressure along Γ1.")
rates = study.folder / "s1-convergence.png"
plots.drawn(comm, lambda: plots.plot_convergence(records, rates, "S1"))
study.show("s1-convergence.png", "S1: the errors fall like h and like h².")

# %% [markdown]
# ## Check
# Over the last three levels both rates are those of the theory, contact ends within a facet of the
# origin, and the energy comes close to $J(u) = -0.48587761266$, from below.

# %%
h1, l2 = (np.array([record[f"rate_{norm}"] for record in records[-2:]]) for norm in ("h1", "l2"))
assert np.all(abs(h1 - 1.0) < 0.05), h1
assert np.all(abs(l2 - 2.0) < 0.10), l2
(transition,) = solution.contact.transitions
assert np.linalg.norm(transition) < solution.h, transition
gap = exact.S1.energy - solution.energy
assert 0.0 < gap < 3.0 * records[-1]["error_h1"] ** 2, gap
study.finish()
