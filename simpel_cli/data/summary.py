"""How much data, in words: the user's episodes, the segments that they were cut into, or rows that stand alone."""

from collections.abc import Sequence

from simpel_cli.data import Episode, Recording, origins
from simpel_cli.data.split import PARTS  # also the names of episodes that no column names


def split_summary(recording: Recording) -> str:
    """Return e.g. `9 train / 3 test episodes`."""
    if _stand_alone(recording):
        return f"{_rows(recording.train)} train / {_rows(recording.test)} test rows"
    train, test = (_episodes(recording, part) for part in (recording.train, recording.test))
    text = f"{len(train)} train / {len(test)} test episodes"
    if set(train) & set(test):
        text += " (parts of the same)"
    if len(recording.train) > len(train) or len(recording.test) > len(test):
        text += f" in {len(recording.train)} / {len(recording.test)} segments"
    return text


def held_out_summary(recording: Recording) -> str:
    """Return e.g. `3 episodes` or `1 episode in 4 segments`."""
    if _stand_alone(recording):
        return _counted(_rows(recording.test), "row")
    episodes, segments = len(_episodes(recording, recording.test)), len(recording.test)
    return _counted(episodes, "episode") + (f" in {segments} segments" if segments > episodes else "")


def _stand_alone(recording: Recording) -> bool:
    """Whether rows, not episodes, were split: an episode is in both parts, and no row follows another."""
    every = (*recording.train, *recording.test)
    follow = any(e.next_states is None and e.states.shape[1] for e in every)
    return not follow and len(set(_episodes(recording, every)) - set(PARTS)) < 2


def _episodes(recording: Recording, part: Sequence[Episode]) -> list[str]:
    """The user's episodes in a part."""
    of = origins((*recording.train, *recording.test))
    return list(dict.fromkeys(of[e.name][0] for e in part))


def _rows(part: Sequence[Episode]) -> int:
    return sum(len(episode.time) for episode in part)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
