"""What a data YAML may say: the schema, its defaults and its validation."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from simpel_cli.data.sensor_keys import SENSOR, read_sensor
from simpel_cli.data.timing.keys import JOIN, LATENCY, Join, read_join, read_latency, read_times
from simpel_cli.errors import ConfigError, did_you_mean
from simulators.expression import ExpressionError, symbols_used
from simulators.quantity import BETWEEN_ROWS

LAYOUTS = ("trajectories", "transitions")
CHOICES = ("random", "first")
LAWS = ("auto", "gaussian", "student_t")
NOISE = ("law", "scale")
SPLIT_BY = ("episode", "time")
OF_INPUTS = {  # what to do where one is named
    "noise.scale": "only states and outputs are measured with noise. An input may stand in the expression of one of them.",
    "latency": "only states and outputs are recorded late. One that acts late is sim.inputs.{0}.delay.",
    "sensor": "only states and outputs have a sensor that saturates. What acts is its column: clip it there.",
    "times": "the times of inputs are those of the rows, data.time. Only states and outputs have clocks of their own.",
}
SPLIT_DEFAULT: dict[str, Any] = {"test_fraction": 0.25, "by": "episode"}


@dataclass(frozen=True)
class Measurements:
    """Files of measurements and how they map onto a simulator.

    Args:
        path: a file (.parquet, .csv, .mat, .h5, .hdf5, .mcap, .db3, or the folder of a rosbag2), a pattern of files with `*`,
            `**`, `?` and `{name}`, whose text becomes a column, e.g. `runs/*/mass{mass}_*.csv`, or a list of these with the
            same columns (an empty one: nothing was measured);
            relative paths are tried against the config file's folder, then the working one. An episode never runs on
            from one file into the next: where their names are the same in two files, or none are given, they are called
            by the file's name.
        time: column of the time, s. Without it, a row is one `dt` of the simulator.
        episode: column that names the episode of a row. Without it, the file is one episode.
        columns: quantity of the simulator -> column; null = not measured; left out = a column of the same name.
        computed: new column -> formula in columns of the file, e.g. `{v: vx*cos(theta) + vy*sin(theta)}`.
        split: `{column: name}` with the values train and test (other values are left out and counted; `test: [names]` where the
            test is called otherwise), or
            `{test_files: [test.csv]}`: these of the files in `path` to test on, the others to train on, or
            `{test_fraction: 0.25, by: episode|time}`: whole episodes, or the last fraction of each episode; 0: all is
            trained on and nothing judged. A single
            episode of a simulator without states is split by rows, drawn at random: none depends on another.
        noise_std: standard deviation of the measurement noise per state or output, in its unit; it describes the rows
            at the simulator's dt and is estimated where absent, and then no less than step/sqrt(12) of a sensor that is
            quantised more coarsely than its noise.
        noise: `{law: gaussian}`, or `student_t` with degrees of freedom that are learned per output, for measurements of which
            some lie far off; `auto`: what the training rows say, by their leave-one-out log score.
            `scale: {y: 0.01 + 0.05*abs(y)}`: how the scale of the noise of a measured state or output goes with the states,
            inputs and outputs of its row, in their units. Only the shape matters: how large the noise is, is learned.
        resample: s; bring the rows to this dt (the simulator's) with an anti-aliasing filter.
        layout: `trajectories` (rows follow each other) or `transitions` (next values in `next_<state column>`).
        n_train: number of training transitions to use; null = all, 0 = none: the posterior is the prior.
        choice: which ones: `random` (seeded; the smaller set is part of the larger one) or `first`.
        seed: of the split and of the choice; null = the run's seed.
        n_episodes: use the first so many training episodes; null = all.
        units: quantity of the simulator -> unit of its column, compared with the simulator's. Also read from Parquet
            field metadata (`unit`) and from `card.yaml` beside the file (`columns: {phi: {unit: rad}}`).
        stack_actions: number of past inputs that a transition carries along.
        max_gap: s; a longer distance between two rows cuts the episode; null = 1.5 dt, of the data or, if that is longer,
            of what they are resampled to.
        derived: states whose column was computed from another column, e.g. a speed that was differentiated from the
            position: `discover` does not take them for measurements. A plain difference is found without this.
        between_rows: input -> `held` at the value of its row until the next, `linear`, straight to the value of the next row,
            or `smooth`, a curve through the rows; in place of what the simulator says. Held where neither says anything
            (`discover` then compares all three).
        latency: state or output -> how old its value is when it is recorded, s: in a row at t is what was measured at
            t - latency. In place of `sim.outputs.y.delay`. Or [low, high]: `discover` estimates it.
        times: state or output -> column of the time at which it was measured, s, of a sensor with a clock of its own: its
            values belong to the row at or after that time. Needs `time`.
        join: tables of other sensors, `{path, time, columns, episode}` each: their values belong to the row of `path` at or
            after their `time` (s, on the same clock). `columns`: those that are taken; left out: all that `path` does not
            have. `episode`: column of the names that `data.episode` has, too; left out: the column of that name, or by time
            alone. Needs `time`; inputs come from `path`.
        sensor: state or output -> `{saturates: [low, high]}`, what its sensor records at most, in its unit; null: no end. A
            value at an end says that the quantity is there or beyond: of an output it is trained on and scored as that, of a
            state it is a missing value, and so it is of both in `discover`.
        groups: columns that name groups of episodes, e.g. the ball, the payload, the subject: `discover` asks by itself whether
            parameters of the simulator, or effects, differ from group to group.

    Raises:
        ConfigError: a value that is not allowed; the message names `data.<key>`.
    """

    path: str | tuple[str, ...]
    time: str | None = None
    episode: str | None = None
    columns: Mapping[str, str | None] = field(default_factory=dict)
    computed: Mapping[str, str] = field(default_factory=dict)
    split: Mapping[str, Any] = field(default_factory=lambda: dict(SPLIT_DEFAULT))
    noise_std: Mapping[str, float | int] = field(default_factory=dict)
    noise: Mapping[str, Any] = field(default_factory=dict)
    resample: float | int | None = None
    layout: str = "trajectories"
    n_train: int | None = None
    choice: str = "random"
    seed: int | None = None
    n_episodes: int | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    stack_actions: int = 0
    max_gap: float | int | None = None
    derived: tuple[str, ...] = ()
    between_rows: Mapping[str, str] = field(default_factory=dict)
    latency: Mapping[str, Any] = field(default_factory=dict)
    times: Mapping[str, str] = field(default_factory=dict)
    join: tuple[Mapping[str, Any], ...] = ()
    sensor: Mapping[str, Any] = field(default_factory=dict)
    groups: tuple[str, ...] = ()

    sections: ClassVar[dict[str, Any]] = {  # JSON schemas of fields whose type says too little
        "layout": {"enum": list(LAYOUTS)},
        "choice": {"enum": list(CHOICES)},
        "split": {
            "type": "object",
            "properties": {
                "column": {"type": "string"},
                "test": {"type": "array", "items": {"type": "string"}, "minItems": 1},
                "test_files": {"type": "array", "items": {"type": "string"}, "minItems": 1},
                "test_fraction": {"type": "number", "minimum": 0, "exclusiveMaximum": 1},
                "by": {"enum": list(SPLIT_BY)},
            },
            "additionalProperties": False,
        },
        "noise": {
            "type": "object",
            "properties": {
                "law": {"enum": list(LAWS)},
                "scale": {"type": "object", "additionalProperties": {"type": ["string", "number"]}},
            },
            "additionalProperties": False,
        },
        "between_rows": {"type": "object", "additionalProperties": {"enum": list(BETWEEN_ROWS)}},
        "latency": LATENCY,
        "join": JOIN,
        "sensor": SENSOR,
    }

    def __post_init__(self) -> None:
        if not all(isinstance(path, str) and path for path in self.paths):
            raise ConfigError(f"data.path: {self.path!r} is not allowed, only the name of a file or a list of names.")
        _one_of("layout", self.layout, LAYOUTS)
        _one_of("choice", self.choice, CHOICES)
        _positive("resample", self.resample)
        _positive("max_gap", self.max_gap)
        _whole("n_train", self.n_train, 0)
        _whole("n_episodes", self.n_episodes, 1)
        _whole("seed", self.seed, 0)
        _whole("stack_actions", self.stack_actions, 0)
        for name, std in self.noise_std.items():
            _positive(f"noise_std.{name}", std)
        for key in self.noise:
            if key not in NOISE:
                raise ConfigError(
                    f"data.noise.{key}: no such key, only {' or '.join(NOISE)}.{did_you_mean(key, NOISE)}"
                )
        _check_scale(self.noise.get("scale"))
        _one_of("noise.law", self.noise.get("law", "auto"), LAWS)
        for name, word in self.between_rows.items():
            _one_of(f"between_rows.{name}", word, BETWEEN_ROWS)
        if not isinstance(self.groups, list | tuple) or not all(
            isinstance(c, str) and c.isidentifier() for c in self.groups
        ):
            raise ConfigError(
                f"data.groups: {self.groups!r} is not allowed, only a list of names of columns (letters, digits, underscores)."
            )
        _check_split(self.split)
        read_latency(self.latency)
        read_times(self.times, self.time)
        read_sensor(self.sensor)
        _ = self.joined
        if self.layout == "transitions" and self.stack_actions:
            raise ConfigError(
                f"data.stack_actions: {self.stack_actions} past inputs are not known in layout 'transitions', whose "
                "rows do not follow each other. Set data.stack_actions: 0, or store trajectories."
            )
        if self.layout == "transitions" and self.resample is not None:
            raise ConfigError(
                "data.resample: rows of layout 'transitions' cannot be resampled. Set data.resample: null."
            )
        if self.resample is not None and self.time is None:
            raise ConfigError(
                "data.resample: the distance of the rows is not known. Name the column of the time: data.time: <name>."
            )

    @property
    def all_train(self) -> bool:
        """Whether nothing is kept to test on."""
        return not self.paths or self.split.get("test_fraction") == 0

    @property
    def paths(self) -> tuple[str, ...]:
        """The files, one or several."""
        return (self.path,) if isinstance(self.path, str) else tuple(self.path)

    @property
    def joined(self) -> tuple[Join, ...]:
        """The tables of other sensors."""
        return read_join(self.join, self.time)

    def ends(self) -> dict[str, tuple[float, float]]:
        """Return the lowest and the highest value that a sensor records, infinite where there is no end."""
        return read_sensor(self.sensor)

    def known_latency(self) -> dict[str, float]:
        """Return how old the values of a column are when they are recorded, s, where it is a number."""
        return {name: value for name, value in read_latency(self.latency).items() if isinstance(value, float)}

    def latency_ranges(self) -> dict[str, tuple[float, float]]:
        """Return between which ends that is, s, where it is to be estimated."""
        return {name: value for name, value in read_latency(self.latency).items() if isinstance(value, tuple)}

    def latency_over(self, latency: Mapping[str, float]) -> dict[str, float]:
        """Return the known latencies of a simulator and of these data, s, which precede; a range takes one away."""
        return {name: s for name, s in latency.items() if name not in self.latency} | self.known_latency()

    @property
    def law(self) -> str:
        """Law of the noise: auto, gaussian or student_t."""
        return str(self.noise.get("law", "auto"))

    @property
    def noise_scale(self) -> Mapping[str, Any]:
        """Scale of the noise, state or output -> expression; empty: the same in every row."""
        return self.noise.get("scale") or {}

    def seed_or(self, run_seed: int) -> int:
        """Return the seed of the split and of the choice: its own if declared, else the run's."""
        return run_seed if self.seed is None else self.seed

    def check_names(self, quantities: tuple[str, ...], measurable: tuple[str, ...]) -> None:
        """Compare the keys with the simulator.

        Args:
            quantities: names of all states, inputs and outputs.
            measurable: names of the states and outputs, which can have noise; the others are inputs.

        Raises:
            ConfigError: a key that the simulator does not have.
        """
        for key, names, allowed in (
            ("columns", self.columns, quantities),
            ("units", self.units, quantities),
            ("noise_std", self.noise_std, measurable),
            ("noise.scale", self.noise_scale, measurable),
            ("derived", self.derived, measurable),
            ("between_rows", self.between_rows, tuple(name for name in quantities if name not in measurable)),
            ("latency", self.latency, measurable),
            ("times", self.times, measurable),
            ("sensor", self.sensor, measurable),
        ):
            for name in names:
                if name not in allowed:
                    if key in OF_INPUTS and name in quantities:
                        raise ConfigError(f"data.{key}.{name}: {name} is an input; {OF_INPUTS[key].format(name)}")
                    of_sensors = dict.fromkeys(("latency", "times", "sensor", "noise.scale"), "state or output")
                    what = (of_sensors | {"between_rows": "input"}).get(key, "quantity")
                    raise ConfigError(
                        f"data.{key}.{name}: the simulator has no such {what} (it has: {', '.join(allowed)})."
                        + did_you_mean(name, list(allowed))
                    )


def _one_of(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        hint = did_you_mean(str(value), list(allowed))
        raise ConfigError(f"data.{key}: {value!r} is not allowed, only {' or '.join(allowed)}.{hint}")


def _check_scale(scale: Any) -> None:
    if scale is not None and not isinstance(scale, Mapping):
        raise ConfigError(
            f"data.noise.scale: {scale!r} is not allowed, only expressions by name, e.g. {{y: 0.01 + 0.05*abs(y)}}."
        )
    for name, formula in (scale or {}).items():
        if not isinstance(formula, str):
            if not (_is_number(formula) and 0 < formula < float("inf")):
                raise ConfigError(
                    f"data.noise.scale.{name}: {formula!r} is not allowed, only an expression of the row or a positive number. "
                    f"Write one, e.g. 0.01 + 0.05*abs({name}), or leave {name} out: its noise is then the same in every row."
                )
            continue
        try:
            symbols_used(formula)
        except ExpressionError as error:
            raise ConfigError(f"data.noise.scale.{name}: {error}") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _positive(key: str, value: Any) -> None:
    if value is not None and not (_is_number(value) and 0 < value < float("inf")):
        raise ConfigError(f"data.{key}: {value!r} is not allowed, only a positive number.")


def _whole(key: str, value: Any, least: int) -> None:
    if value is not None and not (isinstance(value, int) and not isinstance(value, bool) and value >= least):
        raise ConfigError(f"data.{key}: {value!r} is not allowed, only a whole number of at least {least}.")


def _check_split(split: Mapping[str, Any]) -> None:
    forms = "{column: <name>, test: [<value>]}, {test_files: [<file>]} or {test_fraction: 0.25, by: episode|time}"
    allowed = ("column", "test", "test_files", "test_fraction", "by")
    for key in split:
        if key not in allowed:
            raise ConfigError(f"data.split.{key}: no such key, only {forms}.{did_you_mean(key, list(allowed))}")
    others = set(split) - {"column", "test"} if "column" in split else set(split) - {"test_files"}
    if (
        not split
        or (others and ("column" in split or "test_files" in split))
        or ("test" in split and "column" not in split)
    ):
        raise ConfigError(f"data.split: {dict(split)} is not allowed, only {forms}.")
    if "test_files" in split:
        files = split["test_files"]
        if not (isinstance(files, list | tuple) and files and all(isinstance(file, str) and file for file in files)):
            raise ConfigError(f"data.split.test_files: {files!r} is not a list of files, e.g. [test.csv].")
        return
    if "column" in split:
        if not isinstance(split["column"], str):
            raise ConfigError(f"data.split.column: {split['column']!r} is not the name of a column.")
        test = split.get("test", ["test"])
        if not (isinstance(test, list | tuple) and test and all(isinstance(name, str) and name for name in test)):
            raise ConfigError(
                f"data.split.test: {test!r} is not a list of values of the column, e.g. [test_slow, test_fast]."
            )
        return
    fraction = split.get("test_fraction", SPLIT_DEFAULT["test_fraction"])
    if not (_is_number(fraction) and 0 <= fraction < 1):
        raise ConfigError(
            f"data.split.test_fraction: {fraction!r} is not allowed, only a number from 0 up to, not with, 1."
        )
    _one_of("split.by", split.get("by", SPLIT_DEFAULT["by"]), SPLIT_BY)
