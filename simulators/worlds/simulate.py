"""Measured-like data: episodes of a world or model with unknown parameters, excited, sampled and disturbed by noise.

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

from simulators.model import Model, ModelError, Quantity
from simulators.parameters import draw
from simulators.quantity import check_word, refuse_unknown
from simulators.worlds.excitation import Excitation, HeldRandom
from simulators.worlds.motion import check_finite, on_rows
from simulators.worlds.rk4 import RK4
from simulators.worlds.sensors import Sensors, wrapped
from simulators.worlds.streams import Streams
from simulators.worlds.world import World

OWN_COLUMNS = ("episode", "t", "split")
LAYOUTS = ("trajectories", "transitions")
NOISE_ON = ("both", "next")
NEXT = ("next_", "exact_next_")  # of the columns of layout transitions
LICENCE = "made by simpel simulate: simulated data, not measured on a real system"


class Simulation(NamedTuple):
    """Simulated measurements.

    Args:
        columns: name -> one value per row: episode, t (s), states, inputs, outputs, split (train or test). A static
            model has no episode and no t. Layout transitions has neither, but next_<state>, the state dt later, and
            exact_next_<state>, the same without noise.
        card: how they were made, of plain values fit for YAML; `columns` gives the unit of each column.

    """

    columns: dict[str, np.ndarray]
    card: dict[str, Any]


@dataclass(frozen=True)
class Simulate:
    """How to turn a world or a model into measurements; the fields are the YAML keys.

    Args:
        episodes: number of independent trajectories.
        steps: rows per episode, `dt` of the source apart.
        layout: `trajectories`, or `transitions`: episodes times steps independent rows, each a state (uniform, `initial`), an
            input (uniform on its range) and what follows.
        noise_on: of layout transitions: noise on `both` states, or on the `next` one only.
        seed: of everything random.
        excitation: law of the inputs, each signal drawn on its own.
        initial: state -> [low, high] of its uniform initial value; left out: the declared range.
        noise_std: state or output -> standard deviation of the Gaussian noise on it, in its unit; 0 where left out.
        unmeasured: states and outputs that get no column.
        truth: parameter -> value; those left out are drawn from their prior.
        test_fraction: the last episodes (static: rows), so large a fraction, get split = test; 0 = no column `split`.
        hide_truth: leave the parameter values out of the card.
        description: a sentence for the card; empty = none.

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
    noise_std: dict[str, float] = field(default_factory=dict)
    unmeasured: tuple[str, ...] = ()
    truth: dict[str, float] = field(default_factory=dict)
    test_fraction: float = 0.25
    hide_truth: bool = False
    description: str = ""

    def __post_init__(self) -> None:
        for key, least in (("episodes", 1), ("steps", 1), ("seed", 0)):
            if getattr(self, key) < least:
                raise ModelError(f"simulation.{key}: {getattr(self, key)} is not allowed; give at least {least}")
        check_word("simulation.layout", self.layout, LAYOUTS)
        check_word("simulation.noise_on", self.noise_on, NOISE_ON)
        if not 0 <= self.test_fraction < 1:
            raise ModelError(f"simulation.test_fraction: {self.test_fraction:g} is not allowed; give 0 <= fraction < 1")
        for name, std in self.noise_std.items():
            if not 0 <= std < math.inf:
                raise ModelError(f"simulation.noise_std.{name}: {std:g} is no standard deviation; give 0 or more")

    def run(self, source: Model | World) -> Simulation:
        """Simulate.

        Raises:
            ModelError: a name that the source does not have, a range upside down, or a state that is not finite.

        """
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
        measurable = (*source.states, *source.outputs)
        _known("noise_std", self.noise_std, measurable)
        _known("unmeasured", self.unmeasured, measurable)
        if {q.name for q in measurable} <= set(self.unmeasured):
            raise ModelError(f"simulation.unmeasured: nothing of {source.name} is left to measure; leave one out")
        _known("truth", self.truth, source.params)
        _known("initial", self.initial, source.states)
        truth = self._truth(source)
        if not source.states:
            columns = self._static(source, truth)
        elif self.layout == "transitions":
            columns = self._transitions(source, truth)
        else:
            columns = self._trajectories(source, truth)
        left_out = {f"{part}{name}" for name in self.unmeasured for part in ("", *NEXT)}
        columns = {name: values for name, values in columns.items() if name not in left_out}
        if self.test_fraction:
            rows = np.arange(self.episodes * self.steps)
            columns["split"] = self._split(
                columns["episode"] if source.states and self.layout == "trajectories" else rows
            )
        return Simulation(columns, self._card(source, truth, columns))

    @property
    def _streams(self) -> Streams:
        return Streams(self.seed)

    @property
    def _sensors(self) -> Sensors:
        return Sensors(self._streams, self.noise_std)

    def _truth(self, source: Model | World) -> np.ndarray:
        """Return the parameter vector (dp,); what is given replaces a draw and leaves the other draws as they were."""
        drawn = draw(source.params, self._streams.of("params"), 1)[0]
        return np.array([self.truth.get(q.name, value) for q, value in zip(source.params, drawn, strict=True)])

    def _trajectories(self, source: Model | World, truth: np.ndarray) -> dict[str, np.ndarray]:
        n, steps = self.episodes, self.steps
        inputs = np.zeros((n, steps, len(source.inputs)))
        for i, quantity in enumerate(source.inputs):
            for k in range(n):
                stream = self._streams.of(f"input.{quantity.name}", k)
                inputs[k, :, i] = self.excitation.signal(stream, steps, source.dt, quantity)
        states = on_rows(source, self._initial(source), inputs, np.tile(truth, (n, 1)))
        columns = {"episode": np.repeat(np.arange(n), steps), "t": np.tile(source.dt * np.arange(steps), n)}
        for i, quantity in enumerate(source.states):
            columns[quantity.name] = self._measured(quantity, states[:, :, i])
        for i, quantity in enumerate(source.inputs):
            columns[quantity.name] = inputs[:, :, i].ravel()
        flat = (states.reshape(n * steps, -1), inputs.reshape(n * steps, -1), np.tile(truth, (n * steps, 1)))
        return columns | self._outputs(source, flat, (n, steps))

    def _transitions(self, source: Model | World, truth: np.ndarray) -> dict[str, np.ndarray]:
        """Independent rows: a state, an input and the state dt later."""
        n = self.episodes * self.steps
        ranges = [self._initial_range(q) for q in source.states]
        before = np.column_stack([
            self._streams.of(f"initial.{q.name}").uniform(*ends, n) for q, ends in zip(source.states, ranges, strict=True)
        ])  # fmt: skip
        inputs = np.zeros((n, len(source.inputs)))
        for i, q in enumerate(source.inputs):
            inputs[:, i] = self._streams.of(f"input.{q.name}").uniform(q.low, q.high, n)
        params = np.tile(truth, (n, 1))
        step = RK4(source).step if isinstance(source, Model) else source.step
        after = step(before, inputs, params)
        check_finite(source, after, source.dt)
        columns = {}
        for i, q in enumerate(source.states):
            now = before[:, i]
            columns[q.name] = self._sensors.read(q, now) if self.noise_on == "both" else wrapped(q, now)
            columns[f"next_{q.name}"] = self._sensors.read(q, after[:, i], stream="next_noise")
            columns[f"exact_next_{q.name}"] = wrapped(q, after[:, i])
        columns |= {q.name: inputs[:, i] for i, q in enumerate(source.inputs)}
        return columns | self._outputs(source, (before, inputs, params), (1, n))

    def _static(self, source: Model | World, truth: np.ndarray) -> dict[str, np.ndarray]:
        """Rows of inputs uniform on their ranges, and the outputs there."""
        n = self.episodes * self.steps
        columns = {q.name: self._streams.of(f"input.{q.name}").uniform(q.low, q.high, n) for q in source.inputs}
        inputs = np.column_stack(list(columns.values())) if columns else np.zeros((n, 0))
        return columns | self._outputs(source, (np.zeros((n, 0)), inputs, np.tile(truth, (n, 1))), (1, n))

    def _outputs(
        self, source: Model | World, rows: tuple[np.ndarray, np.ndarray, np.ndarray], shape: tuple[int, int]
    ) -> dict[str, np.ndarray]:
        if not isinstance(source, Model) or not source.outputs:
            return {}
        values = RK4(source).measure(*rows)
        return {q.name: self._measured(q, values[:, i].reshape(shape)) for i, q in enumerate(source.outputs)}

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

    def _measured(self, quantity: Quantity, values: np.ndarray) -> np.ndarray:
        """Return what is recorded of the values (episodes, steps) of one quantity; one value per row."""
        return np.concatenate([self._sensors.read(quantity, exact, k) for k, exact in enumerate(values)])

    def _split(self, groups: np.ndarray) -> np.ndarray:
        n = int(groups[-1]) + 1
        if n < 2:
            raise ModelError(
                "simulation.test_fraction: one episode cannot be split into train and test; set simulation.episodes: 2 "
                "or more, or simulation.test_fraction: 0"
            )
        n_test = min(max(round(self.test_fraction * n), 1), n - 1)
        return np.where(groups >= n - n_test, "test", "train")

    def _card(self, source: Model | World, truth: np.ndarray, columns: dict[str, np.ndarray]) -> dict[str, Any]:
        units = ({"t": "s"} if self.layout == "trajectories" else {}) | {
            q.name: q.unit for q in (*source.states, *source.inputs, *source.outputs)
        }
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
            "noise_std": {q.name: float(self.noise_std.get(q.name, 0)) for q in measured},
        }
        if source.states and self.layout == "transitions":
            card |= {"layout": self.layout, "noise_on": self.noise_on}
        elif source.states:
            card["excitation"] = excitation
        if source.states:
            card["initial"] = {q.name: list(self._initial_range(q)) for q in source.states if q in measured}
        if not self.hide_truth:
            card["truth"] = {q.name: float(value) for q, value in zip(source.params, truth, strict=True)}
        return card


def _bare(column: str, known: Iterable[str]) -> str:
    """Return the quantity that a column is about."""
    return column if column in known else column.removeprefix("exact_").removeprefix("next_")


def _known(key: str, given: Iterable[str], quantities: tuple[Quantity, ...]) -> None:
    names = [quantity.name for quantity in quantities]
    for name in given:
        if name not in names:
            refuse_unknown(f"simulation.{key}.{name}", "no such name", name, names)
