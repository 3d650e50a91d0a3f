"""From coarse to fine: prolongation between nested meshes, and P1 as a subspace of CR.

On nested meshes every fine cell lies in one coarse cell, its parent, and nothing else has to be
known: the value at a fine dof is the average, over the fine cells that touch it, of the parents'
affine functions there. That holds for any pattern of refinement and any dimension; for P1, which is
continuous, the average is that of equal numbers. Each rank adds its own cells' share. Where their
parents live on other ranks, the parents' dofs are ghosts here.

P1 is contained in CR: a conforming function's mean over a facet is the mean of its d vertex values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from ..arrays import FloatArray, Int32Array
from ..fem.layout import Layout
from ..garbage import release
from ..mesh.shared import ghosted, shared_sum
from .constrained import rows_of
from .parents import Parents


class Transfer:
    """Transfer of functions from a P1 space to a finer space.

    A rank has the rows of its own fine dofs. Their columns are local coarse dofs, ghosts included,
    so that none has to be given another number, and no matrix of several ranks is put together.
    """

    def __init__(
        self,
        coarse: Layout,
        fine: Layout,
        lengths: Int32Array | int,
        dofs: Int32Array,
        values: FloatArray,
    ):
        """Take the entries as they are, one row after the other.

        Args:
            coarse: The coarse dofs.
            fine: The fine dofs.
            lengths: Number of entries of each owned fine node's row.
            dofs: The entries' local coarse nodes, in each row in any order.
            values: The entries, the same for all unknowns of a node.
        """
        self._coarse, self._fine = coarse, fine
        rows = fine.size[0]
        if fine.block > 1:
            lengths, dofs, values = _for_each_unknown(fine, lengths, dofs.ravel(), values)
        if isinstance(lengths, int):
            start = np.arange(0, (rows + 1) * lengths, lengths, dtype=PETSc.IntType)
        else:
            start = np.zeros(rows + 1, dtype=PETSc.IntType)
            np.cumsum(lengths, out=start[1:])
        self._csr = start, dofs.ravel().astype(PETSc.IntType, copy=False), values
        sizes = rows, coarse.local
        self._rows = PETSc.Mat().createAIJWithArrays(sizes, self._csr, comm=PETSc.COMM_SELF)
        self._own = self._rows.createVecLeft()

    def coarse_vector(self) -> PETSc.Vec:
        """Make a vector for coarse functions, with room for ghosts."""
        coarse = self._coarse
        return ghosted(coarse.mesh.comm, coarse.index_map, block=coarse.block)

    def add(self, x_coarse: PETSc.Vec, x: PETSc.Vec) -> None:
        """Add a coarse function to x."""
        x_coarse.ghostUpdate(PETSc.InsertMode.INSERT_VALUES, PETSc.ScatterMode.FORWARD)
        x.getLocalVector(self._own)
        with x_coarse.localForm() as local:
            self._rows.multAdd(local, self._own, self._own)
        x.restoreLocalVector(self._own)

    def restrict(self, b: PETSc.Vec, b_coarse: PETSc.Vec) -> None:
        """Multiply b by the transposed matrix."""
        b.getLocalVector(self._own, readonly=True)
        with b_coarse.localForm() as local:
            self._rows.multTranspose(self._own, local)
        b.restoreLocalVector(self._own, readonly=True)
        b_coarse.ghostUpdate(PETSc.InsertMode.ADD_VALUES, PETSc.ScatterMode.REVERSE)

    def coarse_support(self, dofs: Int32Array) -> Int32Array:
        """Find the owned coarse dofs whose functions don't vanish at given owned fine dofs."""
        _, columns, values = rows_of(self._rows, dofs)
        return self._coarse.owned_among(columns[values != 0.0])

    def matrix(self) -> PETSc.Mat:
        """Return it as a matrix of all ranks, for products."""
        start, dofs, values = self._csr
        numbers = self._coarse.numbers(dofs.astype(np.int32, copy=False))
        csr = start, numbers.astype(PETSc.IntType, copy=False), values
        sizes = self._fine.size, self._coarse.size
        return PETSc.Mat().createAIJ(sizes, csr=csr, comm=self._fine.mesh.comm)

    def free(self) -> None:
        """Free the rows."""
        release(self._rows, self._own)


def _for_each_unknown(
    fine: Layout, lengths: Int32Array | int, nodes: Int32Array, values: FloatArray
) -> tuple[Int32Array, Int32Array, FloatArray]:
    """Repeat the rows of nodes for each of their unknowns, and number columns by unknowns."""
    block, rows = fine.block, fine.index_map.size_local
    lengths = np.full(rows, lengths) if isinstance(lengths, int) else lengths
    start = np.cumsum(lengths) - lengths
    repeated = np.repeat(lengths, block)
    row = np.repeat(np.arange(rows * block), repeated)
    within = np.arange(len(row)) - np.repeat(np.cumsum(repeated) - repeated, repeated)
    entry = start[row // block] + within
    return repeated, nodes[entry] * block + row % block, values[entry]


def inclusion(p1: Layout, cr: Layout) -> Transfer:
    """Include P1 in CR on the same mesh: d entries 1/d in each row."""
    d = cr.cells.shape[1] - 1
    owned = cr.index_map.size_local
    columns = np.empty((owned + cr.index_map.num_ghosts, d), dtype=np.int32)
    for i in range(d + 1):
        others = [j for j in range(d + 1) if j != i]
        for k, j in enumerate(others):
            columns[cr.cells[:, i], k] = p1.cells[:, j]
    return Transfer(p1, cr, d, columns[:owned], np.full(owned * d, 1.0 / d))


def prolongation(coarse: Layout, fine: Layout, parents: Parents) -> Transfer:
    """Prolong P1 on a coarse mesh to P1 or CR on a nested one: any fine cell of a dof tells all.

    Args:
        coarse: The coarse dofs.
        fine: The fine dofs.
        parents: The coarse cells that hold the fine ones.
    """
    weights, parent_cell = parents.weights(coarse, fine), parents.cell
    coarse, corners = parents.layout(coarse), fine.cells.shape[1]
    slot = np.empty(fine.index_map.size_local + fine.index_map.num_ghosts, dtype=np.int32)
    slot[fine.cells] = np.arange(fine.cells.size, dtype=np.int32).reshape(fine.cells.shape)
    slot = slot[: fine.index_map.size_local]
    if len(weights) < len(parent_cell):  # the same in each parent, whose children are in a row
        parent = slot // (len(weights) * corners)
        slot = slot - parent * (len(weights) * corners)
    else:
        parent = parent_cell.take(slot // corners)
    values = weights.reshape(-1, corners).take(slot, axis=0)
    dofs = coarse.cells.take(parent, axis=0)
    if fine.cr:  # few zeros: leave them
        return Transfer(coarse, fine, corners, dofs, values.ravel())
    kept = values != 0.0
    return Transfer(coarse, fine, kept.sum(axis=1, dtype=np.int32), dofs[kept], values[kept])


@dataclass(frozen=True, eq=False)
class Ancestor:
    """A function that another one was prolonged from.

    Attributes:
        u: The function on the mesh below.
        parents: The cells there that hold those of the mesh above.
    """

    u: fem.Function
    parents: Parents


def prolongate(
    u: fem.Function,
    V: fem.FunctionSpace,
    parents: Parents,
    ancestor: Ancestor | None = None,
) -> FloatArray:
    """Apply the prolongation once, without its matrix, and extrapolate if there is what it takes.

    What u has beyond the prolongation of its predecessor is, where the solution is smooth, h²
    times a function of the place and of the kind of facet: which child, which of its facets. The
    next mesh adds a quarter of that, to each family of children what its parent's family got.

    Args:
        u: A CR or P1 function on the coarse mesh, ghosts up to date.
        V: The same kind of space on the fine mesh.
        parents: The coarse cells that hold the fine ones.
        ancestor: u's predecessor on the mesh below. Not used where either of the meshes is not a
            regular refinement.

    Returns:
        Values of all local dofs, ghosts included.
    """
    coarse, fine = Layout.of_space(u.function_space), Layout.of_space(V)
    weights, parent_cell = parents.weights(coarse, fine), parents.cell
    corners, block = fine.cells.shape[1], fine.block
    gain, repeats = None, False
    if ancestor is not None:
        repeats = len(weights) < len(parent_cell) and ancestor.parents.regular
        # A rank without cells has no say, but a part in what follows
        if V.mesh.comm.allreduce(repeats or len(parent_cell) == 0, op=MPI.LAND):
            before = prolongate(ancestor.u, u.function_space, ancestor.parents)
            gain = 0.25 * (u.x.array - before)
    result, cells_of_node = np.empty(fine.local), _sums(fine, np.ones(fine.cells.size))
    for component in range(block):
        known = u.x.array[component::block]
        if len(weights) == len(parent_cell):
            values = np.einsum("cij,cj->ci", weights, parents.take(known, coarse.cells))
        else:  # the same pattern in each parent
            local = known[coarse.cells[: len(parent_cell) // len(weights)]]
            values = local @ weights.reshape(-1, corners).T
        if gain is not None and repeats:
            of_families = gain[component::block][coarse.cells].reshape(-1, 1, values.shape[1])
            values.reshape(len(of_families), len(weights), -1)[:] += of_families
        result[component::block] = _sums(fine, values.ravel()) / cells_of_node
    return result


def _sums(layout: Layout, values: FloatArray) -> FloatArray:
    """Sum of what all ranks' cells have for each local node; PETSc's loop needs no copies."""
    result = np.zeros(layout.index_map.size_local + layout.index_map.num_ghosts)
    vector = PETSc.Vec().createWithArray(result, comm=PETSc.COMM_SELF)
    dofs = layout.cells.ravel().astype(PETSc.IntType, copy=False)
    vector.setValues(dofs, values, PETSc.InsertMode.ADD_VALUES)
    vector.assemble()
    vector.destroy()
    return shared_sum(layout.mesh, layout.index_map, result)
