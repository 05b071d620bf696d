"""Arithmetic written as text, e.g. `(m*g*l*sin(phi) + C_m*u)/I`, turned into CasADi terms.

Python's own parser makes the syntax tree; a whitelist turns its nodes into CasADi terms. Nothing is ever evaluated as
Python; a number enters as a CasADi constant, so that `9**9**9` is a float that overflows, not an integer that grows.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple, NoReturn, TypeAlias

import casadi

Symbol: TypeAlias = Any  # casadi.SX or casadi.MX, which have no common base class

MAX_LENGTH = 10_000  # characters: a corrected car in the world frame has thousands
MAX_DEPTH = 100  # nested nodes: each costs stack frames, and a sum of n terms is n deep


class ExpressionError(ValueError):
    """An expression that cannot be read; the message shows it with a caret under the offending column."""


class Function(NamedTuple):
    """One callable name of the expression language: what it builds and how many arguments it takes."""

    build: Callable[..., Symbol]
    arity: int
    variadic: bool = False  # `arity` or more


FUNCTIONS: dict[str, Function] = {
    **{
        name: Function(getattr(casadi, name), 1)
        for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "sign")
    },
    "abs": Function(casadi.fabs, 1),
    "atan2": Function(casadi.atan2, 2),
    "min": Function(lambda *terms: reduce(casadi.fmin, terms), 2, variadic=True),
    "max": Function(lambda *terms: reduce(casadi.fmax, terms), 2, variadic=True),
    "where": Function(casadi.if_else, 3),
}
CONSTANTS: dict[str, float] = {"pi": math.pi}
RESERVED: frozenset[str] = frozenset(FUNCTIONS) | frozenset(CONSTANTS)

_OPERATORS: dict[type[ast.AST], Callable[..., Symbol]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_LOGIC = "use where(condition, a, b) instead; of conditions, min(a, b) is `and`, max(a, b) is `or`, 1 - a is `not`"
_CURES: dict[type[ast.AST], str] = {
    ast.BoolOp: f"`and` and `or` are not allowed: {_LOGIC}",
    ast.Not: f"`not` is not allowed: {_LOGIC}",
    ast.BitAnd: f"`&` is not allowed: {_LOGIC}",
    ast.BitOr: f"`|` is not allowed: {_LOGIC}",
    ast.Invert: f"`~` is not allowed: {_LOGIC}",
    ast.IfExp: "`a if condition else b` is not allowed: write where(condition, a, b)",
    ast.BitXor: "`^` is not allowed: write ** for a power",
    ast.Attribute: "a dot is not allowed after a name: functions are called plainly, e.g. sin(phi)",
    ast.Subscript: "square brackets are not allowed: give each element a name of its own",
    ast.Lambda: "lambda is not allowed: an expression is plain arithmetic",
    ast.JoinedStr: "a string is not allowed: an expression is plain arithmetic",
}
_ALLOWED = f"+ - * / **, comparisons, numbers, names and {' '.join(FUNCTIONS)}"


def did_you_mean(word: str, allowed: list[str]) -> str:
    """Return `" Did you mean X?"` for a near miss of `word` in `allowed`, else an empty string."""
    close = get_close_matches(word, allowed, n=1, cutoff=0.6)
    return f" Did you mean {close[0]}?" if close else ""


def parse(expression: str, symbols: Mapping[str, Symbol], kind: type = casadi.SX) -> Symbol:
    """Build the CasADi term of an expression.

    Args:
        expression: `+ - * / **`, comparisons (chained too; 1 where true, else 0), the functions of `FUNCTIONS`, `pi`.
        symbols: the names that it may use, each a 1 x 1 symbol or term.
        kind: casadi.SX or casadi.MX, whichever `symbols` are made of.

    Returns:
        A 1 x 1 term of that kind.

    Raises:
        ExpressionError: anything else than the arithmetic above, an unknown name, a constant part that is not finite.

    Example:
        >>> x = casadi.SX.sym("x")
        >>> parse("where(x > 0, sqrt(x), 0)", {"x": x})

    """
    reader = _Reader(" ".join(expression.split()), symbols, kind)
    return reader.term(_tree(reader.text), 0)


def symbols_used(expression: str) -> set[str]:
    """Return the names that an expression refers to, functions and constants left out.

    Raises:
        ExpressionError: the expression is not Python syntax, or is too long or too deep.

    """
    tree = _tree(" ".join(expression.split()))
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)} - RESERVED


def _tree(text: str) -> ast.expr:
    if not text:
        raise ExpressionError("the expression is empty: write a number or a formula")
    if len(text) > MAX_LENGTH:
        raise ExpressionError(
            f"the expression has {len(text)} characters, {MAX_LENGTH} are allowed: write the system as a Python "
            f"simulator (begins {text[:40]!r})"
        )
    if "#" in text:  # Python would drop the rest of the line in silence
        _refuse(text, text.index("#"), "a comment is not allowed inside an expression")
    try:
        return ast.parse(text, mode="eval").body
    except SyntaxError as error:
        _refuse(text, (error.offset or len(text) + 1) - 1, f"this is not a formula ({error.msg})")
    except (
        ValueError,
        MemoryError,
        RecursionError,
        OverflowError,
    ):  # null bytes, integers of thousands of digits, nesting
        _refuse(text, 0, "this cannot be read: too deeply nested, or not text")


def _refuse(text: str, column: int, problem: str) -> NoReturn:
    # A window keeps the caret on the same terminal line as the column that it points at.
    start = max(0, column - 60)
    shown = "".join(character if character.isprintable() else "?" for character in text[start : start + 100])
    raise ExpressionError(f"{problem}\n  {shown}\n  {' ' * (column - start)}^")


class _Reader(NamedTuple):
    """Turns syntax nodes of `text` into terms."""

    text: str
    symbols: Mapping[str, Symbol]
    kind: type

    def refuse(self, node: ast.expr, problem: str) -> NoReturn:
        column = len(self.text.encode()[: node.col_offset].decode())  # ast counts bytes, a caret counts characters
        _refuse(self.text, column, problem)

    def term(self, node: ast.expr, depth: int) -> Symbol:
        if depth > MAX_DEPTH:
            self.refuse(node, f"more than {MAX_DEPTH} nested operations: add brackets so that sums split in halves")
        value = self.node(node, depth + 1)
        if value.is_constant() and not value.is_regular():
            self.refuse(node, "this part is not a finite number")
        return value

    def node(self, node: ast.expr, depth: int) -> Symbol:
        match node:
            case ast.Constant(value=bool() as value):  # an int to Python, no number here
                self.refuse(node, f"a number or a name is expected, not {value}")
            case ast.Constant(value=int() | float() as value):
                return self.number(node, value)
            case ast.Constant(value=value):
                self.refuse(node, f"a number or a name is expected, not {str(value)[:40]!r}")
            case ast.Name(id=name):
                return self.name(node, name)
            case ast.BinOp(left=left, op=op, right=right):
                build = self.operator(node, op)
                return build(self.term(left, depth), self.term(right, depth))
            case ast.UnaryOp(op=op, operand=operand):
                return self.operator(node, op)(self.term(operand, depth))
            case ast.Compare(left=left, ops=ops, comparators=others):
                terms = [self.term(side, depth) for side in (left, *others)]
                links = [self.operator(node, op)(a, b) for op, (a, b) in zip(ops, pairwise(terms), strict=True)]
                return reduce(casadi.logic_and, links)
            case ast.Call():
                return self.call(node, depth)
        self.refuse(node, _CURES.get(type(node), f"{type(node).__name__} is not allowed; allowed: {_ALLOWED}"))

    def operator(self, node: ast.expr, op: ast.AST) -> Callable[..., Symbol]:
        if type(op) not in _OPERATORS:
            self.refuse(node, _CURES.get(type(op), f"{type(op).__name__} is not allowed; allowed: {_ALLOWED}"))
        return _OPERATORS[type(op)]

    def number(self, node: ast.expr, value: float) -> Symbol:
        try:
            return self.kind(float(value))
        except OverflowError:
            self.refuse(node, "this part is not a finite number")

    def name(self, node: ast.expr, name: str) -> Symbol:
        if name in self.symbols:
            return self.symbols[name]
        if name in CONSTANTS:
            return self.kind(CONSTANTS[name])
        if name in FUNCTIONS:
            self.refuse(node, f"{name} is a function: write {name}(...)")
        known = sorted(self.symbols)
        hint = did_you_mean(name, [*known, *RESERVED])
        self.refuse(node, f"unknown name {name!r}; known here: {', '.join([*known, *CONSTANTS])}.{hint}")

    def call(self, node: ast.Call, depth: int) -> Symbol:
        if not isinstance(node.func, ast.Name):
            self.refuse(node, _CURES.get(type(node.func), "only a function name can be called"))
        name = node.func.id
        if name not in FUNCTIONS:
            known = "is a quantity, not a function" if name in self.symbols else "is no function here"
            hint = did_you_mean(name, list(FUNCTIONS))
            self.refuse(node, f"{name!r} {known}; functions: {' '.join(FUNCTIONS)}.{hint}")
        function = FUNCTIONS[name]
        if node.keywords:
            self.refuse(node, f"{name} takes its arguments by position, without names")
        given = len(node.args)
        if given < function.arity or (given > function.arity and not function.variadic):
            more = " or more" if function.variadic else ""
            self.refuse(node, f"{name} takes {function.arity}{more} argument(s), {given} given")
        return function.build(*(self.term(argument, depth) for argument in node.args))
