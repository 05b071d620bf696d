"""One named number of a simulator with its unit, range and prior, and how YAML declares it."""

import keyword
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, NoReturn

import casadi

from simulators.expression import CONSTANTS, RESERVED, ExpressionError, Symbol, did_you_mean, parse

PRIORS = ("uniform", "normal", "lognormal")
VARIABLE = ("unit", "range", "periodic")  # of a state or an input
TIMES = ("delay", "lag")  # of an input
BETWEEN_ROWS = HELD, LINEAR, SMOOTH = ("held", "linear", "smooth")  # what an input does from one row to the next
GIVEN = (*TIMES, "between_rows")  # of an input
LIMITS = ("limits", "role")  # of a state
HIDDEN = "hidden"  # role of a state that nothing measures, on which nothing acts but what its equation says
ROLES = ("position", "velocity", "level", "temperature", "other", HIDDEN)  # of a state, that a user may declare
READING = "reading"  # role of a state that is the lagging reading of a sensor; simpel gives it


class ModelError(ValueError):
    """What a user declared wrong: the key path, what was given, what is allowed and the cure."""


class Quantity(NamedTuple):
    """One named number of a model.

    `prior` matters for parameters only. For `normal` (`lognormal`: of the logarithm) the range is the interval of +-2
    standard deviations, mean = (low + high)/2 and sd = (high - low)/4, and nothing is cut off at its ends.
    An empty `unit` means that none was stated. Outputs have no range: low = high = nan. `role` says what a state is, one of
    `ROLES`; empty: nothing was said, see `simulators.effects.structure`.
    """

    name: str
    unit: str
    low: float
    high: float
    periodic: bool = False
    prior: str = "uniform"
    role: str = ""

    @property
    def middle(self) -> float:
        """Middle of the range, of a lognormal one the geometric."""
        return float((self.low * self.high) ** 0.5 if self.prior == "lognormal" else (self.low + self.high) / 2)


def check_model_name(name: Any) -> None:
    """Refuse what CasADi cannot call a function."""
    if not (isinstance(name, str) and casadi.Function.check_name(name)):
        raise ModelError(
            f"sim.name: {name!r} is no model name; allowed: letters, digits and single underscores, "
            "beginning with a letter, no word that CasADi reserves"
        )


def check_spelling(path: str, name: Any) -> None:
    """Refuse what cannot be a name in an expression."""
    if not isinstance(name, str) or not name.isidentifier() or "__" in name or keyword.iskeyword(name):
        raise ModelError(
            f"{path}: {name!r} is no name; allowed: letters, digits and single underscores, not beginning "
            "with a digit, no word of Python's such as lambda or in"
        )


def check_free(path: str, name: str) -> None:
    """Refuse the name of a constant or function of expressions."""
    if name in RESERVED:
        what = "constant" if name in CONSTANTS else "function"
        raise ModelError(f"{path}: {name} is a {what} of expressions; choose another name")


def check_word(path: str, word: Any, allowed: tuple[str, ...]) -> None:
    """Refuse a word that is not one of the allowed."""
    if word not in allowed:
        hint = did_you_mean(str(word), list(allowed))
        raise ModelError(f"{path}: {word!r} is not allowed, only {' or '.join(allowed)}.{hint}")


def check_mapping(path: str, node: Any) -> None:
    """Refuse what is not a mapping."""
    if not isinstance(node, Mapping):
        raise ModelError(f"{path}: {node!r} is not a mapping; write `{path.rsplit('.')[-1]}: {{name: ...}}`")


def refuse_unknown(path: str, problem: str, word: str, allowed: Iterable[str]) -> NoReturn:
    """Raise: a word that is not known, what is, and the nearest."""
    known = list(allowed)
    raise ModelError(f"{path}: {problem}; known: {', '.join(known) or 'none'}.{did_you_mean(word, known)}")


def check_keys(path: str, node: Any, allowed: tuple[str, ...], cure: str = "leave it out") -> None:
    """Refuse keys that are not allowed."""
    check_mapping(path, node)
    for key in node:
        if key not in allowed:
            hint = did_you_mean(str(key), list(allowed))
            raise ModelError(f"{path}.{key}: unknown key; allowed: {', '.join(allowed)}; {cure}.{hint}")


def read_unit(path: str, node: Mapping[str, Any]) -> str:
    """Read a unit, a text."""
    unit = node.get("unit", "")
    if not isinstance(unit, str):
        raise ModelError(f'{path}.unit: {unit!r} is not a text; quote it, e.g. unit: "1" for a number without unit')
    return unit


def read_number(path: str, value: Any) -> float:
    """Read a number, or a text of one: YAML 1.1 takes `1e-3` for a text, and `2*pi` is worth allowing."""
    if isinstance(value, str):
        value = float(read_term(path, value, {}))
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ModelError(f"{path}: {value!r} is not a number")
    if not math.isfinite(value):
        raise ModelError(f"{path}: {value} is not finite; give a finite number")
    return float(value)


def read_term(path: str, formula: Any, scope: Mapping[str, Symbol]) -> Symbol:
    """Read a formula or a number in the names of the scope."""
    if isinstance(formula, bool) or not isinstance(formula, (str, int, float)):
        raise ModelError(f"{path}: {formula!r} is no expression; write a formula, e.g. -k*x, or a number")
    try:
        return parse(str(formula), scope)
    except ExpressionError as error:
        raise ModelError(f"{path}: {error}") from None


def read_range(path: str, node: Mapping[str, Any], key: str = "range") -> tuple[float, float]:
    """Read `range: [low, high]`, or another key that holds a range."""
    if key not in node:
        raise ModelError(f"{path}: no {key}; add `{key}: [low, high]`")
    ends = node[key]
    if not isinstance(ends, (list, tuple)) or len(ends) != 2:
        raise ModelError(f"{path}.{key}: {ends!r} is not a range; write [low, high]")
    low, high = (read_number(f"{path}.{key}", end) for end in ends)
    if low >= high:
        cure = "swap them" if low > high else "give low < high"
        raise ModelError(f"{path}.{key}: low = {low:g} is not below high = {high:g}; {cure}")
    return low, high


def read_limits(path: str, node: Mapping[str, Any], key: str = "limits") -> tuple[float, float]:
    """Read the limits of a state, or of a sensor; null is none."""
    ends = node[key]
    if not isinstance(ends, (list, tuple)) or len(ends) != 2:
        raise ModelError(f"{path}.{key}: {ends!r} is not allowed; write [low, high], null for no limit")
    if node.get("periodic"):
        raise ModelError(f"{path}.limits: a periodic state has no ends; leave limits out")
    low, high = (
        infinite if end is None else read_number(f"{path}.{key}", end)
        for end, infinite in zip(ends, (-math.inf, math.inf), strict=True)
    )
    if low >= high:
        raise ModelError(f"{path}.{key}: low = {low:g} is not below high = {high:g}; swap or widen them")
    return low, high


def read_variable(path: str, name: str, node: Any, more: tuple[str, ...] = ()) -> Quantity:
    """Read a state or an input."""
    check_keys(path, node, (*VARIABLE, *more))
    periodic = node.get("periodic", False)
    if not isinstance(periodic, bool):
        raise ModelError(f"{path}.periodic: {periodic!r} is not allowed; write true or false")
    if periodic and read_unit(path, node) not in ("rad", ""):
        raise ModelError(
            f"{path}.unit: {node['unit']!r} is not allowed for a periodic state, whose sine and cosine are learned; use rad "
            "(convert the column of the measurements, too)"
        )
    role = node.get("role", "")
    if "role" in node:
        check_word(f"{path}.role", role, ROLES)
    return Quantity(name, read_unit(path, node), *read_range(path, node), periodic=periodic, role=role)


def read_times(
    key: str,
    nodes: Mapping[str, Any],
    params: tuple[Quantity, ...],
    fixed: dict[str, float],
    section: str = "inputs",
    why: str = "an input cannot act before it is given",
) -> dict[str, float | str]:
    """Read the delays or lags of inputs or sensors: a number, or the name of a parameter."""
    known = {q.name: q.low for q in params} | fixed
    found: dict[str, float | str] = {}
    for name, node in nodes.items():
        if key not in node:
            continue
        path, value = f"sim.{section}.{name}.{key}", node[key]
        if isinstance(value, str) and value not in known:
            refuse_unknown(path, f"{value!r} is neither a number (s) nor a parameter", value, known)
        least = known[value] if isinstance(value, str) else read_number(path, value)
        found[name] = value if isinstance(value, str) else least
        if least < 0:
            raise ModelError(f"{path}: {least:g} s is negative; {why}")
    return found


def read_between_rows(inputs: Mapping[str, Any]) -> dict[str, str]:
    """Read what the inputs do between rows, of those that say so: `held`, `linear` or `smooth`."""
    found = {}
    for name, node in inputs.items():
        if "between_rows" in node:
            check_word(f"sim.inputs.{name}.between_rows", node["between_rows"], BETWEEN_ROWS)
            found[name] = node["between_rows"]
    return found


def read_uncertain(path: str, name: str, node: Mapping[str, Any]) -> Quantity:
    """Read an uncertain parameter."""
    prior = node.get("prior", "uniform")
    if prior not in PRIORS:
        refuse_unknown(f"{path}.prior", f"{prior!r} is no prior", str(prior), PRIORS)
    low, high = read_range(path, node)
    if prior == "lognormal" and low <= 0:
        raise ModelError(f"{path}.range: low = {low:g} has no logarithm; a lognormal prior needs 0 < low")
    return Quantity(name, read_unit(path, node), low, high, prior=prior)


def read_expression(path: str, node: Any) -> Any:
    """Read the formula of an output or an intermediate."""
    if not isinstance(node, Mapping):
        return node
    if "expression" not in node:
        raise ModelError(f"{path}: no expression; add `expression: <formula>`")
    return node["expression"]
