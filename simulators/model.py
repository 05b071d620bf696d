"""A simulator: a symbolic right-hand side with named quantities that carry units and ranges.

    d(state)/dt = f(x, u, p),    y = h(x, u, p),    p ~ p(phi)

`Declared` is its YAML form, a few expressions; a system too large for those builds `Model` in Python.
"""

import keyword
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple, NoReturn

import casadi

from simulators.expression import CONSTANTS, RESERVED, ExpressionError, Symbol, did_you_mean, parse, symbols_used

PRIORS = ("uniform", "normal", "lognormal")
TIMES = ("delay", "lag")  # of an input


class ModelError(ValueError):
    """What a user declared wrong: the key path, what was given, what is allowed and the cure."""


class Quantity(NamedTuple):
    """One named number of a model.

    `prior` matters for parameters only. For `normal` (`lognormal`: of the logarithm) the range is the interval of +-2
    standard deviations, mean = (low + high)/2 and sd = (high - low)/4, and nothing is cut off at its ends.
    An empty `unit` means that none was stated. Outputs have no range: low = high = nan.
    """

    name: str
    unit: str
    low: float
    high: float
    periodic: bool = False
    prior: str = "uniform"


@dataclass(frozen=True)
class Model:
    """A simulator in symbols.

    Args:
        name: letters, digits and single underscores.
        dt: duration of one transition, s.
        substeps: RK4 steps per transition.
        states: dx of them; the rows of x and of `rhs`.
        inputs: du of them; the rows of u, held constant over a transition.
        params: dp uncertain parameters; the rows of p. Known numbers are constants inside `rhs`.
        outputs: measured quantities that are not states; the rows of `output`.
        rhs: (x, u, p) -> d(state)/dt, dx rows.
        output: (x, u, p) -> measured quantities, one row each.
        gap: expected model error of one transition, by state or output, in its unit; empty where nothing is stated.
        fixed: the known numbers by name, for the reader and for reports.
        delay: input: how much later it acts than it is recorded, s, or the parameter that says so.
        lag: input: time constant of a first-order lag behind the delay, s, or the parameter that says so.
        symbol: casadi.SX, or casadi.MX for large vector models.

    """

    name: str
    dt: float
    substeps: int
    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    params: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    rhs: Callable[[Symbol, Symbol, Symbol], Symbol]
    output: Callable[[Symbol, Symbol, Symbol], Symbol]
    gap: dict[str, float] = field(default_factory=dict)
    fixed: dict[str, float] = field(default_factory=dict)
    delay: dict[str, float | str] = field(default_factory=dict)
    lag: dict[str, float | str] = field(default_factory=dict)
    symbol: Any = casadi.SX

    def memory(self) -> float:
        """Return how far back inputs act, s: the longest delay and three time constants of the longest lag."""
        high = {q.name: q.high for q in self.params} | self.fixed
        ends = [[high[v] if isinstance(v, str) else v for v in times.values()] for times in (self.delay, self.lag)]
        return max(ends[0], default=0.0) + 3 * max(ends[1], default=0.0)

    def function(self) -> casadi.Function:
        """Return the CasADi function (x, u, p) -> (dx, y); every argument is a column, empty ones are 0 x 1.

        Raises:
            ModelError: `rhs` or `output` returns another shape than the declared quantities ask for.

        """
        groups = {"x": self.states, "u": self.inputs, "p": self.params}
        arguments = [self.symbol.sym(name, len(group), 1) for name, group in groups.items()]
        results = {"dx": (self.rhs(*arguments), self.states), "y": (self.output(*arguments), self.outputs)}
        for name, (value, group) in results.items():
            if value.shape != (len(group), 1):
                raise ModelError(
                    f"{self.name}: {name} has shape {value.shape}, expected ({len(group)}, 1): one row for each of "
                    f"{[quantity.name for quantity in group]}"
                )
        return casadi.Function(self.name, arguments, [value for value, _ in results.values()], [*groups], [*results])


@dataclass(frozen=True)
class Declared:
    """A simulator as a YAML file declares it; the fields are the YAML keys.

    Args:
        name: letters, digits and single underscores.
        dt: duration of one transition, s.
        substeps: RK4 steps per transition.
        states: name: {unit, range: [low, high], periodic: false}; none for a static function.
        inputs: as states, without `periodic`; `delay` and `lag` (s, or the name of a parameter) say how late and how
            slowly an input acts.
        parameters: name: a number (known), an expression of other parameters (derived), {unit, value} (known), or
            {unit, range, prior: uniform|normal|lognormal} (uncertain, see `Quantity`).
        dynamics: state: expression of its time derivative, in states, inputs and parameters.
        outputs: name: expression, or {unit, expression}; a measured quantity that is not a state.
        gap: state or output: expected model error of one transition, in its unit.

    Example:
        >>> Declared("decay", dt=0.1, states={"c": {"range": [0, 1]}}, dynamics={"c": "-c"}).model().function()

    """

    name: str
    dt: float
    substeps: int = 10
    states: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    dynamics: dict[str, Any] = field(default_factory=dict)
    outputs: dict[str, Any] = field(default_factory=dict)
    gap: dict[str, Any] = field(default_factory=dict)

    def model(self) -> Model:
        """Check everything and build the model.

        Raises:
            ModelError: names the key, what it holds, what is allowed and the cure.

        """
        if not (isinstance(self.name, str) and casadi.Function.check_name(self.name)):
            raise ModelError(
                f"sim.name: {self.name!r} is no model name; allowed: letters, digits and single underscores, "
                "beginning with a letter, no word that CasADi reserves"
            )
        dt = _number("sim.dt", self.dt)
        if dt <= 0:
            raise ModelError(f"sim.dt: {dt:g} s is not positive; give the duration of one transition in seconds")
        if not isinstance(self.substeps, int) or isinstance(self.substeps, bool) or self.substeps < 1:
            raise ModelError(f"sim.substeps: {self.substeps!r} is not allowed; give a whole number, at least 1")
        self._check_names()
        states = tuple(_variable(f"sim.states.{name}", name, node) for name, node in self.states.items())
        inputs = tuple(_variable(f"sim.inputs.{name}", name, node, TIMES) for name, node in self.inputs.items())
        outputs = tuple(_output(f"sim.outputs.{name}", name, node) for name, node in self.outputs.items())
        if not states and not outputs:
            raise ModelError(
                "sim.states: neither states nor outputs: declare a state, or an output of a static function"
            )
        self._check_dynamics()
        params, fixed, derived = self._parameters()
        measured = {name: _expression(f"sim.outputs.{name}", node) for name, node in self.outputs.items()}

        def terms(section: str, formulas: Mapping[str, Any], x: Symbol, u: Symbol, p: Symbol) -> Symbol:
            scope: dict[str, Symbol] = {name: casadi.SX(value) for name, value in fixed.items()}
            for group, column in ((states, x), (inputs, u), (params, p)):
                scope |= {quantity.name: column[row] for row, quantity in enumerate(group)}
            for name, formula in derived.items():
                scope[name] = _term(f"sim.parameters.{name}", formula, scope)
            rows = [_term(f"sim.{section}.{name}", formula, scope) for name, formula in formulas.items()]
            return casadi.vertcat(*rows) if rows else casadi.SX(0, 1)

        rates = {name: self.dynamics[name] for name in self.states}
        model = Model(
            name=self.name,
            dt=dt,
            substeps=self.substeps,
            states=states,
            inputs=inputs,
            params=params,
            outputs=outputs,
            rhs=lambda x, u, p: terms("dynamics", rates, x, u, p),
            output=lambda x, u, p: terms("outputs", measured, x, u, p),
            gap=self._gap(),
            fixed=fixed,
            delay=_times("delay", self.inputs, params, fixed),
            lag=_times("lag", self.inputs, params, fixed),
        )
        model.function()  # reads every expression once, so that an error surfaces here and not at first use
        return model

    def _check_names(self) -> None:
        taken: dict[str, str] = {}
        for section in ("states", "inputs", "parameters", "outputs", "dynamics", "gap"):
            path, node = f"sim.{section}", getattr(self, section)
            _mapping(path, node)
            for name in node:
                if isinstance(name, bool):
                    raise ModelError(
                        f"{path}: a name became {name}: YAML reads no, off, false, yes, on and true as booleans; "
                        'quote it ("no": ...) or choose another name'
                    )
                if not isinstance(name, str) or not name.isidentifier() or "__" in name or keyword.iskeyword(name):
                    raise ModelError(
                        f"{path}: {name!r} is no name; allowed: letters, digits and single underscores, not beginning "
                        "with a digit, no word of Python's such as lambda or in"
                    )
                if section in ("dynamics", "gap"):  # these refer to quantities, the others introduce them
                    continue
                if name in RESERVED:
                    what = "constant" if name in CONSTANTS else "function"
                    raise ModelError(f"{path}.{name}: {name} is a {what} of expressions; choose another name")
                if name in taken:
                    raise ModelError(f"{path}.{name}: the name is taken by {taken[name]}; choose another name")
                taken[name] = f"{path}.{name}"

    def _check_dynamics(self) -> None:
        for name in self.dynamics:
            if name not in self.states:
                _unknown(f"sim.dynamics.{name}", "is no state", name, self.states)
        for name in self.states:
            if name not in self.dynamics:
                raise ModelError(f"sim.dynamics: no entry for the state {name}; add `{name}: <its time derivative>`")

    def _gap(self) -> dict[str, float]:
        gap = {}
        for name, value in self.gap.items():
            if name not in self.states and name not in self.outputs:
                _unknown(f"sim.gap.{name}", "is neither a state nor an output", name, [*self.states, *self.outputs])
            gap[name] = _number(f"sim.gap.{name}", value)
            if gap[name] < 0:
                raise ModelError(f"sim.gap.{name}: {gap[name]:g} is negative; give a standard deviation, 0 for none")
        return gap

    def _parameters(self) -> tuple[tuple[Quantity, ...], dict[str, float], dict[str, str]]:
        """Return the uncertain ones, the known numbers, and the derived expressions in an order of evaluation."""
        uncertain: list[Quantity] = []
        fixed: dict[str, float] = {}
        formulas: dict[str, str] = {}
        for name, node in self.parameters.items():
            path = f"sim.parameters.{name}"
            if isinstance(node, str):
                formulas[name] = node
            elif not isinstance(node, Mapping):
                fixed[name] = _number(path, node)
            elif "value" in node:
                _keys(path, node, ("unit", "value"), "a known parameter takes no range")
                _unit(path, node)
                fixed[name] = _number(f"{path}.value", node["value"])
            else:
                _keys(path, node, ("unit", "range", "prior"), "`value: <number>` in place of a range makes it known")
                uncertain.append(_uncertain(path, name, node))
        derived: dict[str, str] = {}
        for name in self._order(formulas):
            if symbols_used(formulas[name]) <= fixed.keys():
                scope = {other: casadi.SX(value) for other, value in fixed.items()}
                fixed[name] = float(_term(f"sim.parameters.{name}", formulas[name], scope))
            else:
                derived[name] = formulas[name]
        return tuple(uncertain), fixed, derived

    def _order(self, formulas: Mapping[str, str]) -> list[str]:
        uses: dict[str, set[str]] = {}
        for name, formula in formulas.items():
            path = f"sim.parameters.{name}"
            try:
                uses[name] = symbols_used(formula)
            except ExpressionError as error:
                raise ModelError(f"{path}: {error}") from None
            for other in sorted(uses[name] - self.parameters.keys()):
                _unknown(path, f"uses {other}, which is no parameter", other, self.parameters)
        try:
            order = list(TopologicalSorter(uses).static_order())
        except CycleError as error:
            loop = " -> ".join(reversed(error.args[1]))
            raise ModelError(
                f"sim.parameters: derived in a circle, {loop}; give one of them a number or a range"
            ) from None
        return [name for name in order if name in formulas]


def _mapping(path: str, node: Any) -> None:
    if not isinstance(node, Mapping):
        raise ModelError(f"{path}: {node!r} is not a mapping; write `{path.rsplit('.')[-1]}: {{name: ...}}`")


def _unknown(path: str, problem: str, word: str, allowed: Iterable[str]) -> NoReturn:
    known = list(allowed)
    raise ModelError(f"{path}: {problem}; known: {', '.join(known) or 'none'}.{did_you_mean(word, known)}")


def _keys(path: str, node: Any, allowed: tuple[str, ...], cure: str = "leave it out") -> None:
    _mapping(path, node)
    for key in node:
        if key not in allowed:
            hint = did_you_mean(str(key), list(allowed))
            raise ModelError(f"{path}.{key}: unknown key; allowed: {', '.join(allowed)}; {cure}.{hint}")


def _unit(path: str, node: Mapping[str, Any]) -> str:
    unit = node.get("unit", "")
    if not isinstance(unit, str):
        raise ModelError(f'{path}.unit: {unit!r} is not a text; quote it, e.g. unit: "1" for a number without unit')
    return unit


def _number(path: str, value: Any) -> float:
    """Read a number, or a text of one: YAML 1.1 takes `1e-3` for a text, and `2*pi` is worth allowing."""
    if isinstance(value, str):
        value = float(_term(path, value, {}))
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ModelError(f"{path}: {value!r} is not a number")
    if not math.isfinite(value):
        raise ModelError(f"{path}: {value} is not finite; give a finite number")
    return float(value)


def _term(path: str, formula: Any, scope: Mapping[str, Symbol]) -> Symbol:
    if isinstance(formula, bool) or not isinstance(formula, (str, int, float)):
        raise ModelError(f"{path}: {formula!r} is no expression; write a formula, e.g. -k*x, or a number")
    try:
        return parse(str(formula), scope)
    except ExpressionError as error:
        raise ModelError(f"{path}: {error}") from None


def _range(path: str, node: Mapping[str, Any]) -> tuple[float, float]:
    if "range" not in node:
        raise ModelError(f"{path}: no range; add `range: [low, high]`")
    ends = node["range"]
    if not isinstance(ends, (list, tuple)) or len(ends) != 2:
        raise ModelError(f"{path}.range: {ends!r} is not a range; write [low, high]")
    low, high = (_number(f"{path}.range", end) for end in ends)
    if low >= high:
        cure = "swap them" if low > high else "give low < high"
        raise ModelError(f"{path}.range: low = {low:g} is not below high = {high:g}; {cure}")
    return low, high


def _variable(path: str, name: str, node: Any, more: tuple[str, ...] = ()) -> Quantity:
    _keys(path, node, ("unit", "range", "periodic", *more))
    periodic = node.get("periodic", False)
    if not isinstance(periodic, bool):
        raise ModelError(f"{path}.periodic: {periodic!r} is not allowed; write true or false")
    if periodic and _unit(path, node) not in ("rad", ""):
        raise ModelError(
            f"{path}.unit: {node['unit']!r} is not allowed for a periodic state, whose sine and cosine are learned; use rad "
            "(convert the column of the measurements, too)"
        )
    return Quantity(name, _unit(path, node), *_range(path, node), periodic=periodic)


def _times(
    key: str, inputs: Mapping[str, Any], params: tuple[Quantity, ...], fixed: dict[str, float]
) -> dict[str, float | str]:
    """Read the delays or lags of the inputs: a number, or the name of a parameter."""
    known = {q.name: q.low for q in params} | fixed
    found: dict[str, float | str] = {}
    for name, node in inputs.items():
        if key not in node:
            continue
        path, value = f"sim.inputs.{name}.{key}", node[key]
        if isinstance(value, str) and value not in known:
            _unknown(path, f"{value!r} is neither a number (s) nor a parameter", value, known)
        least = known[value] if isinstance(value, str) else _number(path, value)
        found[name] = value if isinstance(value, str) else least
        if least < 0:
            raise ModelError(f"{path}: {least:g} s is negative; an input cannot act before it is given")
    return found


def _uncertain(path: str, name: str, node: Mapping[str, Any]) -> Quantity:
    prior = node.get("prior", "uniform")
    if prior not in PRIORS:
        _unknown(f"{path}.prior", f"{prior!r} is no prior", str(prior), PRIORS)
    low, high = _range(path, node)
    if prior == "lognormal" and low <= 0:
        raise ModelError(f"{path}.range: low = {low:g} has no logarithm; a lognormal prior needs 0 < low")
    return Quantity(name, _unit(path, node), low, high, prior=prior)


def _output(path: str, name: str, node: Any) -> Quantity:
    unit = ""
    if isinstance(node, Mapping):
        _keys(path, node, ("unit", "expression"))
        unit = _unit(path, node)
    return Quantity(name, unit, math.nan, math.nan)


def _expression(path: str, node: Any) -> Any:
    if not isinstance(node, Mapping):
        return node
    if "expression" not in node:
        raise ModelError(f"{path}: no expression; add `expression: <formula>`")
    return node["expression"]
