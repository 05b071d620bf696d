"""A simulator: a symbolic right-hand side with named quantities that carry units and ranges.

    d(state)/dt = f(x, u, p),    y = h(x, u, p),    p ~ p(phi)

`Declared` is its YAML form, a few expressions; a system too large for those builds `Model` in Python.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi

from simulators.coordinates import UNLIMITED, Coordinates, Flow
from simulators.definitions import (
    evaluated,
    in_order,
    read_covariates,
    read_groupings,
    read_intermediates,
    read_parameters,
)
from simulators.expression import Symbol
from simulators.quantity import (
    GIVEN,
    HELD,
    LIMITS,
    SMOOTH,
    ModelError,
    Quantity,
    check_free,
    check_mapping,
    check_model_name,
    check_spelling,
    read_between_rows,
    read_limits,
    read_number,
    read_term,
    read_times,
    read_variable,
    refuse_unknown,
)
from simulators.readings import with_sensors
from simulators.sections import SECTIONS
from simulators.sensors import read_sensors, with_lagging_readings
from simulators.tables import read_tables

__all__ = ["Coordinates", "Declared", "Flow", "Model", "ModelError", "Quantity"]

TIE = 1e-9  # rows; a delay of a whole number of rows must not need one more


@dataclass(frozen=True)
class Model:
    """A simulator in symbols.

    Args:
        name: letters, digits and single underscores.
        dt: duration of one transition, s.
        substeps: RK4 steps per transition.
        states: dx of them; the rows of x and of `rhs`.
        inputs: du of them; the rows of u.
        params: dp uncertain parameters; the rows of p. Known numbers are constants inside `rhs`.
        outputs: measured quantities that are not states; the rows of `output`.
        rhs: (x, u, p) -> d(state)/dt, dx rows.
        output: (x, u, p) -> measured quantities, one row each.
        gap: expected model error of one transition, by state or output, in its unit; empty where nothing is stated.
        fixed: the known numbers by name, for the reader and for reports.
        delay: input: how much later it acts than it is recorded, s, or the parameter that says so.
        lag: input: time constant of a first-order lag behind the delay, s, or the parameter that says so.
        between_rows: input: `held` over a transition at the value of its row, `linear`, straight to the value of the next
            row, or `smooth`, a curve through the rows around. Held where nothing is said.
        covariates: input that nobody drives, a parameter that is known in every row -> its column; the last of the inputs.
        per: uncertain parameter -> column of the groups from one to another of which it differs (`simulators.groups`).
        spreads: such a parameter -> range of its spread, where one was given.
        known_groups: such a parameter -> group -> range of its value there, where it is known.
        asked: further columns of groups -> the key of an effect that names them.
        groups: column -> names of the groups, where they are known: then inputs and parameters of groups are there.
        base: the model without them; None: this is it.
        limits: state -> lowest and highest value, to which it is clipped after each Runge-Kutta step, never inside one.
        saturation: measured state or output -> lowest and highest reading of its sensor. `output` is clipped to it; a state
            is not, as what is measured of it is.
        latency: measured output -> how old a value is when it is recorded, s; no equation depends on it.
        sensor_delay, sensor_lag: state or output -> how late, and with which time constant its sensor shows it, s, or the
            parameter that says so. `rhs` and `output` are of what a prompt sensor shows.
        coordinates: in which a transition is integrated; None: the states.
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
    between_rows: dict[str, str] = field(default_factory=dict)
    covariates: dict[str, str] = field(default_factory=dict)
    per: dict[str, str] = field(default_factory=dict)
    spreads: dict[str, tuple[float, float]] = field(default_factory=dict)
    known_groups: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    asked: dict[str, str] = field(default_factory=dict)
    groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    base: "Model | None" = None
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    saturation: dict[str, tuple[float, float]] = field(default_factory=dict)
    latency: dict[str, float] = field(default_factory=dict)
    sensor_delay: dict[str, float | str] = field(default_factory=dict)
    sensor_lag: dict[str, float | str] = field(default_factory=dict)
    coordinates: Coordinates | None = None
    symbol: Any = casadi.SX

    @property
    def columns_of_groups(self) -> dict[str, str]:
        """Columns that name groups, each with the key that named it first."""
        return {by: f"sim.parameters.{name}.per" for name, by in reversed(self.per.items())} | {
            by: key for by, key in self.asked.items() if by not in self.per.values()
        }

    def memory(self) -> float:
        """Return how far back inputs act, s: the longest delay and three time constants of the longest lag."""
        return self._reach(self.delay, self.lag)

    def _reach(self, delay: Mapping[str, float | str], lag: Mapping[str, float | str]) -> float:
        high = {q.name: q.high for q in self.params} | self.fixed
        ends = [[high[v] if isinstance(v, str) else v for v in times.values()] for times in (delay, lag)]
        return max(ends[0], default=0.0) + 3 * max(ends[1], default=0.0)

    @property
    def linear(self) -> tuple[int, ...]:
        """Rows of the inputs that move from a row to the next: a transition depends on their next values, too.

        They go straight there, or nearly: what a smooth one does depends on the rows around, which a transition does not know.
        """
        return tuple(i for i, word in enumerate(self.words_between_rows) if word != HELD)

    @property
    def smooth(self) -> tuple[int, ...]:
        """Those of them that are smooth curves through their rows."""
        return tuple(i for i, word in enumerate(self.words_between_rows) if word == SMOOTH)

    @property
    def words_between_rows(self) -> tuple[str, ...]:
        """What every input does from a row to the next; held where nothing is said, or nothing moves."""
        return tuple(self.between_rows.get(q.name, HELD) if self.states else HELD for q in self.inputs)

    def past(self) -> int:
        """Return the number of inputs before its own that a transition of the system depends on."""
        return math.ceil(self.memory() / self.dt - TIE)

    def echoes(self) -> int:
        """Return how many inputs more late sensors show: what a state was is known from what was read and what then acted."""
        if not (self.inputs and (self.sensor_delay or self.sensor_lag)):
            return 0
        return max(math.ceil(self._reach(self.sensor_delay, self.sensor_lag) / self.dt - TIE), 1)

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

    def flow(self) -> Flow:
        """Return what integrates one transition: in the states, or in coordinates of the model's own."""
        x, u, p = (self.symbol.sym(n, len(g), 1) for n, g in zip("xup", self._groups, strict=True))
        own = self.coordinates
        if own is None:
            rhs = casadi.Function(f"{self.name}_rhs", [x, u, p], [self.rhs(x, u, p)], ["x", "u", "p"], ["dx"])
            low, high = (tuple(self.limits.get(q.name, UNLIMITED)[end] for q in self.states) for end in (0, 1))
            return Flow(None, rhs, None, low, high)
        z = self.symbol.sym("z", own.size, 1)
        return Flow(
            casadi.Function(f"{self.name}_enter", [x, p], [own.enter(x, p)], ["x", "p"], ["z"]),
            casadi.Function(f"{self.name}_rhs", [z, u, p], [own.rhs(z, u, p)], ["z", "u", "p"], ["dz"]),
            casadi.Function(f"{self.name}_leave", [z, p], [own.leave(z, p)], ["z", "p"], ["x"]),
            *own.ends,
        )

    @property
    def _groups(self) -> tuple[tuple[Quantity, ...], ...]:
        return self.states, self.inputs, self.params


@dataclass(frozen=True)
class Declared:
    """A simulator as a YAML file declares it; the fields are the YAML keys.

    Args:
        name: letters, digits and single underscores.
        dt: duration of one transition, s.
        substeps: RK4 steps per transition.
        states: name: {unit, range: [low, high], periodic: false, limits: [low, high], role}; none for a static function. What
            leaves the `limits` is put back after each Runge-Kutta step (null: no limit), e.g. a level that cannot be negative.
            `role`: position, velocity, level, temperature or other; says which effects can act there.
        inputs: as states, without `periodic`; `delay` and `lag` (s, or the name of a parameter) say how late and how
            slowly an input acts, `between_rows` (held, linear or smooth) what it does from one row to the next.
        parameters: name: a number (known), an expression of other parameters (derived), {unit, value} (known), or
            {unit, range, prior: uniform|normal|lognormal, per: COLUMN, spread: [low, high], groups: {name: [low, high]}}
            (uncertain, see `Quantity`; with `per` it differs from group to group, by a `spread` that may have a range, but in
            `groups` whose value is known, see `simulators.groups`), or {unit, range, column} (known in every row by a column
            of the measurements, such as a payload).
        intermediates: name: expression, or {unit, expression}, in states, inputs, parameters, tables and other intermediates,
            in any order; a name that dynamics and outputs can use.
        tables: name: {inputs, method: linear|cubic, unit} with `file` (a CSV) or `axes` and `values`; a name as those of
            intermediates, whose value is looked up (see `simulators.tables`).
        dynamics: state: expression of its time derivative, in all these names.
        outputs: name: expression, or {unit, expression, scale, bias, saturates: [low, high], lag, range, delay}; a measured
            quantity that is not a state. The reading is scale*expression + bias within `saturates` (null: no end); with `lag`
            (s) it follows as a first-order lag does, and is a state of the model by this name, with this `range`. `delay` (s)
            says how old a reading is when it is recorded, as data.latency does.
        sensors: state or output: {value, lag, delay}; what its column shows of it. `value` is an expression in its place, in
            its name and parameters, such as `1.02*x + b`; then it follows with a `lag` and is late by a `delay` (s, or the
            name of a parameter). All else is about the system itself.
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
    intermediates: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, Any] = field(default_factory=dict)
    dynamics: dict[str, Any] = field(default_factory=dict)
    outputs: dict[str, Any] = field(default_factory=dict)
    sensors: dict[str, Any] = field(default_factory=dict)
    gap: dict[str, Any] = field(default_factory=dict)

    symbol: ClassVar[Any] = casadi.SX
    sections: ClassVar[dict[str, Any]] = SECTIONS  # JSON schemas of fields

    def model(self) -> Model:
        """Check everything and build the model.

        Raises:
            ModelError: names the key, what it holds, what is allowed and the cure.

        """
        check_model_name(self.name)
        dt = read_number("sim.dt", self.dt)
        if dt <= 0:
            raise ModelError(f"sim.dt: {dt:g} s is not positive; give the duration of one transition in seconds")
        if not isinstance(self.substeps, int) or isinstance(self.substeps, bool) or self.substeps < 1:
            raise ModelError(f"sim.substeps: {self.substeps!r} is not allowed; give a whole number, at least 1")
        self._check_names()
        states = tuple(read_variable(f"sim.states.{name}", name, node, LIMITS) for name, node in self.states.items())
        known_per_row, columns = read_covariates(self.parameters)
        inputs = tuple(read_variable(f"sim.inputs.{name}", name, node, GIVEN) for name, node in self.inputs.items())
        inputs += known_per_row
        if not states and not self.outputs:
            raise ModelError(
                "sim.states: neither states nor outputs: declare a state, or an output of a static function"
            )
        self._check_dynamics()
        params, fixed, derived = read_parameters(self.parameters)
        per, spreads, known_groups = read_groupings(self.parameters)
        sections = (self.states, self.inputs, self.parameters, self.intermediates, self.tables)
        tables = read_tables(self.tables, (name for section in sections for name in section))
        defined = in_order(read_intermediates(self.intermediates) | tables, "write one of them without the others")
        least = {q.name: q.low for q in params} | fixed
        sensors = read_sensors(self.outputs, self.parameters, least, dt / self.substeps)
        lags = {name: sensor.lag for name, sensor in sensors.items() if sensor.lag is not None}

        def named(p: Symbol) -> dict[str, Symbol]:
            """Without what depends on a covariate, which is an input."""
            scope: dict[str, Symbol] = {name: self.symbol(value) for name, value in fixed.items()}
            scope |= {quantity.name: p[row] for row, quantity in enumerate(params)}
            for name, definition in derived.items():
                if definition.uses <= scope.keys():
                    scope[name] = definition.build(scope)
            return scope

        def known(x: Symbol, u: Symbol, p: Symbol) -> dict[str, Symbol]:
            scope: dict[str, Symbol] = {name: self.symbol(value) for name, value in fixed.items()}
            for group, column in ((states, x), (inputs, u), (params, p)):
                scope |= {quantity.name: column[row] for row, quantity in enumerate(group)}
            return evaluated(derived, scope)

        def whole(x: Symbol, u: Symbol, p: Symbol) -> dict[str, Symbol]:
            return evaluated(defined, known(x, u, p))

        def outputs_of(scope: dict[str, Symbol]) -> list[Symbol]:
            return [sensor.target(scope) for sensor in sensors.values()]

        def time_constant(lag: float | str) -> Callable[[Symbol, Symbol, Symbol], Symbol]:
            return lambda x, u, p: known(x, u, p)[lag] if isinstance(lag, str) else lag

        model = Model(
            name=self.name,
            dt=dt,
            substeps=self.substeps,
            states=states,
            inputs=inputs,
            params=params,
            outputs=tuple(sensor.quantity for sensor in sensors.values()),
            rhs=lambda x, u, p: column(self.symbol, self.rates(whole(x, u, p))),
            output=lambda x, u, p: column(self.symbol, outputs_of(whole(x, u, p))),
            gap=self._gap(),
            fixed=fixed,
            delay=read_times("delay", self.inputs, params, fixed),
            lag=read_times("lag", self.inputs, params, fixed),
            between_rows=read_between_rows(self.inputs),
            covariates=columns,
            per=per,
            spreads=spreads,
            known_groups=known_groups,
            limits={
                name: read_limits(f"sim.states.{name}", node) for name, node in self.states.items() if "limits" in node
            },
            saturation={name: sensor.ends for name, sensor in sensors.items() if sensor.saturates},
            latency={name: sensor.delay for name, sensor in sensors.items() if sensor.delay},
            coordinates=self.own_coordinates(known),
            symbol=self.symbol,
        )
        if model.coordinates is not None and model.limits:
            raise ModelError(
                f"sim.states.{next(iter(model.limits))}.limits: {type(self).__name__} is not integrated in its states, so that "
                "nothing could be put back; leave limits out"
            )
        model = with_lagging_readings(model, {name: time_constant(lag) for name, lag in lags.items()})
        model = with_sensors(model, self.sensors, named)
        model.function()  # reads every expression once, so that an error surfaces here and not at first use
        return model

    def rates(self, known: Mapping[str, Symbol]) -> list[Symbol]:
        """Return d(state)/dt in the order of the states, from what every name stands for."""
        return [read_term(f"sim.dynamics.{name}", self.dynamics[name], known) for name in self.states]

    def own_coordinates(self, known: Callable[[Symbol, Symbol, Symbol], dict[str, Symbol]]) -> Coordinates | None:
        """Return the coordinates in which a transition is integrated; None: the states."""
        return None

    def _check_names(self) -> None:
        taken: dict[str, str] = {}
        for section in ("states", "inputs", "parameters", "intermediates", "tables", "outputs", "dynamics", "gap"):
            path, node = f"sim.{section}", getattr(self, section)
            check_mapping(path, node)
            for name in node:
                if isinstance(name, bool):
                    raise ModelError(
                        f"{path}: a name became {name}: YAML reads no, off, false, yes, on and true as booleans; "
                        'quote it ("no": ...) or choose another name'
                    )
                check_spelling(path, name)
                if section in ("dynamics", "gap"):  # these refer to quantities, the others introduce them
                    continue
                check_free(f"{path}.{name}", name)
                if name in taken:
                    raise ModelError(f"{path}.{name}: the name is taken by {taken[name]}; choose another name")
                taken[name] = f"{path}.{name}"

    def _check_dynamics(self) -> None:
        for name in self.dynamics:
            if name not in self.states:
                refuse_unknown(f"sim.dynamics.{name}", "is no state", name, self.states)
        for name in self.states:
            if name not in self.dynamics:
                raise ModelError(f"sim.dynamics: no entry for the state {name}; add `{name}: <its time derivative>`")

    def _gap(self) -> dict[str, float]:
        gap = {}
        for name, value in self.gap.items():
            if name not in self.states and name not in self.outputs:
                refuse_unknown(
                    f"sim.gap.{name}", "is neither a state nor an output", name, [*self.states, *self.outputs]
                )
            gap[name] = read_number(f"sim.gap.{name}", value)
            if gap[name] < 0:
                raise ModelError(f"sim.gap.{name}: {gap[name]:g} is negative; give a standard deviation, 0 for none")
        return gap


def column(symbol: Any, rows: list[Symbol]) -> Symbol:
    """Stack rows; none make an empty column."""
    return casadi.vertcat(*rows) if rows else symbol(0, 1)
