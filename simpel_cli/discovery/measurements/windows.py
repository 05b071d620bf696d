"""Measured episodes as one padded, masked batch of windows of equal length."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.data.recording import Episode
from simpel_cli.errors import DataError

LEAST = 3  # rows of a window: a start, and one that it predicts, and one that confirms it
LONGEST = 256  # rows of a window: a longer record is cut, and its windows run side by side
LEAST_EPISODES = 3  # to hold out whole ones
LONGEST_TEST = 2048  # of a window on which free runs are judged


class Windows(NamedTuple):
    """W windows of T rows; a row that is padding or not measured does not count.

    Args:
        y: (W, T, ny) measurements, 0 where they do not count.
        ok: (W, T, ny) 1 where a measurement counts, else 0.
        u: (W, lead + T, nu) inputs, with `lead` rows of the past in front.
        start: (W, nx) guess of the first state.
        spread: (W, nx) standard deviation of the first state about it.
        episode: (W,) index of the episode, in the order given.
        begin: (W,) row of the episode at which the window begins.
    """

    y: np.ndarray
    ok: np.ndarray
    u: np.ndarray
    start: np.ndarray
    spread: np.ndarray
    episode: np.ndarray
    begin: np.ndarray

    @property
    def arrays(self) -> tuple[Array, ...]:
        """What the filter takes, window by window."""
        return tuple(jnp.asarray(a) for a in (self.y, self.ok, self.u, self.start, self.spread))


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
        at_least: windows per episode, so that few episodes can be held out in parts.
        longest: rows of a window.
    """
    rows_of_longest = max(len(e.time) for e in episodes)
    pieces = max(at_least, -(-rows_of_longest // longest))
    length = -(-rows_of_longest // pieces)
    rows: dict[str, list[np.ndarray]] = {
        "y": [],
        "ok": [],
        "u": [],
        "start": [],
        "spread": [],
        "episode": [],
        "begin": [],
    }
    for index, episode in enumerate(episodes):
        columns = [
            episode.states[:, list(states).index(n)] if n in states else episode.outputs[:, list(outputs).index(n)]
            for n in measured
        ]
        y = np.stack(columns, axis=1)
        past = np.concatenate([np.repeat(episode.inputs[:1], lead, axis=0), episode.inputs])
        for begin in range(0, len(y), length):
            part = y[begin : begin + length]
            if len(part) < LEAST:
                continue
            ok = np.isfinite(part)
            missing = length - len(part)
            rows["ok"].append(np.pad(ok.astype(float), ((0, missing), (0, 0))))
            rows["y"].append(np.pad(np.where(ok, part, 0.0), ((0, missing), (0, 0))))
            u = past[begin : begin + lead + len(part)]
            rows["u"].append(np.pad(np.nan_to_num(u), ((0, missing), (0, 0)), mode="edge"))
            start = np.array(centre, float)
            for j, name in enumerate(measured):
                if name in states and ok[0, j]:
                    start[list(states).index(name)] = part[0, j]
            rows["start"].append(start)
            rows["spread"].append(spread)
            rows["episode"].append(np.array(index))
            rows["begin"].append(np.array(begin))
    if not rows["y"]:
        raise DataError(
            f"data: none of {len(episodes)} episodes ({', '.join(e.name for e in episodes[:3])}"
            f"{', ...' if len(episodes) > 3 else ''}) has {LEAST} rows in a row, and discover follows episodes in time. Record "
            "longer episodes, or choose others to test on (data.split)."
        )
    return Windows(*(np.stack(rows[name]) for name in Windows._fields))


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
