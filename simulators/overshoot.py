"""How far the line that stands for a late input within a step may go beyond the range of the input.

A held input that arrives within a step is a straight line there, with the same mean and first moment, whose ends lie beyond the
two values by a third of their distance at most. What a simulator does there is no matter of physics, but it has to be defined,
as a root need not be, and to go on as it does within: a command that is clipped at its range does not, and the mean of its line
would be another.
"""

import casadi
import numpy as np

from simulators.model import Model

BEYOND = 1 / 3  # of the width of a range
POINTS = 16  # of the others, at which the model is tried
GOES_ON = 0.5  # of what an input changes in as much of its range: so far a rate may be from where a parabola leads


def reach(model: Model) -> tuple[tuple[float, float], ...]:
    """Return the range that the line of every input keeps to: the declared one, and beyond where the rates go on as within."""
    if not (model.states and model.inputs):
        return tuple((q.low, q.high) for q in model.inputs)
    everywhere = model.function()
    random = np.random.default_rng(0)
    groups = model.states, model.inputs, model.params
    x, u, p = (np.array([random.uniform(q.low, q.high, POINTS) for q in g]).reshape(len(g), POINTS) for g in groups)

    def rates(i: int, at: float) -> np.ndarray:
        there = u.copy()
        there[i] = at
        return np.array(casadi.DM(everywhere(x, there, p)[0]).full())

    def goes_on(i: int, end: float, way: float) -> bool:
        """Whether it does beyond an end, half as far and as far as `way`; points where it is undefined within are left out."""
        first, second, third, near, far = (rates(i, end + k * way / 2) for k in (-2, -1, 0, 1, 2))
        asked = np.isfinite(first) & np.isfinite(second) & np.isfinite(third)
        change, bend = third - second, third - 2 * second + first
        most = GOES_ON * (np.abs(third - second) + np.abs(second - first)) + 1e-9 * np.abs(third)
        for k, there in ((1, near), (2, far)):
            led = third + k * change + k * (k + 1) / 2 * bend
            if not (np.isfinite(there[asked]).all() and np.all(np.abs(there - led)[asked] <= most[asked])):
                return False
        return bool(asked.any())

    found = []
    for i, q in enumerate(model.inputs):
        wide = BEYOND * (q.high - q.low)
        found.append((q.low - wide * goes_on(i, q.low, -wide), q.high + wide * goes_on(i, q.high, wide)))
    return tuple(found)
