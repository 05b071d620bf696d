"""How much of a planted term the data can show, in nats, where no name of the tool's can be asked for its evidence.

Over windows, d is what the term adds to the noise-free measurements; what other parameters and first states could do for it
is taken out by least squares. The expected log-likelihood ratio of the true model over the best one without is then
1/2 sum (d / sigma)^2, to first order.
"""

import numpy as np

from tests.exam import nuisances
from tests.exam.draw import Set
from tests.exam.integrate import simulate
from tests.exam.plants import SYSTEMS
from tests.exam.record import TEST, TRAIN, Record, random_of
from tests.exam.rig import ROWS, plant

WINDOW = 15  # rows: short enough for first order
STEP = 1e-4  # of a range or of a state's standard deviation


def visible(drawn: Set, made: Record, only: int | None = None, *, moving: bool = False) -> float:
    """Return the nats that the planted terms are worth in the training episodes.

    Args:
        drawn: a set with terms in rates and inputs; what acts on a sensor, or late, is left out.
        made: its data.
        only: number of one planted term, where the others are in the model and their parameters free.
        moving: what is asked is what the parameter is worth that is no constant, with every planted term in the model.
    """
    every = range(len(drawn.effects))
    beside = [i for i in every if i != only] if moving or only is not None else []
    system = SYSTEMS[drawn.system]
    begins = np.arange(0, ROWS, WINDOW)
    start = made.true[:TRAIN, begins].reshape(-1, len(system.states))
    commands = np.concatenate([made.commands[:TRAIN, b : b + WINDOW] for b in begins], axis=1)
    commands = commands.reshape(len(start), WINDOW, -1)
    of_window = np.tile(begins * system.dt, TRAIN)
    columns = [system.states.index(name) for name in drawn.measured]
    _, at = nuisances.parameters_of(
        drawn.nuisances, random_of(drawn, 1), made.parameters, TRAIN + TEST, ROWS * system.dt
    )

    def true(t: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parameters of every window, of which some are the same in an episode."""
        known = {name: np.asarray(value, float) for name, value in at(t).items()}
        return {n: np.repeat(v[:TRAIN], len(begins)) if v.shape == (TRAIN + TEST,) else v for n, v in known.items()}

    def run(
        x: np.ndarray, p: dict[str, float], *, lacking: bool, all_knobs: tuple[dict[str, float], ...] = made.knobs
    ) -> np.ndarray:
        there = beside if lacking else every
        moves = true if moving and not lacking else None
        rate = plant(system, p, tuple(drawn.effects[i] for i in there), tuple(all_knobs[i] for i in there), moves)
        states, _, _ = simulate(
            lambda s, u, t: rate(s, u, t + of_window), x, commands, system.dt,
            linear=nuisances.LINEAR in drawn.nuisances,
        )  # fmt: skip
        return states[..., columns] / made.noise[columns]

    without = run(start, made.parameters, lacking=True)
    added = run(start, made.parameters, lacking=False) - without
    by_start, by_parameter = [], []
    for i, size in enumerate(start.std(axis=0) * STEP):
        moved = start.copy()
        moved[:, i] += size
        by_start.append((run(moved, made.parameters, lacking=True) - without) / STEP)
    for name, (low, high) in system.ranges.items():
        moved = made.parameters | {name: made.parameters[name] + STEP * (high - low)}
        by_parameter.append((run(start, moved, lacking=True) - without) / STEP)
    for i in beside:
        for name in (n for n in made.knobs[i] if not n.startswith("_")):
            knobs = [dict(k) for k in made.knobs]
            knobs[i][name] *= 1 + STEP
            moved_term = run(start, made.parameters, lacking=True, all_knobs=tuple(knobs))
            by_parameter.append((moved_term - without) / STEP)
    left, rest = [], []
    for w in range(len(start)):  # first states are each window's own
        own = np.stack([s[w].ravel() for s in by_start], -1)
        target = np.stack([added[w].ravel(), *(s[w].ravel() for s in by_parameter)], -1)
        target = target - own @ np.linalg.lstsq(own, target, rcond=None)[0]
        left.append(target[:, 0])
        rest.append(target[:, 1:])
    d, shared = np.concatenate(left), np.concatenate(rest)
    d = d - shared @ np.linalg.lstsq(shared, d, rcond=None)[0]
    return float(0.5 * d @ d)
