"""What reading yields: episodes in physical units, and the one-step transitions inside them."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias
from zlib import crc32

import numpy as np

from simpel_cli.errors import DataError
from simulators.model import Model
from simulators.worlds.world import World

Source: TypeAlias = Model | World  # what measurements are read for


class Check(NamedTuple):
    """One thing that was looked at: `ok` False is a warning; `detail` says what was found or done."""

    name: str
    ok: bool
    detail: str


class Episode(NamedTuple):
    """Contiguous rows at the simulator's dt, float64, physical units, in the simulator's order.

    Angles run on continuously within an episode (they are unwrapped). A state or an output that is missing in a row is NaN.
    """

    name: str
    time: np.ndarray  # (T,) s
    states: np.ndarray  # (T, n_states)
    inputs: np.ndarray  # (T, n_inputs)
    outputs: np.ndarray  # (T, n_measured_outputs)
    next_states: np.ndarray | None = None  # (T, n_states) where rows do not follow each other (layout: transitions)
    late: np.ndarray | None = None  # (T, n_states + n_measured_outputs) s, how long before its row a value was measured
    # (T, n_states + n_measured_outputs) variance of a measured value over that of this one: 1 measured, less: estimated, of
    # states that were not measured in their row; in `discover` also by the declared scale of its noise; None: all alike
    weight: np.ndarray | None = None
    # (T, n_states + n_measured_outputs) -1, 1: the quantity lies at the low or high end of its sensor or beyond, else 0 (an
    # output is the end itself there, a state NaN); None: no sensor was declared, or no value lies at an end
    beyond: np.ndarray | None = None


class Recording(NamedTuple):
    """Measurements, checked and split."""

    train: tuple[Episode, ...]
    test: tuple[Episode, ...]
    outputs: tuple[str, ...]  # names of the measured outputs
    noise_std: dict[str, float]  # per state and output, declared or estimated, of the rows in the episodes
    estimated: tuple[str, ...]  # names of the states that were not measured
    checks: tuple[Check, ...]
    files: tuple[Path, ...]  # what was read
    derived: tuple[str, ...] = ()  # names of the states whose column was computed from another one's
    groups: dict[str, tuple[str, ...]] = {}  # noqa: RUF012  column -> names of the groups that were trained on
    least_noise: dict[str, float] = {}  # noqa: RUF012  per state and output, that of rounding: no estimate can be below


class Transitions(NamedTuple):
    """One-step pairs, float64, physical units, not encoded."""

    states: np.ndarray  # (n, ds)
    inputs: (
        np.ndarray
    )  # (n, (stack + 1) * du + linear), past inputs (oldest first), the current ones, the next linear ones
    next_states: np.ndarray  # (n, ds)
    outputs: np.ndarray  # (n, dy_out), at the row of the inputs
    episode: np.ndarray  # (n,) index of the episode
    row: np.ndarray  # (n,) row in the episode
    weight: (
        np.ndarray
    )  # (n, ds + dy_out) how much change and output count, 1 where they were measured (`Episode.weight`)
    beyond: np.ndarray  # (n, ds + dy_out) of outputs `Episode.beyond`; of changes 0: a state at an end has no value

    def take(self, rows: np.ndarray) -> "Transitions":
        """Return some of them."""
        return Transitions(*(column[rows] for column in self))


def transitions(episodes: Sequence[Episode], stack_actions: int, linear: Sequence[int] = ()) -> Transitions:
    """Cut episodes into transitions; none crosses from one episode into another.

    Without states (a static model) every row that has its past inputs is one.

    Args:
        episodes: at least one.
        stack_actions: number of past inputs to carry along; the first so many rows of an episode have no such past.
        linear: inputs that go straight from a row to the next, whose next values are carried along, too.

    Raises:
        DataError: no episode is long enough.
    """
    if not episodes:
        raise DataError("no transition: there is no episode.")
    parts = [_of_episode(index, episode, stack_actions, linear) for index, episode in enumerate(episodes)]
    joined = Transitions(*(np.concatenate(column) for column in zip(*parts, strict=True))) if parts else None
    if joined is None or len(joined.row) == 0:
        raise DataError(f"no transition: none of {len(parts)} episodes has {stack_actions + 2} rows in a row.")
    return joined


def with_measured_targets(pairs: Transitions, episodes: Sequence[Episode]) -> Transitions:
    """Return the transitions whose next states and outputs were all measured; of none, all: estimates are all there is."""
    n_states = pairs.states.shape[1]
    good = np.ones(len(pairs.row), bool)
    for index, episode in enumerate(episodes):
        if episode.weight is None:
            continue
        own = pairs.episode == index
        after, now = episode.weight[pairs.row[own] + (n_states > 0)], episode.weight[pairs.row[own]]
        good[own] = (after[:, :n_states] == 1).all(axis=1) & (now[:, n_states:] == 1).all(axis=1)
    return pairs.take(good) if good.any() else pairs


def no_transitions(source: Source, outputs: int, stack_actions: int, linear: Sequence[int] = ()) -> Transitions:
    """Return no transition at all, of a simulator with so many measured outputs."""
    width = (stack_actions + 1) * len(source.inputs) + len(linear)
    states, inputs = np.empty((0, len(source.states))), np.empty((0, width))
    nothing = np.empty(0, int)
    every = np.empty((0, len(source.states) + outputs))
    return Transitions(states, inputs, states, np.empty((0, outputs)), nothing, nothing, every, every)


def _of_episode(index: int, episode: Episode, stack: int, linear: Sequence[int]) -> Transitions:
    length, n_states = episode.states.shape
    if episode.next_states is not None:
        rows, following = np.arange(length), episode.next_states
    elif n_states == 0:
        rows, following = np.arange(stack, length), episode.states[stack:]
    else:
        rows, following = np.arange(stack, length - 1), episode.states[stack + 1 :]
    stacked = [episode.inputs[rows - back] for back in range(stack, -1, -1)]
    if linear:  # of rows that do not follow each other the next inputs are not known: `read` refuses them
        stacked.append(episode.inputs[np.minimum(rows + 1, length - 1)][:, list(linear)])
    return Transitions(
        states=episode.states[rows],
        inputs=np.concatenate(stacked, axis=1),
        next_states=following,
        outputs=episode.outputs[rows],
        episode=np.full(len(rows), index),
        row=rows,
        weight=_weight(episode, rows, n_states),
        beyond=_beyond(episode, rows, n_states),
    )


def _weight(episode: Episode, rows: np.ndarray, n_states: int) -> np.ndarray:
    """Variance of a change between two measured values over that of this one; of an output its own weight."""
    if episode.weight is None:
        return np.ones((len(rows), n_states + episode.outputs.shape[1]))
    change = np.empty((len(rows), 0))
    if n_states:
        before, after = episode.weight[rows, :n_states], episode.weight[rows + 1, :n_states]
        change = 2 / (1 / before + 1 / after)
    return np.concatenate([change, episode.weight[rows, n_states:]], axis=1)


def _beyond(episode: Episode, rows: np.ndarray, n_states: int) -> np.ndarray:
    """At which end of its sensor an output lies; 0 of changes."""
    found = np.zeros((len(rows), n_states + episode.outputs.shape[1]))
    if episode.beyond is not None:
        found[:, n_states:] = episode.beyond[rows, n_states:]
    return found


def select(pairs: Transitions, n_train: int | None, choice: str, seed: int) -> Transitions:
    """Choose training transitions; with the same seed, fewer are always part of more.

    Args:
        pairs: all training transitions.
        n_train: how many; None = all, in their order.
        choice: `random` (the first of a seeded permutation) or `first`.
        seed: of the permutation.

    Raises:
        DataError: more are asked for than there are.
    """
    available = len(pairs.row)
    if n_train is None:
        return pairs
    if n_train > available:
        raise DataError(f"data.n_train: {n_train} training transitions are asked for, the data have {available}.")
    order = stream(seed, "n_train").permutation(available) if choice == "random" else np.arange(available)
    return pairs.take(order[:n_train])


def stream(seed: int, name: str) -> np.random.Generator:
    """Random numbers of one purpose: two names never share a stream."""
    return np.random.default_rng((seed, crc32(name.encode())))
