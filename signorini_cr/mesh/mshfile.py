"""Reading mesh files in gmsh's formats 2.2 and 4.1, ASCII or binary, each byte accounted for.

gmsh itself takes much for granted: a file cut off in the wrong place can make it fault. Here every
count, line and number is compared with the format's description, what is allocated is never more
than the file is long, and each complaint names the place.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, Int64Array, found_in
from ..errors import InputError
from ..reading import read_regular
from ..rounding import counted
from .polygon import FARTHEST

Array = npt.NDArray[Any]

ELEMENTS = {
    1: ("Line 2", 1, 2), 2: ("Triangle 3", 2, 3), 3: ("Quadrilateral 4", 2, 4),
    4: ("Tetrahedron 4", 3, 4), 5: ("Hexahedron 8", 3, 8), 6: ("Prism 6", 3, 6),
    7: ("Pyramid 5", 3, 5), 8: ("Line 3", 1, 3), 9: ("Triangle 6", 2, 6),
    10: ("Quadrilateral 9", 2, 9), 11: ("Tetrahedron 10", 3, 10), 12: ("Hexahedron 27", 3, 27),
    13: ("Prism 18", 3, 18), 14: ("Pyramid 14", 3, 14), 15: ("Point", 0, 1),
    16: ("Quadrilateral 8", 2, 8), 17: ("Hexahedron 20", 3, 20), 18: ("Prism 15", 3, 15),
    19: ("Pyramid 13", 3, 13), 20: ("Triangle 9", 2, 9), 21: ("Triangle 10", 2, 10),
    23: ("Triangle 15", 2, 15), 26: ("Line 4", 1, 4), 27: ("Line 5", 1, 5),
    29: ("Tetrahedron 20", 3, 20), 36: ("Quadrilateral 16", 2, 16),
}  # fmt: skip
"""Name, dimension and number of nodes of gmsh's element types."""

DIMENSIONS = ("point", "curve", "surface", "volume")
MOST_BYTES = 1_000_000_000
"""In a file."""
_MOST_TAGS = 10**6
_MOST_QUOTED = 40
"""Most characters of the file that a message quotes."""


class Block(NamedTuple):
    """Elements of one type with the same physical groups.

    Attributes:
        kind: gmsh's element type, a key of `ELEMENTS`.
        groups: Tags of the physical groups of the type's dimension.
        nodes: Tags of the nodes, shape (elements, nodes of the type).
    """

    kind: int
    groups: frozenset[int]
    nodes: Int64Array


class MshFile(NamedTuple):
    """Contents of a mesh file.

    Attributes:
        tags: Tags of the nodes, ascending, shape (nodes,).
        points: Coordinates, shape (nodes, 3).
        blocks: The elements.
        names: Name of each physical group that has one, by dimension and tag.
    """

    tags: Int64Array
    points: FloatArray
    blocks: list[Block]
    names: dict[tuple[int, int], str]

    def groups(self, dim: int) -> list[int]:
        """Return the tags of the physical groups of one dimension."""
        named = {tag for d, tag in self.names if d == dim}
        return sorted(named.union(*(b.groups for b in self.blocks if ELEMENTS[b.kind][1] == dim)))

    def elements(self, kind: int, group: int | None = None) -> Int64Array:
        """Return the node tags of all elements of a type, or of those in one physical group."""
        found = [b.nodes for b in self.blocks if b.kind == kind and group in (None, *b.groups)]
        return np.concatenate([np.empty((0, ELEMENTS[kind][2]), dtype=np.int64), *found])


class _Damaged(Exception):
    """Something in the file is not as the format has it."""


class _Source(Protocol):
    """Numbers of a section, in ASCII or binary."""

    def take(self, kinds: str) -> list[Any]:
        """Take some numbers: n for a size or tag of nodes and elements, i for an integer, d."""

    def end_row(self) -> None:
        """Insist on the end of a line."""

    def table(self, rows: int, columns: int, kind: str) -> Array:
        """Take lines of numbers of one kind, shape (rows, columns)."""


class _Text:
    """A section in ASCII: a line for each row.

    Args:
        body: What stands between ``$Name`` and ``$EndName``.
        first: Number of its first line in the file.
    """

    def __init__(self, body: bytes, first: int) -> None:
        self.body, self.first = body, first
        self.lines = [line for line in body.split(b"\n") if line and not line.isspace()]
        self.at = 0  # the line that comes next
        self.words: list[bytes] = []  # what is left of the one before
        if strange := body.translate(None, b"0123456789+-.eE \t\r\n"):
            self.at = 1 + next(i for i, line in enumerate(self.lines) if strange[:1] in line)
            self.fail("numbers are expected")

    def fail(self, fault: str) -> NoReturn:
        """Complain about the line before the next."""
        if self.at < 1:
            raise _Damaged(fault)
        found = self.lines[self.at - 1].strip().decode("utf-8", "backslashreplace")
        shown = found if len(found) <= _MOST_QUOTED else found[:_MOST_QUOTED] + "…"
        raise _Damaged(f"in line {self.number(self.at - 1)} ({shown}) {fault}")

    def number(self, at: int) -> int:
        """Find the number in the file of a line that is not blank."""
        every = enumerate(self.body.split(b"\n"), self.first)
        return [i for i, line in every if line and not line.isspace()][at]

    def next_line(self) -> bytes:
        """Go to the next line."""
        if self.at >= len(self.lines):
            raise _Damaged(f"it ends with line {self.number(-1)}" if self.lines else "it is empty")
        self.at += 1
        return self.lines[self.at - 1]

    def take(self, kinds: str) -> list[Any]:
        """Take numbers as in `_Source`, from one line."""
        if not self.words:
            self.words = self.next_line().split()
        if len(self.words) < len(kinds):
            self.fail("numbers are missing")
        taken, self.words = self.words[: len(kinds)], self.words[len(kinds) :]
        try:
            return [float(w) if k == "d" else int(w) for k, w in zip(kinds, taken, strict=True)]
        except ValueError:
            self.fail(_expected(kinds))

    def end_row(self) -> None:
        """Insist on the end of a line, as in `_Source`."""
        if self.words:
            self.fail(f"{counted(len(self.words), 'number')} too many")

    def table(self, rows: int, columns: int, kind: str) -> Array:
        """Take lines of numbers, as in `_Source`."""
        found = self.lines[self.at : self.at + rows]
        for i, line in enumerate(found, self.at + 1):
            if len(line.split()) != columns:
                self.at = i
                self.fail(f"{columns} numbers are expected")
        if len(found) < rows:
            self.at = len(self.lines)
            self.next_line()
        values = _parsed(found, columns, kind)
        if values is None:
            bad = (i for i, line in enumerate(found) if _parsed([line], columns, kind) is None)
            self.at += 1 + next(bad, 0)
            self.fail(_expected(kind))
        self.at += rows
        return values

    def end(self) -> None:
        """Insist on the section's end."""
        if self.at < len(self.lines):
            self.next_line()
            self.fail("the section should have ended")


def _expected(kinds: str) -> str:
    return f"{'' if 'd' in kinds else 'whole '}numbers are expected"


def _parsed(lines: list[bytes], columns: int, kind: str) -> Array | None:
    """Read so many numbers from each line, None if a word is no number of this kind."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # what comes of words that are none
        try:
            dtype = np.float64 if kind == "d" else np.int64
            values = np.fromstring(b" ".join(lines), dtype, sep=" ")
        except (ValueError, OverflowError, DeprecationWarning):
            return None
    return values.reshape(-1, columns) if values.size == len(lines) * columns else None


class _Binary:
    """A section in binary.

    Args:
        data: The file.
        at: Where the section begins.
        order: "<" or ">".
        wide: Whether sizes and tags of nodes and elements take 8 bytes (format 4.1) or 4.
    """

    def __init__(self, data: bytes, at: int, order: str, wide: bool) -> None:
        self.data, self.at, self.order = data, at, order
        self.codes = {"n": "q" if wide else "i", "i": "i", "d": "d"}

    def numbers(self, count: int, kind: str) -> Array:
        """Take some numbers of one kind."""
        dtype = np.dtype(self.order + self.codes[kind])
        if not 0 <= count <= (len(self.data) - self.at) // dtype.itemsize:
            raise _Damaged(
                f"at byte {self.at} {count} numbers are announced, and the file has "
                f"{len(self.data)} bytes"
            )
        found = np.frombuffer(self.data, dtype, count, self.at)
        self.at += count * dtype.itemsize
        return found.astype(np.float64 if kind == "d" else np.int64)

    def take(self, kinds: str) -> list[Any]:
        """Take numbers, as in `_Source`."""
        return [self.numbers(1, kind)[0].item() for kind in kinds]

    def end_row(self) -> None:
        """Insist on the end of a line, as in `_Source`."""

    def table(self, rows: int, columns: int, kind: str) -> Array:
        """Take lines of numbers, as in `_Source`."""
        return self.numbers(rows * columns, kind).reshape(rows, columns)


def read(path: Path) -> MshFile:
    """Read a mesh file.

    Args:
        path: In gmsh's format 2.2 or 4.1, ASCII or binary.

    Raises:
        InputError: It cannot be read, or is damaged; the message says where.
    """
    try:
        data = read_regular(path, MOST_BYTES)
    except InputError:
        raise
    except (OSError, ValueError) as error:  # a name may hold what none can
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"cannot be read: {reason}") from error
    try:
        return _Reader(data).read()
    except _Damaged as fault:
        raise InputError(str(fault)) from None


class _Reader:
    """One file on its way in."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0
        self.binary, self.order, self.version = False, "<", 0
        self.names: dict[tuple[int, int], str] = {}
        self.groups: dict[tuple[int, int], frozenset[int]] | None = None  # of entities, 4.1
        self.tags: Int64Array | None = None
        self.points: FloatArray = np.empty((0, 3))
        self.blocks: list[Block] | None = None

    def read(self) -> MshFile:
        """Read all sections, in the order of the file."""
        known: dict[str, Callable[[], None]] = {
            "MeshFormat": self.format,
            "PhysicalNames": self.physical_names,
        }
        numeric: dict[str, Callable[[_Source], None]] = {
            "Entities": self.entities,
            "PartitionedEntities": lambda source: self.entities(source, partitioned=True),
            "Nodes": self.nodes,
            "Elements": self.elements,
        }
        before: set[str] = set()
        while name := self.heading():
            if not before and name not in ("MeshFormat", "Comments"):
                break
            if name in before and (name in known or name in numeric):
                raise _Damaged(f"damaged gmsh file: the section ${name} comes twice")
            if name != "Comments":
                before.add(name)
            try:
                if name in numeric:
                    self.section(name, numeric[name])
                elif name in known:
                    known[name]()
                else:
                    self.body(name)  # no matter of ours
                self.ending(name)
            except _Damaged as fault:
                raise _Damaged(f"damaged gmsh file: section ${name}: {fault}") from None
        if "MeshFormat" not in before:
            raise _Damaged("not a gmsh mesh file (formats 2.2 and 4.1 are read)")
        if self.tags is None or self.blocks is None:
            missing = "Nodes" if self.tags is None else "Elements"
            raise _Damaged(f"damaged gmsh file: it has no section ${missing}")
        order = np.argsort(self.tags)
        tags, points = self.tags[order], self.points[order]
        twice = np.flatnonzero(tags[1:] == tags[:-1])
        if len(twice):
            raise _Damaged(f"damaged gmsh file: two nodes have the number {tags[twice[0]]}")
        for block in self.blocks:
            absent = block.nodes[~found_in(tags, block.nodes)[1]]
            if len(absent):
                raise _Damaged(f"damaged gmsh file: an element has node {absent[0]}, which is none")
        return MshFile(tags, points, self.blocks, self.names)

    # sections

    def heading(self) -> str | None:
        """Name of the section that begins here, None at the end of the file."""
        rest = re.compile(rb"\s*").match(self.data, self.at)
        assert rest is not None
        self.at = rest.end()
        if self.at == len(self.data):
            return None
        found = re.compile(rb"\$(\w{1,80})[ \t\r]*(\n|$)").match(self.data, self.at)
        if found is None or found[1].startswith(b"End"):
            if self.version == 0:
                raise _Damaged("not a gmsh mesh file (formats 2.2 and 4.1 are read)")
            raise _Damaged(f"damaged gmsh file: no section begins in {self.line()}")
        self.at = found.end()
        return found[1].decode()

    def line(self) -> str:
        """Say where in the file we are."""
        if self.binary:
            return f"byte {self.at}"
        return f"line {self.data.count(10, 0, self.at) + 1}"

    def ending(self, name: str) -> None:
        """Insist on the section's last line."""
        found = re.compile(rb"\s*\$End" + name.encode() + rb"[ \t\r]*(?:\n|$)").match(
            self.data, self.at
        )
        if found is None:
            raise _Damaged(f"$End{name} is expected in {self.line()}")
        self.at = found.end()

    def body(self, name: str) -> tuple[bytes, int]:
        """Take what stands between a section's first and last line, and its first line's number."""
        end = self.data.find(b"$End" + name.encode(), self.at)
        if end < 0:
            raise _Damaged(f"there is no $End{name}")
        body, first = self.data[self.at : end], self.data.count(10, 0, self.at) + 1
        self.at = end
        return body, first

    def section(self, name: str, read: Callable[[_Source], None]) -> None:
        """Read a section of numbers."""
        if self.version == 0:
            raise _Damaged("it comes before $MeshFormat")
        if self.binary:
            binary = _Binary(self.data, self.at, self.order, self.version == 4)
            if self.version == 2:  # the number of nodes or elements is told in ASCII
                found = re.compile(rb"[ \t]*(\d{1,18})[ \t\r]*\n").match(self.data, self.at)
                if found is None:
                    raise _Damaged(f"a number is expected in {self.line()}")
                self.count, binary.at = int(found[1]), found.end()
            read(binary)
            self.at = binary.at
            return
        text = _Text(*self.body(name))
        if self.version == 2:
            (self.count,) = text.take("n")
            text.end_row()
        read(text)
        text.end()

    def format(self) -> None:
        """Read $MeshFormat: version, whether binary, and the size of a number."""
        found = re.compile(rb"[ \t]*([^\s]+)[ \t]+(\d+)[ \t]+(\d+)[ \t\r]*\n").match(
            self.data, self.at
        )
        words = self.data[self.at : self.at + 40].split()
        version = words[0].decode("ascii", "backslashreplace") if words else ""
        if version not in ("2", "2.0", "2.1", "2.2", "4.1"):
            raise _Damaged(f"gmsh format {version}: formats 2.2 and 4.1 are read")
        if found is None or int(found[2]) > 1 or int(found[3]) != 8:
            raise _Damaged(f"three numbers, as in {version} 0 8, are expected in {self.line()}")
        self.version, self.binary, self.at = int(version[0]), found[2] == b"1", found.end()
        if self.binary:
            one = self.data[self.at : self.at + 4]
            self.order = {struct.pack("<i", 1): "<", struct.pack(">i", 1): ">"}.get(one, "")
            if not self.order:
                raise _Damaged(f"the number 1 is expected at byte {self.at}")
            self.at += 4

    def physical_names(self) -> None:
        """Read $PhysicalNames, in ASCII always."""
        body, first = self.body("PhysicalNames")
        rows = [(i, row) for i, row in enumerate(body.split(b"\n"), first) if row.strip()]
        pattern = re.compile(rb'\s*([0-3])\s+(\d{1,10})\s+"(.*)"\s*')
        if not rows or not rows[0][1].strip().isdigit():
            raise _Damaged(f"a number is expected in line {first}")
        if int(rows[0][1]) != len(rows) - 1:
            raise _Damaged(f"{int(rows[0][1])} names are announced, {len(rows) - 1} are there")
        for line, row in rows[1:]:
            if (found := pattern.fullmatch(row)) is None:
                raise _Damaged(f"dimension, tag and name in quotes are expected in line {line}")
            key = int(found[1]), int(found[2])
            if key in self.names:
                raise _Damaged(f"line {line} names {DIMENSIONS[key[0]]} group {key[1]} anew")
            self.names[key] = found[3].decode("utf-8", "replace")

    def entities(self, source: _Source, partitioned: bool = False) -> None:
        """Read $Entities or $PartitionedEntities: physical groups of points, curves, surfaces."""
        if self.version == 2:
            raise _Damaged("there is no such section in format 2.2")
        if self.groups is None:
            self.groups = {}
        if partitioned:
            source.take("n")
            source.end_row()
            (ghosts,) = source.take("n")
            source.end_row()
            source.table(_count(ghosts), 2, "i")
        counts = source.take("nnnn")
        source.end_row()
        for dim, count in enumerate(counts):
            for _ in range(_count(count)):
                (tag,) = source.take("i")
                if partitioned:
                    source.take("ii")
                    self.several(source, "i")
                source.take("ddd" if dim == 0 else "dddddd")
                groups = self.several(source, "i")
                if dim > 0:
                    self.several(source, "i")
                source.end_row()
                self.groups[dim, tag] = frozenset(abs(group) for group in groups)

    @staticmethod
    def several(source: _Source, kind: str) -> list[int]:
        """Take a number and so many numbers."""
        (count,) = source.take("n")
        if not 0 <= count <= _MOST_TAGS:
            raise _Damaged(f"{count} numbers are announced where there are few")
        return [source.take(kind)[0] for _ in range(count)]

    def nodes(self, source: _Source) -> None:
        """Read $Nodes."""
        if self.version == 2:
            self.nodes_of_2(source)
        else:
            tags: list[Array] = [np.empty(0, dtype=np.int64)]
            points: list[Array] = [np.empty((0, 3))]
            blocks, total, _, _ = source.take("nnnn")
            source.end_row()
            for _ in range(_count(blocks)):
                dim, _, parametric, count = source.take("iiin")
                source.end_row()
                if dim not in range(4) or parametric not in (0, 1):
                    raise _Damaged(f"a block of nodes of dimension {dim} is announced")
                tags.append(source.table(_count(count), 1, "n")[:, 0])
                points.append(source.table(count, 3 + dim * parametric, "d")[:, :3])
            self.tags, self.points = np.concatenate(tags), np.concatenate(points)
            self.insist_count(total, len(self.tags), "nodes")
        assert self.tags is not None
        wrong = np.flatnonzero(~(np.abs(self.points) <= FARTHEST).all(axis=1))
        if len(wrong):
            where = ", ".join(f"{x:g}" for x in self.points[wrong[0]])
            raise _Damaged(
                f"node {self.tags[wrong[0]]} lies at ({where}); coordinates up to {FARTHEST:g} "
                "are allowed"
            )
        if len(self.tags) and self.tags.min() < 1:
            raise _Damaged(f"a node has the number {self.tags.min()}")

    def nodes_of_2(self, source: _Source) -> None:
        if isinstance(source, _Binary):
            row = np.dtype([("tag", source.order + "i4"), ("x", source.order + "f8", 3)])
            if self.count > (len(source.data) - source.at) // row.itemsize:
                raise _Damaged(f"{self.count} nodes are announced, more than the file holds")
            found = np.frombuffer(source.data, row, self.count, source.at)
            source.at += self.count * row.itemsize
            self.tags, self.points = found["tag"].astype(np.int64), found["x"].astype(np.float64)
            return
        assert isinstance(source, _Text)
        values = source.table(_count(self.count), 4, "d")
        if np.any((values[:, 0] != np.rint(values[:, 0])) | (np.abs(values[:, 0]) > 2**53)):
            raise _Damaged("a node has a number that is not whole")
        self.tags, self.points = values[:, 0].astype(np.int64), values[:, 1:]

    def elements(self, source: _Source) -> None:
        """Read $Elements."""
        self.blocks = []
        if self.version == 4:
            blocks, total, _, _ = source.take("nnnn")
            source.end_row()
            for _ in range(_count(blocks)):
                dim, entity, kind, count = source.take("iiin")
                source.end_row()
                width = self.nodes_of(kind)
                if ELEMENTS[kind][1] != dim:
                    raise _Damaged(f"{ELEMENTS[kind][0]} elements in a block of dimension {dim}")
                if self.groups is not None and (dim, entity) not in self.groups:
                    raise _Damaged(f"{DIMENSIONS[dim]} {entity} is not among $Entities")
                groups = (self.groups or {}).get((dim, entity), frozenset())
                nodes = source.table(_count(count), 1 + width, "n")[:, 1:]
                self.blocks.append(Block(kind, groups, nodes))
            self.insist_count(total, sum(len(b.nodes) for b in self.blocks), "elements")
        elif isinstance(source, _Binary):
            total = 0
            while total < self.count:
                total += self.run_of_2(source, self.count - total)
            self.insist_count(self.count, total, "elements")
        else:
            assert isinstance(source, _Text)
            self.elements_of_2(source)

    def run_of_2(self, source: _Binary, most: int) -> int:
        """Read a block in binary, or a run of blocks of one element each; return the count."""
        start = source.at
        kind, count, labels = source.take("iii")
        width = 1 + labels + self.nodes_of(kind)
        if count < 1 or not 0 <= labels <= _MOST_TAGS:
            raise _Damaged(f"a block of {count} elements with {labels} tags is announced")
        if count > 1:
            self.add(kind, labels, source.table(count, width, "i"))
            return count
        source.at = start
        left = min(most, (len(source.data) - start) // (4 * (3 + width)))
        ahead = np.frombuffer(source.data, source.order + "i4", left * (3 + width), start)
        alike = (ahead.reshape(left, 3 + width)[:, :3] == (kind, 1, labels)).all(axis=1)
        run = left if alike.all() else int(np.argmin(alike))
        if run == 0:
            raise _Damaged(f"it breaks off at byte {start}")
        self.add(kind, labels, source.table(run, 3 + width, "i")[:, 3:])
        return run

    def elements_of_2(self, source: _Text) -> None:
        """Read one element a line: number, type, how many tags, the tags, the nodes."""
        lines = source.lines[source.at :]
        if len(lines) != self.count:
            raise _Damaged(f"{self.count} elements are announced, {len(lines)} are there")
        alike: dict[tuple[int, int], list[bytes]] = {}
        for line in lines:
            source.at += 1
            words = line.split()
            if len(words) < 3 or not (words[1].isdigit() and words[2].isdigit()):
                source.fail("an element's number, type and tags are expected")
            kind, labels = int(words[1][:9]), int(words[2][:9])
            if kind not in ELEMENTS:
                source.fail(f"there is the type {kind}, which is unknown here")
            if len(words) != 3 + labels + ELEMENTS[kind][2]:
                source.fail(f"{3 + labels + ELEMENTS[kind][2]} numbers are expected")
            alike.setdefault((kind, labels), []).append(line)
        for (kind, labels), found in alike.items():
            values = _parsed(found, 3 + labels + ELEMENTS[kind][2], "n")
            if values is None:
                raise _Damaged("whole numbers are expected")
            self.add(kind, labels, values[:, 2:])

    def add(self, kind: int, labels: int, rows: Array) -> None:
        """Add elements of format 2: a number, tags, nodes; the first tag is the physical group."""
        assert self.blocks is not None
        groups = np.abs(rows[:, 1]) if labels else np.zeros(len(rows), dtype=np.int64)
        for group in np.unique(groups):
            tags = frozenset({int(group)} - {0})
            self.blocks.append(Block(kind, tags, rows[groups == group, 1 + labels :]))

    @staticmethod
    def nodes_of(kind: int) -> int:
        if kind not in ELEMENTS:
            raise _Damaged(f"there are elements of the type {kind}, which is unknown here")
        return ELEMENTS[kind][2]

    @staticmethod
    def insist_count(announced: int, found: int, what: str) -> None:
        if announced != found:
            raise _Damaged(f"{announced} {what} are announced, {found} are there")


def _count(number: int) -> int:
    if number < 0:
        raise _Damaged(f"a count of {number}")
    return number
