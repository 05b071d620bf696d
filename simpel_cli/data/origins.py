"""Where rows come from: the user's own episode, the segment of it that checks or splits cut, and the time."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.recording import Episode


class Places(NamedTuple):
    """Origin of n rows, in the user's own words."""

    episode: np.ndarray  # (n,) name
    segment: np.ndarray  # (n,) from 1; an episode that was not cut is one segment
    row: np.ndarray  # (n,) row in the segment, from 0
    time: np.ndarray  # (n,) s, as measured


def origins(episodes: Sequence[Episode]) -> dict[str, tuple[str, int]]:
    """Return the user's episode and the segment of it, from 1, by the name of every `Episode`.

    Reading calls the second segment of episode 3 `3/2`. A user's own name may look the same: `day/2` is taken for a
    segment only if there is an episode `day`, or neither `day/0` nor `day/1` (the first segment may be too short to
    be kept, but it is never numbered).

    Args:
        episodes: all of a recording, or the answer may miss the ones that tell.
    """
    names = {episode.name for episode in episodes}
    return {episode.name: _origin(episode, names) for episode in episodes}


def _origin(episode: Episode, names: set[str]) -> tuple[str, int]:
    base, slash, number = episode.name.rpartition("/")
    counts = bool(slash) and number.isdecimal() and number == str(int(number)) and int(number) > 1
    numbered = {f"{base}/0", f"{base}/1"} & names
    if episode.next_states is None and counts and (base in names or not numbered):
        return base, int(number)
    return episode.name, 1


def places(
    episodes: Sequence[Episode], of: Mapping[str, tuple[str, int]], index: np.ndarray, row: np.ndarray
) -> Places:
    """Return the origin of rows.

    Args:
        episodes: what the rows are of.
        of: origins of them and perhaps of others.
        index: of the episode, (n,).
        row: in the episode, (n,).
    """
    first = np.concatenate([[0], np.cumsum([len(episode.time) for episode in episodes])])
    time = np.concatenate([episode.time for episode in episodes])
    return Places(
        episode=np.array([of[episode.name][0] for episode in episodes])[index],
        segment=np.array([of[episode.name][1] for episode in episodes])[index],
        row=row,
        time=time[first[index] + row],
    )
