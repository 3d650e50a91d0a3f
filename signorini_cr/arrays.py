"""Arrays by what they hold, and their sums over all ranks."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

BoolArray: TypeAlias = npt.NDArray[np.bool_]
FloatArray: TypeAlias = npt.NDArray[np.float64]
IndexArray: TypeAlias = npt.NDArray[np.intp]
Int32Array: TypeAlias = npt.NDArray[np.int32]
Int64Array: TypeAlias = npt.NDArray[np.int64]


def summed(comm: MPI.Comm, values: npt.ArrayLike) -> FloatArray:
    """Sum up what the ranks have, in the same array if it has floating-point numbers; collective.

    `np.bincount` has integers where it is given nothing to add up, on one rank perhaps, and what
    the others then got would be no number. mpi4py's `allreduce` would pickle the array, which takes
    longer than many a sum.
    """
    found: FloatArray = np.asarray(values, dtype=np.float64)
    comm.Allreduce(MPI.IN_PLACE, found)
    return found


def found_in(ordered: npt.NDArray, wanted: npt.NDArray) -> tuple[IndexArray, BoolArray]:
    """Find values in an ascending list.

    Args:
        ordered: The list, shape (n,), perhaps (0,). If it is long, let the values have its type: it
            is converted else.
        wanted: The values, of any shape.

    Returns:
        The place of each in the list, another one (0 if the list is empty) where it isn't there,
        and whether it is; both of the values' shape.
    """
    place = np.searchsorted(ordered, wanted)
    if not len(ordered):
        return place, np.zeros(place.shape, dtype=bool)
    place = np.minimum(place, len(ordered) - 1)
    return place, ordered[place] == wanted
