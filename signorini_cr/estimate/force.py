"""Guaranteed bounds of what flows through parts of the boundary: contact forces, fluxes at Γ0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix

from ..arrays import FloatArray, Int32Array
from ..data.diffusion import diffusion
from ..data.loads import reacts, trace_of
from ..errors import InputError
from ..fem.cells import Cells, dot_rows, measures, sum_rows
from ..fem.conditions import Condition, Data, facets_of
from ..fem.layout import Layout
from ..fem.space import function_space, ghosted_vector
from ..garbage import release
from ..jit import compiled
from ..options import DUAL, ESTIMATE_PREFIX, solve_once
from ..vi.solved import Solved
from .certificate import UNDERFLOW, Certificate, Made
from .companion import bend_squares
from .duality import apart
from .heights import mean_square
from .weights import Weighed, Weight

NO_BOUNDS = "what flows through the part has no bounds"
TOUCHES = (
    "Γ1 touches Γ0, where a change of u as small as one likes changes the force; with a weight that"
    " is 0 there it has some"
)
MEETS = (
    "the part touches another one on which u is set or bounded, where a change of u as small as one"
    " likes changes what flows through it; with a weight that is 0 there it has some"
)
SPATIAL = "they are worked out for d = 2 only"


class Certified(Solved, Protocol):
    """A solution that knows its certificate."""

    @property
    def certificate(self) -> Certificate:
        """The certificate of its error."""


class Interval(NamedTuple):
    """Bounds of a number that u has.

    Attributes:
        value: The same number of u_h.
        lower: It is not below this.
        upper: It is not above this.
    """

    value: float
    lower: float
    upper: float


def made_of(solution: Certified) -> Made:
    """Return what the certificate is made of; an error where there is none, or another physics."""
    diffusion(solution.level.data)
    certificate = solution.certificate
    if certificate.made is None:
        raise InputError(f"{NO_BOUNDS}: {certificate.reason}")
    return certificate.made


def force_interval(
    made: Made, cells: Cells, conditions: Sequence[Condition], weight: Data | None = None
) -> Interval:
    """Bound ∫ λ over parts, or ∫ λ ω with a weight ω; collective.

    With φ = 1 on them and φ = 0 on the rest of Γ0 and Γ1 it is a(u, φ) − χ(φ), and the certificate
    knows a ball that A u is in. φ is found by solving for nearly the least ‖Aφ‖, as accurately as
    the figures deserve; that costs about as much as the solve. With a weight ω it is φ + ℓ that is
    ω on the parts, see `Weight`.
    """
    if cells.tdim != 2:
        raise InputError(f"{NO_BOUNDS}: {SPATIAL}")
    given = None if weight is None else Weight.of(made, cells, conditions, weight)
    if given is None:
        phi = indicator(made, cells, conditions)
    else:
        phi = extended(given.values, given.known, made, cells)
    at = np.ascontiguousarray(phi.x.array[phi.function_space.dofmap.list[: cells.number]].T)
    work, off, slack = against(made, cells, at)
    (energy,) = cells.total(square(made, cells, at))
    lost = lost_of_norms(made, cells)
    if given is None:
        weighed = Weighed(force=sum(through(made, cells, condition) for condition in conditions))
    else:
        weighed = given.weighed(made, cells, float(np.sqrt(energy)) + lost)
    at_fixed = any(condition.fixed is not None for condition in conditions)
    # what e = 0 on Γ0 is good for elsewhere has to be paid for where φ = 1
    exits = at_fixed or made.on_contact_alone
    more = unsure(made, at, slack, weighed) if exits else 0.0
    value, middle, lifted, more = cells.total(
        weighed.force,
        weighed.force + 0.5 * work,
        weighed.square,
        weighed.unsure + 0.5 * off + more,
    )
    # ℓ meets all of A(u − v), of which one half is known to be at most the radius
    reach = made.reach * (np.sqrt(energy) + 2.0 * np.sqrt(lifted) + 3.0 * lost) + more
    # a force off one bound only has its sign
    signs = {s for c in conditions for s, _ in c.bounds} if not at_fixed else set()
    if min(cells.comm.allgather(weighed.least)) < 0.0:
        signs = set()
    lowest, highest = (0.0 if signs == {s} else s * -np.inf for s in (1, -1))
    lower, upper = max(float(middle - reach), lowest), min(float(middle + reach), highest)
    return Interval(float(value), lower, upper)


def lost_of_norms(made: Made, cells: Cells) -> float:
    """Bound what norms of φ and ℓ lack where squares are below all numbers; collective."""
    stiff = max(cells.comm.allgather(float(np.max(made.kappa, initial=0.0))))
    (number,) = cells.total(cells.number)
    return float(UNDERFLOW * (1.0 + np.sqrt(stiff)) * np.sqrt(number))


def through(made: Made, cells: Cells, condition: Condition) -> float:
    """Return ∫ λ_h on a contact part, ∫ y·n on a Dirichlet part; this rank's share."""
    if condition.number in made.forces:
        return made.forces[condition.number]
    side = cells.sides[condition.number]
    return float(np.sum(made.through(cells)[side.local, side.cells]))


def unsure(
    made: Made, at: FloatArray, slack: FloatArray, weighed: Weighed = Weighed(force=0.0)
) -> float:
    """Bound what is left of −div y = f times φ + ℓ where it does not vanish on Γ0; rank's share.

    Args:
        made: What is left.
        at: φ of P1 at the cells' vertices, shape (3, cells).
        slack: From `against`.
        weighed: What ℓ adds.
    """
    largest = np.abs(at).max(initial=0.0) + weighed.mean
    return float(np.sum(slack) + weighed.left + made.missed.sum() * largest)


def against(made: Made, cells: Cells, at: FloatArray) -> tuple[float, float, FloatArray]:
    """Compute (A v − p', Aφ), this rank's share, p' = p + A u_h, for d = 2.

    Args:
        made: v, p and u_h.
        cells: The mesh.
        at: φ of P1 at the cells' vertices, shape (3, cells).

    Returns:
        The product; how far it may be from the truth, where κ, c or b vary within cells or facets;
        and |∫_T (f + div y)| times φ's mean where c has not taken that up, shape (cells,).
    """
    d = cells.tdim
    everywhere = slice(0, cells.number)
    w, P, total = made.w, made.excess, sum_rows(at)
    # (A v − p', Aφ) with p' = p + A u_h, cell by cell: first gradients, then c, then b
    v = made.vertices[cells.vertices]
    slopes = cells.apply(at, everywhere)
    height, off = made.bumps[cells.facets], 0.0
    if made.within is None:
        work = made.kappa * (
            dot_rows(v, slopes) - dot_rows(w, slopes) - 4 / 3 * dot_rows(height, slopes)
        )
    else:
        work = dot_rows(made.within.pull, at) - made.kappa * dot_rows(w, slopes)
        off += float(made.within.unsure @ np.sqrt(dot_rows(at, slopes) / cells.volume))
    if made.cusps is not None:
        pull, _ = made.cusps.pulls(cells)
        work[made.cusps.at] += dot_rows(pull, at[:, made.cusps.at])
    s = sum_rows(P)
    work -= (s * total - dot_rows(P, at)) / d - s * total / (d + 1)
    if made.hats is not None:
        work -= cells.volume * dot_rows(made.hats, at)
    if reacts(made.reaction):
        means = (sum_rows(v - w) * total + dot_rows(v - w, at)) / 12.0
        means += (2.0 * sum_rows(height) * total - dot_rows(height, at)) / 15.0
        if made.cusps is not None:
            means[made.cusps.at] += dot_rows(made.cusps.moments, at[:, made.cusps.at])
        work += made.reaction * cells.volume * means
    if made.most_reaction is not made.reaction:
        sizes = mean_square(v - w, height) * (total**2 + dot_rows(at, at)) / 12.0
        off += float(((made.most_reaction - made.reaction) * cells.volume) @ np.sqrt(sizes))
    slack = np.abs(made.left * total) / (d + 1)
    if made.taken_up is not None:
        work -= np.where(made.taken_up, made.left * total, 0.0) / (d + 1)
        slack[made.taken_up] = 0.0
    edge = made.segments
    on_edge = np.einsum("qin,in->qn", edge.hats, trace_of(cells, edge.side, at))
    of_edge = edge.measure * np.sum(edge.weights[:, None] * edge.rest * on_edge, axis=0)
    if edge.most.any():
        jump = apart(cells, w, edge, made.vertices, made.bumps)
        least, most = edge.of_loss * edge.measure
        of_edge = of_edge - least * np.sum(edge.weights[:, None] * jump * on_edge, axis=0)
        sizes = (edge.weights @ jump**2) * (edge.weights @ on_edge**2)
        off += float((most - least) @ np.sqrt(sizes))
    if made.shed is not None:
        share = edge.measure / measures(cells, edge.facets)[edge.place]
        of_edge = of_edge + made.shed[edge.place] * share * (edge.weights @ on_edge)
    return float(np.sum(work) - np.sum(of_edge)), off, slack


def square(made: Made, cells: Cells, at: FloatArray) -> float:
    """Compute ‖Aφ‖², or a bound of it, this rank's share, from φ at the cells' vertices."""
    total, edge = sum_rows(at), made.segments
    slopes = cells.apply(at, slice(0, cells.number))
    kappa = made.kappa if made.within is None else made.within.mean
    found = float(np.sum(kappa * dot_rows(at, slopes)))
    masses = made.most_reaction * cells.volume
    found += float(masses @ (total**2 + dot_rows(at, at))) / 12.0
    (a, b), measure = trace_of(cells, edge.facets, at), measures(cells, edge.facets)
    return found + float(np.sum(edge.most * measure * (a**2 + a * b + b**2))) / 3.0


def of_bumps(dual: Made, cells: Cells) -> float:
    """Bound ‖Aβ‖² of the bumps β that a linear problem's companion has; this rank's share.

    They are those of facets on which it is set, where it loses nothing.
    """
    height, plain = dual.bumps[cells.facets], cells.unstretched()
    everywhere = slice(0, cells.number)
    # the mean of ∇β is that of −4/3 the heights' P1 function
    steep = 16 / 9 * dot_rows(height, plain.apply(height, everywhere))
    steep += bend_squares(plain, height, everywhere)
    found = float(np.sum(dual.most * steep))
    area = cells.volume * mean_square(np.zeros_like(height), height)
    return found + float(np.sum(dual.most_reaction * area))


def _form(V: fem.FunctionSpace, made: Made, cells: Cells) -> fem.Form:
    """Return about a in P1, with data in functions: one form for all problems, compiled once."""
    mesh, edge = V.mesh, made.segments
    constants = fem.functionspace(mesh, ("DG", 0))
    reaction, loss = fem.Function(constants), fem.Function(constants)
    reaction.x.array[: len(made.left)] = made.reaction
    loss.x.array[edge.facets.cells] = edge.loss
    for function in (reaction, loss):
        function.x.scatter_forward()
    kappa = cells.coefficient(made.kappa)
    u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
    inside = ufl.inner(kappa * ufl.grad(u), ufl.grad(w)) + reaction * u * w
    found: fem.Form = compiled(mesh.comm, fem.form, inside * ufl.dx + loss * u * w * ufl.ds)
    return found


def indicator(made: Made, cells: Cells, conditions: Sequence[Condition]) -> fem.Function:
    """Make a P1 function, 1 on some parts, 0 on the rest of Γ0 and Γ1, with nearly least ‖Aφ‖."""
    domain, forms = cells.domain, made.data.forms
    V = function_space(domain.mesh, "P1")
    values, layout = fem.Function(V), Layout.of_space(V)
    others = [c for c in (*forms.fixed, *forms.bounded) if c not in conditions]
    chosen, rest = (layout.nodes_at(facets_of(domain, each)) for each in (conditions, others))
    both, zeros = cells.comm.allreduce(np.array([len(np.intersect1d(chosen, rest)), len(rest)]))
    if both > 0:
        all_of_it = len(conditions) == len(forms.bounded) and not any(
            condition.fixed is not None for condition in conditions
        )
        raise InputError(f"{NO_BOUNDS}: {TOUCHES if all_of_it else MEETS}")
    if zeros == 0 and forms.of_one is None:
        values.x.array[:] = 1.0
        return values
    values.x.array[chosen] = 1.0
    return extended(values, np.concatenate([chosen, rest]), made, cells)


def extended(values: fem.Function, known: Int32Array, made: Made, cells: Cells) -> fem.Function:
    """Extend values given at some dofs to a P1 function φ with nearly the least ‖Aφ‖; collective.

    Args:
        values: A P1 function.
        known: Local dofs at which φ is the same, ghosts included.
        made: What A is made of.
        cells: The mesh.
    """
    V = values.function_space
    bc, form, phi = fem.dirichletbc(values, known), _form(V, made, cells), fem.Function(V)
    A, b = assemble_matrix(form, [bc]), np.zeros_like(phi.x.array)
    A.assemble()
    fem.apply_lifting(b, [form], [[bc]])
    Layout.of_space(V).shared_sum(b)
    b[known] = values.x.array[known]
    load, found = (ghosted_vector(V, array) for array in (b, phi.x.array))
    solve_once(A, load, found, DUAL, ESTIMATE_PREFIX)
    release(A, load, found)
    # Exactly so, whatever the solver did
    phi.x.array[known] = values.x.array[known]
    phi.x.scatter_forward()
    return phi
