"""Words for those who name what is not there.

Nothing heavy is imported here: the command line answers at once.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from types import MappingProxyType


def guess(word: str, known: Iterable[str], there: str = "") -> str:
    """Ask whether the likeliest of some words was meant, if one is near, and say what there is.

    Args:
        word: What is not known.
        known: What is.
        there: A sentence on that, to stand behind the question or alone.

    Returns:
        As "did you mean neumann? Allowed are neumann, contact", or "allowed are neumann, contact".
    """
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean {near[0]}? {there[:1].upper()}{there[1:]}".rstrip() if near else there


def meant(
    word: object,
    known: Iterable[str],
    there: str = "there are",
    more: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Say what there is in the place of a word that is not known, the likeliest first.

    Args:
        word: What is not known.
        known: What is.
        there: What stands before the list of these.
        more: What is told of some of them, in the list.
    """
    known = list(known)
    listed = ", ".join(name + more.get(name, "") for name in known)
    return guess(str(word).lower(), known, f"{there} {listed}")
