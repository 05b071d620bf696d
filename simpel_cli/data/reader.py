"""From a data YAML and a simulator to a `Recording`: find, read, check, cut, estimate, resample."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from simpel_cli.data.checks import clock, sensors, values
from simpel_cli.data.checks.noise import runs
from simpel_cli.data.checks.saturation import saturation
from simpel_cli.data.checks.units import check_units, period
from simpel_cli.data.column_noise import Told, column, column_noise, inside, noise_check
from simpel_cli.data.config import Measurements
from simpel_cli.data.estimation.derived_speeds import derived, differences
from simpel_cli.data.estimation.kinematics import Motion, kinematics
from simpel_cli.data.estimation.smoother import estimate_speeds, speeds
from simpel_cli.data.files import Files, read_files
from simpel_cli.data.groups import group_names, with_groups
from simpel_cli.data.recording import Check, Episode, Recording, Source
from simpel_cli.data.resample import resample
from simpel_cli.data.rows import Mapping, Rows, arrange, map_columns, named_episodes
from simpel_cli.data.split import PARTS, assign
from simpel_cli.data.tables.locate import by_file
from simpel_cli.data.time_gaps import cut_at_gaps
from simpel_cli.data.timing.when_measured import refuse_unplaced, when_measured
from simpel_cli.errors import ConfigError, DataError
from simulators.model import Model, Quantity
from simulators.quantity import HELD


def read(
    config: Measurements,
    model: Source,
    base: Path,
    seed: int,
    *,
    whole: bool = True,
    partial: bool | None = None,
    too_few: Callable[[Recording], bool] | None = None,
) -> Recording:
    """Read measurements for a simulator.

    Args:
        config: the data YAML.
        model: gives names, order, units, ranges and dt.
        base: folder of the config file; relative paths are tried there first, then in the working directory.
        seed: of the run; `config.seed` wins.
        whole: every state is needed in every row, so refuse one that is not measured and cannot be estimated; else it
            stays NaN.
        partial: rows may lack values, and values may be measured before their row (`Episode.late`); None: unless `whole`. With
            `whole`, the filter is to estimate what is missing (`filtering.estimated_rows`): rows still have to be dt apart.
        too_few: whether of partial rows there are too few to estimate what is missing, so that only whole rows count; None:
            never.

    Returns:
        Checked episodes, at least one each to train and to test on, unless the data YAML keeps none to test on.

    Raises:
        ConfigError: a key that does not fit the simulator.
        DataError: anything wrong with file, columns, rows or units.
    """
    known: dict[str, tuple[str, ...]] = {}
    if isinstance(model, Model) and model.base is not None:  # of a fit: its groups are known
        model, known = model.base, model.groups
    if not config.paths:
        return Recording((), (), (), dict(config.noise_std), (), (), ())
    measurable = (*model.states, *model.outputs)
    names = tuple(q.name for q in measurable)
    config.check_names((*names, *(q.name for q in model.inputs)), names)
    moving = [i for i, word in enumerate(model.words_between_rows) if word != HELD] if isinstance(model, Model) else []
    if moving and config.layout == "transitions":
        assert isinstance(model, Model)
        name, word = model.inputs[moving[0]].name, model.words_between_rows[moving[0]]
        key = "data" if name in config.between_rows else f"sim.inputs.{name}"
        raise ConfigError(
            f"{key}.between_rows: {name} is {word}, but the next value of an input is not known in layout 'transitions', whose "
            f"rows do not follow each other. Store trajectories, or set data.between_rows={{{name}: held}}."
        )
    files = read_files(config, model, base)
    recording = _recorded(files, model, known, base, seed, whole=whole, partial=partial)
    if too_few is not None and too_few(recording):
        return _recorded(files, model, known, base, seed, whole=whole, partial=False)
    return recording


def _recorded(
    files: Files,
    model: Source,
    known: dict[str, tuple[str, ...]],
    base: Path,
    seed: int,
    *,
    whole: bool,
    partial: bool | None,
) -> Recording:
    """Check and cut what the files hold; known: the groups of a fit; others as of `read`."""
    config, table, joined = files
    quantities = (*model.states, *model.outputs, *model.inputs)
    mapping = map_columns(config, model, table, joined)
    refuse_unplaced(config, model, mapping)
    dynamic = bool(model.states) and config.layout == "trajectories"

    units, cards = check_units(config, table, mapping.columns, quantities, joined, mapping.joined)
    notes = [note for each in (table, *(other.table for other in joined)) for note in each.notes]
    report = [Check("files", True, "; ".join(notes)), units] if notes else [units]
    measured = np.array([q.name in mapping.columns for q in model.states], dtype=bool)
    rows = arrange(config, model, table, mapping)
    # the filter of `discover` takes a row as it is; brought to another dt it has to be complete
    partial = (not whole if partial is None else partial) and dynamic and config.resample is None
    rows, when = when_measured(
        config, model, rows, table, mapping, joined, named_episodes(config, table, rows), partial=partial,
        ranges=not whole,
    )  # fmt: skip
    report += [when] if when is not None else []
    if config.sensor:
        ends, rows = saturation(config, model, rows, mapping)
        report.append(ends)
    finite, rows = values.finite(rows, measured, _column_names(config, model, mapping), partial=partial)
    split, rows = assign(*by_file(config, table, base), rows, dynamic, config.seed_or(seed))
    report += [finite, split]
    filled = values.filled(rows)
    report += [check(filled, model, mapping.outputs) for check in (values.constant, values.ranges)]
    groups: dict[str, tuple[str, ...]] = {}
    if isinstance(model, Model) and model.columns_of_groups:
        groups = known or group_names(model, table, rows)
        rows = with_groups(rows, table, groups)
    if config.layout == "transitions":
        parts = {part: _pairs(config, model, rows, part) for part in PARTS}
        told = Told({}, {}, {})  # rows that do not follow each other tell nothing of it
        computed: tuple[str, ...] = config.derived
    else:
        report.append(clock.monotonic(rows, table, config))
        parts, told, more, computed = _trajectories(config, model, rows, mapping, whole, partial=partial)
        report += more
    for part, episodes in parts.items():
        if not episodes and not (part == "test" and config.all_train):
            raise DataError(f"too few rows: no usable {part} transition is left. " + _what_failed(report))
    if partial:
        _refuse_silent(mapping, [q.name for q in model.states], parts["train"])
    return Recording(
        train=parts["train"],
        test=parts["test"],
        outputs=mapping.outputs,
        noise_std=told.std | {name: float(std) for name, std in config.noise_std.items()},
        estimated=mapping.unmeasured,
        checks=tuple(report),
        files=tuple(dict.fromkeys((*table.files, *(f for other in joined for f in other.table.files), *cards))),
        derived=tuple(name for name in computed if name in mapping.columns),
        groups=groups,
        least_noise=told.least,
    )


def _refuse_silent(mapping: Mapping, states: list[str], train: tuple[Episode, ...]) -> None:
    """Refuse a measured quantity without a value in all training episodes, of which nothing can be learned."""
    for i, name in enumerate([*states, *mapping.outputs]):
        if name not in mapping.columns:
            continue
        if not any(np.isfinite(np.concatenate([e.states, e.outputs], axis=1)[:, i]).any() for e in train):
            raise DataError(
                f"column '{mapping.columns[name]}' ({name}) has no value in any of {len(train)} training episodes. Say that it "
                f"was not measured, data.columns: {{{name}: null}}, or split otherwise (data.split)."
            )


def _trajectories(
    config: Measurements, model: Source, rows: Rows, mapping: Mapping, whole: bool, *, partial: bool
) -> tuple[dict[str, tuple[Episode, ...]], Told, list[Check], tuple[str, ...]]:
    """Episodes by split, noise by quantity, checks, states whose column was computed from another."""
    as_they_are = partial and not whole
    sampling, raw, longest = clock.sampling(rows, model, config, as_they_are=as_they_are)
    cut, starts = cut_at_gaps(rows, longest, config)
    tagged = _segments(model, rows, starts)
    measured = np.array([q.name in mapping.columns for q in model.states], dtype=bool)
    there = values.complete(rows, measured)
    if there.all():
        faults, computed = _sensors(config, model, mapping, [episode for _, episode in tagged], raw, as_they_are)
    elif there.sum() > len(there) / 2:  # faults of sensors show in rows that follow each other
        alone = rows.take(there)
        pieces = _segments(model, alone, cut_at_gaps(alone, longest, config)[1])
        faults, computed = _sensors(config, model, mapping, [episode for _, episode in pieces], raw, as_they_are)
    else:
        faults, computed = _sensors(
            config, model, mapping, [episode for _, episode in tagged], raw, as_they_are, together=False
        )
    report = [sampling, cut, *faults]
    episodes = tuple(episode for part in PARTS for tag, episode in tagged if tag == part)
    of_slope: dict[str, tuple[str, float]] = {}
    at_rows = rows.late.shape[1] == 0
    if mapping.unmeasured and there.all() and at_rows:
        episodes, of_slope, check = estimate_speeds(model, episodes, mapping.unmeasured, raw, required=whole)
        report.append(check)
    part_of = {episode.name: tag for tag, episode in tagged}
    told = column_noise(config, model, mapping, [episode for episode in episodes if part_of[episode.name] == "train"])
    gain = 1.0
    if config.resample is not None:
        episodes, gain, check = resample(
            episodes, raw, config.resample, model.linear if isinstance(model, Model) else ()
        )
        report.append(check)
    # the slope of a spline is smooth already: the filter takes nothing more from it
    noise = {name: std * gain for name, std in told.std.items()} | {
        speed: told.std[position] * factor for speed, (position, factor) in of_slope.items() if position in told.std
    }
    told = told._replace(std=noise, least={name: std * gain for name, std in told.least.items()})
    kept, short = _long_enough(config, model, episodes)
    report += [short, noise_check(config, model, told)]
    return {part: tuple(e for e in kept if part_of[e.name] == part) for part in PARTS}, told, report, computed


def _sensors(
    config: Measurements,
    model: Source,
    mapping: Mapping,
    segments: list[Episode],
    dt: float,
    as_they_are: bool,
    *,
    together: bool = True,
) -> tuple[list[Check], tuple[str, ...]]:
    """Faults of the sensors and the clock, of the rows as they were measured, and columns that are no measurement.

    Where sensors do not speak `together`, every column is tested by its own values, one after another, none against another.
    """

    def there(values: np.ndarray) -> np.ndarray:
        return values if together else values[np.isfinite(values)]

    observed = (*model.states, *(q for q in model.outputs if q.name in mapping.outputs))
    measured = [(i, q.name) for i, q in enumerate(observed) if q.name in mapping.columns]
    columns = {name: [there(column(s, i)) for s in segments] for i, name in measured}
    moving = {name: [part for s in segments for part in _moving(s, i, together)] for i, name in measured}
    units = {q.name: q.unit for q in observed}
    times = [segment.time for segment in segments]
    together &= all(segment.late is None for segment in segments)
    motions = [
        Motion(p, v, units[v], list(zip(times, columns[p], columns[v], strict=True)))
        for v, positions in speeds(model).items()
        for p in positions
        if p in columns and v in columns and together
    ]
    found = [
        sensors.jitter(times, dt, model.dt if config.resample is None else None, as_they_are=as_they_are),
        sensors.stale(moving),
        sensors.quantisation(moving, units),
        kinematics(motions),
        derived(motions, config.derived),
    ]
    return found, tuple(dict.fromkeys([*config.derived, *differences(motions)]))


def _moving(episode: Episode, i: int, together: bool) -> list[np.ndarray]:
    """Pieces of a column between the values at an end of its sensor, which repeats those as it should."""
    values = inside(episode, i)
    if not together:
        return [values[np.isfinite(values)]]
    return [values] if episode.beyond is None else runs(values)


def _segments(model: Source, rows: Rows, starts: np.ndarray) -> list[tuple[str, Episode]]:
    """Contiguous rows with their split; a second segment of episode 3 is called 3/2. Angles are unwrapped."""
    first = np.flatnonzero(starts)
    seen: Counter[str] = Counter()
    segments = []
    for begin, end in zip(first, np.append(first[1:], len(rows.time)), strict=True):
        label = str(rows.episode[begin])
        seen[label] += 1
        segment = Episode(
            name=label if seen[label] == 1 else f"{label}/{seen[label]}",
            time=rows.time[begin:end],
            states=_unwrap(rows.states[begin:end], model.states),
            inputs=rows.inputs[begin:end],
            outputs=rows.outputs[begin:end],
            late=_late(rows.take(np.arange(begin, end))),
            beyond=_beyond(rows.take(np.arange(begin, end))),
        )
        segments.append((str(rows.split[begin]), segment))
    return segments


def _late(rows: Rows) -> np.ndarray | None:
    """How long before its row each value was measured, (T, n_states + n_outputs) s; None: every value at its row."""
    if not rows.late.shape[1]:
        return None
    return np.where(np.isfinite(np.concatenate([rows.states, rows.outputs], axis=1)), rows.late, 0.0)


def _beyond(rows: Rows) -> np.ndarray | None:
    """At which end of its sensor every value lies; None: none does."""
    return rows.beyond if rows.beyond.any() else None


def _pairs(config: Measurements, model: Source, rows: Rows, part: str) -> tuple[Episode, ...]:
    """Rows that are transitions on their own, one `Episode` per named episode, or one for all."""
    chosen = rows.take(rows.split == part)
    following = chosen.next_states.copy()
    for i, quantity in enumerate(model.states):
        turn = period(quantity)
        if turn is not None:  # the next angle is the one nearest to the angle, as in an episode that was unwrapped
            following[:, i] -= turn * np.round((following[:, i] - chosen.states[:, i]) / turn)
    names = chosen.episode if config.episode is not None else np.full(len(chosen.time), part)
    episodes = []
    for name in dict.fromkeys(names.tolist()):
        own = names == name
        columns = (chosen.time[own], chosen.states[own], chosen.inputs[own], chosen.outputs[own], following[own])
        episodes.append(Episode(str(name), *columns, beyond=_beyond(chosen.take(own))))
    return tuple(episodes)


def _unwrap(values: np.ndarray, quantities: tuple[Quantity, ...]) -> np.ndarray:
    turned = values.copy()
    for i, quantity in enumerate(quantities):
        turn = period(quantity)
        if turn is not None:
            known = np.isfinite(values[:, i])
            turned[known, i] = np.unwrap(values[known, i], period=turn)
    return turned


def _long_enough(config: Measurements, model: Source, episodes: tuple[Episode, ...]) -> tuple[list[Episode], Check]:
    """Keep segments with at least one transition."""
    least = config.stack_actions + (2 if model.states else 1)
    kept = [episode for episode in episodes if len(episode.time) >= least]
    short = len(episodes) - len(kept)
    detail = (
        f"{short} of {len(episodes)} segments shorter than {least} rows dropped" if short else f"{len(kept)} segments"
    )
    return kept, Check("length", short == 0, detail)


def _column_names(config: Measurements, model: Source, mapping: Mapping) -> tuple[str, ...]:
    """Columns behind `values.finite`, in its order."""
    states = [mapping.columns[q.name] for q in model.states if q.name in mapping.columns]
    inputs = [mapping.columns[q.name] for q in model.inputs]
    outputs = [mapping.columns[name] for name in mapping.outputs]
    following = [f"next_{name}" for name in states] if config.layout == "transitions" else []
    return (config.time or "row number", *states, *inputs, *outputs, *following)


def _what_failed(report: list[Check]) -> str:
    """The warnings so far, which tell why rows are gone."""
    return "; ".join(f"{check.name}: {check.detail}" for check in report if not check.ok)
