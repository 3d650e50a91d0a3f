"""The Signorini problem with the Crouzeix-Raviart element, on DOLFINx.

On a mesh with facet tags, a contact boundary takes five lines::

    import signorini_cr as scr

    domain = scr.Domain.from_tags(mesh, facet_tags, contact=1, dirichlet=2)
    problem = scr.Problem(f=1.0, obstacle=lambda x: 0.1 * x[0])
    solution = scr.solve(problem, domain)
    print(solution.contact.force)
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .shown import HTML

if TYPE_CHECKING:
    from .adaptive import adapt_to_run, solve_adaptive
    from .errors import InputError, NotConverged
    from .estimate.certificate import Certificate
    from .evolution import Solver, solve_in_time
    from .fem.conditions import Contact, Dirichlet, Neumann, Robin
    from .fem.problem import Form, Material, Problem
    from .levels import solve, solve_levels
    from .mesh.domain import Domain, Polygon, read_gmsh
    from .solution import Solution

# The wheels of DOLFINx find MPI only where this has loaded it before them. Its own complaints,
# such as that of a second PETSc, are for the user to see.
try:
    import dolfinx_solver  # noqa: F401
except ModuleNotFoundError:
    pass

__version__ = "0.3.0"

# Loaded when first used: `signorini-cr --help` must not wait for DOLFINx
_ROOMS = {
    "Domain": "mesh.domain",
    "Polygon": "mesh.domain",
    "read_gmsh": "mesh.domain",
    "InputError": "errors",
    "NotConverged": "errors",
    "Solution": "solution",
    "solve": "levels",
    "solve_levels": "levels",
    "solve_adaptive": "adaptive",
    "solve_in_time": "evolution",
    "adapt_to_run": "adaptive",
    "Solver": "evolution",
    "Certificate": "estimate.certificate",
    "Problem": "fem.problem",
    "Material": "fem.problem",
    "Form": "fem.problem",
    "Dirichlet": "fem.conditions",
    "Neumann": "fem.conditions",
    "Robin": "fem.conditions",
    "Contact": "fem.conditions",
}
# Modules that scripts use by name, wherever they stand.
_MODULES = {
    "exact": "verification.exact",
    "norms": "verification.norms",
    "theory": "verification.theory",
    "families": "mesh.families",
    "plots": "output.plots",
    "notebook": "output.notebook",
    "force": "force",
    "means": "means",
}
__all__ = [  # noqa: RUF022, in the order in which one meets them
    "Domain",
    "Polygon",
    "read_gmsh",
    "Problem",
    "Material",
    "Form",
    "Dirichlet",
    "Neumann",
    "Robin",
    "Contact",
    "solve",
    "solve_levels",
    "solve_adaptive",
    "solve_in_time",
    "adapt_to_run",
    "Solver",
    "Solution",
    "Certificate",
    "InputError",
    "NotConverged",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return getattr(import_module(f".{_ROOMS[name]}", __name__), name)
    if name in _MODULES:
        return import_module(f".{_MODULES[name]}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class _ByShortName(Loader):
    """Finds the modules that scripts use by name for `import` and `from`, too.

    It is asked after Python's own finders, and hands on the module itself, not a second one.
    """

    @classmethod
    def find_spec(cls, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        package, _, short = name.rpartition(".")
        return ModuleSpec(name, cls()) if package == __name__ and short in _MODULES else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module: ModuleType = __getattr__(spec.name.rpartition(".")[2])
        spec.loader_state = module.__spec__
        return module

    def get_code(self, name: str) -> None:
        """Say to `python3 -m` that this is no program."""

    def exec_module(self, module: ModuleType) -> None:
        """Has run already; what importing wrote into it is put back."""
        assert module.__spec__
        module.__spec__ = module.__spec__.loader_state


sys.meta_path.append(_ByShortName)


def _as_html(solution: Solution) -> str:
    html: str = import_module(".output.notebook", __name__).as_html(solution)
    return html


HTML["Solution"] = _as_html


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
