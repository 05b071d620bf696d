"""Episodes that a person can run on a rig: a start, and inputs from a few families within their declared ranges."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.filtering.measurements.windows import LONGEST
from simpel_cli.filtering.setup import Setup
from simulators.model import Quantity
from simulators.worlds.excitation import HeldRandom, Multisine

FREE = "free response"
STEPS, RAMPS, SWEEP, MULTISINE, HELD = "steps", "ramps", "sweep", "multisine", "held random signal"
DRIVEN = (STEPS, RAMPS, SWEEP, MULTISINE, HELD)
SHARES = (0.15, 0.4, 1.0)  # of the range of an input
PACES = (1.0, 3.0, 9.0)  # cycles in an episode; slow reversals reveal friction
LEAST_ROWS_PER_CYCLE = 6
QUIET = 0.05  # share of an episode before the first step: a step at its first row would not be one
SINES = 8


class Proposal(NamedTuple):
    """One episode.

    Args:
        kind: FREE or one of DRIVEN.
        share: of the range of the input about its rest value; negative: begins downwards.
        pace: cycles in the episode, of the fastest part.
        driven: which input moves; None: all do.
        seed: of what is random in it.
        start: (nx,) first state.
    """

    kind: str
    share: float
    pace: float
    driven: int | None
    seed: int
    start: np.ndarray


class Reach(NamedTuple):
    """First states that the data cover.

    Args:
        low, high: (nx,) of each state; equal where it was not measured.
        rest: (nx,) where a velocity is zero, and any other state in the middle.
        free: (nx,) whether a person can choose it: a velocity is left at rest.
        seen: (k, nx) first states of measured episodes.
    """

    low: np.ndarray
    high: np.ndarray
    rest: np.ndarray
    free: np.ndarray
    seen: np.ndarray


def reach_of(plan: Setup) -> Reach:
    """Read off the training windows where an episode can start."""
    windows, model = plan.windows, plan.augmented.model
    low, high = windows.start[0].copy(), windows.start[0].copy()
    for i, q in enumerate(model.states):
        if q.name in plan.augmented.measured:
            j = plan.augmented.measured.index(q.name)
            values = windows.y[..., j][windows.ok[..., j] > 0]
            values = np.angle(np.exp(1j * values)) if q.periodic else values
            low[i], high[i] = np.clip([values.min(), values.max()], q.low, q.high)
    velocity = np.array([q.name in plan.augmented.roles.velocity for q in model.states])
    rest = np.where(velocity, np.clip(0.0, low, high), (low + high) / 2)
    turns = np.array([q.periodic for q in model.states])
    seen = np.where(turns, np.angle(np.exp(1j * windows.start)), windows.start)
    first = np.unique(windows.episode, return_index=True)[1]
    return Reach(low, high, rest, ~velocity & (high > low), np.clip(seen[first], low, high))


def rows_of(plan: Setup) -> int:
    """Length of an episode: that of the longest measured one, one window at most."""
    windows = plan.windows
    lengths = [(windows.ok[windows.episode == e] > 0).any(axis=2).sum() for e in np.unique(windows.episode)]
    return int(min(max(lengths), LONGEST))


def random_start(reach: Reach, random: np.random.Generator) -> np.ndarray:
    """Return a start that was seen, or one at rest anywhere the data reached."""
    if random.random() < 0.3:
        return reach.seen[random.integers(len(reach.seen))]
    # ends of the range are likely: episodes from there also cover what lies in between
    where = np.clip(random.uniform(-0.2, 1.2, len(reach.low)), 0, 1)
    return np.where(reach.free, reach.low + where * (reach.high - reach.low), reach.rest)


def proposals(reach: Reach, inputs: int, n: int, random: np.random.Generator) -> list[Proposal]:
    """Return n episodes that go through all families, shares and paces."""
    every = [
        (kind, share, pace, which)
        for pace in PACES
        for share in SHARES
        for kind in DRIVEN
        for which in ([None] if inputs == 1 else [*range(inputs), None])
    ]
    order = random.permutation(len(every))
    found = []
    for i in range(n):
        start = reach.rest if i == 0 else random_start(reach, random)
        if not inputs or i % 8 == 0:
            found.append(Proposal(FREE, 0.0, 1.0, None, 0, start))
            continue
        kind, share, pace, which = every[order[i % len(every)]]
        found.append(Proposal(kind, share, pace, which, int(random.integers(2**31)), start))
    return found


def neighbours(best: Sequence[Proposal], reach: Reach, n: int, random: np.random.Generator) -> list[Proposal]:
    """Return n episodes near the best ones: each differs in one or two properties."""
    found = []
    for i in range(n):
        own = best[i % len(best)]
        what = random.choice(["start", "move", "share", "pace", "seed"] if own.kind != FREE else ["start", "move"])
        if what == "start":
            own = own._replace(start=random_start(reach, random))
        elif what == "move":
            step = 0.15 * random.normal(size=len(reach.low)) * (reach.high - reach.low)
            own = own._replace(start=np.clip(own.start + np.where(reach.free, step, 0.0), reach.low, reach.high))
        elif what == "share":
            size = np.clip(abs(own.share) * random.uniform(0.5, 2.0), 0.02, 1.0)
            own = own._replace(share=float(size * random.choice([-1.0, 1.0])))
        elif what == "pace":
            own = own._replace(pace=float(np.clip(own.pace * random.uniform(0.5, 2.0), 0.5, 50.0)))
        if own.kind in (MULTISINE, HELD) and what != "move":
            own = own._replace(seed=int(random.integers(2**31)))
        found.append(own)
    return found


def signal(proposal: Proposal, inputs: Sequence[Quantity], rows: int, dt: float) -> np.ndarray:
    """Return the inputs of an episode, (rows, nu), within their ranges."""
    out = np.stack([np.full(rows, resting(q)) for q in inputs], axis=1) if inputs else np.zeros((rows, 0))
    if proposal.kind == FREE:
        return out
    for j, q in enumerate(inputs):
        if proposal.driven in (None, j):
            random = np.random.default_rng((proposal.seed, j))
            wave = proposal.share * _wave(proposal.kind, proposal.pace, rows, dt, random)
            middle = 0.0 if q.low < 0 < q.high else (q.low + q.high) / 2
            room = np.where(wave > 0, q.high - middle, middle - q.low)
            out[:, j] = np.clip(middle + wave * room, q.low, q.high)
    return out


def resting(q: Quantity) -> float:
    """Value of an input that does nothing: zero where it can be."""
    return 0.0 if q.low <= 0 <= q.high else (q.low + q.high) / 2


def _wave(kind: str, pace: float, rows: int, dt: float, random: np.random.Generator) -> np.ndarray:
    """Return a signal within -1..1."""
    at = np.arange(rows) / rows
    pace = min(pace, rows / LEAST_ROWS_PER_CYCLE)
    unit = Quantity("", "", -1.0, 1.0)
    if kind == STEPS:
        since = np.maximum(at - QUIET, 0.0) / (1 - QUIET)
        return np.where(at < QUIET, 0.0, np.where(np.floor(2 * pace * since) % 2 == 0, 1.0, -1.0))
    if kind == RAMPS:
        return 2 / np.pi * np.arcsin(np.sin(2 * np.pi * pace * at))
    if kind == SWEEP:
        slow = min(1.0, pace)
        return np.sin(2 * np.pi * (slow * at + (pace - slow) * at**2 / 2))
    if kind == MULTISINE:
        lowest = min(1.0, pace / 2) / (rows * dt)
        return Multisine(lowest, pace / (rows * dt), SINES).signal(random, rows, dt, unit)
    longest = max(rows * dt / max(pace, 2.0), dt)  # it changes at least once
    return HeldRandom(max(longest / 4, dt), longest).signal(random, rows, dt, unit)
