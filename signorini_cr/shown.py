"""Displays of results that are more than a line of text, in a notebook.

It stands above what it shows: the front door, which knows both, has put it here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

HTML: dict[str, Callable[[Any], str]] = {}
"""Functions that make HTML of an object, by the name of its class."""
