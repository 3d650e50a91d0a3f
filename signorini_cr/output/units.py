"""Names and units of u, the axes and the rest, for pictures, tables and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

GLUE = "\u00a0"
"""The space between a number and its unit."""


def literal(words: str) -> str:
    r"""Write a user's words for a picture so that they stay what they are.

    Matplotlib sets what is between dollar signs as a formula, and leaves out of legends what begins
    with an underscore, which a space of no width before it prevents.
    """
    return ("\u200b" if words.startswith("_") else "") + words.replace("$", r"\$")


@dataclass(frozen=True)
class Units:
    """Names and units; what is left out is not told. Nothing is converted.

    Attributes:
        x: The unit of lengths.
        u: The unit of u.
        time: The unit of times.
        flux: The unit of κ∂ₙu and of the contact pressure.
        force: The unit of their integrals over parts of the boundary.
        names: What x, y, u and flux are called, "temperature" for u, say.
    """

    x: str = ""
    u: str = ""
    time: str = ""
    flux: str = ""
    force: str = ""
    names: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, report: Mapping[str, Any]) -> Units:
        """Take the units and names of a report, from `record`."""
        return cls(**report.get("units", {}), names=report.get("names", {}))

    def record(self) -> dict[str, dict[str, str]]:
        """Return all that is told, as it stands in report.json; empty if there is nothing."""
        units = {
            each.name: getattr(self, each.name)
            for each in fields(self)
            if each.name != "names" and getattr(self, each.name)
        }
        told = {"units": units, "names": dict(self.names)}
        return {key: words for key, words in told.items() if words}

    def after(self, key: str) -> str:
        """Return the unit as it follows a number, after a space at which no line breaks."""
        unit = getattr(self, key)
        return f"{GLUE}{unit}" if unit else ""

    def within(self, key: str) -> str:
        """Return the unit as it follows a name in a picture, " in m" for one."""
        return literal(self.told(key))

    def told(self, key: str) -> str:
        """Return the unit as it follows a name in a text, " in m" for one."""
        return " in" + self.after(key) if self.after(key) else ""

    def name(self, key: str, usual: str = "") -> str:
        """Return the name as it precedes a symbol in a picture, with a space behind it."""
        name = literal(self.names.get(key, usual))
        return f"{name} " if name else ""


PLAIN = Units()
"""Neither names nor units."""
