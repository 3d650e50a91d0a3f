"""Pieces that the domain falls into, and what holds those that Γ0, b and c do not.

Only an obstacle can hold such a piece, and only where the net force ∫ f + ∫ g over it is below 0,
which presses it on; or above 0 with an obstacle above it, which is the same upside down. Then the
solution exists and is unique, as J(u + c) − J(u) = −c (∫ f + ∫ g) grows with c, and admissible
functions are bounded below. The reduced matrices are definite as long as each such piece has an
active dof. A start with one is enough: where all other equations hold, the forces of the active
dofs add up to −(∫ f + ∫ g) > 0, so that one of them stays active.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from .. import compat
from ..arrays import FloatArray, IndexArray, Int32Array, summed
from ..errors import raise_together
from ..fem.layout import Layout
from ..mesh.planar import pieces
from .active import ActiveSet
from .stopping import NOISE
from .system import System

BELOW = 4.0
"""A piece is put so far below its obstacle, in parts of what its loads could lift it by."""

DOUBT = 4.0
"""Error that a net force may have, in multiples of the difference of two fine rules."""


@dataclass(frozen=True, eq=False)
class Floating:
    """Pieces that nothing but an obstacle can hold.

    Attributes:
        count: How many there are, over all ranks.
        piece: Piece of each local dof, from 1; 0 where it is held, shape (dofs,).
    """

    count: int
    piece: IndexArray

    @classmethod
    def of(cls, V: fem.FunctionSpace, dirichlet: Int32Array) -> Floating:
        """Find them; collective.

        Args:
            V: The discrete space: dofs of a cell are connected.
            dirichlet: Local dofs that are held, ghosts included.
        """
        comm, labels = V.mesh.comm, _labels(V)
        held, own = (
            np.unique(np.concatenate(comm.allgather(np.unique(found))))
            for found in (labels[dirichlet], labels)
        )
        floating = np.setdiff1d(own, held)
        number = np.searchsorted(floating, labels)
        found = np.append(floating, np.inf)[number] == labels
        return cls(len(floating), np.where(found, number + 1, 0))

    def check(self, system: System, inflow: FloatArray | None) -> None:
        """Insist on pieces that are pressed onto the obstacle; collective.

        The scheme's own rule alone may see a force where there is none: so a much finer one has to
        see it, too, and not differ from one that is less fine by as much.

        Args:
            system: The variational inequality.
            inflow: `OnMesh.inflow`.

        Raises:
            InputError: One is not.
        """
        V, net = system.u_D.function_space, self._net(system)
        owned = system.A.getLocalSize()[0]
        sizes, dofs = np.abs(system.chi[:owned]), np.ones(owned)
        size, number = self._sums(V.mesh.comm, self.piece[:owned], sizes, dofs)
        finite = (np.isfinite(_floors(system, sign)[system.bounded]) for sign in (1.0, -1.0))
        below, above = self._sums(V.mesh.comm, self.piece[system.bounded], *finite) > 0.0
        forces, doubt = net[None], NOISE * np.sqrt(number) * size
        if inflow is not None:
            less, finest = self._sums(V.mesh.comm, self.piece[_cell_dofs(V)[:, 0]], *inflow)
            forces, doubt = np.stack([net, finest]), doubt + DOUBT * np.abs(finest - less)
        # an obstacle below is pressed by forces below 0, one above by those above 0, as all rules
        # see them
        down, up = np.where(below, -forces, -np.inf), np.where(above, forces, -np.inf)
        pressed = np.maximum(down, up).min(axis=0)
        adrift = 1 + np.flatnonzero(pressed[1:] <= doubt[1:])
        complaint = None
        if len(adrift) and (where := self._where(V, bad := int(adrift[0]))) is not None:
            amount = f"of {forces[-1, bad]:g}"
            if abs(forces[-1, bad]) <= doubt[bad] and forces[:, bad].any():
                amount = "that can't be told from 0"
            block = V.dofmap.index_map_bs
            alone = number[bad] == V.dofmap.index_map.size_global * block
            falls = "the domain falls" if block == 1 else "the unknowns fall"
            complaint = (
                "there is " if alone else f"{falls} into pieces, and {where} has "
            ) + f"{system.words.held}, and {_of_contact(below[bad], above[bad], amount)}"
        raise_together(V.mesh.comm, complaint)

    def _sums(self, comm: MPI.Comm, piece: IndexArray, *values: FloatArray) -> FloatArray:
        """Sum up over each piece, on all ranks, shape (len(values), count + 1); collective.

        Args:
            comm: The ranks.
            piece: The piece of each thing that has a value, shape (n,).
            *values: Each of shape (n,).
        """
        sums = [np.bincount(piece, each, self.count + 1) for each in values]
        return summed(comm, np.array(sums))

    def _where(self, V: fem.FunctionSpace, piece: int) -> str | None:
        """Name a piece by a point in it; None on ranks that have no cell of it."""
        dofs = np.flatnonzero(self.piece[_cell_dofs(V)[:, 0]] == piece)
        if not len(dofs):
            return None
        nodes = compat.cell_nodes(V.mesh)[dofs[0] // V.dofmap.index_map_bs]
        middle = V.mesh.geometry.x[nodes].mean(axis=0)[: V.mesh.geometry.dim]
        return f"the one around ({', '.join(f'{x:g}' for x in middle)})"

    def hold(self, system: System, start: fem.Function) -> None:
        """Put pieces of which no dof is active onto the obstacle they are pressed to; collective.

        All dofs that it bounds go on their bounds, and all others so far beyond that the residual
        makes the former active.

        Args:
            system: The variational inequality.
            start: The start, ghosts up to date as on return.
        """
        x, comm = start.x.array, start.function_space.mesh.comm
        residual = fem.Function(start.function_space)
        system.residual(start, residual)
        bounded, bounds = system.bounded, system.bounds
        at = x[bounded]
        forces = bounds.sign(at) * residual.x.array[bounded]
        pushed = ActiveSet.of(bounded, bounds.gap(at), forces)
        active = summed(comm, np.bincount(self.piece[bounded], pushed.mask, self.count + 1))
        diagonal = system.operator.whole_diagonal
        lift = np.abs(system.b[: len(diagonal)]) / diagonal
        # upside down where the net force pulls
        sign = np.where(self._net(system) <= 0.0, 1.0, -1.0)
        floor = np.where(sign[self.piece] > 0.0, _floors(system, 1.0), _floors(system, -1.0))
        bottom, depth = np.full(self.count + 1, np.inf), np.zeros(self.count + 1)
        top = -bottom
        np.maximum.at(depth, self.piece[: len(lift)], lift)
        own = bounded[np.isfinite(floor[bounded])]
        np.minimum.at(bottom, self.piece[own], floor[own])
        np.maximum.at(top, self.piece[own], floor[own])
        bottom = np.min(comm.allgather(bottom), axis=0)
        top, depth = np.max(comm.allgather([top, depth]), axis=0)
        for piece in range(1, self.count + 1):
            if active[piece] == 0.0:
                below = BELOW * depth[piece] + (top[piece] - bottom[piece])
                there = self.piece == piece
                held = np.where(np.isfinite(floor), floor, bottom[piece] - below)
                x[there] = sign[piece] * held[there]

    def _net(self, system: System) -> FloatArray:
        """Compute the net force ∫ f + ∫ g on each piece, shape (count + 1,); collective."""
        owned = system.A.getLocalSize()[0]
        comm = system.u_D.function_space.mesh.comm
        (net,) = self._sums(comm, self.piece[:owned], system.chi[:owned])
        return np.asarray(net)


def _of_contact(below: bool, above: bool, amount: str) -> str:
    """Say why contact does not hold a piece.

    Args:
        below: Whether it has an obstacle below.
        above: Whether it has one above.
        amount: Of the net force on it, in words.
    """
    if not below and not above:
        return "no contact facet: nothing holds it"
    side = "below" if below else "above"
    wanted = f"only one {side} 0, which presses it onto the obstacle, would hold it"
    if below and above:
        wanted = "any constant that fits between the obstacles may be added to a solution"
    return f"a net force ∫f + ∫g {amount}: {wanted}"


def _floors(system: System, sign: float) -> FloatArray:
    """Return α, or −β for the sign −1, by dof; −∞ where there is none."""
    floor = system.lower if sign > 0.0 else -system.upper
    return np.where(floor > PETSc.NINFINITY, floor, -np.inf)


def _cell_dofs(V: fem.FunctionSpace) -> Int32Array:
    """Find the dofs of the owned cells that hang together, a row for each of a node's unknowns."""
    topology, block = V.mesh.topology, V.dofmap.index_map_bs
    nodes = V.dofmap.list[: topology.index_map(topology.dim).size_local, None]
    dofs: Int32Array = block * nodes + np.arange(block, dtype=np.int32)[:, None]
    return dofs.reshape(-1, nodes.shape[-1])


def _labels(V: fem.FunctionSpace) -> FloatArray:
    """Find for each local dof the largest number of all that it is connected with; collective."""
    dofs, layout = _cell_dofs(V), Layout.of_space(V)
    piece = pieces(dofs, layout.local)
    labels = layout.numbers(np.arange(layout.local, dtype=np.int32)).astype(np.float64)
    while True:  # from rank to rank, along a piece
        before, largest = labels.copy(), np.full(len(dofs), -1.0)
        np.maximum.at(largest, piece, labels[dofs].max(axis=1, initial=-1.0))
        labels[dofs] = largest[piece][:, None]
        layout.shared_maximum(labels)
        if not V.mesh.comm.allreduce(not np.array_equal(labels, before), op=MPI.LOR):
            return labels
