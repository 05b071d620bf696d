"""Measured-like data: episodes of a world or model with unknown parameters, excited, sampled and disturbed by sensors.

`groups` gives every episode its parameters, `timing` says when rows are recorded, `motion` follows the true values to
those times, and `sensors` records them.

Every draw has its own stream, derived by name from one seed and, within an episode, from its number: more episodes
leave the first ones as they were, longer ones leave their beginning (unless the excitation scales a whole signal), and
more noise leaves the motion.
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from simulators.model import TIE, Model, ModelError, Quantity
from simulators.parameters import draw
from simulators.quantity import BETWEEN_ROWS, HELD, check_word, refuse_unknown
from simulators.worlds.excitation import Excitation, HeldRandom
from simulators.worlds.groups import Covariate, Dealt, Group, Groups
from simulators.worlds.motion import Drifting, Inputs, check_finite, named, true_values
from simulators.worlds.recording import Recording
from simulators.worlds.rk4 import RK4
from simulators.worlds.sensors import NoiseLaw, Sensors, wrapped
from simulators.worlds.streams import Streams
from simulators.worlds.timing import Clock, Timing
from simulators.worlds.world import World

OWN_COLUMNS = ("episode", "t", "split")
LAYOUTS = ("trajectories", "transitions")
NOISE_ON = ("both", "next")
NEXT = ("next_", "exact_next_")  # of the columns of layout transitions
LICENCE = "made by simpel simulate: simulated data, not measured on a real system"


class Simulation(NamedTuple):
    """Simulated measurements.

    Args:
        columns: name -> one value per row: episode, t (s), groups, covariates, states, inputs, outputs, split (train or
            test); NaN where a sensor recorded nothing. A static model has no episode and no t. Layout transitions has
            neither, but next_<state>, the state dt later, and exact_next_<state>, the same as no sensor sees it.
        card: how they were made, of plain values fit for YAML; `columns` gives the unit of each column.

    """

    columns: dict[str, np.ndarray]
    card: dict[str, Any]


@dataclass(frozen=True)
class Simulate:
    """How to turn a world or a model into measurements; the fields are the YAML keys.

    Args:
        episodes: number of independent trajectories.
        steps: rows per episode, `dt` of the source apart; sensors with clocks of their own add rows.
        layout: `trajectories`, or `transitions`: episodes times steps independent rows, each a state (uniform, `initial`), an
            input (uniform on its range) and what follows.
        noise_on: of layout transitions: noise on `both` states, or on the `next` one only.
        seed: of everything random.
        excitation: law of the inputs, each signal drawn on its own.
        initial: state -> [low, high] of its uniform initial value; left out: the declared range.
        noise_std: state or output -> scale of the noise on it, in its unit: a number, or an expression of states, inputs
            and outputs at that instant, e.g. 0.01 + 0.02*abs(y); 0 where left out. It is the standard deviation of
            Gaussian noise, and less than that of Student's t.
        unmeasured: states and outputs that get no column.
        truth: parameter -> value; those left out are drawn from their prior.
        test_fraction: the last episodes (static: rows), so large a fraction, get split = test; 0 = no column `split`.
        hide_truth: leave the parameter values out of the card.
        description: a sentence for the card; empty = none.
        noise: state or output -> law of its noise, gaussian or student_t; Gaussian where left out.
        quantisation: state or output -> step of its converter, in its unit; it rounds after the noise.
        saturates: state or output -> lowest and highest value that its sensor records; null = no end.
        missing: state or output -> share of its cells that are NaN, drawn cell by cell.
        latency: state or output -> age of a value when it is recorded, s, or as the simulator says; rows begin later by it.
        rates: state or output -> s between two samples of its sensor; NaN in the rows between.
        clocks: state or output -> its sensor samples at times of its own: {offset, drift}. They become rows.
        jitter: share of dt by which the times of rows vary at random.
        between_rows: input -> how the plant sees it between rows: held, linear from row to row, or smooth, a curve through the
            rows; where left out, as the simulator says.
        groups: column -> groups to which episodes are dealt in turn, and parameters that differ between them.
        covariates: column -> a known number that differs between episodes, the value of a parameter.
        drift: parameter -> its relative change from the beginning to the end of an episode, linear in time.

    Raises:
        ModelError: a value that is not allowed; names `simulation.<key>`.

    """

    episodes: int = 20
    steps: int = 100
    layout: str = "trajectories"
    noise_on: str = "both"
    seed: int = 0
    excitation: Excitation = field(default_factory=HeldRandom)
    initial: dict[str, Any] = field(default_factory=dict)
    noise_std: dict[str, float | str] = field(default_factory=dict)
    unmeasured: tuple[str, ...] = ()
    truth: dict[str, float] = field(default_factory=dict)
    test_fraction: float = 0.25
    hide_truth: bool = False
    description: str = ""
    noise: dict[str, NoiseLaw] = field(default_factory=dict)
    quantisation: dict[str, float] = field(default_factory=dict)
    saturates: dict[str, tuple[float | None, ...]] = field(default_factory=dict)
    missing: dict[str, float] = field(default_factory=dict)
    latency: dict[str, float] = field(default_factory=dict)
    rates: dict[str, float] = field(default_factory=dict)
    clocks: dict[str, Clock] = field(default_factory=dict)
    jitter: float = 0.0
    between_rows: dict[str, str] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)
    covariates: dict[str, Covariate] = field(default_factory=dict)
    drift: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, least in (("episodes", 1), ("steps", 1), ("seed", 0)):
            if getattr(self, key) < least:
                raise ModelError(f"simulation.{key}: {getattr(self, key)} is not allowed; give at least {least}")
        check_word("simulation.layout", self.layout, LAYOUTS)
        check_word("simulation.noise_on", self.noise_on, NOISE_ON)
        if not 0 <= self.test_fraction < 1:
            raise ModelError(f"simulation.test_fraction: {self.test_fraction:g} is not allowed; give 0 <= fraction < 1")
        self._sensors.check()
        self._timing.check()
        for name, word in self.between_rows.items():
            check_word(f"simulation.between_rows.{name}", word, BETWEEN_ROWS)
        for name, change in self.drift.items():
            if not math.isfinite(change):
                raise ModelError(f"simulation.drift.{name}: {change:g} is not finite; give a relative change, e.g. 0.1")

    def run(self, source: Model | World) -> Simulation:
        """Simulate.

        Raises:
            ModelError: a name that the source does not have, a range upside down, or a state that is not finite.

        """
        for key in ("between_rows", "latency"):  # the simulator may say them, too
            if (own := getattr(source, key, {})).keys() - getattr(self, key).keys():
                return dataclasses.replace(self, **{key: own | getattr(self, key)}).run(source)
        own = OWN_COLUMNS if self.layout == "trajectories" else OWN_COLUMNS[-1:]
        for quantity in (*source.states, *source.inputs, *source.outputs):
            if quantity.name in own:
                raise ModelError(
                    f"simulation: {source.name} calls a quantity `{quantity.name}`, as a column of its own is called "
                    f"({', '.join(own)}); choose another name, or simulation.layout=transitions, which has no time"
                )
        if source.states and self.layout == "transitions":
            made = {f"{part}{q.name}" for q in source.states for part in NEXT}
            for quantity in (*source.states, *source.inputs, *source.outputs):
                if quantity.name in made:
                    raise ModelError(
                        f"simulation.layout: {source.name} calls a quantity `{quantity.name}`, as the column of a next state "
                        "is called; choose another name"
                    )
        self._check_names(source, own)
        self._check_kind(source)
        truth = self._truth(source)
        follow = source.states and self.layout == "trajectories"
        dealt = self._groups.deal(source.params, truth, self.episodes * (1 if follow else self.steps), self._streams)
        if not source.states:
            columns = self._static(source, dealt)
        elif self.layout == "transitions":
            columns = self._transitions(source, dealt)
        else:
            columns = self._trajectories(source, dealt)
        left_out = {f"{part}{name}" for name in self.unmeasured for part in ("", *NEXT)}
        columns = {name: values for name, values in columns.items() if name not in left_out}
        if self.test_fraction:
            columns["split"] = self._split(columns["episode"] if follow else np.arange(self.episodes * self.steps))
        return Simulation(columns, self._card(source, truth, dealt, columns))

    def _check_names(self, source: Model | World, own: tuple[str, ...]) -> None:
        """Refuse names that the source does not have."""
        measurable = (*source.states, *source.outputs)
        for key in ("noise_std", "noise", "quantisation", "saturates", "missing", "latency", "rates", "clocks"):
            _known(key, getattr(self, key), measurable)
        _known("unmeasured", self.unmeasured, measurable)
        if {q.name for q in measurable} <= set(self.unmeasured):
            raise ModelError(f"simulation.unmeasured: nothing of {source.name} is left to measure; leave one out")
        for name, column in source.covariates.items() if isinstance(source, Model) else ():
            raise ModelError(
                f"sim.parameters.{name}: a column knows it; to simulate, give a range alone and "
                f"simulation.covariates={{{column}: {{parameter: {name}, range: [low, high]}}}}"
            )
        _known("truth", self.truth, source.params)
        _known("drift", self.drift, source.params)
        _known("initial", self.initial, source.states)
        _known("between_rows", self.between_rows, source.inputs)
        names = [q.name for q in (*source.states, *source.inputs, *source.outputs)]
        self._sensors.check_expressions(names)
        taken = {*own, *names, *(f"{part}{q.name}" for q in source.states for part in NEXT)}
        rows = 1 if source.states and self.layout == "trajectories" else self.steps
        self._groups.check(source.params, taken, self.truth, self.episodes * rows)

    def _check_kind(self, source: Model | World) -> None:
        """Refuse what makes no sense without time, or what a world cannot do."""
        moving = [name for name, word in self.between_rows.items() if word != HELD]
        in_time = {"jitter": self.jitter, "drift": self.drift, "between_rows": moving}
        if not source.states or self.layout == "transitions":
            why, cure = "rows of layout transitions do not follow each other in time", "take layout=trajectories"
            if not source.states:
                why, cure = f"{source.name} has no states, so its rows have no time", "take a simulator with states"
            late = [f"outputs.{name}.delay" for name in getattr(source, "latency", {})]
            late += [f"inputs.{n}.{w}" for w in ("delay", "lag") if not source.states for n in getattr(source, w, {})]
            for key in late:
                raise ModelError(f"sim.{key}: {why}; set it to 0, or {cure}")
            for key, given in ({k: getattr(self, k) for k in ("latency", "rates", "clocks")} | in_time).items():
                if given:
                    raise ModelError(f"simulation.{key}: {why}; leave it out, or {cure}")
        if not isinstance(source, Model):
            for key in (each for each, given in in_time.items() if given):
                raise ModelError(
                    f"simulation.{key}: {source.name} is a world, which answers from row to row with held inputs and "
                    "constant parameters; leave it out, or take a simulator with equations"
                )
        elif late := [name for name in source.delay.values() if name in self.drift]:
            raise ModelError(f"simulation.drift.{late[0]}: it is a delay of an input, which cannot drift; leave it out")

    @property
    def _streams(self) -> Streams:
        return Streams(self.seed)

    @property
    def _sensors(self) -> Sensors:
        return Sensors(self._streams, self.noise_std, self.noise, self.quantisation, self.saturates, self.missing)

    @property
    def _timing(self) -> Timing:
        return Timing(self.latency, self.rates, self.clocks, self.jitter)

    @property
    def _groups(self) -> Groups:
        return Groups(self.groups, self.covariates)

    def _truth(self, source: Model | World) -> np.ndarray:
        """Return the parameter vector (dp,); what is given replaces a draw and leaves the other draws as they were."""
        drawn = draw(source.params, self._streams.of("params"), 1)[0]
        return np.array([self.truth.get(q.name, value) for q, value in zip(source.params, drawn, strict=True)])

    def _trajectories(self, source: Model | World, dealt: Dealt) -> dict[str, np.ndarray]:
        n, dt = self.episodes, source.dt
        measured = tuple(q for q in (*source.states, *source.outputs) if q.name not in self.unmeasured)
        rows = self._timing.rows([q.name for q in measured], dt, n, self.steps, self._streams)
        recording = Recording(self._sensors, measured, self.latency, rows)
        inputs = self._inputs(source, rows.inputs)
        params = Drifting(dealt.params, self._drift_rates(source, rows.inputs.shape[1]))
        true = true_values(source, self._initial(source), inputs, params, recording.instants, self._finer())
        episode = np.repeat(np.arange(n), [len(times) for times in rows.recorded])
        columns = {"episode": episode, "t": np.concatenate(rows.recorded)}
        columns |= {name: values[episode] for name, values in dealt.columns.items()}
        found = recording.read(true) | recording.given([q.name for q in source.inputs], inputs, TIE * dt)
        order = [q.name for q in (*source.states, *source.inputs, *source.outputs)]
        return columns | {name: found[name] for name in order if name in found}

    def _inputs(self, source: Model | World, times: np.ndarray) -> Inputs:
        """Draw the inputs that are given at the times (episodes, rows), s."""
        n, steps = times.shape
        values = np.zeros((n, steps, len(source.inputs)))
        for i, quantity in enumerate(source.inputs):
            for k in range(n):
                stream = self._streams.of(f"input.{quantity.name}", k)
                values[k, :, i] = self.excitation.signal(stream, steps, source.dt, quantity)
        words = [self.between_rows.get(q.name, HELD) for q in source.inputs]
        return Inputs.of_rows(times, values, words)

    def _drift_rates(self, source: Model | World, rows: int) -> np.ndarray:
        """Return the relative change of every parameter, 1/s, over so many rows."""
        lasts = source.dt * max(rows - 1, 1)
        return np.array([self.drift.get(q.name, 0.0) / lasts for q in source.params])

    def _finer(self) -> str:
        """Return the keys because of which the motion between rows matters."""
        given = {key: [*getattr(self, key).values()] for key in ("latency", "drift")}
        given |= {"clocks": [*self.clocks], "jitter": [self.jitter]}
        given["between_rows"] = [word != HELD for word in self.between_rows.values()]
        return " and ".join(f"simulation.{key}" for key, values in given.items() if any(values))

    def _transitions(self, source: Model | World, dealt: Dealt) -> dict[str, np.ndarray]:
        """Independent rows: a state, an input and the state dt later."""
        n = self.episodes * self.steps
        ranges = [self._initial_range(q) for q in source.states]
        before = np.column_stack([
            self._streams.of(f"initial.{q.name}").uniform(*ends, n) for q, ends in zip(source.states, ranges, strict=True)
        ])  # fmt: skip
        inputs = np.zeros((n, len(source.inputs)))
        for i, q in enumerate(source.inputs):
            inputs[:, i] = self._streams.of(f"input.{q.name}").uniform(q.low, q.high, n)
        step = RK4(source).step if isinstance(source, Model) else source.step
        after = step(before, inputs, dealt.params)
        check_finite(source, after, source.dt)
        now, then = (named(source, states, inputs, dealt.params) for states in (before, after))
        columns = dict(dealt.columns)
        for q in source.states:
            columns[q.name] = self._sensors.read(q, now) if self.noise_on == "both" else wrapped(q, now[q.name])
            columns[f"next_{q.name}"] = self._sensors.read(q, then, part="next_")
            columns[f"exact_next_{q.name}"] = wrapped(q, then[q.name])
        columns |= {q.name: inputs[:, i] for i, q in enumerate(source.inputs)}
        return columns | {q.name: self._sensors.read(q, now) for q in source.outputs}

    def _static(self, source: Model | World, dealt: Dealt) -> dict[str, np.ndarray]:
        """Rows of inputs uniform on their ranges, and the outputs there."""
        n = self.episodes * self.steps
        given = {q.name: self._streams.of(f"input.{q.name}").uniform(q.low, q.high, n) for q in source.inputs}
        inputs = np.column_stack(list(given.values())) if given else np.zeros((n, 0))
        true = named(source, np.zeros((n, 0)), inputs, dealt.params)
        return dealt.columns | given | {q.name: self._sensors.read(q, true) for q in source.outputs}

    def _initial(self, source: Model | World) -> np.ndarray:
        """Draw the initial states, (episodes, ds)."""
        start = np.zeros((self.episodes, len(source.states)))
        for i, quantity in enumerate(source.states):
            low, high = self._initial_range(quantity)
            for k in range(self.episodes):
                start[k, i] = self._streams.of(f"initial.{quantity.name}", k).uniform(low, high)
        return start

    def _initial_range(self, quantity: Quantity) -> tuple[float, float]:
        ends = self.initial.get(quantity.name, (quantity.low, quantity.high))
        if not (
            isinstance(ends, (list, tuple))
            and len(ends) == 2
            and all(isinstance(end, (int, float)) and math.isfinite(end) for end in ends)
            and ends[0] <= ends[1]
        ):
            raise ModelError(
                f"simulation.initial.{quantity.name}: {ends!r} is no range; write [low, high] with low <= high"
            )
        return float(ends[0]), float(ends[1])

    def _split(self, groups: np.ndarray) -> np.ndarray:
        n = int(groups[-1]) + 1
        if n < 2:
            raise ModelError(
                "simulation.test_fraction: one episode cannot be split into train and test; set simulation.episodes: 2 "
                "or more, or simulation.test_fraction: 0"
            )
        n_test = min(max(round(self.test_fraction * n), 1), n - 1)
        return np.where(groups >= n - n_test, "test", "train")

    def _card(
        self, source: Model | World, truth: np.ndarray, dealt: Dealt, columns: dict[str, np.ndarray]
    ) -> dict[str, Any]:
        units = ({"t": "s"} if self.layout == "trajectories" else {}) | {
            q.name: q.unit for q in (*source.states, *source.inputs, *source.outputs)
        }
        units |= {name: q.unit for name, c in self.covariates.items() for q in source.params if q.name == c.parameter}
        excitation = {"law": type(self.excitation).__name__}
        if dataclasses.is_dataclass(self.excitation):
            excitation |= dataclasses.asdict(self.excitation)
        measured = [q for q in (*source.states, *source.outputs) if q.name in columns]
        card: dict[str, Any] = {"description": self.description} if self.description else {}
        card |= {
            "source": source.name,
            "made_by": "simpel simulate",
            "licence": LICENCE,
            "seed": self.seed,
            "dt": source.dt,
            "episodes": self.episodes,
            "steps": self.steps,
            "columns": {name: {"unit": units[bare]} for name in columns if (bare := _bare(name, units)) in units},
            "noise_std": {q.name: self._scale(q.name) for q in measured},
        }
        card |= self._sensors.planted([q.name for q in measured]) | self._timing.planted([q.name for q in measured])
        if self.between_rows:
            card["between_rows"] = dict(self.between_rows)
        card |= self._groups.planted(hide_truth=self.hide_truth)
        if source.states and self.layout == "transitions":
            card |= {"layout": self.layout, "noise_on": self.noise_on}
        elif source.states:
            card["excitation"] = excitation
        if source.states:
            card["initial"] = {q.name: list(self._initial_range(q)) for q in source.states if q in measured}
        if not self.hide_truth:
            known = {c.parameter for c in self.covariates.values()}  # they have a column
            values = zip(source.params, truth, strict=True)
            card["truth"] = {q.name: float(value) for q, value in values if q.name not in known}
            card |= {"truth_by_group": dealt.by_group} if self.groups else {}
            card |= {"drift": dict(self.drift)} if self.drift else {}
        return card

    def _scale(self, name: str) -> float | str:
        given = self.noise_std.get(name, 0.0)
        return given if isinstance(given, str) else float(given)


def _bare(column: str, known: Iterable[str]) -> str:
    """Return the quantity that a column is about."""
    return column if column in known else column.removeprefix("exact_").removeprefix("next_")


def _known(key: str, given: Iterable[str], quantities: tuple[Quantity, ...]) -> None:
    names = [quantity.name for quantity in quantities]
    for name in (each for each in given if each not in names):
        refuse_unknown(f"simulation.{key}.{name}", "no such name", name, names)
