"""How a world or a model moves from row to row, over all episodes at once."""

import numpy as np

from simulators.model import Model, ModelError
from simulators.worlds.rk4 import RK4
from simulators.worlds.world import World


def on_rows(source: Model | World, start: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
    """Follow n episodes, `dt` from row to row, inputs held in between.

    Args:
        source: the model or world.
        start: (n, ds) states in the first row.
        inputs: (n, rows, du); before the first row the first one was held.
        params: (n, dp).

    Returns:
        The states in every row, (n, rows, ds), not wrapped.

    Raises:
        ModelError: a state is not finite.

    """
    n, rows, _ = inputs.shape
    states = np.zeros((n, rows, len(source.states)))
    states[:, 0] = start
    model = RK4(source) if isinstance(source, Model) else None
    past = model.past(params) if model is not None else 0
    given = np.concatenate([np.repeat(inputs[:, :1], past, axis=1), inputs], axis=1)
    for j in range(1, rows):
        if model is not None:
            states[:, j] = model.follow(states[:, j - 1], given[:, j - 1 : j + past], params)
        elif not isinstance(source, Model):
            states[:, j] = source.step(states[:, j - 1], inputs[:, j - 1], params)
        check_finite(source, states[:, j], j * source.dt)
    return states


def check_finite(source: Model | World, states: np.ndarray, t: float) -> None:
    """Refuse states (n, ds) at t, s, that are not finite."""
    bad = np.argwhere(~np.isfinite(states))
    if len(bad):
        k, i = bad[0]
        raise ModelError(
            f"simulation: {source.states[i].name} of {source.name} is {states[k, i]} at t = {t:g} s of "
            f"episode {k}; narrow simulation.initial or the inputs, or give {source.name} smaller steps"
        )
