"""How far the line that stands for a late input within a step may go beyond the range of the input.

A held input that arrives within a step is a straight line there, with the same mean and first moment, whose ends lie beyond the
two values by a third of their distance at most. What a simulator does there is no matter of physics, but it has to be defined:
a root or a logarithm need not be.
"""

import casadi
import numpy as np

from simulators.model import Model

BEYOND = 1 / 3  # of the width of a range
POINTS = 32  # at which the model is tried beyond each end


def reach(model: Model) -> tuple[tuple[float, float], ...]:
    """Return the range that the line of every input keeps to: the declared one, and beyond where the model is finite."""
    if not (model.states and model.inputs):
        return tuple((q.low, q.high) for q in model.inputs)
    everywhere = model.function()
    random = np.random.default_rng(0)
    groups = model.states, model.inputs, model.params
    x, u, p = (np.array([random.uniform(q.low, q.high, POINTS) for q in g]).reshape(len(g), POINTS) for g in groups)

    def defined(i: int, end: float, way: float) -> bool:
        there = u.copy()
        there[i] = end + way * np.linspace(0, 1, POINTS)
        return all(np.isfinite(casadi.DM(of).full()).all() for of in everywhere(x, there, p))

    found = []
    for i, q in enumerate(model.inputs):
        wide = BEYOND * (q.high - q.low)
        found.append(
            (q.low - wide * defined(i, q.low, -wide), q.high + wide * defined(i, q.high, wide)),
        )
    return tuple(found)
