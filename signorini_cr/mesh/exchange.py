"""Rows of tables, from the ranks that have them to those that ask for them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..arrays import IndexArray, Int32Array


class Exchange:
    """Rows that ranks ask of one another, each of them once.

    Attributes:
        place: Where what was asked for is among the rows fetched, shape (n,).
        count: How many rows that are.
        rows: This rank's rows that are asked for, once for each rank that asks.
    """

    place: IndexArray
    count: int
    rows: Int32Array

    def __init__(self, comm: MPI.Comm, rank: npt.NDArray, row: npt.NDArray):
        """Tell the ranks what they are asked for; collective.

        Args:
            comm: The ranks.
            rank: Whom this one asks, shape (n,).
            row: For which of that rank's rows, shape (n,).
        """
        self._comm = comm
        both = (rank.astype(np.int64) << 32) + row
        asked, self.place = np.unique(both, return_inverse=True)
        self.count = len(asked)
        self._asked = np.bincount(asked >> 32, minlength=comm.size).astype(np.int32)
        self._given = np.empty_like(self._asked)
        comm.Alltoall(self._asked, self._given)
        self.rows = self.give_back(asked.astype(np.int32))  # the lower half

    def fetch(self, table: npt.NDArray) -> npt.NDArray:
        """Fetch the rows asked for; collective.

        Args:
            table: What this rank has; of one kind on all ranks.
        """
        return self._send(table[self.rows], self._given, self._asked)

    def give_back(self, fetched: npt.NDArray) -> npt.NDArray:
        """Send something for each row fetched to where it came from; collective.

        Returns:
            What the ranks send for each of `rows`.
        """
        return self._send(fetched, self._asked, self._given)

    def _send(self, table: npt.NDArray, out: Int32Array, back: Int32Array) -> Any:
        table = np.ascontiguousarray(table)
        received = np.empty((int(back.sum()), *table.shape[1:]), dtype=table.dtype)
        row = MPI.BYTE.Create_contiguous(table.itemsize * int(np.prod(table.shape[1:]))).Commit()
        self._comm.Alltoallv([table, out, row], [received, back, row])
        row.Free()
        return received
