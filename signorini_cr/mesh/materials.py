"""The materials of a mesh's cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from dolfinx.mesh import Mesh, MeshTags

from ..arrays import BoolArray, Int32Array
from ..errors import InputError, together

NONE = 0
"""The number of cells that consist of nothing that has a name."""


def numbered(names: Sequence[str]) -> dict[str, int]:
    """Number materials from 1 on."""
    return {name: NONE + 1 + i for i, name in enumerate(names)}


@dataclass(frozen=True, eq=False)
class Materials:
    """The materials' names, and one or none for each cell.

    Attributes:
        numbers: Their numbers by name.
        of_cells: That of each local cell, `NONE` where there is none, shape (cells,); empty where
            no material has a name.
        others: Physical surfaces of a file that nobody has asked for, beside materials.
    """

    numbers: Mapping[str, int] = field(default_factory=dict)
    of_cells: Int32Array = field(default_factory=lambda: np.empty(0, dtype=np.int32))
    others: tuple[str, ...] = ()

    def where(self, name: str) -> BoolArray:
        """Tell which local cells consist of a material, shape (cells,)."""
        return np.asarray(self.of_cells == self.numbers[name])

    def of_children(self, parent: Int32Array) -> Materials:
        """Carry them to cells with some parents."""
        return Materials(self.numbers, self.of_cells[parent]) if self.numbers else self

    @classmethod
    def from_tags(
        cls,
        mesh: Mesh,
        tags: MeshTags | None,
        wanted: Mapping[str, int | Sequence[int]],
    ) -> Materials:
        """Take cell tags of the user's own; collective.

        Args:
            mesh: The mesh.
            tags: Values on cells.
            wanted: The value or values that stand for each material.

        Raises:
            InputError: There are no such tags, a value stands for two materials, or a material has
                no cell.
        """
        if not wanted:
            return cls()
        of_cells = together(mesh.comm, _of_cells, mesh, tags, wanted)
        numbers = numbered(list(wanted))
        here = of_cells[: mesh.topology.index_map(mesh.topology.dim).size_local]
        for name, given in wanted.items():
            if not mesh.comm.allreduce(np.count_nonzero(here == numbers[name])):
                found = [] if tags is None else tags.values.tolist()
                there = sorted(set().union(*mesh.comm.allgather(set(found))))
                words = ", ".join(map(str, there)) or "none"
                own = ", ".join(map(str, tag_values(name, given, "cell")))
                raise InputError(
                    f"no cell is tagged {name} (value {own}): the values there are {words}"
                )
        return cls(numbers, of_cells)


def _of_cells(
    mesh: Mesh, tags: MeshTags | None, wanted: Mapping[str, int | Sequence[int]]
) -> Int32Array:
    """Find the number of the material of each local cell, shape (cells,)."""
    tdim = mesh.topology.dim
    if tags is None or tags.dim != tdim:
        found = "none" if tags is None else f"of dimension {tags.dim}"
        raise InputError(f"materials need tags on cells, of dimension {tdim}; found {found}")
    cells = mesh.topology.index_map(tdim)
    values = np.zeros(cells.size_local + cells.num_ghosts, dtype=np.int32)
    if len(strange := np.setdiff1d(tags.indices, np.arange(len(values)))):
        raise InputError(
            f"cell_tags has a value for cell {strange[-1]} of rank {mesh.comm.rank}, which has"
            f" {len(values)} cells: tags of this mesh are needed"
        )
    owner = dict[int, str]()
    for name, number in numbered(list(wanted)).items():
        own = tag_values(name, wanted[name], "cell")
        for value in map(int, own):
            if value in owner:
                raise InputError(
                    f"the cell value {value} stands for {owner[value]} and for {name}: a value"
                    " can stand for one material only"
                )
            owner[value] = name
        values[tags.indices[np.isin(tags.values, own)]] = number
    return values


def tag_values(name: str, given: object, of: str) -> Int32Array:
    """Take the value or values in a user's own tags that stand for something, each once, ascending.

    Args:
        name: What they stand for.
        given: What the user says.
        of: What the tags are on, "facet" or "cell".

    Raises:
        InputError: They are no whole numbers, or too large.
    """
    try:
        numbers = np.atleast_1d(np.asarray(given))
    except ValueError:  # lists of unlike lengths in a list
        numbers = np.array([given], dtype=object)
    known = np.iinfo(np.int32)
    if numbers.size and not (
        numbers.dtype.kind in "iu" and known.min <= numbers.min() <= numbers.max() <= known.max
    ):
        raise InputError(f"{name} is {given!r}: {of} values are whole numbers of 32 bits")
    return np.unique(numbers.astype(np.int32))
