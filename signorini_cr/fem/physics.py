"""The seam that a physics stands behind.

Meshes, multigrid and the active set method know of nodes, of how many unknowns each has, of
matrices, and of which unknowns are set or bounded. A node is a facet, or a vertex of the P1 spaces
on coarse meshes; all nodes of a space have the same number of unknowns, its block size, and unknown
c of node i has the number ``block * i + c``. Everything else is a physics': the space, a_h, χ, what
is set and bounded, the P1 operator of coarse meshes, and the certificate. Arrays that it hands over
are read, not written, and stay its own. A physics whose bounds
are on a combination of a facet's unknowns chooses that combination as one of them. Transfers carry
each unknown by itself: the choice is to be the same at all nodes. What is set on Γ0 are all
unknowns of a facet, and meshes have no ghost cells, so that forms have no inner facets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from dolfinx import fem

from ..arrays import FloatArray, Int32Array
from ..mesh.domain import Domain
from .snapshot import Snapshot


@dataclass(frozen=True, eq=False)
class Imposed:
    """Values or bounds of unknowns that a condition asks for on its part of the boundary.

    Attributes:
        key: The data's name, for messages.
        facets: Local indices of the part's facets, ghosts included, shape (n,).
        components: Which unknowns of a facet it is about, shape (c,).
        means: Their values' means over the facets, shape (n, c).
        ends: Their values at the vertices, in the order of `facet_measures`, shape (n, d, c).
        sign: Of a bound: s, where s times the unknown must not be below the values.
    """

    key: str
    facets: Int32Array
    components: Int32Array
    means: FloatArray
    ends: FloatArray
    sign: int = 1


class Words(NamedTuple):
    """A physics' own words for what messages are about.

    Attributes:
        load: What χ is made of.
        positive: What a_h's diagonal that is not above 0 says of the data.
        held: What holds no part of the domain that floats.
    """

    load: str = "a load"
    positive: str = "a_h must be finite, and its diagonal above 0"
    held: str = "no Dirichlet facet"


class OnMesh(Protocol):
    """A physics on one mesh, with its data, each sampled once."""

    @property
    def words(self) -> Words:
        """The words of messages."""

    @property
    def domain(self) -> Domain:
        """Mesh and boundary parts."""

    @property
    def V(self) -> fem.FunctionSpace:
        """The discrete space: CR, or P1, with a block of unknowns at each node."""

    @property
    def a(self) -> fem.Form:
        """a_h, which is symmetric, and positive definite where something holds u."""

    @property
    def fixed(self) -> tuple[Imposed, ...]:
        """The values set on Γ0: of all unknowns of a facet."""

    @property
    def bounds(self) -> tuple[Imposed, ...]:
        """Bounds on Γ1: of one unknown a facet."""

    def chi(self) -> FloatArray:
        """Compute χ by unknown, this rank's cells' share, ghosts included."""

    def of_constants(self) -> FloatArray | None:
        """Compute a_h(1, ·) by unknown, this rank's cells' share; None where it vanishes."""

    def inflow(self) -> FloatArray | None:
        """Compute ∫ f + ∫ g over each owned cell by two rules, much finer than that of `chi`.

        Returns:
            A cell's unknowns one after the other, shape (2, block * cells), the finest last; None
            if that can't be told.
        """

    def conforming(self, cells: Int32Array, index_map: Any) -> tuple[fem.Form, float]:
        """Return a form whose matrix, times a number, is the P1 operator on this mesh.

        `compat.with_dofs` makes a space with such nodes.

        Args:
            cells: The vertices' nodes in each local cell, shape (cells, d + 1).
            index_map: How the ranks share these nodes.
        """

    def at_vertices(self, u: fem.Function, facets: Int32Array) -> FloatArray:
        """Find the values of what is bounded at the vertices of contact facets, shape (n, d)."""

    def squared_energy_norm(self, u: fem.Function) -> float:
        """Compute a_h(u, u), this rank's cells' share."""

    def tidy(self) -> None:
        """Make room: drop what is large and needed until a solution is certified."""


class Physics(Protocol):
    """The interface of a physics; one object for all meshes of a sequence.

    Attributes:
        element: "CR" or "P1".
        problem: The user's data.
        exact: The exact solution, None if it isn't known.
    """

    element: str
    problem: Any
    exact: Any

    @property
    def galerkin(self) -> bool:
        """True if P1 operators are sure to be the Galerkin products of finer meshes' operators."""

    @property
    def not_definite(self) -> str | None:
        """The message where a_h is not found to be positive definite; None if it is sure to be."""

    def check(self, domain: Domain) -> None:
        """Refuse data for which there is no solution; collective."""

    def on(self, domain: Domain) -> OnMesh:
        """Take it to a mesh."""

    def snapshot(self, domains: Sequence[Domain]) -> Snapshot:
        """Note what data that may change are at present, on some meshes."""

    def errors(self, domain: Domain, w: fem.Function) -> tuple[float, float]:
        """Compute ‖u − w‖_h and ‖u − w‖ in L2, where u is known; collective."""

    def certify(self, solution: Any) -> Any:
        """Bound the error of a solution, or say why that can't be done; collective.

        Args:
            solution: The `Solution`, of this physics.

        Returns:
            The `Certificate`. All that it may know has a default. Adaptive refinement goes by its
            `indicators`, with a tolerance by `bound_h1` as well; where there is no bound, `reason`
            says why.
        """
