r"""Domains: a mesh and the parts of its boundary.

The boundary of Ω consists of Γ0 (Dirichlet), Γ1 (contact) and, beyond the paper, Γg (Neumann).
A `Domain` comes from a `Polygon`, from a gmsh file or from a mesh and facet tags of the user's own.
"""

from __future__ import annotations

import itertools
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple

import basix.ufl
import numpy as np
import numpy.typing as npt
from dolfinx import fem, la
from dolfinx.graph import adjacencylist
from dolfinx.io.utils import distribute_entity_data
from dolfinx.mesh import (
    Mesh,
    MeshTags,
    create_mesh,
    exterior_facet_indices,
    meshtags,
    meshtags_from_entities,
)
from mpi4py import MPI

from ..arrays import FloatArray, IndexArray, Int32Array
from ..compat import cell_nodes, coordinate_map
from ..errors import (
    InputError,
    insist_on_kind,
    naming,
    on_root,
    raise_together,
    to_float,
    together,
)
from ..garbage import watch
from ..rounding import counted
from . import gmshmesh
from .exchange import Exchange
from .materials import Materials, tag_values
from .materials import numbered as numbered_materials
from .partition import by_position
from .polygon import check_labels, check_loops, circle, coordinates, cut, diameter
from .valid import folded, too_thin

CONTACT, DIRICHLET, NEUMANN = 1, 2, 3
PARTS = {"contact": CONTACT, "dirichlet": DIRICHLET, "neumann": NEUMANN}
"""Names that parts of a boundary have by themselves, and their values in facet tags."""
USUAL = ("contact", "dirichlet")
"""Parts that there must be where no part has a name of its own."""
REST = NEUMANN
"""The part of the exterior facets that nobody names: the weak form's natural condition."""


class Refinement(NamedTuple):
    """From a mesh to one that was made from it.

    Attributes:
        mesh: The coarse one, as long as anyone else needs it.
        parent: Row of the coarse cell that holds each cell, shape (cells,).
        exchange: What fetches these rows from other ranks, if cells have moved.
        pattern: Barycentric coordinates in its parent of the corners of each child, shape
            (children, d + 1, d + 1), where all cells are known to have been cut in the same way,
            the children of each in a row.
    """

    mesh: weakref.ref[Mesh]
    parent: Int32Array | IndexArray
    exchange: Exchange | None = None
    pattern: FloatArray | None = None

    def carry(self, values: npt.NDArray) -> npt.NDArray:
        """Give the fine cells what their parents have, of the coarse cells in order; collective."""
        rows = values if self.exchange is None else self.exchange.fetch(values)
        found: npt.NDArray = rows[self.parent]
        return found


class Parts(dict[str, int]):
    """Parts of a boundary and their values in facet tags.

    Attributes:
        called: The parts that stand for one value each of a user's own tags, by that value.
    """

    def __init__(self, parts: Mapping[str, int], called: Mapping[int, str]):
        """Take both."""
        super().__init__(parts)
        self.called = dict(called)


def named(parts: Mapping[str, int], key: str | int) -> str:
    """Return the name of the part that a name or a facet value stands for; "" for no such value."""
    insist_on_kind("a part", key, (str, int, np.integer), "a name or a facet value")
    if not isinstance(key, int | np.integer):
        return key
    return parts.called.get(key, "") if isinstance(parts, Parts) else ""


@dataclass(frozen=True, eq=False)
class Domain:
    """A mesh whose exterior facets are sorted into Γ0, Γ1, Γg and other parts; collective to make.

    Attributes:
        mesh: Affine simplices; no ghost cells when we make it.
        tags: Facet tags; each exterior facet has the value of one part.
        parts: The parts' names, and their values in the tags.
        materials: What the cells consist of.
        descent: From the coarsest mesh to this one, a step for each refinement.
        seconds: Wall time it took to triangulate or read, and to share out; 0 where it was there.
    """

    mesh: Mesh
    tags: MeshTags
    seconds: float = 0.0
    parts: Mapping[str, int] = field(default_factory=lambda: dict(PARTS))
    materials: Materials = field(default_factory=Materials)
    descent: tuple[Refinement, ...] = ()

    def __post_init__(self) -> None:
        """Free what meshes before have left; collective.

        Raises:
            InputError: A facet between two cells has the value of a part.
        """
        watch(self.mesh)
        if not self.descent:
            raise_together(self.mesh.comm, self._inside())

    def _inside(self) -> str | None:
        """Say that a facet of a part lies inside, if one does."""
        outer = exterior_facets(self.mesh)
        for name, value in self.parts.items():
            if len(np.setdiff1d(self.facets(value), outer)):
                return f"tags: a facet between two cells is {name}, which is a part of the boundary"
        return None

    def __repr__(self) -> str:
        """Describe the domain in a line; the facets are those of this rank."""
        cells = self.mesh.topology.index_map(self.mesh.topology.dim).size_global
        facets = ", ".join(f"{len(self.facets(part))} {name}" for name, part in self.parts.items())
        here = f" on rank {self.mesh.comm.rank}" if self.mesh.comm.size > 1 else ""
        return f"<Domain: {cells} cells; facets{here}: {facets}>"

    def facets(self, part: int) -> Int32Array:
        """Find the local indices of the facets of one part that this rank owns.

        Args:
            part: A value of `parts`.
        """
        found = self.tags.find(part)
        return found[found < self.mesh.topology.index_map(self.mesh.topology.dim - 1).size_local]

    def names_of(self, facets: Int32Array) -> npt.NDArray[Any]:
        """Name the parts that some facets of this rank are in, shape (n,)."""
        names, values = np.array(list(self.parts)), np.array(list(self.parts.values()))
        own = self.tags.values[np.searchsorted(self.tags.indices, facets)]
        order = np.argsort(values)
        return np.asarray(names[order[np.searchsorted(values, own, sorter=order)]])

    @cached_property
    def all_facets(self) -> dict[int, Int32Array]:
        """Local indices of the facets of each part, ghosts included, ascending; collective."""
        mark = la.vector(self.mesh.topology.index_map(self.mesh.topology.dim - 1))
        for part in self.parts.values():
            mark.array[self.facets(part)] = part
        mark.scatter_forward()
        return {
            part: np.flatnonzero(mark.array == part).astype(np.int32)
            for part in self.parts.values()
        }

    @cached_property
    def _own(self) -> dict[fem.Function, fem.Function]:
        """The functions that `own` has made."""
        return {}

    def own(self, function: fem.Function) -> fem.Function:
        """Return a function of this mesh for one of a coarser mesh, as `carried` has made it last.

        Collective where it has not.
        """
        return self._own[function] if function in self._own else self.carried(function)

    def carried(self, function: fem.Function) -> fem.Function:
        """Carry a function that is constant on each cell of a coarser mesh to this one; collective.

        Args:
            function: Of degree 0, on this mesh or on one that it was refined from. What it is
                counts: whoever begins to work with it has its values carried anew.

        Raises:
            InputError: It is of another degree, or on another mesh.
        """
        V = function.function_space
        if V.mesh is self.mesh:
            return function
        above = [i for i, step in enumerate(self.descent) if step.mesh() is V.mesh]
        if not above or not _is_of_degree_0(function):
            raise InputError(
                "data given as a dolfinx Function live on one mesh only, unless they are of degree"
                " 0 on the coarsest; give a function of x to solve on a sequence of meshes"
            )
        values = get_by_cells(function)
        for step in self.descent[above[0] :]:
            values = step.carry(values)
        fine = self._own.get(function)
        if fine is None:
            V_fine = fem.functionspace(self.mesh, V.ufl_element())
            fine = self._own[function] = fem.Function(V_fine, name=function.name)
        set_by_cells(fine, values)
        return fine

    def instead(self, function: fem.Function) -> fem.Function:
        """Return a function of this mesh that stands here for one of the same kind on any other."""
        if function not in self._own:
            kind = function.function_space.ufl_element()
            self._own[function] = fem.Function(fem.functionspace(self.mesh, kind))
        return self._own[function]

    @classmethod
    def from_tags(
        cls,
        mesh: Mesh,
        facet_tags: MeshTags,
        *,
        cell_tags: MeshTags | None = None,
        materials: Mapping[str, int | Sequence[int]] | None = None,
        contact: int | Sequence[int] | None = None,
        dirichlet: int | Sequence[int] | None = None,
        neumann: int | Sequence[int] | None = None,
        parts: Sequence[int] = (),
        **others: int | Sequence[int],
    ) -> Domain:
        """Take a mesh and facet tags of the user's own; collective.

        Exterior facets that are neither contact nor Dirichlet are Neumann facets, the weak
        form's natural condition. Other values on interior facets are ignored. Each contact
        and Dirichlet value must be there; and where Neumann values or further parts are given, they
        must be all that is left, but for facets without a tag or with the value 0. With further
        parts, whose conditions are in `Problem.conditions`, there need be no contact and no
        Dirichlet part.

        Args:
            mesh: Triangles or tetrahedra, straight-sided, any ghost mode.
            facet_tags: Values on facets.
            cell_tags: Values on cells, for the materials.
            materials: The value or values there that stand for each material, by names of your
                own; `Problem.materials` has their data. Cells without any have those of `Problem`.
            contact: The value or values that stand for Γ1; 1 if there are no further parts.
            dirichlet: The value or values that stand for Γ0; 2 if there are no further parts.
            neumann: The value or values that stand for Γg; named so that they can be checked.
            parts: Values that are further parts by themselves, called as they are: 3 is the part
                "3", and `Problem.conditions` may have its condition by 3.
            **others: The same for further parts, by names of your own.

        Raises:
            InputError: The mesh is of another kind, or folded, or has cells that are 10⁶ times as
                long as high; or the tags lie elsewhere, contradict one
                another, are not all there, or leave Γ0 or Γ1 empty.
        """
        insist_on_kind("mesh", mesh, Mesh, "a dolfinx Mesh")
        insist_on_kind("facet_tags", facet_tags, MeshTags, "dolfinx MeshTags")
        insist_on_kind("parts", parts, Sequence, "a list of values")
        insist_on_kind("cell_tags", cell_tags, (MeshTags, NoneType), "dolfinx MeshTags")
        insist_on_kind("materials", materials, (Mapping, NoneType), "a dictionary by names")
        others = {**{str(value): value for value in parts}, **others}
        given = {"contact": contact, "dirichlet": dirichlet, "neumann": neumann, **others}
        inner = numbered(others)
        needed = {name for name, own in given.items() if own is not None} - {"neumann"}
        if not others:
            needed |= set(USUAL)
        wanted = _wanted(given, inner, needed)
        raise_together(mesh.comm, _unfit(mesh, facet_tags))
        exterior = exterior_facets(mesh)
        raise_together(mesh.comm, folded(mesh))
        values = _values(mesh, facet_tags, exterior, wanted, inner)
        known = {int(value) for numbers in wanted.values() for value in numbers}
        there = _insist_on(mesh, facet_tags, exterior, wanted, needed)
        if (neumann is not None or others) and (left := sorted(there - known - {0})):
            words = [f"{part} {_list(numbers)}" for part, numbers in wanted.items()]
            words[0] = words[0].replace(" ", " is ", 1)
            raise InputError(
                f"exterior facets are tagged {_list(left)}, which stands for nothing:"
                f" {', '.join(words[:-1])} and {words[-1]}"
            )
        made = Materials.from_tags(mesh, cell_tags, materials or {})
        tags = meshtags(mesh, mesh.topology.dim - 1, exterior, values[exterior])
        alone = {int(v[0]): part for part, v in wanted.items() if len(v) == 1}
        return cls(mesh, tags, parts=Parts(inner, alone), materials=made)


def _wanted(
    given: Mapping[str, int | Sequence[int] | None], parts: Mapping[str, int], needed: set[str]
) -> dict[str, Int32Array]:
    """Find the values in a user's facet tags that stand for each part, ascending, by name.

    Args:
        given: What the user says of them.
        parts: The values of our own.
        needed: The parts that there must be.

    Raises:
        InputError: A value stands for two parts.
    """
    wanted = {}
    for name, own in given.items():
        usual = [parts[name]] if own is None and name in needed else []
        wanted[name] = tag_values(name, usual if own is None else own, "facet")
    for a, b in itertools.combinations(wanted, 2):
        if len(both := np.intersect1d(wanted[a], wanted[b])):
            raise InputError(
                f"the facet value {both[0]} stands for {a} and for {b}: "
                "a value can stand for one part only"
            )
    return wanted


def _values(
    mesh: Mesh,
    facet_tags: MeshTags,
    exterior: Int32Array,
    wanted: Mapping[str, Int32Array],
    parts: Mapping[str, int],
) -> Int32Array:
    """Find the part that each local facet belongs to, shape (facets,); collective.

    Args:
        mesh: The user's.
        facet_tags: The user's.
        exterior: Local indices of the exterior facets.
        wanted: From `_wanted`.
        parts: The values of our own.

    Raises:
        InputError: A tag of one of the parts is on a facet inside, or on none of the mesh.
    """
    fdim = mesh.topology.dim - 1
    values = np.full(_count(mesh, fdim), REST, dtype=np.int32)
    inside = np.ones(len(values), dtype=bool)
    inside[exterior] = False
    complaint = None
    last = int(facet_tags.indices.max(initial=-1))
    if last >= len(values):
        complaint = f"facet {last} is tagged, of {len(values)} facets: tags of this mesh are needed"
    owned = mesh.topology.index_map(fdim).size_local
    for name, numbers in wanted.items():
        chosen = facet_tags.indices[np.isin(facet_tags.values, numbers)]
        chosen = chosen[chosen < owned]
        values[chosen] = parts[name]
        if np.any(inside[chosen]):
            complaint = (
                f"{counted(np.count_nonzero(inside[chosen]), 'facet')} tagged {name} inside the"
                " domain: only exterior facets can be tagged"
            )
    raise_together(mesh.comm, complaint)
    return values


def _insist_on(
    mesh: Mesh,
    facet_tags: MeshTags,
    exterior: Int32Array,
    wanted: Mapping[str, Int32Array],
    needed: set[str],
) -> set[int]:
    """Insist on the values of the parts that there must be; collective.

    Args:
        mesh: The user's.
        facet_tags: The user's.
        exterior: Local indices of the exterior facets.
        wanted: From `_wanted`.
        needed: The parts that there must be.

    Returns:
        The values of exterior facets, of all ranks.
    """
    owned = mesh.topology.index_map(mesh.topology.dim - 1).size_local
    at = exterior[exterior < owned]
    mine = set(facet_tags.values[np.isin(facet_tags.indices, at)].tolist())
    there: set[int] = set().union(*mesh.comm.allgather(mine))
    for name, numbers in wanted.items():
        missing = [int(value) for value in numbers if value not in there]
        if name in needed and (missing or not len(numbers)):
            raise InputError(
                f"no exterior facet is tagged {name} (value {_list(missing)}): the"
                f" values there are {_list(sorted(there))}"
            )
    return there


def is_by_cells(function: object) -> bool:
    """Tell whether it is a scalar function that is constant on each cell."""
    return (
        isinstance(function, fem.Function) and not function.ufl_shape and _is_of_degree_0(function)
    )


def _is_of_degree_0(function: fem.Function) -> bool:
    return bool(function.function_space.ufl_element().embedded_superdegree == 0)


def get_by_cells(function: fem.Function) -> FloatArray:
    """Return a function of degree 0 on this rank's cells, shape (cells, entries)."""
    dofmap = function.function_space.dofmap
    values: FloatArray = function.x.array.reshape(-1, dofmap.bs)[dofmap.list[:, 0]]
    return values


def set_by_cells(function: fem.Function, values: FloatArray) -> None:
    """Set it on the first of these cells."""
    dofmap = function.function_space.dofmap
    function.x.array.reshape(-1, dofmap.bs)[dofmap.list[: len(values), 0]] = values


def numbered(names: Iterable[str]) -> dict[str, int]:
    """Give values in facet tags to the usual parts and to further ones, by name."""
    own = [name for name in dict.fromkeys(names) if name not in PARTS]
    return PARTS | {name: len(PARTS) + 1 + i for i, name in enumerate(own)}


def _list(items: Iterable[object]) -> str:
    return ", ".join(str(item) for item in items) or "none"


def _count(mesh: Mesh, dim: int) -> int:
    index_map = mesh.topology.index_map(dim)
    return index_map.size_local + index_map.num_ghosts


def exterior_facets(mesh: Mesh) -> Int32Array:
    """Find the facets of the boundary that this rank owns, local indices; collective."""
    tdim = mesh.topology.dim
    mesh.topology.create_connectivity(tdim - 1, tdim)
    mesh.topology.create_connectivity(tdim, tdim - 1)
    return exterior_facet_indices(mesh.topology)


def facet_entities(mesh: Mesh, facets: Int32Array) -> Int32Array:
    """Find the cell and the local facet index of facets; of those inside the first of their cells.

    Args:
        mesh: The mesh.
        facets: Local indices, shape (n,).

    Returns:
        Pairs (cell, facet's number in the cell), shape (n, 2).
    """
    tdim = mesh.topology.dim
    mesh.topology.create_connectivity(tdim - 1, tdim)
    mesh.topology.create_connectivity(tdim, tdim - 1)
    f2c = mesh.topology.connectivity(tdim - 1, tdim)
    c2f = mesh.topology.connectivity(tdim, tdim - 1).array.reshape(-1, tdim + 1)
    cells = f2c.array[f2c.offsets[facets]]
    return np.column_stack([cells, np.argmax(c2f[cells] == facets[:, None], axis=1)]).astype(
        np.int32
    )


def _unfit(mesh: Mesh, facet_tags: MeshTags) -> str | None:
    """Say what keeps a user's mesh and tags from being used, if anything."""
    tdim = mesh.topology.dim
    kind = mesh.topology.cell_type.name
    if kind not in ("triangle", "tetrahedron"):
        return f"the mesh consists of {kind} cells: triangles or tetrahedra are needed"
    if mesh.geometry.dim != tdim:
        return f"{kind} cells in {mesh.geometry.dim} dimensions: the mesh has to fill its space"
    if coordinate_map(mesh).degree != 1:
        return "the mesh has curved cells: straight-sided ones are needed"
    if mesh.geometry.x.dtype != np.float64:
        return f"the mesh has coordinates of type {mesh.geometry.x.dtype}: float64 is needed"
    if facet_tags.dim != tdim - 1:
        return f"the tags have dimension {facet_tags.dim}: facets have dimension {tdim - 1}"
    return too_thin(mesh.geometry.x[cell_nodes(mesh), :tdim])


@dataclass(frozen=True, eq=False)
class Polygon:
    """A polygonal domain, holes allowed, with a boundary part for every edge.

    Attributes:
        vertices: Shape (n, 2), in either orientation.
        boundary: Part of edge i, which runs from vertex i to vertex i + 1: a key of `PARTS`, or one
            of `names`.
        holes: Polygons inside this one, apart from each other.
        names: Further parts, of an edge each or more, with conditions in `Problem.conditions`. With
            some, there need be no edge that is contact, and none that is dirichlet.
        materials: What lies in a polygon, shape (n, 2), consists of a material, whose data are in
            `Problem.materials`. These polygons may share edges and reach beyond the domain, but not
            overlap; lines of the mesh follow their edges.
        edges: What edge i is called in messages; by default i.

    Raises:
        InputError: An outline crosses itself or another one, or a label is not known.
    """

    vertices: FloatArray
    boundary: tuple[str, ...]
    holes: tuple[Polygon, ...] = ()
    names: tuple[str, ...] = ()
    materials: Mapping[str, FloatArray] = field(default_factory=dict)
    edges: tuple[int, ...] = ()

    def __repr__(self) -> str:
        """Describe the polygon in a line."""
        loops = [self, *self.holes]
        parts = Counter(part for loop in loops for part in loop.boundary)
        words = [f"{number} {part}" for part, number in parts.items()]
        if self.holes:
            words.append(counted(len(self.holes), "hole"))
        return f"<Polygon: {counted(parts.total(), 'edge')}: {', '.join(words)}>"

    @classmethod
    def with_arcs(
        cls,
        vertices: npt.ArrayLike,
        boundary: Sequence[str],
        arcs: Mapping[int, Sequence[float]],
        size: float,
        **others: Any,
    ) -> Polygon:
        """Cut edges that are circular arcs into equal facets.

        They are no longer than `size`, and 24 or more for a full circle, so that no point of them
        is further from the arc than a thirtieth of their length. The domain is the polygon that
        comes out: refinement does not move nodes onto the arc.

        Args:
            vertices: Shape (n, 2), two at least.
            boundary: Part of each edge, and so of all its facets.
            arcs: A point [x, y] between its ends that an arc passes through, by edge.
            size: Facet length wanted, that of `mesh`.
            **others: Further attributes by name.

        Raises:
            InputError: There is no such edge or no such arc; and what the class raises.
        """
        points, labels, edges = cut(vertices, boundary, arcs, size)
        return cls(points, labels, edges=edges, **others)

    @classmethod
    def circle(
        cls, center: Sequence[float], radius: float, part: str, size: float, **others: Any
    ) -> Polygon:
        """Cut a circle into facets as `with_arcs` does, all of one part: a round hole, say.

        Args:
            center: [x, y].
            radius: Above 0.
            part: Of all of it.
            size: Facet length wanted, that of `mesh`.
            **others: Further attributes by name.

        Raises:
            InputError: The radius is not positive; and what the class raises.
        """
        points = circle(center, radius, size)
        return cls(points, (part,) * len(points), edges=(0,) * len(points), **others)

    def __post_init__(self) -> None:
        """Take lists as well as arrays and check everything that can be checked at once."""
        insist_on_kind("materials", self.materials, Mapping, "a dictionary by names")
        object.__setattr__(self, "vertices", coordinates(self.vertices))
        object.__setattr__(self, "boundary", tuple(self.boundary))
        object.__setattr__(self, "holes", tuple(self.holes))
        for hole in self.holes:
            insist_on_kind("a hole", hole, Polygon, "a Polygon")
        object.__setattr__(self, "names", tuple(self.names))
        check_labels(self.boundary, len(self.vertices), (*PARTS, *self.names))
        object.__setattr__(self, "edges", tuple(self.edges) or tuple(range(len(self.vertices))))
        loops = self, *self.holes
        check_loops([each.vertices for each in loops], [each.edges for each in loops])
        polygons = {name: coordinates(polygon) for name, polygon in self.materials.items()}
        object.__setattr__(self, "materials", polygons)
        for name, polygon in polygons.items():
            with naming(f"the material {name}"):
                check_loops([polygon])
        if any(hole.holes for hole in self.holes):
            raise InputError("a hole has holes of its own: describe what lies in them separately")

    def check_parts(self) -> None:
        """Insist on an edge for each name and, without names, on a Dirichlet and a contact part.

        A hole alone needs neither.
        """
        labels = set(self.boundary).union(*(hole.boundary for hole in self.holes))
        for name in self.parts:
            if name not in labels and name not in PARTS:
                raise InputError(
                    f"no edge is labelled {name!r}, which is one of the names; found "
                    f"{_list(sorted(labels))}"
                )
        if self.names:
            return
        for part in USUAL:
            if part not in labels:
                raise InputError(
                    f"no edge is labelled {part!r}: the boundary needs a contact part and a "
                    f"dirichlet part, found {_list(sorted(labels))}"
                )

    @property
    def diameter(self) -> float:
        """Largest distance between two points."""
        return diameter(self.vertices)

    def mesh(self, size: float, comm: MPI.Comm = MPI.COMM_WORLD) -> Domain:
        """Triangulate with facets of about the length `size`; collective.

        Every vertex becomes a mesh vertex; an edge is cut into equal facets no longer than
        `size`. The same polygon and size give the same mesh.

        Args:
            size: Facet length wanted; with the diameter the mesh is as coarse as can be.
            comm: The ranks that share the mesh.

        Raises:
            InputError: The size is no positive number or longer than the diameter, no edge has one
                of the names or, without names, none is contact or Dirichlet, or gmsh can't make
                the mesh.
        """
        size = to_float("size", size, "a positive number")
        insist_on_kind("comm", comm, MPI.Comm, "a communicator of MPI")
        together(comm, self._insist_on_size, size)
        self.check_parts()
        loops = [self.vertices, *(hole.vertices for hole in self.holes)]
        names = itertools.chain(self.boundary, *(hole.boundary for hole in self.holes))
        labels = np.array([self.parts[name] for name in names], dtype=np.int32)
        numbers = numbered_materials(list(self.materials))
        what = loops, labels, size, self.materials, numbers
        return distribute(comm, self.parts, numbers, gmshmesh.triangulate, *what)

    def _insist_on_size(self, size: float) -> None:
        """Refuse a length that no facet can have."""
        if not (np.isfinite(size) and size > 0):
            raise InputError(f"size is {size:g}: a positive number is needed")
        if size > self.diameter * (1 + 1e-9):
            raise InputError(
                f"size is {size:g}, longer than the domain, whose diameter is {self.diameter:g}"
            )

    @property
    def parts(self) -> dict[str, int]:
        """The parts that there may be, and their values in facet tags."""
        names = itertools.chain(self.names, *(hole.names for hole in self.holes))
        return numbered(names)


def read_gmsh(
    path: str | PathLike[str],
    comm: MPI.Comm = MPI.COMM_WORLD,
    names: Sequence[str] = (),
    materials: Sequence[str] = (),
) -> Domain:
    """Read a gmsh file (2.2 or 4.1, ASCII or binary) with named physical curves; collective.

    The physical curves named dirichlet, contact and neumann (in any case) are Γ0, Γ1 and Γg.
    Exterior facets in no physical curve are Neumann facets, the weak form's natural condition;
    curves of other names may lie inside the domain.

    Args:
        path: A planar mesh of straight-sided triangles.
        comm: The ranks that share the mesh.
        names: Further curves to look for, whose conditions are in `Problem.conditions`. With some,
            there need be no curve named contact, and none named dirichlet.
        materials: Physical surfaces to look for, whose data are in `Problem.materials`.

    Raises:
        InputError: The file can't be read, or is no such mesh; the message says where.
    """
    insist_on_kind("path", path, (str, PathLike), "the path of a file")
    insist_on_kind("names", names, Sequence, "a list of names")
    insist_on_kind("materials", materials, Sequence, "a list of names")
    parts, numbers = numbered(names), numbered_materials(materials)
    needed = [name for name in parts if name not in PARTS] if names else USUAL
    what = Path(path), parts, needed, numbers
    return distribute(comm, parts, numbers, gmshmesh.read, *what)


def distribute(
    comm: MPI.Comm,
    parts: Mapping[str, int],
    numbers: Mapping[str, int],
    make: Callable[..., gmshmesh.Triangulation],
    *args: object,
) -> Domain:
    """Make arrays on rank 0, share them out as a mesh without ghost cells, labels and materials."""
    insist_on_kind("comm", comm, MPI.Comm, "a communicator of MPI")
    began = time.perf_counter()
    raw: gmshmesh.Triangulation | None = None

    def on_rank_0() -> None:
        nonlocal raw
        raw = make(*args)  # kept there: what on_root returns goes to every rank

    on_root(comm, on_rank_0)
    if raw is None:
        none = np.empty(0, dtype=np.int64)
        raw = gmshmesh.Triangulation(
            np.empty((0, 2)), none.reshape(0, 3), none.reshape(0, 2), none.astype(np.int32)
        )
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    mesh = create_mesh(
        comm,
        cells=raw.triangles,
        x=raw.points,
        e=element,
        partitioner=by_position(raw.points, raw.triangles),
    )
    exterior = exterior_facets(mesh)
    ends, labels = distribute_entity_data(mesh, 1, raw.facets, raw.labels)
    mesh.topology.create_connectivity(1, 0)
    found = meshtags_from_entities(mesh, 1, adjacencylist(ends), labels)
    values = np.full(_count(mesh, 1), REST, dtype=np.int32)
    values[found.indices] = found.values
    tags = meshtags(mesh, 1, exterior, values[exterior])
    materials = Materials()
    if numbers:
        corners, of_cells = distribute_entity_data(mesh, 2, raw.triangles, raw.materials)
        others = comm.bcast(raw.others)
        materials = Materials(numbers, np.zeros(_count(mesh, 2), dtype=np.int32), others)
        mesh.topology.create_connectivity(2, 2)
        cells = meshtags_from_entities(mesh, 2, adjacencylist(corners), of_cells)
        materials.of_cells[cells.indices] = cells.values
    return Domain(mesh, tags, time.perf_counter() - began, parts, materials)
