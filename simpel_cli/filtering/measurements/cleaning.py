"""What of a recording a search may take for measurements: no computed columns, no lone values, no mere noise."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.checks.noise import MIN_ROWS
from simpel_cli.data.checks.outliers import lone_values
from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.errors import DataError
from simulators.model import Model

MOST_SHARE = 0.05  # of a channel; more is not a few spikes, and leaving it out would choose the data
MOST_MISSING = 0.2  # of a channel in which lone values are looked for
SHOWN = 6  # places that a message names
LAGS = 5
FEW_ROWS = 30  # fewer tell nothing about a memory
FAR_OUTSIDE = 100.0  # widths of the declared range: a range may be rough, but not so
TURNS = 1000.0
WHITE_QUANTILE = 0.999  # of the statistic that white noise has


class Place(NamedTuple):
    """One value: channel, split, index of the episode in its split, row."""

    name: str
    split: str
    episode: int
    row: int


class Cleaned(NamedTuple):
    """Episodes whose left out values are NaN, and which those are."""

    recording: Recording
    left_out: tuple[Place, ...]
    too_many: dict[str, float]  # channel -> share of its values that stand out; none of them is left out


def cleaned(recording: Recording, model: Model, declared_noise: Collection[str]) -> Cleaned:
    """Take computed columns, values at the ends of sensors, and lone values out.

    Args:
        recording: as it was read; where its values count by the scale of their noise (`Episode.weight`), one is no lone value
            for noise that it is declared to have.
        model: names the channels.
        declared_noise: channels whose noise the user declared; that of others is estimated anew without lone values.

    Raises:
        DataError: nothing is measured, or nothing but noise is.
    """
    recording = without_ends(without_computed(recording, model))
    names = measured(recording, model)
    splits = {"train": list(recording.train), "test": list(recording.test)}
    refuse_noise(recording, model)
    left_out: list[Place] = []
    too_many: dict[str, float] = {}
    noise = dict(recording.noise_std)
    inputs = [e.inputs for episodes in splits.values() for e in episodes]
    for name in names:
        pieces = [column(e, name, recording, model) for episodes in splits.values() for e in episodes]
        scales = [_scale(e, name, recording, model) for episodes in splits.values() for e in episodes]
        masks = _lone(pieces, inputs, scales)
        share = sum(int(m.sum()) for m in masks) / max(sum(len(m) for m in masks), 1)
        if share > MOST_SHARE:
            too_many[name] = share
        if not 0 < share <= MOST_SHARE:
            continue
        places = [(split, i) for split, episodes in splits.items() for i in range(len(episodes))]
        for (split, i), mask in zip(places, masks, strict=True):
            left_out += [Place(name, split, i, int(row)) for row in np.flatnonzero(mask)]
            splits[split][i] = _blanked(splits[split][i], name, mask, recording, model)
        if name in noise and name not in declared_noise:
            rest = [np.where(m, np.nan, p) for p, m in zip(pieces, masks, strict=True)]
            before, after = _level(pieces), _level(rest)
            noise[name] *= after / before if 0 < after < before else 1.0
    clean = recording._replace(train=tuple(splits["train"]), test=tuple(splits["test"]), noise_std=noise)
    refuse_far(clean, model)
    return Cleaned(clean, tuple(left_out), too_many)


def _scale(episode: Episode, name: str, recording: Recording, model: Model) -> np.ndarray:
    """Scale of the noise of one channel over the typical one, (T,)."""
    if episode.weight is None:
        return np.ones(len(episode.time))
    weight = episode.weight[:, [*(q.name for q in model.states), *recording.outputs].index(name)]
    return np.asarray(weight**-0.5)


def _lone(pieces: list[np.ndarray], inputs: list[np.ndarray], scales: list[np.ndarray]) -> list[np.ndarray]:
    """Find lone values beside what is missing, which is taken for the straight line between its neighbours.

    Of a channel that is missing in many rows none is looked for: the filter's own test of outliers comes later.
    """
    known = [np.isfinite(p) for p in pieces]
    missing = 1 - sum(int(k.sum()) for k in known) / max(sum(map(len, known)), 1)
    if missing == 0:
        return lone_values(pieces, inputs, scales)
    if missing > MOST_MISSING or not all(k.any() for k in known):
        return [np.zeros(len(p), bool) for p in pieces]
    filled = [np.interp(np.arange(len(p)), np.flatnonzero(k), p[k]) for p, k in zip(pieces, known, strict=True)]
    return [mask & k for mask, k in zip(lone_values(filled, inputs, scales), known, strict=True)]


def without_computed(recording: Recording, model: Model) -> Recording:
    """Treat columns that were computed from others as not measured.

    Raises:
        DataError: no other is left.
    """
    if not recording.derived:
        return recording
    names = ", ".join(recording.derived)
    estimated = tuple(dict.fromkeys((*recording.estimated, *recording.derived)))
    outputs = tuple(n for n in recording.outputs if n not in recording.derived)
    if not outputs and all(q.name in estimated for q in model.states):
        raise DataError(
            f"data.derived: [{names}] leaves nothing that is measured (states: "
            f"{', '.join(q.name for q in model.states)}). Name only columns that were computed from another one."
        )
    note = f"{names} {'is' if len(recording.derived) == 1 else 'are'} not taken for a measurement by discover"
    checks = tuple(
        c._replace(detail=f"{c.detail.split(': set data.columns')[0]}: {note}") if c.name == "derived" else c
        for c in recording.checks
    )
    kept = [recording.outputs.index(n) for n in outputs]
    columns = [*range(len(model.states)), *(len(model.states) + k for k in kept)]

    def narrowed(e: Episode) -> Episode:
        late, weight, beyond = (None if a is None else a[:, columns] for a in (e.late, e.weight, e.beyond))
        return e._replace(outputs=e.outputs[:, kept], late=late, weight=weight, beyond=beyond)

    train, test = (tuple(map(narrowed, episodes)) for episodes in (recording.train, recording.test))
    return recording._replace(train=train, test=test, outputs=outputs, estimated=estimated, checks=checks)


def without_ends(recording: Recording) -> Recording:
    """Leave out values at the ends of their sensors: to a filter an inequality is no measurement."""

    def within(e: Episode) -> Episode:
        if e.beyond is None:
            return e
        return e._replace(outputs=np.where(e.beyond[:, e.states.shape[1] :] != 0, np.nan, e.outputs))

    train, test = (tuple(map(within, episodes)) for episodes in (recording.train, recording.test))
    if not any(e.beyond is not None and (e.beyond != 0).any() for e in (*recording.train, *recording.test)):
        return recording._replace(train=train, test=test)
    checks = tuple(
        c._replace(detail=f"{c.detail}; discover leaves these values out") if c.name == "saturation" else c
        for c in recording.checks
    )
    return recording._replace(train=train, test=test, checks=checks)


def refuse_noise(recording: Recording, model: Model) -> None:
    """Refuse training data in which no channel has a memory, nor follows an input: noise, or a system at rest.

    Raises:
        DataError: names the channels.
    """
    names = measured(recording, model)
    periodic = {q.name for q in model.states if q.periodic}
    for name in names:
        columns = [column(e, name, recording, model) for e in recording.train]
        pieces = [c[np.isfinite(c)] for c in columns]
        inputs = [e.inputs[np.isfinite(c)] for e, c in zip(recording.train, columns, strict=True)]
        if sum(len(p) for p in pieces if len(p) > LAGS) < FEW_ROWS:
            return
        # an angle without order runs away where it is unwrapped
        parts = [np.sin, np.cos] if name in periodic else [np.asarray]
        if any(not is_noise([part(p) for p in pieces], inputs) for part in parts):
            return
    raise DataError(
        f"data: nothing but noise is measured: in {', '.join(names)} no training row depends on the rows before it or on "
        "an input, so that nothing can be missing. Record a motion that is larger than the noise, or compare columns and "
        f"time with the file (data.columns, data.time; a row is {model.dt:g} s)."
    )


def refuse_far(recording: Recording, model: Model) -> None:
    """Refuse values so far outside their declared range that the two cannot be in one unit.

    Raises:
        DataError: names the quantity, its extreme and its range.
    """
    episodes = (*recording.train, *recording.test)
    names = measured(recording, model)
    columns = {n: np.concatenate([column(e, n, recording, model) for e in episodes]) for n in names}
    columns |= {q.name: np.concatenate([e.inputs[:, j] for e in episodes]) for j, q in enumerate(model.inputs)}
    for q in (*model.states, *model.inputs):  # outputs have no range
        values = columns.get(q.name)
        if values is None or not np.isfinite(values).any():
            continue
        furthest = values[np.nanargmax(np.abs(values - (q.low + q.high) / 2))]
        most = FAR_OUTSIDE * (TURNS if q.periodic else 1.0)  # an angle may go round and round
        if abs(furthest - (q.low + q.high) / 2) > most * (q.high - q.low):
            raise DataError(
                f"data: {q.name} reaches {furthest:.4g} {q.unit}, more than {most:g} times the width of its range "
                f"[{q.low:g}, {q.high:g}] {q.unit} beyond it. Take wrong rows out, or compare the units of the column and "
                f"of sim ({q.name}: range)."
            )


def is_noise(pieces: Sequence[np.ndarray], inputs: Sequence[np.ndarray]) -> bool:
    """Whether a channel is constant or white, and follows no input.

    Q = n sum_l r_l^2 over autocorrelations, and over correlations with every input of the last rows, is chi-squared.

    Args:
        pieces: contiguous rows, each (T,).
        inputs: of the same rows, (T, nu).

    Reference: Box and Pierce (1970), Distribution of residual autocorrelations.
    """
    from scipy.stats import chi2

    mean = np.mean(np.concatenate(pieces))
    centred = [p - mean for p in pieces]
    power = sum(float(p @ p) for p in centred)
    size = max(float(np.max(np.abs(p))) for p in pieces)
    n = sum(len(p) for p in pieces)
    if power <= n * (1e-9 * size) ** 2:
        return True
    memory = [sum(float(p[:-lag] @ p[lag:]) for p in centred) / power for lag in range(1, LAGS + 1)]
    if n * float(np.sum(np.square(memory))) > chi2.ppf(WHITE_QUANTILE, LAGS):
        return False
    every = np.concatenate(inputs)
    followed = []
    for j in np.flatnonzero(np.ptp(every, axis=0) > 0):
        own = [u[:, j] - np.mean(every[:, j]) for u in inputs]
        scale = np.sqrt(power * sum(float(u @ u) for u in own))
        for lag in range(3):
            moved = sum(float(u[: len(u) - lag] @ p[lag:]) for u, p in zip(own, centred, strict=True))
            followed.append(moved / scale)
    return not followed or n * float(np.sum(np.square(followed))) <= float(chi2.ppf(WHITE_QUANTILE, len(followed)))


def outlier_check(found: Cleaned, names: Sequence[str]) -> Check:
    """Report what was left out, of how many, and where."""
    episodes = {"train": found.recording.train, "test": found.recording.test}
    rows = sum(len(e.time) for part in episodes.values() for e in part)
    parts = []
    for name in names:
        own = [p for p in found.left_out if p.name == name]
        if own:
            shown = [
                f"{episodes[p.split][p.episode].name} at {episodes[p.split][p.episode].time[p.row]:.4g} s"
                for p in own[:SHOWN]
            ]
            more = ", ..." if len(own) > SHOWN else ""
            tested = sum(p.split == "test" for p in own)
            also = f"; {tested} of them in test episodes, whose errors leave them out too" if tested else ""
            parts.append(f"{len(own)} of {rows} values of {name} left out (episode {', '.join(shown)}{more}{also})")
    for name, share in found.too_many.items():
        parts.append(f"{share:.0%} of the values of {name} stand out, more than {MOST_SHARE:.0%}: no more is left out")
    return Check("outliers", not parts, "; ".join(parts) if parts else "no value stands alone")


def measured(recording: Recording, model: Model) -> tuple[str, ...]:
    """Names of the channels that were measured."""
    return (*(q.name for q in model.states if q.name not in recording.estimated), *recording.outputs)


def column(episode: Episode, name: str, recording: Recording, model: Model) -> np.ndarray:
    """Values of one channel, (T,)."""
    states = [q.name for q in model.states]
    if name in states:
        return episode.states[:, states.index(name)]
    return episode.outputs[:, recording.outputs.index(name)]


def _blanked(episode: Episode, name: str, mask: np.ndarray, recording: Recording, model: Model) -> Episode:
    states, outputs = episode.states.copy(), episode.outputs.copy()
    changed = episode._replace(states=states, outputs=outputs)
    column(changed, name, recording, model)[mask] = np.nan
    return changed


def _level(pieces: Sequence[np.ndarray]) -> float:
    """Level of the third differences, as `third_difference_std` has it, around what is left out."""
    squares = [np.diff(p, 3) ** 2 for p in pieces if len(p) >= MIN_ROWS]
    means = [float(np.nanmean(s)) for s in squares if np.isfinite(s).any()]
    return float(np.sqrt(np.median(means))) if means else 0.0
