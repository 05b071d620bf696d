"""A world: a simulator that answers queries and shows no equations, such as MuJoCo or a program of the user's."""

from typing import Protocol, runtime_checkable

import numpy as np

from simulators.model import Quantity


@runtime_checkable
class World(Protocol):
    """Query access to one transition of `dt` seconds.

    What a `_target_` of the `sim:` group returns from `.model()` when it has no symbolic model. Its parameters have a
    prior like those of a `Model`, so that it can serve as simulation prior; it has no gradients.
    """

    @property
    def name(self) -> str:
        """Letters, digits and underscores."""

    @property
    def dt(self) -> float:
        """Duration of one transition, s."""

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Return the ds states; together they determine the future."""

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Return the du inputs, held constant over a transition."""

    @property
    def params(self) -> tuple[Quantity, ...]:
        """Return the dp uncertain parameters with their prior."""

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """Return nothing: a world is observed through its states (a `Model` may have further outputs)."""

    @property
    def gap(self) -> dict[str, float]:
        """Expected error of one transition by state, in its unit; empty where nothing is stated."""

    def step(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Answer n independent queries.

        Args:
            states: (n, ds); periodic ones may lie anywhere.
            inputs: (n, du).
            params: (n, dp), one parameter vector per query.

        Returns:
            The states dt later, (n, ds), not wrapped; a row of NaN where the world could not go on.

        """


@runtime_checkable
class FinerWorld(World, Protocol):
    """A world that also answers for a part of a transition."""

    def shorter(self, duration: float) -> World:
        """Return the world whose `step` goes on for `duration` s only, at most `dt`.

        The states, commands on their way among them, mean what they mean in the middle of a transition.

        Raises:
            ModelError: its time steps do not reach that instant.

        """
