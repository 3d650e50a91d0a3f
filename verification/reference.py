"""The discrete problem solved by code that shares nothing with the program.

From the coordinates of the cells, the numbers of their facets and the boundary parts alone: own
Crouzeix-Raviart matrices in NumPy, a primal-dual active set method with SciPy's sparse direct
solver, residuals in extended precision and iterative refinement until the contact forces stand.
The quadrature points are Basix's, since the discrete problem is defined with them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from signorini_cr import Domain

FloatArray = npt.NDArray[Any]
LongArray = npt.NDArray[np.longdouble]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Values = Callable[[Any, Any], Any]

CONTACT, DIRICHLET, NEUMANN = 1, 2, 3
MOST_STEPS = 60
"""Of the active set method, before it goes on with one facet at a time."""
REFINEMENTS = 60
STANDS = 1e-13
"""Relative change of the forces at which the refinement ends."""


@dataclass(frozen=True, eq=False)
class Cells:
    """A mesh as arrays, all of it on one rank.

    Attributes:
        points: The cells' vertices, shape (cells, 3, 2).
        facets: Global numbers of the facets, facet i opposite vertex i, shape (cells, 3).
        parts: Global numbers of the facets of each boundary part.
    """

    points: FloatArray
    facets: IntArray
    parts: dict[int, IntArray]


def gathered(domain: Domain) -> Cells | None:
    """A mesh on rank 0, None on the others; collective."""
    mesh = domain.mesh
    topology, comm = mesh.topology, mesh.comm
    owned = topology.index_map(2).size_local
    facet_map = topology.index_map(1)
    topology.create_connectivity(2, 1)
    local = topology.connectivity(2, 1).array.reshape(-1, 3)[:owned]
    geometry = mesh.geometry
    nodes = geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap
    points = comm.gather(geometry.x[nodes[:owned], :2])
    facets = comm.gather(facet_map.local_to_global(local.ravel().astype(np.int32)).reshape(-1, 3))
    parts = {}
    for part in (CONTACT, DIRICHLET, NEUMANN):
        found = domain.tags.find(part)
        found = found[found < facet_map.size_local].astype(np.int32)
        parts[part] = comm.gather(facet_map.local_to_global(found))
    if points is None:
        return None
    return Cells(
        np.concatenate(points),
        np.concatenate(facets).astype(np.int64),
        {part: np.sort(np.concatenate(found)).astype(np.int64) for part, found in parts.items()},
    )


@dataclass(frozen=True, eq=False)
class Data:
    """Functions of x and y, and the degree of the rule that integrates them."""

    f: Values
    g: Values
    obstacle: Values
    dirichlet: Values
    coefficient: Values
    degree: int = 4


def long(values: Any) -> LongArray:
    """The same numbers in extended precision."""
    return np.asarray(values, dtype=np.longdouble)


@dataclass(frozen=True, eq=False)
class Found:
    """The reference solution.

    Attributes:
        facets: Global numbers of the contact facets, ascending.
        force: Contact force on each.
        active: Whether it is in contact.
        degenerate: Whether its indicator drowns in the rounding of data in double precision.
        change: What the last refinement changed of forces and of x, relative.
        kkt: Largest violation of the discrete conditions, each relative to what it is made of.
        made_of: What the forces are made of: |A||x| + |b| on the contact facets.
        transitions: Points between a facet in contact and one that is not, shape (m, 2), and the
            length of the latter, shape (m,).
    """

    facets: IntArray
    force: FloatArray
    active: BoolArray
    degenerate: BoolArray
    change: float
    kkt: float
    made_of: FloatArray
    transitions: tuple[FloatArray, FloatArray]


class Discrete:
    """The discrete variational inequality on a mesh."""

    def __init__(self, cells: Cells, data: Data):
        """Assemble."""
        self.facets = cells.facets
        count = int(cells.facets.max()) + 1
        p = long(cells.points)
        edge = np.roll(p, -2, axis=1) - np.roll(p, -1, axis=1)  # opposite vertex i
        twice = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
        # ψ_i = 1 − 2 λ_i, and ∇λ_i is the opposite edge turned, over twice the area
        turned = np.stack([-edge[..., 1], edge[..., 0]], axis=2)
        self.slopes = -2 * turned / twice[:, None, None]
        area = abs(twice) / 2
        x, w = basix.make_quadrature(basix.CellType.triangle, data.degree)
        w = w / w.sum()
        hats = np.column_stack([1 - x.sum(axis=1), x])
        at = np.einsum("qi,nik->nqk", hats, cells.points)
        values = data.coefficient(at[..., 0], at[..., 1])
        self.stiffness = area * (long(values) @ long(w))
        f = long(data.f(at[..., 0], at[..., 1])) * area[:, None]
        self.b = np.zeros(count, dtype=np.longdouble)
        np.add.at(self.b, self.facets, f @ long(w[:, None] * (1 - 2 * hats)))
        self._neumann(cells, data)
        self.given = np.zeros(count, dtype=bool)
        self.given[cells.parts[DIRICHLET]] = True
        self.contact = cells.parts[CONTACT]
        self.x = np.zeros((2, count), dtype=np.longdouble)  # its sum, to twice the digits
        self.x[0, cells.parts[DIRICHLET]] = self._means(cells, DIRICHLET, data.dirichlet, data)
        self.bound = self._means(cells, CONTACT, data.obstacle, data)
        self.cell, self.local, self.ends = self._ends(cells, CONTACT)
        self.bound_at_ends = long(data.obstacle(self.ends[..., 0], self.ends[..., 1]))
        local = self.stiffness[:, None, None] * np.einsum("nik,njk->nij", self.slopes, self.slopes)
        rows, columns = (np.repeat(self.facets, 3, axis=1), np.tile(self.facets, (1, 3)))
        entries = local.reshape(-1, 9).astype(np.float64).ravel()
        where = (rows.ravel(), columns.ravel())
        self.matrix = sparse.csc_matrix((entries, where), shape=(count, count))
        self.absolute = sparse.csc_matrix((abs(entries), where), shape=(count, count))

    def _ends(self, cells: Cells, part: int) -> tuple[IntArray, IntArray, FloatArray]:
        """Cell, facet's number in it, and end points of the facets of a part."""
        place = {int(facet): k for k, facet in enumerate(cells.facets.ravel())}
        at = np.array([place[int(facet)] for facet in cells.parts[part]], dtype=np.int64)
        cell, local = at // 3, at % 3
        ends = np.stack([cells.points[cell, (local + k) % 3] for k in (1, 2)], axis=1)
        return cell, local, ends

    @staticmethod
    def _rule(degree: int) -> tuple[FloatArray, FloatArray]:
        t, w = basix.make_quadrature(basix.CellType.interval, degree)
        return t[:, 0], w / w.sum()

    def _means(self, cells: Cells, part: int, values: Values, data: Data) -> LongArray:
        _, _, ends = self._ends(cells, part)
        t, w = self._rule(data.degree)
        at = ends[:, :1] + t[:, None] * (ends[:, 1:] - ends[:, :1])
        return long(values(at[..., 0], at[..., 1])) @ long(w)

    def _neumann(self, cells: Cells, data: Data) -> None:
        cell, local, ends = self._ends(cells, NEUMANN)
        if not len(cell):
            return
        t, w = self._rule(data.degree)
        at = ends[:, :1] + t[:, None] * (ends[:, 1:] - ends[:, :1])
        length = np.sqrt(((long(ends[:, 1]) - long(ends[:, 0])) ** 2).sum(axis=1))
        g = long(data.g(at[..., 0], at[..., 1])) * long(w) * length[:, None]
        np.add.at(self.b, cells.facets[cell, local], g.sum(axis=1))  # ψ = 1 there
        for k, hat in ((1, 1 - t), (2, t)):
            np.add.at(self.b, cells.facets[cell, (local + k) % 3], g @ long(1 - 2 * hat))

    def residual(self) -> LongArray:
        """A x − b, cell by cell from differences, which lose no digits where κ is large."""
        of_cells = self.x[:, self.facets]
        rise = (of_cells[0] - of_cells[0, :, :1]) + (of_cells[1] - of_cells[1, :, :1])
        flux = self.stiffness[:, None] * np.einsum("ni,nik->nk", rise, self.slopes)
        out = -self.b
        np.add.at(out, self.facets, np.einsum("nk,nik->ni", flux, self.slopes))
        return out

    def _solve(self, active: BoolArray) -> float:
        """Solve with a given active set; return what the last refinement changed of the forces."""
        fixed = self.given.copy()
        fixed[self.contact[active]] = True
        self.x[:, self.contact[active]] = 0
        self.x[0, self.contact[active]] = self.bound[active]
        free = np.flatnonzero(~fixed)
        block = self.matrix[free][:, free]
        scale = 1 / np.sqrt(block.diagonal())
        scaled = (sparse.diags(scale) @ block @ sparse.diags(scale)).tocsc()
        factors = splu(
            scaled,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        residual = self.residual()
        change, before = np.inf, np.inf
        for _ in range(REFINEMENTS):
            step = -scale * factors.solve(scale * residual[free].astype(np.float64))
            total = self.x[0, free] + (self.x[1, free] + step)
            self.x[1, free] += (self.x[0, free] - total) + step
            self.x[0, free] = total
            last, residual = residual, self.residual()
            forces = abs(residual[self.contact[active]])
            moved = abs(residual - last)[self.contact[active]].sum() / (forces.sum() + self._size())
            wandered = abs(step).max(initial=0.0) / max(
                abs(self.x[0]).max(), abs(step).max(initial=1e-300)
            )
            change, before = float(max(moved, wandered)), change
            if change <= STANDS or (change <= 1e-10 and change >= 0.5 * before):
                break
        return change

    def _size(self) -> float:
        """Least force that counts: what rounding of the contact rows' data makes."""
        return float(np.finfo(float).eps * self._made_of()[self.contact].sum())

    def _made_of(self) -> FloatArray:
        x = abs(self.x[0]).astype(np.float64)
        return self.absolute @ x + abs(self.b).astype(np.float64)

    @cached_property
    def _diagonal(self) -> FloatArray:
        return self.matrix.diagonal()[self.contact]

    def _transitions(self, active: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Find where u_h − α changes its sign on the half of a free facet that is next to contact.

        Else it is the vertex between the two. u_h is that of the free facet's cell.
        """
        at: dict[tuple[float, float], list[tuple[int, int]]] = {}
        for facet, ends in enumerate(self.ends):
            for k, point in enumerate(ends):
                at.setdefault((float(point[0]), float(point[1])), []).append((facet, k))
        points, lengths = [], []
        for vertex, there in sorted(at.items()):
            if len(there) != 2 or active[there[0][0]] == active[there[1][0]]:
                continue
            facet, k = there[int(active[there[0][0]])]
            own = (
                self.x[0, self.facets[self.cell[facet]]] + self.x[1, self.facets[self.cell[facet]]]
            )
            corner = (self.local[facet] + 1 + k) % 3
            gap = own.sum() - 2 * own[corner] - self.bound_at_ends[facet, k]
            middle = own[self.local[facet]] - self.bound[facet]
            centre = self.ends[facet].mean(axis=0)
            share = float(middle / (middle - gap)) if gap < 0 < middle else 1.0
            points.append(centre + share * (np.array(vertex) - centre))
            lengths.append(float(np.linalg.norm(self.ends[facet, 1] - self.ends[facet, 0])))
        return np.array(points).reshape(-1, 2), np.array(lengths)

    def solve(self, start: bool = False) -> Found:
        """Solve by the primal-dual active set method.

        Args:
            start: Whether all contact facets are active at the start, or none.
        """
        active = np.full(len(self.contact), start)
        seen: set[bytes] = set()
        for step in range(40 * MOST_STEPS):
            change = self._solve(active)
            force = self.residual()[self.contact]
            gap = (self.x[0, self.contact] - self.bound) + self.x[1, self.contact]
            indicator = np.where(active, force, -self._diagonal * gap)
            wrong = (indicator > 0) != active
            if not wrong.any():
                break
            cycles = active.tobytes() in seen or step > MOST_STEPS
            seen.add(active.tobytes())
            if cycles:  # one at a time, the last of those that are wrong: this ends (Murty)
                wrong[: np.flatnonzero(wrong)[-1]] = False
            active = active ^ wrong
        else:
            raise RuntimeError("the reference's active set method did not end")
        made_of = self._made_of()
        noise = 4 * np.finfo(float).eps * made_of[self.contact]
        free = ~self.given
        free[self.contact[active]] = False
        left = self.residual()[free]
        return Found(
            facets=self.contact,
            force=np.where(active, force, 0).astype(np.float64),
            active=active,
            degenerate=(abs(indicator) <= noise).astype(bool),
            change=change,
            kkt=float((abs(left) / made_of[free]).max(initial=0.0)),
            made_of=made_of[self.contact],
            transitions=self._transitions(active),
        )
