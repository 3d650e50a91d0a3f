"""Expressions in x and y, as they stand in a problem file.

The text is parsed with Python's own grammar and read against a whitelist; it is never evaluated as
Python. What comes out is a graph of operations, see :mod:`signorini_cr.app.formula`.
"""

import ast
import math
import re
import unicodedata
import warnings
from collections.abc import Callable, Collection, Mapping
from typing import NoReturn, TypeAlias, TypeVar

from ..errors import InputError
from ..hints import guess
from .formula import (
    CONSTANTS,
    FUNCTIONS,
    VARIABLES,
    Expression,
    Node,
    constant,
    is_constant,
    operands_first,
    operation,
)

T = TypeVar("T")

LONGEST = 10_000  # characters
DEEPEST = 150  # levels of nesting
LARGEST = 10_000  # operations, definitions included
LISTED = 30  # names told of, where one is not among them
LONGEST_CHAIN = 250  # operations, each of which needs the one before; at 500 UFL 2026.1 gives up

RESERVED = frozenset((*VARIABLES, *CONSTANTS, *FUNCTIONS))

_ARITHMETIC = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
_BY_PAIRS = {ast.Add: "+", ast.Sub: "+", ast.Mult: "*"}
_COMPARISONS = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
_FOREIGN = {  # what other languages say
    "ln": "log", "e": "exp(1)", "arcsin": "asin", "arccos": "acos", "arctan": "atan",
    "arctan2": "atan2", "fabs": "abs", "sgn": "sign", "minimum": "min", "maximum": "max",
    "conditional": "where", "pow": "a**b", "π": "pi",
}  # fmt: skip
_DECIMALS = "decimals have a point, as 0.5"
_CONSTRUCTS: dict[type, str] = {  # what Python has and this language has not
    ast.BitXor: "a power is written **, not ^",
    ast.BitAnd: "conditions are joined by 'and', not &",
    ast.BitOr: "conditions are joined by 'or', not |",
    ast.Invert: "a condition is turned round by 'not', not ~",
    ast.FloorDiv: "// is not part of the language",
    ast.Mod: "% is not part of the language",
    ast.IfExp: "a choice is written where(condition, a, b)",
    ast.Attribute: "a dot is not part of the language",
    ast.Subscript: "square brackets are not part of the language",
    ast.List: "square brackets are not part of the language",
    ast.Tuple: f"a comma only separates the arguments of a function; {_DECIMALS}",
    ast.Lambda: "'lambda' is not part of the language",
}


def parse(
    text: str, names: Mapping[str, Expression] | None = None, later: Collection[str] = ()
) -> Expression:
    """Read an expression.

    Args:
        text: What was written.
        names: Names already defined, which may be used in ``text``.
        later: Names defined further down, which may not; for the message only.

    Returns:
        The expression.

    Raises:
        InputError: The text is not an expression; the message shows where and what is allowed.
    """
    line = " ".join(text.split())
    if not line.isprintable():
        raise InputError("the expression holds a character that cannot be printed")
    if not line:
        raise InputError("the expression is empty; a number or a formula in x and y belongs here")
    if len(line) > LONGEST:
        raise InputError(
            f"the expression has {len(line)} characters; at most {LONGEST} are allowed"
        )
    root = _Reader(line, names or {}, later).read()
    chain: dict[int, int] = {}  # the longest that ends with an operation
    for node in operands_first(root):
        below = (chain[id(arg)] for arg in node.args if isinstance(arg, Node))
        chain[id(node)] = 1 + max(below, default=0)
    if len(chain) > LARGEST:
        raise InputError(
            f"the expression has {len(chain)} operations; at most {LARGEST} are allowed"
        )
    if chain[id(root)] > LONGEST_CHAIN:
        raise InputError(
            f"the expression has {chain[id(root)]} operations one upon the other; at most "
            f"{LONGEST_CHAIN} are allowed"
        )
    return Expression(text, root)


_Term: TypeAlias = tuple[ast.BinOp, bool, Node]
"""A term or a factor: where it is joined, whether it is not subtracted, and its value."""


class _Reader:
    """One text on its way from Python's syntax tree to operations."""

    def __init__(self, line: str, names: Mapping[str, Expression], later: Collection[str]):
        self.line = line
        self.names = names
        self.later = later

    def read(self) -> Node:
        if "#" in self.line:
            self.fail("'#' is not part of the language", self.line.index("#"))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                tree = ast.parse(self.line, mode="eval")
        except SyntaxError as error:
            self.fail(self.syntax(error), error.offset - 1 if error.offset else len(self.line))
        except (RecursionError, MemoryError):
            self.too_deep()
        return self.node(tree.body, 1)

    def syntax(self, error: SyntaxError) -> str:
        """Put Python's complaint into the words of this language."""
        message = error.msg or ""
        at = error.offset - 1 if error.offset else len(self.line)
        if "too many nested" in message:
            self.too_deep()
        if "integer string conversion" in message:
            return "this number has too many digits; write it like 1.5e300"
        if self.line[at : at + 1] == "=" or "assign" in message or ":=" in self.line:
            return "'=' is not part of the language; equality is written =="
        if "was never closed" in message:
            return f"'{self.line[at : at + 1]}' is never closed"
        if "unmatched" in message or "invalid character" in message:
            return message
        if re.search(r"\d,0\d", self.line) and "leading zeros" in message:
            return _DECIMALS
        if at >= len(self.line):
            return "something is missing at the end"
        if "invalid decimal literal" in message:
            return "a number runs into a name; a product is written with *, as in 2*x"
        return "the expression cannot be read from here on"

    def too_deep(self) -> NoReturn:
        raise InputError(
            f"the expression is nested deeper than {DEEPEST} levels;"
            " name its parts under [define] instead"
        )

    def fail(self, message: str, start: int, end: int | None = None) -> NoReturn:
        """Raise the message with a picture of the line and the part from ``start`` to ``end``."""
        line, end = self.line, max(end or 0, start + 1)
        if len(line) > 68:
            left = min(max(start - 24, 0), max(len(line) - 66, 0))
            right = left + 66
            line = ("…" if left else "") + line[left:right] + ("…" if right < len(line) else "")
            start, end = (at - left + (left > 0) for at in (start, min(end, right)))
        mark = " " * start + "^" * (end - start)
        raise InputError(f"{message}\n    {line}\n    {mark}")

    def reject(self, at: ast.AST, message: str) -> NoReturn:
        """Raise the message with the part of the line that ``at`` stands for."""
        raw = self.line.encode()
        start, end = (len(raw[:n].decode()) for n in (at.col_offset, at.end_col_offset))  # type: ignore[attr-defined]
        self.fail(message, start, end)

    def node(self, tree: ast.expr, depth: int) -> Node:
        """Translate a tree, checking that it belongs to the language."""
        if depth > DEEPEST:
            self.too_deep()
        below = depth + 1
        match tree:
            case ast.Constant(value=bool() | str() | bytes() | complex() | None):
                self.reject(tree, "this is not a number")
            case ast.Constant(value=int() | float() as value):
                lost = value == 0.0 and self.is_written_otherwise(tree)
                return self.finite(tree, constant(_as_float(value), lost))
            case ast.Name():
                return self.name(tree)
            case ast.UnaryOp(op=ast.UAdd()):
                return self.number(tree.operand, below)
            case ast.UnaryOp(op=ast.USub()):
                return operation("neg", self.number(tree.operand, below))
            case ast.UnaryOp(op=ast.Not()):
                return operation("not", self.condition(tree.operand, below))
            case ast.BinOp() if type(tree.op) in _ARITHMETIC:
                return self.arithmetic(tree, below)
            case ast.BoolOp():
                word = "and" if isinstance(tree.op, ast.And) else "or"
                return self.join(word, [self.condition(part, below) for part in tree.values])
            case ast.Compare():
                return self.compare(tree, below)
            case ast.Call():
                return self.call(tree, below)
        kind = type(getattr(tree, "op", tree))
        self.reject(tree, _CONSTRUCTS.get(kind, "this is not part of the language"))

    def number(self, tree: ast.expr, depth: int) -> Node:
        node = self.node(tree, depth)
        if node.condition:
            self.reject(
                tree,
                "a number belongs here, but this is a condition; where(condition, 1, 0) is 1 or 0",
            )
        return node

    def condition(self, tree: ast.expr, depth: int) -> Node:
        node = self.node(tree, depth)
        if not node.condition:
            self.reject(tree, "a condition such as x < 0 belongs here, but this is a number")
        return node

    def finite(self, tree: ast.expr, node: Node) -> Node:
        if node.lost:
            self.reject(tree, "the value of this constant is below all numbers, but not 0")
        if node.op == "const" and not math.isfinite(node.args[0]):
            value = node.args[0]
            what = "not a real number" if math.isnan(value) else "too large, or infinite"
            self.reject(tree, f"the value of this constant is {what}")
        return node

    def is_written_otherwise(self, tree: ast.expr) -> bool:
        """Tell whether a number that is read as 0 has another digit, as 1e-400 has."""
        written = ast.get_source_segment(self.line, tree) or ""
        return re.search("[1-9]", written.lower().split("e")[0]) is not None

    def join(self, op: str, parts: list[Node]) -> Node:
        return _by_pairs(parts, lambda one, two: operation(op, one, two))

    def arithmetic(self, tree: ast.BinOp, depth: int) -> Node:
        chain = []  # a + b + c + …, which leans to the left, is no deeper than a + b
        first: ast.expr = tree
        while isinstance(first, ast.BinOp) and type(first.op) in _ARITHMETIC:
            chain.append(first)
            first = first.left
        left = self.number(first, depth)
        run: list[_Term] = []  # of a sum or a product that left is the first of
        joined_by = ""
        for link in reversed(chain):
            right = self.number(link.right, depth)
            op = _BY_PAIRS.get(type(link.op), "")
            if op != joined_by:
                left, run, joined_by = self.balanced(joined_by, left, run), [], op
            if op:
                run.append((link, not isinstance(link.op, ast.Sub), right))
                continue
            if isinstance(link.op, ast.Div) and is_constant(right, 0.0):
                self.reject(link, "this divides by zero")
            if isinstance(link.op, ast.Pow) and left.op == "const" and right.op != "const":
                if left.args[0] <= 0.0:
                    self.reject(link, "with a varying exponent, the base must be above 0")
            left = self.finite(link, operation(_ARITHMETIC[type(link.op)], left, right))
        return self.balanced(joined_by, left, run)

    def balanced(self, op: str, first: Node, others: list[_Term]) -> Node:
        """Join by pairs: a - b + c - d is (a - b) + (c - d), so that what is long is not deep."""
        if not others:
            return first

        def both(one: _Term, two: _Term) -> _Term:
            joined = operation(op if one[1] == two[1] else "-", one[2], two[2])
            return one[0], one[1], self.finite(two[0], joined)

        # The first one's link is never looked at
        return _by_pairs([(others[0][0], True, first), *others], both)[2]

    def compare(self, tree: ast.Compare, depth: int) -> Node:
        values = [self.number(part, depth) for part in (tree.left, *tree.comparators)]
        links = []
        for op, left, right in zip(tree.ops, values, values[1:], strict=False):
            if type(op) not in _COMPARISONS:
                self.reject(tree, "numbers are compared by <, <=, >, >=, == and != only")
            links.append(operation(_COMPARISONS[type(op)], left, right))
        return self.join("and", links)

    def call(self, tree: ast.Call, depth: int) -> Node:
        if not isinstance(tree.func, ast.Name):
            self.node(tree.func, depth)
            self.reject(tree.func, "only a function can be called; a product is written with *")
        name = tree.func.id
        if name not in FUNCTIONS:
            if name in self.names or name in VARIABLES or name in CONSTANTS:
                self.reject(tree, f"{name!r} is not a function; a product is written with *")
            self.unknown(tree.func, "function", FUNCTIONS)
        if tree.keywords:
            self.reject(tree, f"{name} takes plain arguments, without names or '='")
        wanted, given = FUNCTIONS[name][0], len(tree.args)
        if given != wanted and (wanted is not None or given < 2):
            need = {1: "one argument", 2: "two arguments", 3: "(condition, a, b)"}.get(
                wanted or 0, "two arguments or more"
            )
            self.reject(
                tree, f"{name} takes {need}, but {given or 'none'} {_is_or_are(given)} given"
            )
        first = self.condition if name == "where" else self.number
        args = [(self.number if i else first)(arg, depth) for i, arg in enumerate(tree.args)]
        node = self.join(name, args) if wanted is None else operation(name, *args)
        return self.finite(tree, node)

    def name(self, tree: ast.Name) -> Node:
        name = tree.id
        if name in VARIABLES:
            return Node("variable", (VARIABLES.index(name),))
        if name in CONSTANTS:
            return constant(CONSTANTS[name])
        if name in self.names:
            return self.names[name].root
        if name in FUNCTIONS:
            self.reject(tree, f"the function {name} needs its arguments in parentheses")
        if name in self.later:
            self.reject(tree, f"{name!r} is defined only further down; move it up under [define]")
        self.unknown(tree, "name", (*VARIABLES, *CONSTANTS, *self.names))

    def unknown(self, tree: ast.Name, kind: str, known: Collection[str]) -> NoReturn:
        """Reject a name, with what may have been meant and what there is."""
        there = f"{kind}s are {_listed(known)}"
        if tree.id in _FOREIGN:
            hint = guess(_FOREIGN[tree.id], _FOREIGN.values(), there)
        else:
            hint = guess(tree.id.lower(), (*known, *FUNCTIONS), there)
        self.reject(tree, f"there is no {kind} {tree.id[:40]!r}; {hint}")


def check_name(name: str) -> str:
    """Return a name for [define] as the parser will see it.

    Raises:
        InputError: The name cannot be used in an expression.
    """
    try:
        plain = isinstance(ast.parse(name, mode="eval").body, ast.Name) and name.isidentifier()
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        plain = False
    if not plain:
        raise InputError("this cannot be a name; letters, digits and _ are allowed, a letter first")
    seen = unicodedata.normalize("NFKC", name)
    if seen in RESERVED:
        letters = "" if seen == name else f", which is {seen!r} in other letters,"
        raise InputError(f"{name!r}{letters} has a meaning already; another name is needed")
    return seen


def _by_pairs(parts: list[T], both: Callable[[T, T], T]) -> T:
    """Join neighbours until there is one: what is long need not be deep."""
    while len(parts) > 1:
        pairs = zip(parts[::2], parts[1::2], strict=False)
        parts = [both(one, two) for one, two in pairs] + parts[len(parts) // 2 * 2 :]
    return parts[0]


def _as_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _is_or_are(number: int) -> str:
    return "is" if number < 2 else "are"


def _listed(words: Collection[str]) -> str:
    words = list(words)
    if len(words) > LISTED:
        return ", ".join(words[:LISTED]) + " and others"
    return ", ".join(words[:-1]) + (" and " if words[:-1] else "") + words[-1]
