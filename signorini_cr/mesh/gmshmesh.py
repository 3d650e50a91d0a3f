"""Triangulating polygons with gmsh, and taking what gmsh has written, on one rank, into arrays.

gmsh is loaded on first use, so a mesh of the user's own works without it.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, IndexArray, Int32Array, Int64Array, found_in
from ..errors import InputError, naming
from ..hints import guess
from ..rounding import counted
from . import mshfile
from .lines import arranged, sorted_out
from .mshfile import ELEMENTS, MshFile
from .planar import overlap, pieces
from .plane import ends_in_words, in_words
from .polygon import MOST_EDGES
from .valid import too_thin

_MOST_TRIANGLES = 2e7
_MOST_GRADED = 3e4  # on edges beside short ones: gmsh takes a minute for so many
_UNEVEN = 0.4  # by what factor facets that meet at a vertex may differ
_LINE, _TRIANGLE = 1, 2  # gmsh's element types
_FAR = 1e3  # in parts of the extent: a polygon that is moved to the origin for gmsh
_USUAL = 1e-6, 1e6  # extents that gmsh is told as they are
_GROWTH = 0.3  # of the size, per length, away from short facets
_ROUNDING = 1e-14  # what distances to boxes may be too long by, in parts
_OPTIONS = {
    "General.Terminal": 0,
    "General.AbortOnError": 2,  # raise instead of going on
    "General.NumThreads": 1,  # the same mesh every time
    "Mesh.Algorithm": 6,  # Frontal-Delaunay: the best angles; but see `_widen_inwards`
    "Mesh.ElementOrder": 1,
    "Mesh.RandomSeed": 1,
    "Mesh.MeshSizeFromPoints": 1,
    "Mesh.MeshSizeFromCurvature": 0,
    "Mesh.MeshSizeExtendFromBoundary": 1,
    "Mesh.MeshSizeFactor": 1,
    "Mesh.MeshSizeMin": 0,
    "Mesh.MeshSizeMax": 1e22,
    "Mesh.RecombineAll": 0,
}


class Triangulation(NamedTuple):
    """A triangle mesh as arrays, all on one rank.

    Attributes:
        points: Coordinates, shape (points, 2).
        triangles: Corners, shape (triangles, 3).
        facets: Ends of the labelled facets, shape (facets, 2).
        labels: Index of each facet's label, shape (facets,).
        materials: Number of each triangle's material, 0 for none, shape (triangles,); empty where
            none has a name.
        others: Named physical surfaces beside the materials, where there are such.
    """

    points: FloatArray
    triangles: Int64Array
    facets: Int64Array
    labels: Int32Array
    materials: Int32Array = np.empty(0, dtype=np.int32)
    others: tuple[str, ...] = ()


def _keep_sigpipe() -> None:
    """Handle SIGPIPE as Python does again: under some gmsh a closed pipe ends the process."""
    handler = signal.getsignal(signal.SIGPIPE)
    if handler is not None:
        with suppress(ValueError):  # not the main thread, whose business signals are
            signal.signal(signal.SIGPIPE, handler)


@contextmanager
def _session() -> Iterator[Any]:
    """Open a silent gmsh with an empty model; a session of the user's own is left as it was."""
    try:
        import gmsh
    except (ImportError, OSError) as error:  # the wheel wants libraries of the system
        raise InputError(f"this needs gmsh, which cannot be loaded: {error}") from error

    ours = not gmsh.isInitialized()
    if ours:
        gmsh.initialize(argv=[], readConfigFiles=False, interruptible=False)
        _keep_sigpipe()
        current = None
        before = {}
    else:
        current = gmsh.model.getCurrent()
        before = {name: gmsh.option.getNumber(name) for name in _OPTIONS}
    try:
        for name, value in _OPTIONS.items():
            gmsh.option.setNumber(name, value)
        gmsh.model.add("signorini_cr")
        yield gmsh
    finally:
        if ours:
            gmsh.finalize()
        else:
            gmsh.model.remove()
            gmsh.model.setCurrent(current)
            for name, value in before.items():
                gmsh.option.setNumber(name, value)


def triangulate(
    loops: Sequence[FloatArray],
    labels: Int32Array,
    size: float,
    polygons: Mapping[str, FloatArray],
    numbers: Mapping[str, int],
) -> Triangulation:
    """Triangulate a polygon with holes; its vertices become mesh vertices.

    Edges are cut into equal facets. Only an edge beside one with much shorter facets is graded
    towards it, since the angles would suffer otherwise.

    Args:
        loops: Vertices of the polygon and of each hole, shapes (n, 2).
        labels: Label of every edge, one loop after the other.
        size: Facet length wanted; shorter edges get one facet.
        polygons: Vertices of each material's polygon, whose edges become lines of the mesh.
        numbers: The materials' numbers.
    """
    away = _away(loops[0])
    moved = [polygon - away for polygon in polygons.values()]
    loops, labels, inner = arranged([loop - away for loop in loops], labels, moved)
    outline, unit = _outline(loops, inner, size), _unit(loops[0])
    with _session() as gmsh:
        curves = _draw(gmsh, outline.over(unit), [len(loop) for loop in loops], size / unit)
        try:
            gmsh.model.mesh.generate(2)
        except Exception as error:
            raise InputError(f"gmsh could not triangulate the polygon: {error}") from error
        found = [_elements(gmsh, 1, _LINE, curve) for curve in curves[: len(labels)]]
        tags, nodes, _ = gmsh.model.mesh.getNodes()
        raw = _compact(
            tags,
            unit * nodes,
            _elements(gmsh, 2, _TRIANGLE),
            np.concatenate(found),
            np.repeat(labels, [len(ends) for ends in found]),
        )
    if (narrow := too_thin(raw.points[raw.triangles], away)) is not None:
        raise InputError(f"the polygon is too narrow, too small or too uneven: {narrow}")
    if not _is_bounded_by(raw.triangles, raw.facets):
        across, shortest = np.ptp(loops[0], axis=0).max(), outline.facets.min()
        raise InputError(
            f"gmsh could not triangulate the polygon, {across:.3g} across with facets of"
            f" {shortest:.3g}: it takes points as near as that for one, or fills holes"
        )
    raw = raw._replace(points=raw.points + away)
    if not polygons:
        return raw
    middles = raw.points[raw.triangles].mean(axis=1)
    return raw._replace(materials=sorted_out(middles, polygons, numbers))


def _is_bounded_by(triangles: Int64Array, facets: Int64Array) -> bool:
    """Tell whether the sides that one triangle has are these facets, and others have two."""
    most = 1 + int(max(triangles.max(initial=0), facets.max(initial=0)))
    sides, cells = np.unique(_sides(triangles, most), return_counts=True)
    return bool(cells.max(initial=0) <= 2) and np.array_equal(
        sides[cells == 1], np.unique(_key(facets, most))
    )


def _away(outline: FloatArray) -> FloatArray:
    """Compute how far a polygon is to be moved towards the origin, shape (2,).

    gmsh compares coordinates with their distances, and loses points far out, where those in which
    lines cross are off the lines by rounding, too. Vertices come back to the digit, as differences
    of numbers of like size are exact.
    """
    extent = np.ptp(outline, axis=0).max()
    return np.where(np.abs(outline[0]) > _FAR * extent, outline[0], 0.0)


def _unit(outline: FloatArray) -> float:
    """Find the length that a polygon's are told to gmsh in parts of, a power of two.

    gmsh takes a length for none below some number, and has another one for infinity: a polygon of
    1e-12 across gets no point inside, whatever size is asked for.
    """
    extent = np.ptp(outline, axis=0).max()
    low, high = _USUAL
    return 1.0 if low <= extent <= high else float(2.0 ** np.floor(np.log2(extent)))


class _Outline(NamedTuple):
    """The lines that a mesh follows, one loop after the other and then those inside.

    Attributes:
        x: Their ends, each once, shape (points, 2).
        near: Facet length wanted at each of these, shape (points,).
        edges: The ends' numbers, shape (lines, 2).
        counts: How many facets each line is cut into, where they are equal, shape (lines,).
        facets: How long these are, shape (lines,).
    """

    x: FloatArray
    near: FloatArray
    edges: IndexArray
    counts: FloatArray
    facets: FloatArray

    def over(self, unit: float) -> _Outline:
        """Divide all lengths by a unit."""
        x, near, facets = (np.divide(each, unit) for each in (self.x, self.near, self.facets))
        return self._replace(x=x, near=near, facets=facets)


def _outline(loops: Sequence[FloatArray], inner: FloatArray, size: float) -> _Outline:
    """Find how finely lines are to be cut.

    Args:
        loops: Vertices of the polygon and of each hole, shapes (n, 2).
        inner: Ends of the lines inside, shape (m, 2, 2).
        size: Facet length wanted.

    Raises:
        InputError: There would be too many facets or triangles.
    """
    ends = np.concatenate(
        [*(np.stack([loop, np.roll(loop, -1, axis=0)], axis=1) for loop in loops), inner]
    )
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    counts = np.maximum(1, np.ceil(lengths / size - 1e-9))
    triangles = _area(loops[0]) / 0.43 / size / size  # equilateral: √3/4
    if counts.sum() > MOST_EDGES or triangles > _MOST_TRIANGLES:
        raise InputError(
            f"size is {size}: that asks for about {triangles:.1e} triangles in the coarsest mesh"
            f"; {_fitting(loops[0], lengths)}"
        )
    facets = lengths / counts
    x, edges = _numbered(ends)
    near = _sizes(x, edges, facets)
    graded = _graded(lengths, facets, near[edges])
    if graded > _MOST_GRADED:
        raise InputError(
            f"an edge has facets of {facets.min():.3g} beside much longer edges: those that grow"
            f" from there along these would be about {graded:.1e}, and {_MOST_GRADED:g} are"
            " allowed; longer edges are needed, or a mesh file"
        )
    return _Outline(x, near, edges, counts, facets)


def _draw(gmsh: Any, outline: _Outline, loops: Sequence[int], size: float) -> list[int]:
    """Tell gmsh the outline, and how fine the mesh is to be.

    Args:
        gmsh: From `_session`.
        outline: The lines.
        loops: How many of them each loop has.
        size: Facet length wanted.

    Returns:
        The tags of the lines.
    """
    geo, edges = gmsh.model.geo, outline.edges
    points = [geo.addPoint(*at, 0.0, h) for at, h in zip(outline.x, outline.near, strict=True)]
    curves = [geo.addLine(points[a], points[b]) for a, b in edges]
    even = outline.near[edges].min(axis=1) > _UNEVEN * outline.facets
    for i in np.flatnonzero(even):
        geo.mesh.setTransfiniteCurve(curves[i], int(outline.counts[i]) + 1)
    *rings, within = np.split(np.array(curves), np.cumsum(loops))
    surface = geo.addPlaneSurface([geo.addCurveLoop(ring.tolist()) for ring in rings])
    geo.synchronize()
    if len(within):
        gmsh.model.mesh.embed(1, within.tolist(), 2, surface)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    if outline.facets.min() < _UNEVEN * size:
        _widen_inwards(gmsh, curves, surface, size)
    return curves


def _numbered(ends: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Number points in the order in which edges meet them, and find the edges' ends among them.

    Args:
        ends: Shape (edges, 2, 2).
    """
    number: dict[tuple[float, ...], int] = {}
    edges = [number.setdefault(tuple(x), len(number)) for x in ends.reshape(-1, 2).tolist()]
    return np.array(list(number)), np.array(edges).reshape(-1, 2)


def _graded(lengths: FloatArray, facets: FloatArray, sizes: FloatArray) -> float:
    """Estimate the number of facets on graded edges, sizes linear between their ends."""
    low, high = np.sort(sizes, axis=1).T
    mean = (high - low) / np.log(np.maximum(high / low, 1 + 1e-9))
    return float(np.sum((lengths / np.maximum(mean, low))[low <= _UNEVEN * facets]))


def _sizes(x: FloatArray, edges: IndexArray, facets: FloatArray) -> FloatArray:
    """Compute the facet length at vertices: the shortest of their edges', growing slowly.

    Args:
        x: The vertices, shape (n, 2).
        edges: The edges' ends, shape (edges, 2).
        facets: Facet length of every edge, shape (edges,).
    """
    h = np.full(len(x), np.inf)
    np.minimum.at(h, edges, facets[:, None])
    return _grown(x, h)


def _grown(x: FloatArray, h: FloatArray) -> FloatArray:
    """Compute min_j h_j + `_GROWTH` |x_i − x_j| at points, shape (n,).

    The points are in a box, which is halved again and again, along its longer side, with as many
    of them on either side. A point goes on with the boxes that may have less than it has found.

    Args:
        x: The points, shape (n, 2).
        h: Their own, shape (n,).
    """
    of_box = np.resize(np.arange(len(x)), (1, 2 ** (len(x) - 1).bit_length()))  # some of them twice
    point, box, found = np.arange(len(x)), np.zeros(len(x), dtype=np.intp), h.copy()
    while True:
        least = np.take_along_axis(of_box, h[of_box].argmin(axis=1)[:, None], axis=1)[box, 0]
        from_there = h[least] + _GROWTH * np.hypot(*(x[least] - x[point]).T)
        np.minimum.at(found, point, from_there)
        if of_box.shape[1] == 1:
            return found
        inside = x[of_box]
        low, high = inside.min(axis=1), inside.max(axis=1)
        away = np.maximum(np.maximum(low[box] - x[point], x[point] - high[box]), 0.0)
        some = (h[least] + _GROWTH * np.hypot(*away.T)) * (1 - _ROUNDING) < found[point]
        point, box = np.repeat(point[some], 2), np.repeat(2 * box[some], 2)
        box[1::2] += 1
        along = (high - low).argmax(axis=1)[:, None, None]
        order = np.take_along_axis(inside, along, axis=2)[:, :, 0].argsort(axis=1)
        of_box = np.take_along_axis(of_box, order, axis=1).reshape(2 * len(of_box), -1)


def _fitting(outline: FloatArray, lengths: FloatArray) -> str:
    """Say how large a polygon is, and what facet length suits it."""
    across = " by ".join(f"{extent:.6g}" for extent in np.ptp(outline, axis=0))
    size = max(np.sqrt(_area(outline) / 0.43 / 400), lengths.sum() / 200)
    return f"the domain is {across}, and a size of {float(f'{size:.1g}'):g} makes some hundred"


def read(
    path: Path,
    parts: Mapping[str, int],
    needed: Sequence[str],
    materials: Mapping[str, int] = MappingProxyType({}),
) -> Triangulation:
    """Read a planar triangle mesh with named physical curves, and perhaps surfaces.

    Args:
        path: A gmsh file, format 2.2 or 4.1, ASCII or binary.
        parts: Label of each name; case does not matter.
        needed: Names of which there must be a curve.
        materials: Numbers of the physical surfaces that are asked for, by name.

    Raises:
        InputError: The file cannot be read, or is no such mesh; the message begins with its path.
    """
    with naming(path):
        if path.suffix.lower() == ".geo" and path.is_file():
            raise InputError(
                "this describes a domain and is no mesh yet; `gmsh -2 "
                f"{path.name}` makes {path.stem}.msh of it, which is needed here"
            )
        return _read(mshfile.read(path), parts, needed, materials)


def _read(
    file: MshFile,
    parts: Mapping[str, int],
    needed: Sequence[str],
    materials: Mapping[str, int],
) -> Triangulation:
    """Take from a file what `read` returns."""
    _check_cells(file)
    names = [(tag, file.names.get((1, tag), "")) for tag in file.groups(1)]
    found: dict[str, list[Int64Array]] = {name: [] for name in parts}
    others: dict[str, list[Int64Array]] = {}
    for tag, name in names:
        key = name.strip()
        key = key if key in parts else key.lower()
        group = found[key] if key in parts else others.setdefault(name or f"{tag}", [])
        group.append(file.elements(_LINE, tag))
    for each in needed:
        if not sum(map(len, found[each])):
            there = ", ".join(name or f"(unnamed, {tag})" for tag, name in names) or "none"
            known = any(name.strip().lower() == each.lower() for _, name in names)
            raise InputError(
                f"the physical curve {each!r} has no line in the file: those on it have to be saved"
                if known
                else f"no physical curve is named {each!r}; the physical curves there are: {there}"
            )
    facets = np.concatenate([part for key in parts for part in found[key]])
    labels = np.repeat(list(parts.values()), [sum(map(len, found[key])) for key in parts])
    triangles = file.elements(_TRIANGLE)
    raw = _compact(file.tags, file.points, triangles, facets, labels)
    if materials:
        of_cells, without = _of_materials(file, materials)
        raw = raw._replace(materials=of_cells, others=without)
    _check_names(triangles, facets, others, tuple(parts))
    try:
        _check_facets(raw, {label: name for name, label in parts.items()})
    except InputError:
        _check_twins(raw)  # of which the others are told
        raise
    return raw


def _of_materials(
    file: MshFile, materials: Mapping[str, int]
) -> tuple[Int32Array, tuple[str, ...]]:
    """Find the number of the physical surface that each triangle is in, or 0, shape (triangles,).

    Beside them the names of the surfaces of which no triangle has a material.

    Raises:
        InputError: There is no such surface, or two of them have a triangle in common.
    """
    called: dict[str, set[int]] = {name: set() for name in materials}
    for tag in file.groups(2):
        name = file.names.get((2, tag), "").strip()
        called.setdefault(name if name in materials else name.lower(), set()).add(tag)
    blocks = [block for block in file.blocks if block.kind == _TRIANGLE]
    found = []
    for block in blocks:
        here = [name for name in materials if called[name] & block.groups]
        if len(here) > 1 and len(block.nodes):
            raise InputError(
                f"the physical surfaces {here[0]!r} and {here[1]!r} share"
                f" {counted(len(block.nodes), 'triangle')}: a cell consists of one material"
            )
        found.append(np.full(len(block.nodes), materials[here[0]] if here else 0, np.int32))
    numbers: Int32Array = np.concatenate(found)
    for name, number in materials.items():
        if number not in numbers:
            there = [each for (dim, _), each in sorted(file.names.items()) if dim == 2]
            raise InputError(
                f"no physical surface with triangles is named {name!r}; the names there"
                f" are: {', '.join(there) or 'none'}"
            )
    tagged, bare = set[int](), set[int]()
    for block in blocks:
        own = any(called[name] & block.groups for name in materials)
        (tagged if own else bare).update(block.groups if len(block.nodes) else ())
    names = {file.names.get((2, tag), "").strip() for tag in bare - tagged}
    return numbers, tuple(sorted(names - {""}))


def _check_names(
    triangles: Int64Array,
    labelled: Int64Array,
    others: dict[str, list[Int64Array]],
    allowed: Sequence[str],
) -> None:
    """Refuse physical curves of other names where they would become Neumann facets unasked.

    They may lie inside the domain, and on facets that one of the allowed names has, too.

    Args:
        triangles: Node tags, shape (triangles, 3).
        labelled: Node tags of the facets of allowed names, shape (facets, 2).
        others: Node tags of the facets of each other name.
        allowed: The names.
    """
    curves = {name: np.concatenate(group) for name, group in others.items() if group}
    if not curves:
        return
    tags = int(triangles.max()) + 1
    keys, cells = np.unique(_sides(triangles, tags), return_counts=True)
    loose = np.setdiff1d(keys[cells == 1], _key(labelled, tags))
    for name, ends in curves.items():
        number = np.count_nonzero(np.isin(_key(ends, tags), loose))
        if number:
            word = next((part for part in allowed if part in name.lower()), name.strip().lower())
            what = (
                f"the physical curve {name!r}"
                if not name.isdigit()
                else (f"the physical curve with the number {name} and no name")
            )
            hint = guess(word, allowed, f"allowed there are {', '.join(allowed)}")
            raise InputError(
                f"{what} has {counted(number, 'facet')} on the boundary; {hint}, or a"
                " name with a condition of its own, in a problem file a section"
                f" [boundary.{name.strip()}]; a curve without a physical group is neumann"
            )


def _check_cells(file: MshFile) -> None:
    """Insist on triangles in the x-y plane, with straight sides, and nothing else."""
    kinds = sorted({block.kind for block in file.blocks if len(block.nodes)})
    properties = [(kind, *ELEMENTS[kind][:2]) for kind in kinds]
    wrong = [name for _, name, dim in properties if dim == 3]
    if wrong:
        raise InputError(f"a mesh in three dimensions ({wrong[0]}): a planar one is needed")
    plane = [(kind, name) for kind, name, dim in properties if dim == 2]
    if not plane:
        raise InputError(
            "no triangles: gmsh saves what has a physical group, so that the surface "
            "needs one as soon as the curves have one"
        )
    lines = [(kind, name) for kind, name, dim in properties if dim == 1]
    for kind, name in plane + lines:
        if kind not in (_TRIANGLE, _LINE):
            raise InputError(
                f"it contains cells of the kind {name!r}: only straight-sided triangles "
                "are possible"
            )
    used = np.concatenate([block.nodes.ravel() for block in file.blocks])
    if np.ptp(file.points[np.searchsorted(file.tags, used), 2]) > 0:
        raise InputError("the mesh does not lie in the x-y plane: z takes several values")


def _check_twins(raw: Triangulation) -> None:
    """Insist on triangles that are there once."""
    order, counts = np.unique(np.sort(raw.triangles), axis=0, return_counts=True)
    if counts.max() > 1:
        place = in_words(raw.points[order[counts.argmax(), 0]])
        raise InputError(
            f"triangles are there twice, as the one at {place}: so gmsh's format 2 has"
            " those of two physical surfaces, where format 4 has them once"
        )


def _check_facets(raw: Triangulation, names: Mapping[int, str]) -> None:
    """Insist on labels of exterior facets, one each, and on triangles side by side."""
    if (found := too_thin(raw.points[raw.triangles])) is not None:
        raise InputError(found)
    of_cells = _sides(raw.triangles, len(raw.points))
    keys, sides, count = np.unique(of_cells, return_inverse=True, return_counts=True)
    sides = sides.reshape(of_cells.shape)
    _check_labels(raw, keys, count, names)
    if count.max() > 2:
        raise InputError(f"{count.max()} triangles meet in one facet: at most 2 can")
    piece = pieces(sides, len(keys))
    if (found := overlap(raw.points, raw.triangles, sides, count, piece)) is not None:
        raise InputError(found)


def _key(ends: Int64Array, points: int) -> Int64Array:
    """Make one number of two, in either order, that are below the number of points."""
    return ends.min(axis=-1) * points + ends.max(axis=-1)


def _sides(triangles: Int64Array, points: int) -> Int64Array:
    """Make such numbers of triangles' sides, each opposite a corner, shape (triangles, 3)."""
    return _key(triangles[:, [[1, 2], [0, 2], [0, 1]]], points)


def _check_labels(
    raw: Triangulation, keys: Int64Array, count: Int64Array, names: Mapping[int, str]
) -> None:
    """Insist on labels of sides on the boundary, one each.

    Args:
        raw: The mesh.
        keys: The sides' ends, by `_key`, ascending.
        count: How many triangles have each side.
        names: Of the labels.

    Raises:
        InputError: A labelled facet is no side, or lies inside, or has two labels.
    """

    def facet(number: int) -> str:
        return f"the facet {ends_in_words(raw.points[raw.facets[number]])}"

    own = _key(raw.facets, len(raw.points))
    side, is_side = found_in(keys, own)
    strange = np.flatnonzero(~is_side)
    inside = np.flatnonzero(count[side] > 1)
    for bad, fault in ((strange, "is no side of a triangle"), (inside, "lies inside the domain")):
        if len(bad):
            name = names[int(raw.labels[bad[0]])]
            raise InputError(f"{facet(bad[0])} is labelled {name} but {fault}")
    order = np.lexsort((raw.labels, own))
    one, two = order[:-1], order[1:]
    twice = np.flatnonzero((own[one] == own[two]) & (raw.labels[one] != raw.labels[two]))
    if len(twice):
        i, j = one[twice[0]], two[twice[0]]
        raise InputError(
            f"{facet(i)} belongs to {names[int(raw.labels[i])]} and to "
            f"{names[int(raw.labels[j])]}: only one is possible"
        )


def _elements(gmsh: Any, dim: int, kind: int, entity: int = -1) -> Int64Array:
    """Return the node tags of the elements of one type, shape (elements, dim + 1)."""
    tags = gmsh.model.mesh.getElementsByType(kind, entity)[1]
    return tags.astype(np.int64).reshape(-1, dim + 1)


def _compact(
    tags: Int64Array,
    points: FloatArray,
    triangles: Int64Array,
    facets: Int64Array,
    labels: Int32Array,
) -> Triangulation:
    """Renumber gmsh's node tags from 0, leaving out the nodes of no triangle and of no facet."""
    used = np.unique(np.concatenate([triangles.ravel(), facets.ravel()]))
    order = np.argsort(tags)
    rows = order[np.searchsorted(tags, used, sorter=order)]
    return Triangulation(
        points.reshape(-1, 3)[rows, :2].copy(),
        np.searchsorted(used, triangles),
        np.searchsorted(used, facets),
        labels.astype(np.int32),
    )


def _widen_inwards(gmsh: Any, curves: list[int], surface: int, size: float) -> None:
    """Let triangles grow from short facets on the boundary to `size` inside."""
    field = gmsh.model.mesh.field.add("Extend")
    gmsh.model.mesh.field.setNumbers(field, "CurvesList", curves)
    gmsh.model.mesh.field.setNumbers(field, "SurfacesList", [surface])
    gmsh.model.mesh.field.setNumber(field, "SizeMax", size)
    gmsh.model.mesh.field.setNumber(field, "DistMax", size / _GROWTH)
    gmsh.model.mesh.field.setAsBackgroundMesh(field)
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    gmsh.option.setNumber("Mesh.Algorithm", 5)  # Delaunay: Frontal-Delaunay can give up early here


def _area(loop: FloatArray) -> float:
    x, y = (loop - loop[0]).T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
