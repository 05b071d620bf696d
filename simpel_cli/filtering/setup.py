"""From a simulator, measurements and a catalogue of effects to everything that a search needs."""

from collections.abc import Collection, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.filtering.likelihood.augmented import Augmented, augment
from simpel_cli.filtering.likelihood.coordinates import Coordinates, coordinates_of
from simpel_cli.filtering.likelihood.filter import filter_of
from simpel_cli.filtering.likelihood.remainders import remainders_of
from simpel_cli.filtering.likelihood.track import Filter
from simpel_cli.filtering.measurements import windows as windows_
from simpel_cli.filtering.measurements.integration_steps import substeps_needed
from simpel_cli.filtering.measurements.windows import LEAST_EPISODES, Windows, clocked, padded, thinned, windows_of
from simulators.effects import Expression, Scales, Store, Term, stores_of, unnamed, with_stores
from simulators.effects.term import (
    BACKLASH,
    BETWEEN_ROWS,
    DELAY,
    LAG,
    RATE_LIMIT,
    SENSOR_DELAY,
    SENSOR_LAG,
    EffectParameter,
)
from simulators.model import Model, ModelError

LEAST_ROWS = 30  # of all training episodes: below, a search would only read noise
MOST_SPARE = 4  # times the rows of a search: windows that are held out for free
Q_BOUNDS = (1e-4, 3.0)  # of the process noise, in typical rates times sqrt(dt)

Key: TypeAlias = tuple[str, str, tuple[str, ...]]
MOST_PADDED = 4  # times the rows that windows of one length may have in all
MOST_GROUPED = 2  # effects that differ between groups and act at once
EMPTY = 0.1  # of its size: how far a state that an effect brings along may be from 0 where it begins there
UNKNOWN_NOISE = 0.01  # of a channel's magnitude, where its noise begins if nothing tells it
PLAY_ROWS = (
    24  # of the past before a window of a cut record: where an input is in its play, or on its way, is mostly settled
)


class Setup(NamedTuple):
    """What a search works with."""

    augmented: Augmented
    rule: Filter
    coordinates: Coordinates
    windows: Windows
    spare: Windows | None  # of the training episodes, that the search leaves out to be quick: held out for free
    scales: Scales
    start: np.ndarray  # (n,) unit coordinates with every effect switched off
    lead: int
    substeps: int
    clocked: bool  # rows follow their time stamps; else they are dt apart
    optimum: np.ndarray | None = None  # (n,) unit coordinates of the simulator alone, where it was calibrated already


def setup(
    model: Model,
    recording: Recording,
    declared_noise: Sequence[str],
    effects: Sequence[Expression],
    substeps: int | None = None,
    *,
    pairs: bool = False,
    kept: Collection[Key] | None = None,
    extra: Sequence[Term] = (),
    most_rows: int | None = None,
    simulated: bool = False,
) -> Setup:
    """Attach every effect, cut the training episodes into windows and bind the filter.

    Args:
        model: the simulator.
        recording: its measurements.
        declared_noise: names of the channels whose noise the user declared.
        effects: the catalogue, or what of it is to be tried.
        substeps: Runge-Kutta steps per row; None: as many as the noise asks for.
        pairs: offer functions of two arguments.
        kept: terms to attach; None: all.
        extra: terms to attach beside them.
        most_rows: of the windows, about; None: all.
        simulated: every episode is one simulation; what it leaves is no noise of the process but has a memory of its own in
            every channel (see `remainders`).

    Raises:
        DataError: too few rows.
    """
    rows = sum(len(e.time) for e in recording.train)
    if rows < LEAST_ROWS:
        raise DataError(
            f"data: {rows} training rows; discover needs at least {LEAST_ROWS} to tell a missing effect from noise. "
            "Record more, or leave fewer for the test split (data.split)."
        )
    if any(e.next_states is not None for e in recording.train):
        raise DataError(
            "data.layout: discover follows episodes in time; give layout `trajectories`, not `transitions`."
        )
    measured = measured_of(model, recording)
    scales = scales_of(model, recording.train, measured, recording.outputs)
    every = terms_of(model, recording, effects, pairs=pairs)
    added = {key_of(t) for t in extra}
    terms = [t for t in every if key_of(t) not in added and (kept is None or key_of(t) in kept)]
    terms += extra
    given, stores = model, tuple(sorted(stores_of(terms)))  # in an order that does not depend on which terms there are
    if stores:
        model, scales = with_stores(model, stores), _with_sizes(scales, stores)
    if simulated:
        remainders = remainders_of(model, measured, recording.train, recording.outputs, scales)
        model, scales = remainders.model, remainders.scales
    augmented = augment(model, terms, measured, remainders.states if simulated else None)
    # of all of them, so that windows do not depend on what is kept
    longest = max((k.high for t in every if t.kind in (DELAY, LAG) for k in t.parameters), default=0.0)
    lead = int(np.ceil((longest + model.memory()) / model.dt)) + 2
    if any(t.kind in (BACKLASH, RATE_LIMIT) for t in every):
        lead = max(lead, PLAY_ROWS)
    spread = spread_of(scales, model)
    timed = clocked([*recording.train, *recording.test], model.dt)
    windows = windows_of(
        recording.train, [q.name for q in model.states], measured, recording.outputs, centre_of(model), spread, lead=lead,
        dt=model.dt, clocked=timed, at_least=4 if len(recording.train) < 4 else 1,
    )  # fmt: skip
    windows = _filled(windows, model, stores, measured, scales)
    windows, spare = thinned(windows, most_rows) if most_rows is not None else (windows, None)
    if spare is not None and most_rows is not None:
        # whole episodes are held out where there are enough, and of very long records a part tells enough
        spare = None if len(np.unique(windows.episode)) >= LEAST_EPISODES else thinned(spare, MOST_SPARE * most_rows)[0]
    # of a sensor that speaks seldom its values do not tell the noise: the calibration does
    known = {name: recording.noise_std.get(name, UNKNOWN_NOISE * scales.size[name]) for name in measured}
    noise_std = {name: max(known[name], 1e-9 * scales.size[name]) for name in measured}
    r = np.array(list(noise_std.values()))
    if substeps is None:
        substeps = substeps_needed(given, recording.train, noise_std, scales, augmented.neutral[: len(given.params)])
    rule = filter_of(augmented, substeps=substeps, lead=lead)
    typical = np.array([scales.rate[model.states[i].name] * np.sqrt(model.dt) for i in augmented.driven])
    coordinates = coordinates_of(
        augmented,
        r,
        np.array([name in declared_noise for name in measured]),
        np.array([scales.size[name] for name in measured]),
        typical * Q_BOUNDS[0],
        typical * Q_BOUNDS[1],
        np.array([recording.least_noise.get(name, 0.0) for name in measured]),
    )
    n_p, n_r, n_q = coordinates.sizes
    start = np.full(len(coordinates.low), 0.5)
    effect_rows = np.arange(len(model.params), n_p)  # parameters of effects
    span = coordinates.high[effect_rows] - coordinates.low[effect_rows]
    # not cut to the bounds: a neutral value may lie beyond them
    neutral = augmented.neutral[effect_rows]
    neutral = np.where(coordinates.log[effect_rows], np.log(np.maximum(neutral, 1e-300)), neutral)
    start[effect_rows] = (neutral - coordinates.low[effect_rows]) / np.where(span > 0, span, 1.0)
    start[n_p : n_p + n_r] = coordinates.unit(np.arange(n_p, n_p + n_r), r)
    start[n_p + n_r : n_p + n_r + n_q] = coordinates.unit(np.arange(n_p + n_r, n_p + n_r + n_q), 0.5 * typical)
    return Setup(augmented, rule, coordinates, windows, spare, scales, start, lead, substeps, timed)


def measured_of(model: Model, recording: Recording) -> tuple[str, ...]:
    """Return the names of the measured states and outputs."""
    return tuple([q.name for q in model.states if q.name not in recording.estimated] + list(recording.outputs))


def terms_of(model: Model, recording: Recording, effects: Sequence[Expression], *, pairs: bool = False) -> list[Term]:
    """Return every effect at every place, and the functions without a name.

    Raises:
        ConfigError: an effect that names what the model does not have.
    """
    measured = measured_of(model, recording)
    scales = scales_of(model, recording.train, measured, recording.outputs)
    try:
        named = [t for e in effects if not e.states for t in e.attach(model, scales, measured)]
    except ModelError as error:
        raise ConfigError(str(error)) from error
    # what is late already is calibrated: a second delay of the same signal could not be distinguished from the first
    late = {DELAY: model.delay, LAG: model.lag, SENSOR_DELAY: model.sensor_delay, SENSOR_LAG: model.sensor_lag}
    return [t for t in named if t.acts_on not in late.get(t.kind, ())] + unnamed(model, scales, pairs=pairs)


def with_memory(model: Model, recording: Recording, effects: Sequence[Expression]) -> list[Term]:
    """Return every effect that brings a state along, at every place: no program carries them all.

    Raises:
        ConfigError: an effect that names what the model does not have.
    """
    measured = measured_of(model, recording)
    scales = scales_of(model, recording.train, measured, recording.outputs)
    try:
        return [t for e in effects if e.states for t in e.attach(model, scales, measured)]
    except ModelError as error:
        raise ConfigError(str(error)) from error


def questions(model: Model) -> list[Term]:
    """Return one term per input of which nothing is said: the way from held over linear to smooth between rows."""
    way = EffectParameter("", "way", "1", 0.0, 1.0, 0.0, (1.0,))
    return [
        Term(
            "moving_input", q.name, BETWEEN_ROWS, "", (way._replace(name=f"moving_input_{q.name}_way"),),
            "an input that moves from a row to the next",
        )
        for q in model.inputs
        if q.name not in model.between_rows and q.name not in model.covariates and model.states
    ]  # fmt: skip


def members(plan: Setup) -> int:
    """Return the number of groups that the two terms have with the most of them: room that a hypothesis needs for these."""
    counts = sorted(sum(len(g.names) for g in t.groupings) for t in plan.augmented.terms)
    return sum(counts[-MOST_GROUPED:])


def key_of(term: Term) -> Key:
    """Return what a term is called by: effect, place, arguments."""
    return term.effect, term.acts_on, term.depends_on


def centre_of(model: Model) -> np.ndarray:
    """Guess of states that nothing measures, (nx,): 0 where they have both signs, an empty tank tells no outflow."""
    return np.array([0.0 if q.low < 0 < q.high else (q.low + q.high) / 2 for q in model.states])


def scales_of(model: Model, episodes: Sequence[Episode], measured: Sequence[str], outputs: Sequence[str]) -> Scales:
    """Read the magnitudes of all quantities off the measurements; of what is not measured, off its range and the model."""
    states = np.concatenate([e.states for e in episodes])
    inputs = np.concatenate([e.inputs for e in episodes])
    values = np.concatenate([e.outputs for e in episodes])
    size: dict[str, float] = {}
    rate: dict[str, float] = {}
    declared = _declared_rates(model, states, inputs)
    for i, q in enumerate(model.states):
        known = q.name in measured
        size[q.name] = float(np.nanmax(np.abs(states[:, i]))) if known else max(abs(q.low), abs(q.high))
        rate[q.name] = max(
            float(np.std(_rates(episodes, i, model.dt))) if known else declared[i], 1e-9 * (q.high - q.low)
        )
    for j, q in enumerate(model.inputs):
        size[q.name] = float(np.nanmax(np.abs(inputs[:, j])))
    for k, name in enumerate(outputs):
        size[name] = float(np.nanmax(np.abs(values[:, k])))
    return Scales({k: max(v, 1e-9) for k, v in size.items()}, rate, model.dt)


def _rates(episodes: Sequence[Episode], i: int, dt: float) -> np.ndarray:
    """Return the rate of a state from each of its values to the next that is there."""
    columns = [(np.flatnonzero(np.isfinite(e.states[:, i])), e.states[:, i]) for e in episodes]
    return np.concatenate([np.diff(values[there]) / (np.diff(there) * dt) for there, values in columns])


def _declared_rates(model: Model, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Root mean square of the model's rates at what was measured, anything in its range where it was not, (nx,)."""
    random = np.random.default_rng(0)
    rows = np.unique(np.linspace(0, len(states) - 1, min(len(states), 500)).astype(int))
    low, high = (np.array([getattr(q, end) for q in model.states]) for end in ("low", "high"))
    x = np.where(np.isfinite(states[rows]), states[rows], random.uniform(low, high, (len(rows), len(low))))
    p = np.array([(q.low + q.high) / 2 for q in model.params])
    rates = np.asarray(model.function()(x.T, np.nan_to_num(inputs[rows]).T, np.tile(p[:, None], len(rows)))[0])
    rates = np.where(np.isfinite(rates), rates, np.nan)
    return np.where(np.isfinite(rates).any(axis=1), np.sqrt(np.nanmean(rates**2, axis=1)), (high - low) / 2)


def whole_windows(
    plan: Setup, episodes: Sequence[Episode], outputs: Sequence[str], longest: int | None = None
) -> Windows:
    """Cut episodes into windows like those of the search, each as long as its episode, or as `longest` (`LONGEST_RUN`).

    Windows are equally long: beside many short episodes a very long one is cut, so that not most of them is padding.
    """
    model, longest = plan.augmented.model, longest or windows_.LONGEST_RUN
    measured, stores = plan.augmented.measured, stores_of(plan.augmented.terms)
    while longest > windows_.LONGEST_RUN and padded([len(e.time) for e in episodes], longest) > MOST_PADDED:
        longest //= 2
    whole = windows_of(
        episodes, [q.name for q in model.states], measured, outputs, centre_of(model), spread_of(plan.scales, model),
        lead=plan.lead, dt=model.dt, clocked=plan.clocked,
        longest=longest,
    )  # fmt: skip
    return _filled(whole, model, stores, measured, plan.scales)


def spread_of(scales: Scales, model: Model) -> np.ndarray:
    """Return the standard deviation of a first state about its guess, (nx,)."""
    return np.array([max(scales.size[q.name], 1e-12) for q in model.states])


def _with_sizes(scales: Scales, stores: Sequence[Store]) -> Scales:
    """Return scales with those of states that effects bring along; no noise acts on these, whatever their rates are."""
    size = {s.name: max(abs(s.low), abs(s.high), 1e-12) for s in stores}
    return scales._replace(size=scales.size | size, rate=scales.rate | size)


def _filled(
    windows: Windows, model: Model, stores: Sequence[Store], measured: Sequence[str], scales: Scales
) -> Windows:
    """Return windows in which states that effects bring along begin at what they follow, as if it had long been so.

    How far they are from it is not known: as far as that moves on the whole.
    """
    states, inputs = [q.name for q in model.states], [q.name for q in model.inputs]
    start, spread = windows.start.copy(), windows.spread.copy()
    for store in stores:
        i = states.index(store.name)
        start[:, i], spread[:, i] = 0.0, EMPTY * scales.size[store.name]
        if store.begins in inputs:
            first = windows.u[:, windows.lead, inputs.index(store.begins)]
            start[:, i], spread[:, i] = first, np.std(windows.u[..., inputs.index(store.begins)])
        elif store.begins in states:
            start[:, i] = windows.start[:, states.index(store.begins)]
            there = store.begins in measured
            values = windows.y[..., measured.index(store.begins)] if there else np.zeros(0)
            known = values[windows.ok[..., measured.index(store.begins)] > 0] if there else values
            spread[:, i] = np.std(known) if len(known) else scales.size[store.begins]
    return windows._replace(start=start, spread=np.maximum(spread, 1e-12))
