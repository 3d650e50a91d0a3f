"""The materials of a mesh's cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from dolfinx.mesh import Mesh, MeshTags

from ..arrays import BoolArray, Int32Array
from ..errors import InputError

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
        tdim = mesh.topology.dim
        if tags is None or tags.dim != tdim:
            found = "none" if tags is None else f"of dimension {tags.dim}"
            raise InputError(f"materials need tags on cells, of dimension {tdim}; found {found}")
        cells = mesh.topology.index_map(tdim)
        values = np.zeros(cells.size_local + cells.num_ghosts, dtype=np.int32)
        numbers, owner = numbered(list(wanted)), dict[int, str]()
        for name, given in wanted.items():
            own = [given] if isinstance(given, int) else list(given)
            for value in own:
                if value in owner:
                    raise InputError(
                        f"the cell value {value} stands for {owner[value]} and for {name}: a value"
                        " can stand for one material only"
                    )
                owner[value] = name
            chosen = tags.indices[np.isin(tags.values, own)]
            values[chosen] = numbers[name]
            count = np.count_nonzero(chosen < cells.size_local)
            if not mesh.comm.allreduce(count):
                there = sorted(set().union(*mesh.comm.allgather(set(tags.values.tolist()))))
                words = ", ".join(map(str, there)) or "none"
                raise InputError(
                    f"no cell is tagged {name} (value {', '.join(map(str, own))}): the values there"
                    f" are {words}"
                )
        return cls(numbers, values)
