"""Data that are written once and evaluated twice: by UFL for the program, by NumPy for the rest.

A formula takes an alphabet (`SYMBOLS` or `NUMBERS`), the coordinates x and y, and its parameters.
In the program's data the parameters are DOLFINx constants, so that a class of problems is compiled
once and not for each of its members.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh


class Alphabet:
    """The functions that a formula may use."""

    def __init__(self, **functions: Callable[..., Any]):
        self.__dict__.update(functions)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Tell type checkers that there may be any function."""
        raise AttributeError(name)


_BOTH: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "sin": (np.sin, ufl.sin),
    "cos": (np.cos, ufl.cos),
    "exp": (np.exp, ufl.exp),
    "log": (np.log, ufl.ln),
    "sqrt": (np.sqrt, ufl.sqrt),
    "atan": (np.arctan, ufl.atan),
    "where": (np.where, ufl.conditional),
    "above": (np.greater, ufl.gt),
    "larger": (np.maximum, ufl.max_value),
    "smaller": (np.minimum, ufl.min_value),
}
NUMBERS = Alphabet(**{name: number for name, (number, _) in _BOTH.items()})
SYMBOLS = Alphabet(**{name: symbol for name, (_, symbol) in _BOTH.items()})

Formula = Callable[[Any, Any, Any, Sequence[Any]], Any]
"""Called with an alphabet, x, y and the parameters."""


def symbolic(formula: Formula, mesh: Mesh, parameters: Sequence[float]) -> Callable[[Any], Any]:
    """Make of a formula what `signorini_cr.Problem` takes: a function of x = ufl.SpatialCoordinate.

    Args:
        formula: Evaluated with UFL.
        mesh: The coarsest mesh, at home to the constants.
        parameters: Numbers, which become constants.
    """
    constants = [fem.Constant(mesh, float(value)) for value in parameters]
    return lambda x: ufl.as_ufl(formula(SYMBOLS, x[0], x[1], constants))


def numeric(formula: Formula, parameters: Sequence[float]) -> Callable[[Any, Any], Any]:
    """The same as a function of two arrays."""

    def values(x: Any, y: Any) -> Any:
        found = np.asarray(formula(NUMBERS, x, y, parameters), dtype=np.float64)
        return np.broadcast_to(found, np.shape(x))

    return values
