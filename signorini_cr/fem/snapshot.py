"""Values of data that may change, as they were when something was solved with them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from dolfinx import fem

from ..arrays import FloatArray


class Snapshot:
    """The values of Constants and Functions, as they are when it is made.

    Args:
        constants: The Constants.
        functions: The Functions, those that stand for them on other meshes included.
    """

    def __init__(self, constants: Sequence[fem.Constant], functions: Iterable[fem.Function]):
        self._constants, self._functions = constants, list(functions)
        self._values = self._now()

    def _now(self) -> list[FloatArray]:
        constants = [np.array(each.value) for each in self._constants]
        return constants + [each.x.array.copy() for each in self._functions]

    def _put(self, values: Sequence[FloatArray]) -> None:
        number = len(self._constants)
        for constant, value in zip(self._constants, values[:number], strict=True):
            constant.value = value
        for function, array in zip(self._functions, values[number:], strict=True):
            function.x.array[:] = array

    @property
    def lasts(self) -> bool:
        """True if the values are still these, on this rank."""
        return all(np.array_equal(a, b) for a, b in zip(self._now(), self._values, strict=True))

    @contextmanager
    def again(self) -> Iterator[None]:
        """Let the data have these values in a block, and those that they have now after it."""
        if self.lasts:
            yield
            return
        now = self._now()
        self._put(self._values)
        try:
            yield
        finally:
            self._put(now)
