"""The data of the Signorini problem and the forms of the paper.

Find u with −∇·(κ∇u) + c u = f in Ω, u = u_D on Γ0, κ∂ₙu = g on Γg and, on the contact boundary Γ1,

    u ≥ α,  κ∂ₙu ≥ 0,  κ∂ₙu (u − α) = 0                                              (1.4)

with κ = 1 and c = 0 unless they are given. Other parts of the boundary, and others of these kinds,
have conditions of their own (see `conditions`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import MappingProxyType, NoneType
from typing import Any

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from ufl.algorithms import compute_form_data
from ufl.algorithms.check_arities import ArityMismatch
from ufl.constantvalue import ComplexValue, IntValue
from ufl.core.expr import Expr
from ufl.corealg.traversal import unique_pre_traversal
from ufl.domain import extract_unique_domain
from ufl.geometry import GeometricFacetQuantity, GeometricQuantity
from ufl.restriction import Restricted

from ..arrays import FloatArray, Int32Array, summed
from ..errors import InputError, insist_on_kind, together
from ..hints import meant
from ..jit import compiled
from ..mesh.domain import PARTS, Domain, Parts, facet_entities, named
from ..mesh.materials import Materials
from ..mesh.shared import bounding_box
from .conditions import (
    Condition,
    Contact,
    Data,
    Dirichlet,
    Given,
    Neumann,
    as_number,
    changed,
    in_short,
    is_by_cells,
    once,
)
from .simplified import simplified
from .snapshot import Snapshot
from .space import ufl_element


@dataclass(frozen=True)
class Material:
    """Data where the domain consists of a material; None for those of the `Problem`.

    Attributes:
        coefficient: κ.
        f: Volume load.
        reaction: c.
        capacity: What multiplies ∂u/∂t in problems in time, above 0.
    """

    coefficient: Data | None = None
    f: Data | None = None
    reaction: Data | None = None
    capacity: float | None = None

    def __repr__(self) -> str:
        """Tell what is given."""
        return in_short(self)


@dataclass(frozen=True)
class Form:
    """A symmetric, coercive a(u, v) of one's own in the place of ∫ κ∇u·∇v, and a load beside f.

    Both are functions that return UFL forms, so that they serve on all meshes and in all spaces.
    They get ``dx`` and ``ds``: ``ds("floor")`` is the measure of the boundary part of that name,
    and ``dx("steel")`` that of the material. Beside the arguments they may hold expressions in
    ``ufl.SpatialCoordinate(mesh)``, Constants, and Functions of degree 0 on the coarsest mesh.
    Where conditions speak of κ∂ₙu, a's conormal derivative is meant.

    There is no certificate, as the flux that goes with a is not known.

    Attributes:
        a: a(u, v, dx, ds), with cell and boundary integrals of u, v and their gradients.
        load: L(v, dx, ds), or None.
    """

    a: Callable[[Expr, Expr, ufl.Measure, Callable[[str], ufl.Measure]], ufl.Form]
    load: Callable[[Expr, ufl.Measure, Callable[[str], ufl.Measure]], ufl.Form] | None = None

    def __repr__(self) -> str:
        """Tell what is given."""
        return in_short(self)


@dataclass(frozen=True)
class Problem:
    """Data of the problem, free of any mesh.

    Attributes:
        f: Volume load, the right-hand side of (1.4).
        g: Normal flux κ∂ₙu on Γg.
        obstacle: α, the lower bound of u on Γ1.
        dirichlet: u_D, the value of u on Γ0.
        coefficient: κ, positive scalar (or symmetric positive definite tensor).
        reaction: c, not below 0.
        form: What takes the place of ∫ κ∇u·∇v; there is no κ then, and nothing but u_D is derived
            from ``exact``.
        conditions: What holds on parts of the boundary, by their names in the domain, or by the
            facet value that a part of `Domain.from_tags` stands for; g, obstacle and dirichlet are
            for the parts neumann, contact and dirichlet where they aren't here.
        materials: The data of materials, by their names in the domain; what is not said there, and
            cells without material, have coefficient, f and reaction.
        exact: The exact solution, where it is known. f, g and u_D that are None are then
            derived from it by differentiation; without it, None means 0.
        quadrature_degree: Polynomial degree up to which loads and coefficient are integrated
            exactly, 0 or more.
        error_degree: The same for the errors against ``exact``.
    """

    f: Data | None = None
    g: Data | None = None
    obstacle: Data = 0.0
    dirichlet: Data | None = None
    coefficient: Data = 1.0
    reaction: Data = 0.0
    form: Form | None = None
    conditions: (
        Mapping[str, Condition] | Mapping[int, Condition] | Mapping[str | int, Condition]
    ) = field(default_factory=dict)
    materials: Mapping[str, Material] = field(default_factory=dict)
    exact: Data | None = None
    quadrature_degree: int = 4
    error_degree: int = 6

    def __repr__(self) -> str:
        """Tell what differs from nothing."""
        return in_short(self)

    def __post_init__(self) -> None:
        """Refuse other kinds of things, and degrees that Basix would stop the process for."""
        insist_on_kind("conditions", self.conditions, Mapping, "a dictionary by parts")
        insist_on_kind("materials", self.materials, Mapping, "a dictionary by names")
        insist_on_kind("form", self.form, (Form, NoneType), "a Form")
        for name in ("conditions", "materials"):  # whoever made the dictionary may change it
            object.__setattr__(self, name, dict(getattr(self, name)))
        for name in ("quadrature_degree", "error_degree"):
            degree = getattr(self, name)
            if not isinstance(degree, int | np.integer) or degree < 0:
                raise InputError(f"{name} is {degree!r}; it must be a whole number, 0 or more")
            object.__setattr__(self, name, int(degree))

    def called_once(self) -> Problem:
        """Make the same problem, whose functions are called once for a mesh."""
        kinds = ((self.conditions, Condition), (self.materials, Material))
        conditions, materials = (
            {key: once(each) if isinstance(each, kind) else each for key, each in given.items()}
            for given, kind in kinds
        )
        form = None if self.form is None else once(self.form)
        return changed(once(self), conditions=conditions, materials=materials, form=form)

    def linear(
        self,
        f: Data,
        conditions: Mapping[str, Condition],
        own: Mapping[str, Data] = MappingProxyType({}),
    ) -> Problem:
        """Make the problem with the same κ and c, but with other loads and conditions.

        Args:
            f: Its volume load.
            conditions: What holds on parts of the boundary, all of them.
            own: The volume loads of materials that have their own, by name.
        """
        materials = {name: replace(each, f=None) for name, each in self.materials.items()}
        for name, load in own.items():
            materials[name] = replace(materials.get(name, Material()), f=load)
        unused = Problem()
        return changed(
            self,
            f=f,
            g=unused.g,
            obstacle=unused.obstacle,
            dirichlet=unused.dirichlet,
            conditions=conditions,
            materials=materials,
            exact=None,
        )


def as_expression(data: Data, x: Expr, called: str = "data", in_cells: bool = False) -> Expr:
    """Turn ``data`` into a UFL expression in the coordinates x; collective.

    What a function of the user's raises on one rank is raised on all.

    Args:
        data: What the user has given.
        x: The coordinates.
        called: What it is called in messages.
        in_cells: Whether it is to have values inside cells, and not on facets alone.

    Raises:
        InputError: That is not possible.
    """
    mesh = extract_unique_domain(x).ufl_cargo()
    return together(mesh.comm, _expression, data, x, called, in_cells)


def _expression(data: Data, x: Expr, called: str, in_cells: bool = False) -> Expr:
    """Do what `as_expression` does on this rank."""
    try:
        given = data(x) if callable(data) and not isinstance(data, Expr) else data
        if isinstance(given, np.ndarray) and given.shape == ():
            given = float(given)
        found = ufl.as_ufl(given)
        if isinstance(found, ufl.classes.Condition):
            raise ValueError("it is a condition, of which ufl.conditional(it, 1, 0) makes a number")
        for each in unique_pre_traversal(found):
            for kind, words in _NO_DATA.items():
                if isinstance(each, kind) and (in_cells or kind is not GeometricFacetQuantity):
                    raise ValueError(f"it holds {words}")
            if isinstance(each, GeometricQuantity) and not isinstance(each, _GEOMETRY):
                raise ValueError(f"it holds {type(each).__name__}, which can't be evaluated")
            if isinstance(each, IntValue):
                float(each)  # which may be too large
        return found
    except (TypeError, ValueError, OverflowError) as error:
        text = "expressions as text are for problem files; " if isinstance(data, str) else ""
        raise InputError(
            f"{called}: {data!r} does not give a number or a UFL expression ({error}); {text}"
            "functions of x take theirs from ufl, as in ufl.sin(x[0])"
        ) from error


_NO_DATA: dict[type, str] = {
    ComplexValue: "a complex number",
    ufl.Argument: "a test or trial function",
    Restricted: "values of one side of a facet",
    GeometricFacetQuantity: "what facets have, as their normal",
}

_GEOMETRY = (
    ufl.SpatialCoordinate,
    ufl.FacetNormal,
    ufl.CellVolume,
    ufl.CellDiameter,
    ufl.Circumradius,
    ufl.MinCellEdgeLength,
    ufl.MaxCellEdgeLength,
    ufl.JacobianDeterminant,
)
"""Geometry that data may hold, the normal on facets alone."""


class Kernel:
    """A form compiled once and bound to any number of meshes of the same cell type.

    Args:
        form: UFL form on the mesh that the data were written for.
        mesh: That mesh.
        stand_ins: The UFL coefficients in ``form`` that get their values when it is bound.

    Attributes:
        own: The Functions that the form holds beside them.
    """

    def __init__(self, form: ufl.Form, mesh: Mesh, stand_ins: Sequence[ufl.Coefficient] = ()):
        self._compiled = compiled(mesh.comm, fem.compile_form, mesh.comm, form)
        self._mesh = mesh
        self._stand_ins = tuple(stand_ins)
        self.own = [
            w
            for w in ufl.algorithms.extract_coefficients(form)
            if not any(w is s for s in self._stand_ins)
        ]
        self._constants = {c: c for c in ufl.algorithms.analysis.extract_constants(form)}
        self._sides, self._regions = (_over(form, kind) for kind in ("exterior_facet", "cell"))

    def on(
        self,
        domain: Domain,
        spaces: Sequence[fem.FunctionSpace] = (),
        functions: Sequence[fem.Function] = (),
    ) -> fem.Form:
        """Bind to a mesh, argument spaces and one function per stand-in."""
        subdomains: dict[Any, list[tuple[int, Int32Array]]] = {}
        if self._sides:
            subdomains[fem.IntegralType.exterior_facet] = [
                (part, facet_entities(domain.mesh, domain.facets(part)).ravel())
                for part in self._sides
            ]
        if self._regions:
            topology = domain.mesh.topology
            of_cells = domain.materials.of_cells[: topology.index_map(topology.dim).size_local]
            subdomains[fem.IntegralType.cell] = [
                (number, np.flatnonzero(of_cells == number).astype(np.int32))
                for number in self._regions
            ]
        return fem.create_form(
            self._compiled,
            list(spaces),
            domain.mesh,
            subdomains,
            {w: domain.own(w) for w in self.own}
            | dict(zip(self._stand_ins, functions, strict=True)),
            self._constants,
        )

    @property
    def constants(self) -> list[fem.Constant]:
        """The Constants in the form."""
        return list(self._constants)

    def snapshot(self) -> Snapshot:
        """Note what the Constants and Functions in the form are at present."""
        return Snapshot(self.constants, self.own)


def _over(form: ufl.Form, kind: str) -> list[int]:
    """List the numbers of what a form's integrals of a type are over, each once."""
    given = [i.subdomain_id() for i in form.integrals() if i.integral_type() == kind]
    found = {each for ids in given for each in (ids if isinstance(ids, tuple) else (ids,))}
    return sorted(found - {"everywhere"})


class _Cells(ufl.Measure):
    """dx, which over a material is dx(name)."""

    def __init__(self, numbers: Mapping[str, int], mesh: ufl.Mesh, **more: Any):
        super().__init__("dx", mesh, **more)
        self._numbers = numbers

    def __call__(self, name: str | None = None, *more: Any, **named: Any) -> ufl.Measure:
        """Integrate over the material of that name, or go on as any measure does."""
        if name is None:
            made = super().__call__(None, *more, **named)
            return _Cells(self._numbers, made.ufl_domain(), metadata=made.metadata())
        if name not in self._numbers:
            there = meant(name, self._numbers or ["none"])
            raise InputError(f"no material is called {name!r}; {there}")
        return super().__call__(self._numbers[name], *more, **named)


def _constants_in(data: Iterable[Expr]) -> dict[fem.Constant, None]:
    """Collect the Constants in expressions, each once."""
    return {e: None for each in data for e in ufl.algorithms.analysis.extract_constants(each)}


def _functions_in(data: Iterable[Expr]) -> dict[fem.Function, None]:
    """Collect the Functions in expressions, each once."""
    return {e: None for each in data for e in ufl.algorithms.extract_coefficients(each)}


def carry(data: Iterable[Expr], domain: Domain) -> None:
    """Carry the Functions in expressions to a mesh, with the values they have now; collective.

    Raises:
        InputError: One of them is on another mesh, and can't be carried to this one.
    """
    for function in _functions_in(data):
        domain.carried(function)


def _lattice(mesh: Mesh) -> FloatArray:
    """Take points of the box around a mesh, the same on all ranks; collective.

    Returns:
        Shape (5^d, 3).
    """
    low, high = bounding_box(mesh)
    # where no symmetry of the data is likely to be
    parts = np.array([0.01, 0.27, 0.52, 0.74, 0.98])
    axes = [parts if b > a else parts[:1] for a, b in zip(low, high, strict=True)]
    return low + np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3) * (high - low)


class Forms:
    """The forms of the paper for one problem and element, compiled when first asked for.

    Args:
        problem: The data.
        mesh: A mesh of the kind they will be used on; data tied to a mesh must be tied to this one.
        element: "CR" or "P1".
        parts: The parts of the boundary by name, and their values in facet tags.
        materials: What the mesh's cells consist of.

    Attributes:
        problem: The data as they were given.
        called: The same, whose functions have been called.
        f: Volume load.
        reaction: c.
        asked: The load that an exact solution asks for; None if there is none, or a constant.
        kappa: κ.
        exact: The exact solution, if it is known.
        conditions: What holds on the parts of the boundary.
    """

    def __init__(
        self,
        problem: Problem,
        mesh: Mesh,
        element: str = "CR",
        parts: Mapping[str, int] = PARTS,
        materials: Materials | None = None,
    ):
        materials = materials or Materials()
        self.problem, self.called = problem, (problem := problem.called_once())
        self.mesh, self.element, self._parts = mesh, element, parts
        self._numbers = materials.numbers
        cell = mesh.ufl_domain()
        self.space = ufl.FunctionSpace(cell, ufl_element(mesh, element))
        self.w = ufl.Coefficient(self.space)
        self.dx, self.ds = ufl.Measure("dx", cell), ufl.Measure("ds", cell)
        self.x = ufl.SpatialCoordinate(cell)
        _check_materials(problem, materials)
        own = [each.coefficient for each in problem.materials.values()]
        if problem.form is not None and (
            any(each is not None for each in own) or problem.coefficient is not Problem.coefficient
        ):
            raise InputError("a form takes the coefficient's place; only one of them can be given")
        self.kappa = self._by_material("coefficient", problem.coefficient, materials)
        if self.uniform and not 0.0 < float(self.kappa) < np.inf:
            said = "finite and above 0" if float(self.kappa) > 0.0 else "above 0"
            raise InputError(f"data: the coefficient is {float(self.kappa):g}; it must be {said}")
        self.exact = (
            None
            if problem.exact is None
            else as_expression(problem.exact, self.x, "exact", in_cells=True)
        )
        # UFL can't differentiate a number
        constant = (
            self.exact is None or as_number(self.exact) is not None or problem.form is not None
        )
        flux = None if constant else self.kappa * ufl.grad(self.exact)

        outward = None if flux is None else ufl.dot(flux, ufl.FacetNormal(cell))
        near = None if flux is None else _lattice(mesh)
        self.asked = None if flux is None else simplified(-ufl.div(flux), near)
        self.reaction = self._by_material("reaction", problem.reaction, materials)
        derivable = self.exact is not None and problem.form is None
        if derivable and as_number(self.reaction) != 0.0:
            gain = self.reaction * self.exact
            self.asked = gain if self.asked is None else simplified(self.asked + gain, near)
        derived = 0.0 if self.asked is None else self.asked
        self.f = self._by_material("f", derived if problem.f is None else problem.f, materials)
        given = Given(partial(_expression, x=self.x), self.exact, outward)
        self.conditions = together(mesh.comm, _conditions, problem, given, parts)
        d = mesh.geometry.dim
        for key, data in self._data.items():
            if data.ufl_shape != () and (key, data.ufl_shape) != ("coefficient", (d, d)):
                raise InputError(f"data: {key} has the shape {data.ufl_shape}; a scalar is needed")
            if any(found != cell for found in ufl.domain.extract_domains(data)):
                raise InputError(f"data: {key} is given on another mesh than the one to solve on")

    def _by_material(self, name: str, usual: Data, materials: Materials) -> Expr:
        """Make a datum that materials may have of their own, and elsewhere is the usual one."""
        base = as_expression(usual, self.x, name, in_cells=True)
        own = {
            material: as_expression(datum, self.x, f"materials[{material!r}].{name}", in_cells=True)
            for material, data in self.called.materials.items()
            if (datum := getattr(data, name)) is not None
        }
        if any(each.ufl_shape for each in (base, *own.values())):
            base, *others = map(self._as_tensor, (base, *own.values()))
            own = dict(zip(own, others, strict=True))
        numbers = [as_number(each) for each in (base, *own.values())]
        if None not in numbers:
            if len(set(numbers)) == 1:
                return base
            return self._on_cells(name, numbers, materials, own)
        for material, datum in own.items():
            if datum.ufl_shape != base.ufl_shape:
                raise InputError(
                    f"materials: {name} of {material} has the shape {datum.ufl_shape}, but"
                    f" {base.ufl_shape} elsewhere"
                )
        if not own:
            return base
        number = self._on_cells(f"whose {name}", range(len(own) + 1), materials, own)
        return _numbered(number, [base, *own.values()])

    def _as_tensor(self, datum: Expr) -> Expr:
        """Turn a scalar into the tensor that does the same."""
        return datum if datum.ufl_shape else datum * ufl.Identity(self.mesh.geometry.dim)

    def _on_cells(
        self,
        name: str,
        numbers: Sequence[float | None],
        materials: Materials,
        own: Iterable[str],
    ) -> fem.Function:
        """Set a number on cells without material of its own, and one for each that has."""
        function = fem.Function(fem.functionspace(self.mesh, ("DG", 0)), name=name)
        dofs = function.function_space.dofmap.list[:, 0]
        function.x.array[dofs] = numbers[0]
        for material, value in zip(own, numbers[1:], strict=True):
            function.x.array[dofs[materials.where(material)]] = value
        function.x.scatter_forward()
        return function

    @property
    def _data(self) -> dict[str, Expr]:
        """The data that the user has given, or that were derived, by the names of `Problem`."""
        data = {
            "coefficient": self.kappa,
            "f": self.f,
            "reaction": self.reaction,
            **{
                key.removeprefix("data."): value
                for c in self.conditions
                for key, value in c.data.items()
            },
        }
        return data if self.exact is None else data | {"exact": self.exact}

    @property
    def fixed(self) -> tuple[Condition, ...]:
        """The conditions that set u: their parts make Γ0."""
        return tuple(c for c in self.conditions if c.fixed is not None)

    @property
    def gamma_0(self) -> tuple[int, ...]:
        """Their parts' values in the facet tags."""
        return tuple(c.number for c in self.fixed)

    @property
    def bounded(self) -> tuple[Condition, ...]:
        """The conditions that bound u: their parts make Γ1."""
        return tuple(c for c in self.conditions if c.bounds)

    @cached_property
    def natural(self) -> tuple[Condition, ...]:
        """The conditions that know of a flux."""
        return tuple(c for c in self.conditions if c.flux is not None)

    @property
    def uncertified(self) -> str | None:
        """The reason why there is no certificate, if the form or some condition has none."""
        if self.problem.form is not None:
            return "the form is the user's own: the flux that goes with it is not known"
        for condition in self.conditions:
            if condition.uncertified:
                return condition.uncertified
            if condition.loss is not None and condition.flux is None:
                return f"{condition.part}: its kind has a loss, and no flux beside it"
        return None

    @cached_property
    def a(self) -> Kernel:
        """a_h(u, v) = Σ_T ∫_T κ∇u·∇v, (1.9), and what the conditions add to it."""
        u, v = ufl.TrialFunction(self.space), ufl.TestFunction(self.space)
        return Kernel(self._bilinear(u, v), self.mesh)

    def carry_data(self, domain: Domain) -> None:
        """Carry the Functions in the data to a mesh, with the values they have now; collective.

        Raises:
            InputError: The data hold a Function on another mesh that can't be carried to this one.
        """
        for function in self.functions:
            domain.carried(function)

    @cached_property
    def functions(self) -> list[fem.Function]:
        """The Functions that the data hold, each once."""
        found = _functions_in(self._data.values())
        if self.problem.form is not None:
            for kernel in (self.a, self.own_load):
                found |= dict.fromkeys([] if kernel is None else kernel.own)
        return list(found)

    @cached_property
    def constants(self) -> list[fem.Constant]:
        """The Constants that the data hold, each once."""
        found = _constants_in(self._data.values())
        if self.problem.form is not None:
            for kernel in (self.a, self.own_load):
                found |= dict.fromkeys([] if kernel is None else kernel.constants)
        return list(found)

    @property
    def holding(self) -> list[Expr]:
        """u_D and the bounds of all parts."""
        bounds = [bound for c in self.bounded for _, bound in c.bounds]
        return [*(c.fixed for c in self.fixed), *bounds]

    def snapshot_of_holding(self) -> Snapshot:
        """Note what Constants and Functions in these are at present, on the coarsest mesh."""
        return Snapshot(list(_constants_in(self.holding)), _functions_in(self.holding))

    def snapshot(self, domains: Sequence[Domain]) -> Snapshot:
        """Note what the Constants and Functions are at present, on some meshes."""
        own = [domain.own(function) for function in self.functions for domain in domains]
        return Snapshot(self.constants, dict.fromkeys([*self.functions, *own]))

    @property
    def uniform(self) -> bool:
        """True if κ is a number."""
        return as_number(self.kappa) is not None

    @property
    def steady(self) -> bool:
        """True if κ is a number on each cell of the coarsest mesh."""
        return self.problem.form is None and (self.uniform or is_by_cells(self.kappa))

    @cached_property
    def loaded(self) -> bool:
        """True if f or a flux is more than the number 0."""
        return any(as_number(data) != 0.0 for data in (self.f, *(c.flux for c in self.natural)))

    @cached_property
    def chi(self) -> Kernel | None:
        """χ(v) = ∫_Ω f v + ∫_Γg g v, (1.10); None where f and g vanish."""
        v = ufl.TestFunction(self.space)
        degree = {"quadrature_degree": self.problem.quadrature_degree}
        loads = [(self.f, self.dx), *((c.flux, self.ds(c.number)) for c in self.natural)]
        terms = [
            data * v * measure(metadata=degree) for data, measure in loads if as_number(data) != 0.0
        ]
        return Kernel(sum(terms[1:], terms[0]), self.mesh) if terms else None

    @cached_property
    def own_load(self) -> Kernel | None:
        """The load of the user's own form, if it has one."""
        own = self.called.form
        if own is None or own.load is None:
            return None
        return Kernel(self._own("load", 1, ufl.TestFunction(self.space)), self.mesh)

    @cached_property
    def a_of_w(self) -> Kernel:
        """a_h(w, w)."""
        return Kernel(self._bilinear(self.w, self.w), self.mesh, [self.w])

    @cached_property
    def a_p1(self) -> Kernel:
        """a_h in P1, for coarse meshes."""
        space = ufl.FunctionSpace(self.mesh.ufl_domain(), ufl_element(self.mesh, "P1"))
        u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
        return Kernel(self._bilinear(u, v), self.mesh)

    @cached_property
    def of_one(self) -> Kernel | None:
        """a_h(1, v), exactly 0 but for the terms without gradients; None if there are none."""
        v = ufl.TestFunction(self.space)
        terms = self._without_gradients(ufl.as_ufl(1.0), v)
        if self.problem.form is not None:
            # UFL can't differentiate a number
            one = fem.Function(fem.functionspace(self.mesh, ("DG", 0)), name="1")
            one.x.array[:] = 1.0
            own = self._called("a", one, v)
            # UFL knows some gradients to be 0 at once, others only where it prepares a form
            if not (
                own.empty() or compute_form_data(own, complex_mode=False).preprocessed_form.empty()
            ):
                terms.append(own)
        return Kernel(sum(terms[1:], terms[0]), self.mesh) if terms else None

    def _bilinear(self, u: Expr, v: Expr) -> ufl.Form:
        """Integrate κ by the rule of the loads; UFL's own guess is one point for a κ that jumps."""
        if self.problem.form is not None:
            arity = sum(isinstance(each, ufl.Argument) for each in (u, v))
            return sum(self._without_gradients(u, v), self._own("a", arity, u, v))
        rule = {} if self.steady else {"quadrature_degree": self.problem.quadrature_degree}
        kappa = self._adjustable(self.kappa)
        form = ufl.inner(kappa * ufl.grad(u), ufl.grad(v)) * self.dx(metadata=rule)
        return sum(self._without_gradients(u, v), form)

    def _without_gradients(self, u: Expr, v: Expr) -> list[ufl.Form]:
        """Add up what a_h has beside κ∇u·∇v."""
        degree = {"quadrature_degree": self.problem.quadrature_degree}
        terms = [(self.reaction, self.dx)]
        terms += [(c.loss, self.ds(c.number)) for c in self.conditions if c.loss is not None]
        return [
            self._adjustable(b) * u * v * measure(metadata=degree)
            for b, measure in terms
            if as_number(b) != 0.0
        ]

    @property
    def _measures(self) -> tuple[ufl.Measure, Callable[[str], ufl.Measure]]:
        """The measures for forms of one's own: dx, of materials too, and ds by parts' names."""

        def ds(name: str) -> ufl.Measure:
            if name not in self._parts:
                raise InputError(
                    f"no part of the boundary is called {name!r}; {meant(name, self._parts)}"
                )
            return self.ds(self._parts[name])

        return _Cells(self._numbers, self.mesh.ufl_domain()), ds

    def _called(self, name: str, *arguments: Expr) -> Any:
        """Call a function of the user's that makes a form; what one rank raises all do.

        It is called with the arguments of `a` alone, which others then take the place of: a is
        needed at several times, and is to be the same.
        """
        own = ufl.TrialFunction(self.space), ufl.TestFunction(self.space)
        given = own if name == "a" else own[1:]

        def made() -> object:
            try:
                found = getattr(self.called.form, name)(*given, *self._measures)
                if not isinstance(found, ufl.Form):
                    return found
                return ufl.replace(found, dict(zip(given, arguments, strict=True)))
            except (TypeError, ValueError) as error:  # of UFL, or of what the function takes
                raise InputError(f"form: {name} makes no form: {error}") from error

        return together(self.mesh.comm, made)

    def _own(self, name: str, arity: int, *arguments: Expr) -> ufl.Form:
        """Make a form of the user's own, of some arguments.

        Raises:
            InputError: It is none that the element can do with.
        """
        form = self._called(name, *arguments)
        if not isinstance(form, ufl.Form):
            raise InputError(f"form: {name} returns {form!r}; a UFL form is needed")
        for integral in form.integrals():
            if integral.integral_type() not in ("cell", "exterior_facet"):
                raise InputError(
                    f"form: {name} has an integral of the type {integral.integral_type()}; dx and"
                    " ds(name) are what there is: functions of Crouzeix-Raviart jump across facets"
                )
            over, inside = integral.subdomain_id(), integral.integral_type() == "cell"
            given = over if isinstance(over, tuple) else (over,)
            known = ("everywhere", *self._numbers.values()) if inside else self._parts.values()
            # numbers in tags of the user's own are others
            tagged = over != "everywhere" and integral.subdomain_data() is not None
            if tagged or not all(each in known for each in given):
                kind = "dx" if inside else "ds"
                raise InputError(
                    f"form: {name} has {kind} over the subdomain {over}; the dx, dx(name) and"
                    " ds(name) that it is given are what there is, the names those of materials"
                    " and of boundary parts"
                )
            if _order(integral.integrand()) > 1:
                raise InputError(
                    f"form: {name} has derivatives of second order or more, which are 0 for"
                    " functions that are linear on each cell"
                )
        try:
            compute_form_data(form, complex_mode=False)
        except ArityMismatch:
            raise InputError(f"form: {name} is not linear in its arguments") from None
        if len(form.arguments()) != arity:
            needed = "u and v" if name == "a" else "v"
            raise InputError(f"form: {name} must be linear in {needed}, and is not")
        return form

    def _adjustable(self, data: Expr) -> Expr:
        """Put a Constant in the place of a number or a tensor of numbers: one form serves all."""
        values = [as_number(data[index]) for index in np.ndindex(data.ufl_shape)]
        if None in values:
            return data
        return fem.Constant(self.mesh, np.array(values, dtype=np.float64).reshape(data.ufl_shape))

    @cached_property
    def _squared_errors(self) -> Kernel:
        """|∇(u − w)|² and (u − w)², tested by constants on each cell, u the exact solution."""
        if self.exact is None:
            raise InputError("errors need an exact solution")
        v = ufl.TestFunction(ufl.FunctionSpace(self.mesh.ufl_domain(), self._pair))
        difference = self.exact - self.w
        slope = ufl.grad(difference)
        squares = ufl.as_vector([ufl.inner(slope, slope), difference**2])
        degree = {"quadrature_degree": self.problem.error_degree}
        return Kernel(ufl.inner(squares, v) * self.dx(metadata=degree), self.mesh, [self.w])

    @property
    def _pair(self) -> Any:
        """Two numbers on each cell."""
        return basix.ufl.element("DG", self.mesh.basix_cell(), 0, shape=(2,))

    def errors(self, domain: Domain, w: fem.Function) -> tuple[float, float]:
        """Compute ‖u − w‖_h in the broken norm (1.6) and ‖u − w‖ in L2; collective.

        One form has both, as the exact solution and its gradient take most of the time and have
        much in common.

        Raises:
            InputError: The exact solution u is not known.
        """
        form = self._squared_errors.on(domain, [fem.functionspace(domain.mesh, self._pair)], [w])
        squares = np.asarray(fem.assemble_vector(form).array).reshape(-1, 2)
        h1, l2 = np.sqrt(summed(domain.mesh.comm, squares.sum(axis=0)))
        return float(h1), float(l2)


def _order(expression: Expr) -> int:
    """Count how often functions are differentiated in it."""
    below = max(map(_order, expression.ufl_operands), default=0)
    return below + isinstance(expression, ufl.differentiation.Derivative)


def _numbered(number: Expr, data: Sequence[Expr], first: int = 0) -> Expr:
    """Choose the datum with a number, counted from `first`, by halves: no deep expression."""
    if len(data) == 1:
        return data[0]
    half = len(data) // 2
    below = _numbered(number, data[:half], first)
    above = _numbered(number, data[half:], first + half)
    return _chosen(ufl.gt(number, first + half - 0.5), above, below)


def _chosen(condition: Expr, first: Expr, second: Expr) -> Expr:
    """Choose the first where a condition holds, else the second, entry by entry."""
    if not first.ufl_shape:
        return ufl.conditional(condition, first, second)
    rows, columns = map(range, first.ufl_shape)
    return ufl.as_matrix(
        [[ufl.conditional(condition, first[i, j], second[i, j]) for j in columns] for i in rows]
    )


def _check_materials(problem: Problem, materials: Materials) -> None:
    """Insist on materials that are there."""
    for name, material in problem.materials.items():
        if name not in materials.numbers:
            there = ", ".join(materials.numbers) or "none"
            raise InputError(f"materials: the domain has none called {name!r}; there are: {there}")
        if not isinstance(material, Material):
            raise InputError(f"materials: {name!r} is {material!r}; a Material is needed")


def _conditions(problem: Problem, given: Given, parts: Mapping[str, int]) -> tuple[Condition, ...]:
    """Say what holds on each part of the boundary.

    Raises:
        InputError: A part has no condition, or a condition no part.
    """
    usual: dict[str, tuple[Condition, str]] = {
        "dirichlet": (Dirichlet(problem.dirichlet), "data.dirichlet"),
        "neumann": (Neumann(problem.g), "data.g"),
        "contact": (
            Contact(given.expression(problem.obstacle, called="obstacle")),
            "data.obstacle",
        ),
    }
    called = parts.called if isinstance(parts, Parts) else {}
    own: dict[str, Condition] = {}
    for key, condition in problem.conditions.items():
        name = named(parts, key)
        if name not in parts:
            values = {part: f" ({value})" for value, part in called.items()}
            there = meant(key, parts, more=values)
            how = f"is called {key!r}" if name else f"stands for the facet value {key} alone"
            raise InputError(f"conditions: no part of the boundary {how}; {there}")
        if name in own:
            raise InputError(f"conditions: the part {name!r} has two")
        own[name] = condition
        if not isinstance(condition, Condition):
            raise InputError(
                f"conditions: {name!r} is {condition!r}; a Condition is needed, such as Contact(0)"
            )
    made = []
    for name, value in parts.items():
        if name in own:
            condition = own[name]
            label = f"boundary.{name}.{condition.names()[0]}"
        elif name in usual:
            condition, label = usual[name]
        else:
            raise InputError(f"conditions: the part {name!r} of the boundary has none")
        made.append(condition.made(given, name, value, label))
        for said in ("fixed", "bounds", "flux", "loss"):  # properties of the user's own, perhaps
            getattr(made[-1], said)
    return tuple(made)
