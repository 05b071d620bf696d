"""Names in the expressions of an effect, and numbers that are stated in scales of a place."""

import ast
import re
from collections.abc import Mapping
from typing import Any

import casadi

from simulators.expression import RESERVED, parse
from simulators.quantity import ModelError


def names_in(text: str) -> set[str]:
    """Return the names that an expression uses."""
    return {node.id for node in ast.walk(ast.parse(text, mode="eval")) if isinstance(node, ast.Name)} - RESERVED


def renamed(text: str, swap: Mapping[str, str]) -> str:
    """Replace whole names in an expression."""
    return re.sub(r"(?<![\w.])[A-Za-z_]\w*", lambda m: swap.get(m[0], m[0]), text)


def value_in(value: Any, scales: Mapping[str, float], path: str) -> float:
    """Return a number, or an expression of scales, as a number."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    try:
        return float(parse(str(value), {name: casadi.SX(scale) for name, scale in scales.items()}))
    except ValueError as error:
        raise ModelError(f"{path}: {error}") from None
