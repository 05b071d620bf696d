"""Measured episodes as one padded, masked batch of windows of equal length."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.data.recording import Episode
from simpel_cli.dynamics.between_rows import beyond
from simpel_cli.errors import DataError

LEAST = 3  # rows of a window: a start, and one that it predicts, and one that confirms it
LONGEST = 256  # rows of a window: a longer record is cut, and its windows run side by side
LEAST_EPISODES = 3  # to hold out whole ones
PARABOLA = 2  # rows behind an episode that go on as its inputs did
UNEVEN = 0.01  # of a step: a clock that strays less is taken for even
ROUNDED = 3  # different steps of an even clock with rounded stamps; one more than two, since floating point rounds, too
LONGEST_RUN = 2048  # of a window along which free runs are calibrated
LONGEST_TEST = 65_536  # of one on which they are judged


class Windows(NamedTuple):
    """W windows of T rows; a row that is padding, not measured, or at an end of its sensor does not count.

    Args:
        y: (W, T, ny) measurements, 0 where they do not count.
        ok: (W, T, ny) how much a measurement counts, 1 as a rule; 0: not at all. Its noise has the variance R/ok.
        u: (W, lead + T, nu) inputs, with `lead` rows of the past in front.
        start: (W, nx) guess of the first state.
        spread: (W, nx) standard deviation of the first state about it.
        episode: (W,) index of the episode, in the order given.
        begin: (W,) row of the episode at which the window begins.
        clock: (W, T, 1 + ny) step to the next row, in dt, and how long before its row each value was measured, s; (W, T, 0)
            where rows are dt apart and all values are measured at them.
    """

    y: np.ndarray
    ok: np.ndarray
    u: np.ndarray
    start: np.ndarray
    spread: np.ndarray
    episode: np.ndarray
    begin: np.ndarray
    clock: np.ndarray

    @property
    def lead(self) -> int:
        """Rows of the past in front of the inputs."""
        return self.u.shape[1] - self.clock.shape[1]

    @property
    def arrays(self) -> tuple[Array, ...]:
        """What the filter takes, window by window: the clock stands behind the inputs."""
        clock = np.pad(self.clock, ((0, 0), (self.lead, 0), (0, 0)))
        u = np.concatenate([self.u, clock], axis=2)
        return tuple(jnp.asarray(a) for a in (self.y, self.ok, u, self.start, self.spread))

    def first(self, rows: int) -> "Windows":
        """Return the first rows of every window."""
        return self._replace(
            y=self.y[:, :rows], ok=self.ok[:, :rows], u=self.u[:, : self.lead + rows], clock=self.clock[:, :rows]
        )


def thinned(windows: Windows, rows: int) -> tuple[Windows, Windows | None]:
    """Choose evenly spaced windows of a long record: a search needs not every row of it to tell effects apart.

    Args:
        windows: all of them.
        rows: that the chosen ones may have, about; one window per episode is chosen in any case.

    Returns:
        the chosen ones and the rest; None: all are chosen.
    """
    count, length = windows.ok.shape[:2]
    most = max(rows // length, len(np.unique(windows.episode)))
    if count <= most:
        return windows, None
    kept = np.unique(np.linspace(0, count - 1, most).round().astype(int))
    rest = np.setdiff1d(np.arange(count), kept)
    return Windows(*(a[kept] for a in windows)), Windows(*(a[rest] for a in windows))


def windows_of(
    episodes: Sequence[Episode],
    states: Sequence[str],
    measured: Sequence[str],
    outputs: Sequence[str],
    centre: np.ndarray,
    spread: np.ndarray,
    *,
    lead: int,
    dt: float,
    clocked: bool = False,
    at_least: int = 1,
    longest: int = LONGEST,
) -> Windows:
    """Cut episodes into windows.

    Args:
        episodes: contiguous rows at the model's dt.
        states: names of the model's states.
        measured: names of the measured channels.
        outputs: names of the columns of `Episode.outputs`.
        centre: (nx,) guess of a state that no channel measures.
        spread: (nx,) standard deviation of a first state about its guess.
        lead: rows of past input that delays and lags look back on; before the record the first input is assumed.
        dt: of the model, s.
        clocked: rows follow their time stamps, and values their own (see `clocked`); else rows are dt apart.
        at_least: windows per episode, so that few episodes can be held out in parts.
        longest: rows of a window.
    """
    length = _length([len(e.time) for e in episodes], longest, at_least)
    rows: dict[str, list[np.ndarray]] = {
        "y": [],
        "ok": [],
        "u": [],
        "start": [],
        "spread": [],
        "episode": [],
        "begin": [],
        "clock": [],
    }
    for index, episode in enumerate(episodes):
        own = list(states)[
            : episode.states.shape[1]
        ]  # what effects and remainders bring along stands last, without a column
        columns = [
            episode.states[:, own.index(n)] if n in own else episode.outputs[:, list(outputs).index(n)]
            for n in measured
        ]
        y = np.stack(columns, axis=1)
        if episode.beyond is not None:  # an inequality is no measurement
            every = [*own, *outputs]
            y = np.where(episode.beyond[:, [every.index(n) for n in measured]] != 0, np.nan, y)
        past = np.concatenate([np.repeat(episode.inputs[:1], lead, axis=0), episode.inputs])
        clock = _clock(episode, own, measured, outputs, dt) if clocked else np.zeros((len(y), 0))
        weight = np.ones(y.shape)
        if episode.weight is not None:
            weight = episode.weight[:, [[*own, *outputs].index(name) for name in measured]]
        for begin in range(0, len(y), length):
            part = y[begin : begin + length]
            if len(part) < LEAST:
                continue
            ok = np.isfinite(part)
            missing = length - len(part)
            counts = np.where(ok, weight[begin : begin + length], 0.0)
            rows["ok"].append(np.pad(counts, ((0, missing), (0, 0))))
            rows["y"].append(np.pad(np.where(ok, part, 0.0), ((0, missing), (0, 0))))
            u = np.nan_to_num(past[begin : begin + lead + len(part)])
            low, high = u.min(axis=0), u.max(axis=0)
            for _ in range(min(missing, PARABOLA)):  # what a smooth input reads there; within what it was
                u = np.concatenate([u, beyond(u)[None]])
            u = np.clip(u, low, high)
            rows["u"].append(np.pad(u, ((0, max(missing - PARABOLA, 0)), (0, 0)), mode="edge"))
            start = np.array(centre, float)
            for j, name in enumerate(measured):
                if name in states and ok[0, j]:
                    start[list(states).index(name)] = part[0, j]
            rows["start"].append(start)
            rows["spread"].append(spread)
            rows["episode"].append(np.array(index))
            rows["begin"].append(np.array(begin))
            rows["clock"].append(np.pad(clock[begin : begin + length], ((0, missing), (0, 0)), mode="edge"))
    if not rows["y"]:
        raise DataError(
            f"data: none of {len(episodes)} episodes ({', '.join(e.name for e in episodes[:3])}"
            f"{', ...' if len(episodes) > 3 else ''}) has {LEAST} rows in a row, and discover follows episodes in time. Record "
            "longer episodes, or choose others to test on (data.split)."
        )
    return Windows(*(np.stack(rows[name]) for name in Windows._fields))


def padded(rows: Sequence[int], longest: int) -> float:
    """Return how many times the rows of episodes their windows have, padding included."""
    length = _length(rows, longest)
    return sum(-(-n // length) for n in rows) * length / sum(rows)


def _length(rows: Sequence[int], longest: int, at_least: int = 1) -> int:
    """Return the rows of a window: the longest episode in equal pieces."""
    pieces = max(at_least, -(-max(rows) // longest))
    return -(-max(rows) // pieces)


def clocked(episodes: Sequence[Episode], dt: float) -> bool:
    """Whether rows are not dt apart or values not measured at their rows. Stamps of an even clock may be rounded."""
    if any(e.late is not None and np.any(e.late > 0) for e in episodes):
        return True
    return strays(np.concatenate([np.diff(e.time) for e in episodes]), dt)


def strays(steps: np.ndarray, dt: float) -> bool:
    """Whether the clock itself strays; an even one whose stamps are rounded does not."""
    if not np.isfinite(steps).all() or len(steps) == 0 or np.std(steps) <= UNEVEN * dt:
        return False
    # an even clock whose stamps are rounded knows two steps, one tick apart, about its own
    return len(np.unique(np.round(steps / (1e-6 * dt)))) > ROUNDED


def _clock(
    episode: Episode, states: Sequence[str], measured: Sequence[str], outputs: Sequence[str], dt: float
) -> np.ndarray:
    """Return the step from every row to the next, in dt, and how long before the row each value was measured, (T, 1 + ny)."""
    pace = np.append(np.diff(episode.time) / dt, 1.0)[:, None]
    if episode.late is None:
        return np.concatenate([pace, np.zeros((len(pace), len(measured)))], axis=1)
    columns = [*states, *outputs]
    return np.concatenate([pace, episode.late[:, [columns.index(name) for name in measured]]], axis=1)


class Piece(NamedTuple):
    """Where a window lies in its episode."""

    episode: str
    rows: np.ndarray  # (n,) of the episode; padding is left out
    time: np.ndarray  # (n,) s


def pieces(windows: Windows, episodes: Sequence[Episode]) -> Iterator[Piece]:
    """Yield the place of every window, in their order."""
    length = windows.y.shape[1]
    for index, begin in zip(windows.episode.tolist(), windows.begin.tolist(), strict=True):
        episode = episodes[index]
        rows = np.arange(begin, min(begin + length, len(episode.time)))
        yield Piece(episode.name, rows, episode.time[rows])
