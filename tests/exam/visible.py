"""How much of a planted term the data can show, in nats, where no name of the tool's can be asked for its evidence.

Over windows, d is what the term adds to the noise-free measurements; what other parameters and first states could do for it
is taken out by least squares. The expected log-likelihood ratio of the true model over the best one without is then
1/2 sum (d / sigma)^2, to first order.
"""

import numpy as np

from tests.exam.draw import Set
from tests.exam.integrate import simulate
from tests.exam.plants import SYSTEMS
from tests.exam.record import ROWS, TRAIN, Record, plant

WINDOW = 15  # rows: short enough for first order
STEP = 1e-4  # of a range or of a state's standard deviation


def visible(drawn: Set, made: Record, only: int | None = None) -> float:
    """Return the nats that the planted terms are worth in the training episodes.

    Args:
        drawn: a set with terms in rates and inputs only.
        made: its data.
        only: number of one planted term, where the others are in the model and their parameters free.
    """
    beside = [] if only is None else [i for i in range(len(drawn.effects)) if i != only]
    system = SYSTEMS[drawn.system]
    begins = np.arange(0, ROWS, WINDOW)
    start = made.true[:TRAIN, begins].reshape(-1, len(system.states))
    commands = np.concatenate([made.commands[:TRAIN, b : b + WINDOW] for b in begins], axis=1)
    commands = commands.reshape(len(start), WINDOW, -1)
    of_window = np.tile(begins * system.dt, TRAIN)
    columns = [system.states.index(name) for name in drawn.measured]

    def run(
        x: np.ndarray, p: dict[str, float], *, lacking: bool, all_knobs: tuple[dict[str, float], ...] = made.knobs
    ) -> np.ndarray:
        there = beside if lacking else range(len(drawn.effects))
        rate = plant(system, p, tuple(drawn.effects[i] for i in there), tuple(all_knobs[i] for i in there))
        states, _, _ = simulate(lambda s, u, t: rate(s, u, t + of_window), x, commands, system.dt)
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
