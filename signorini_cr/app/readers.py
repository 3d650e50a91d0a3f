"""The keys of a TOML file: found, typed and within bounds, or a message that says why not."""

from __future__ import annotations

import math
import re
import sys
import tomllib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ..errors import InputError
from ..hints import guess, meant
from ..reading import read_regular

MOST_CHARACTERS = 40
"""In a unit, or what stands in the place of x, y or u."""
MOST_IN_NAME = 80
"""Characters of what a part, a material or a quantity is called."""
MOST_IN_TITLE = 200
"""Characters."""
MOST_BYTES = 16_000_000
"""In a problem file."""
MOST_PARTS = 100
"""Of a key with points in it; the parser takes the square of their number in memory."""
HUGE = 10**15
"""From here on whole numbers are not shown, and no count is as large."""

_PART = r"""(?:(?<![\w-])[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*"""
_LONG_KEY = re.compile(rf"(?:{_PART}\.[ \t]*){{{MOST_PARTS}}}{_PART}")


def read_text(path: Path) -> str:
    """Read the text of a file in UTF-8."""
    try:
        return read_regular(path, MOST_BYTES).decode("utf-8-sig")
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError("there is no such file") from None
    except IsADirectoryError:
        raise InputError("this is a folder; a problem file (TOML) is needed") from None
    except UnicodeDecodeError as error:
        raise InputError(f"this is not a text file in UTF-8 (byte {error.start})") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"the file cannot be read: {reason}") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Read the table that a TOML text stands for."""
    if long := _LONG_KEY.search(text):
        line = text.count("\n", 0, long.start()) + 1
        raise InputError(f"the key in line {line} has more than {MOST_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError("the TOML is nested too deeply") from None
    except tomllib.TOMLDecodeError as error:
        what, _, where = str(error).rpartition(" (at ")
        where = where.rstrip(")")
        what = re.sub(r"\('(.*?)',?\)", lambda name: "[" + name[1].replace("', '", ".") + "]", what)
        if not where.startswith("line "):
            last = len(text.rstrip().split("\n"))
            if re.match(r"Unterminated|Expected [\"']'+", what):
                what = "a quote is not closed"
            raise InputError(
                f"TOML syntax at the end of the file (line {last}): {what or error}"
            ) from None
        line, column = (int(word.split()[1]) for word in where.split(", "))
        found = text.split("\n")[line - 1].rstrip().expandtabs(1)
        picture = f"\n    {found}\n    {' ' * (column - 1)}^" if 0 < len(found) <= 70 else ""
        if "{" in found and "}" not in found:
            what += " (all of { … } must stand on one line)"
        what = _said_better(what, found, column)
        raise InputError(f"TOML syntax in {where}: {what}{picture}") from None
    except ValueError:  # Python's own limit, of which TOML knows nothing
        digits = sys.get_int_max_str_digits()
        at = re.search(rf"\d(?:_?\d){{{digits}}}", text)
        place = f" in line {text.count(chr(10), 0, at.start()) + 1}" if at else ""
        raise InputError(
            f"a whole number{place} has more than {digits} digits; up to that many are allowed"
        ) from None


def _said_better(what: str, found: str, column: int) -> str:
    """Say what the parser says, with the cure where it is clear.

    Args:
        what: Its words.
        found: The line.
        column: Where they point to, from 1.
    """
    if re.search(r"character '\\[nr]'", what):
        return "the quote is not closed in this line"
    if not what.startswith(("Invalid value", "Expected newline or end of document")):
        return what
    pair = re.match(r"""\s*([\w.-]+)\s*=\s*([^\s"'\[{#][^"'#]*)""", found)
    value = pair[2].strip() if pair else re.split(r"[],}#]", found[column - 1 :])[0].strip()
    if re.fullmatch(r"[+-]?\d+,\d+", value):
        return f"decimals have a point, as {value.replace(',', '.')}"
    if re.fullmatch(r"[+-]?(\.\d+|\d+\.)", value):
        return "a point in a number has digits before it and behind it, as 0.5"
    if not value or len(value) > 60 or '"' in value or not (pair or "value" in what):
        return what
    example = f'{pair[1]} = "{value}"' if pair else f'"{value}"'
    return f"{what}; an expression or a name stands between quotes, as {example}"


def insist_known(
    table: Mapping[str, Any],
    section: str,
    allowed: Collection[str],
    sections: Mapping[str, Collection[str]] = MappingProxyType({}),
) -> None:
    """Reject keys that are not allowed, with what may have been meant.

    Args:
        table: The keys found.
        section: Where, for the message.
        allowed: The keys that may be there.
        sections: Keys of the sections, to see where a key would belong.
    """
    for key in table:
        if key in allowed:
            continue
        full = f"{section}.{key}" if section else key
        homes = [name for name, keys in sections.items() if key in keys and name != section]
        if homes and not guess(key.lower(), allowed):
            hint = f"it belongs under [{homes[0]}]"
        else:
            hint = meant(key, allowed, "allowed are")
        kind = "key" if section else "section"
        raise InputError(f"{full}: there is no such {kind}; {hint}")


def get(
    table: Mapping[str, Any],
    section: str,
    key: str,
    read: Callable[[str, Any], Any],
    default: Any = None,
    needed: str | None = None,
) -> Any:
    """Return the value of a key, read and checked.

    Args:
        table: The keys found.
        section: Where, for the message.
        key: The key wanted.
        read: Called with the full key and the value.
        default: What a missing key stands for.
        needed: What belongs there; a missing key is an error then.
    """
    full = f"{section}.{key}" if section else key
    if key in table:
        return read(full, table[key])
    if needed is not None:
        raise InputError(f"{full}: this key is missing; {needed} is needed")
    return default


def string(key: str, value: Any) -> str:
    """Insist on a string."""
    if not isinstance(value, str):
        raise InputError(f"{key}: a string is needed, found {shown(value)}")
    return value


def word(key: str, value: Any) -> str:
    """Insist on a few characters that fit on a line, of a table or beside an axis."""
    if not string(key, value).strip() or len(value) > MOST_CHARACTERS or not value.isprintable():
        raise InputError(
            f"{key}: 1 to {MOST_CHARACTERS} characters on one line are needed, found {shown(value)}"
        )
    return value.strip()


def insist_on_name(section: str, name: str) -> None:
    """Insist on a name of a part, a material or a quantity that fits into tables and pictures."""
    if not name or name != name.strip() or len(name) > MOST_IN_NAME or not name.isprintable():
        raise InputError(
            f"{section}: a name has 1 to {MOST_IN_NAME} characters on one line, and no blanks at"
            f" its ends, found {shown(name)}"
        )


def title(key: str, value: Any) -> str:
    """Insist on a line that can be printed, and stands over a picture."""
    if len(string(key, value)) > MOST_IN_TITLE or not value.isprintable():
        raise InputError(
            f"{key}: up to {MOST_IN_TITLE} characters on one line are needed, none of which moves"
            f" a cursor, found {shown(value)}"
        )
    return value


def array(key: str, value: Any) -> list[Any]:
    """Insist on a list."""
    if not isinstance(value, list):
        raise InputError(f"{key}: a list is needed, found {shown(value)}")
    return value


def number(key: str, value: Any) -> float:
    """Insist on a finite number; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{key}: a number is needed, found {shown(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise InputError(f"{key}: a finite number is needed, found {shown(value)}")
    return result


def positive(key: str, value: Any) -> float:
    """Insist on a number above 0."""
    result = number(key, value)
    if result <= 0:
        raise InputError(f"{key}: a number above 0 is needed, found {shown(value)}")
    return result


def not_negative(key: str, value: Any) -> float:
    """Insist on a number of 0 or more."""
    result = number(key, value)
    if result < 0:
        raise InputError(f"{key}: 0 or more is needed, found {shown(value)}")
    return result


def fraction(key: str, value: Any) -> float:
    """Insist on a number above 0 and not above 1."""
    result = positive(key, value)
    if result > 1:
        raise InputError(f"{key}: 1 or less is needed, found {shown(value)}")
    return result


def whole(key: str, value: Any) -> int:
    """Insist on a whole number of 1 or more."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"{key}: a whole number is needed, found {shown(value)}")
    if value < 1:
        raise InputError(f"{key}: 1 or more is needed, found {shown(value)}")
    if value >= HUGE:
        raise InputError(f"{key}: less than {HUGE:.0e} is needed, found {shown(value)}")
    return value


def one_of(
    allowed: Collection[str], more: Callable[[str], str] = lambda found: ""
) -> Callable[[str, Any], str]:
    """Make a reader that insists on one of the given words.

    Args:
        allowed: The words.
        more: Says of what was found instead what else would help.
    """

    def read(key: str, value: Any) -> str:
        if string(key, value) in allowed:
            return value
        hint = meant(value, allowed, "allowed are")
        raise InputError(f"{key}: {shown(value)} is unknown; {hint}{more(value)}")

    return read


def shown(value: Any) -> str:
    """Show a TOML value in a few words."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'the string "{value if len(value) <= 40 else value[:39] + "…"}"'
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, int):
        return f"{value}" if abs(value) < HUGE else "a huge number"
    return f"{value}"
