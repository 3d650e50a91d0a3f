"""The file that a run which was ended goes on from: a `Restart`, and what it belongs to."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError, on_root
from ..reading import insist_on_end
from ..restart import Restart
from .files import Where, disk_errors

NAME, MOMENTS = "restart.npz", "moments.npz"


def write_checkpoint(path: Path, restart: Restart, facts: dict[str, Any], comm: MPI.Comm) -> None:
    """Write the file; collective.

    Args:
        path: The file; overwritten if it is there.
        restart: From `Restart.of`.
        facts: Nothing but what JSON knows.
        comm: The ranks.

    Raises:
        InputError: The system refuses to write.
    """

    def write() -> None:
        arrays: dict[str, Any] = {
            f"added{k}": at for k, at in enumerate(restart.added) if at is not None
        }
        for k, (at, values) in enumerate(restart.u):
            arrays[f"u{k}"] = values
            if at is not restart.u[0][0] or k == 0:
                arrays[f"at{k}"] = at
        sizes = {"meshes": len(restart.added), "functions": len(restart.u)}
        arrays["facts"] = _letters({**sizes, "facts": facts})
        write_arrays(path, arrays)

    on_root(comm, write)


def read_checkpoint(folder: Where, comm: MPI.Comm) -> tuple[Restart, dict[str, Any]] | None:
    """Read the file of a folder; collective.

    Returns:
        What was written, None if there is no such file.

    Raises:
        InputError: It can't be read.
    """

    def read() -> tuple[Restart, dict[str, Any]] | None:
        arrays = read_arrays(Path(folder) / NAME)
        if arrays is None:
            return None
        text = json.loads(bytes(arrays["facts"]))
        added = [arrays.get(f"added{k}") for k in range(text["meshes"])]
        at = [arrays.get(f"at{k}", arrays["at0"]) for k in range(text["functions"])]
        u = [(each, arrays[f"u{k}"]) for k, each in enumerate(at)]
        return Restart(tuple(added), tuple(u)), text["facts"]

    return on_root(comm, read)


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write an archive that `read_arrays` reads; called on one rank."""
    with disk_errors(path):
        np.savez(path, sum=_sum(arrays), **arrays)


def read_arrays(path: Path) -> dict[str, Any] | None:
    """Read what `write_arrays` has written, None if there is no such file; called on one rank.

    Raises:
        InputError: It can't be read, or is not as it was written.
    """
    if not path.exists():
        return None
    try:
        insist_on_end(path)
        with path.open("rb") as file:
            begins = file.read(2) == b"PK"
        if not (begins and zipfile.is_zipfile(path)):  # or NumPy talks of pickles
            raise ValueError("it is no archive")
        with np.load(path) as file:
            arrays = dict(file)
        if not np.array_equal(arrays.pop("sum"), _sum(arrays)):
            raise ValueError("it is not as it was written")
    except Exception as error:  # damaged archives raise whatever their readers come across
        words = str(error) or type(error).__name__
        raise InputError(
            f"cannot read {path}: {words}; it is to be removed, and the run begun anew"
        ) from error
    return arrays


def _letters(value: Any) -> npt.NDArray[np.uint8]:
    """Encode what JSON knows in an array."""
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


def _sum(arrays: dict[str, Any]) -> npt.NDArray[np.uint8]:
    """Compute what tells that an archive is whole and nobody has changed it, as good as sure."""
    found = hashlib.blake2b(digest_size=16)
    for name, array in sorted(arrays.items()):
        found.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        found.update(np.ascontiguousarray(array).data)
    return np.frombuffer(found.digest(), dtype=np.uint8)
