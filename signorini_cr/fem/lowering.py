"""Formulas in scalar operators alone, each operand worked on once however often it is used.

UFL's own `expand_indices` goes through an operand at each of its uses: max(a, b) uses each of its
two twice, so that n of them within one another would take 2ⁿ steps.
"""

from __future__ import annotations

from typing import Any

from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.algorithms.expand_indices import IndexExpander


def by_components(expression: Any) -> Any:
    """Carry out derivatives, and write sums over indices as sums of components.

    Args:
        expression: A scalar.
    """
    return _Expander().visit(apply_derivatives(apply_algebra_lowering(expression)))


class _Expander(IndexExpander):
    """UFL's, with a memory for what an operand became with these values of its indices."""

    def __init__(self) -> None:
        super().__init__()
        self._known: dict[Any, Any] = {}

    def visit(self, o: Any) -> Any:
        values = {index.count(): value for index, value in self._index2value.items()}
        key = o, self.component(), tuple(values.get(i) for i in o.ufl_free_indices)
        if key not in self._known:
            function, operands_first = self._handlers[o._ufl_typecode_]
            operands = map(self.visit, o.ufl_operands) if operands_first else ()
            self._known[key] = function(o, *operands)
        return self._known[key]
