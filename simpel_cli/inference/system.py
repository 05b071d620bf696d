"""A simulator with the coordinates of its learning problem, and the units in which networks see it.

Normalisation is the same for every method: inputs by the box of the domain, targets by mean and standard deviation of
draws of the simulator over that box. Training data never enter it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.stats import binom

from simpel_cli.dynamics.divergence import divergence_error
from simpel_cli.dynamics.domain import Domain
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import Transition, encoding_of, transition
from simpel_cli.errors import ConfigError
from simpel_cli.inference.protocols import Normaliser
from simpel_cli.priors.function_prior import (
    MOST_CHANGE,
    SimulatorPrior,
    followed,
    instead_of_lost,
    reach_of,
    sample_parameters,
)
from simulators.model import Model
from simulators.parameters import draw
from simulators.worlds.world import World

NORMALISER_POINTS, NORMALISER_DRAWS = 1000, 64
WORLD_POINTS, WORLD_DRAWS = 200, 16  # of the normaliser, where a query costs a simulation and not a microsecond
DEFAULT_GAP_FRACTION = 0.1  # of the outputs' std, in the normaliser, where the simulator declares no gap
SURE = 0.95  # of the times that a share of `MOST_LOST` passes
MOST_LOST = 0.05  # share of the draws that may run away: more are no tails of a law, but a simulator that fails


class System(NamedTuple):
    """A simulator with the coordinates of its learning problem.

    Args:
        source: symbolic model, or a world with query access only.
        encoding: angle encoding, stacking, targets.
        domain: the declared box.
        transition: one-step map in JAX; None for a world.
    """

    source: Model | World
    encoding: Encoding
    domain: Domain
    transition: Transition | None

    def simulate(self, key: PRNGKeyArray, x: np.ndarray, n: int) -> np.ndarray:
        """Draw n simulators from p(phi) and run each at every input x (M, dx); returns (n, M, dy), float64.

        Raises:
            ConfigError: a simulator returned something that is not finite; names state, input and parameters.
        """
        return self.simulate_and_count(key, x, n)[0]

    def simulate_and_count(self, key: PRNGKeyArray, x: np.ndarray, n: int) -> tuple[np.ndarray, int]:
        """Return the same, and of how many draws the integration ran away, for which others stand.

        A law without ends has such draws in its tails.
        """
        if self.transition is not None:
            prior = SimulatorPrior(gap=None).bind(self.transition, *self.dims, np.ones(self.encoding.dim_x))
            values = np.asarray(jax.jit(prior.run, static_argnums=2)(key, jnp.asarray(x, jnp.float64), n))
            lost = self._lost(values)
            if lost is None:
                # the same key draws the same parameters again
                phi = np.asarray(sample_parameters(key, self.transition.params, n, jnp.dtype(jnp.float64)))
                raise divergence_error(self.source, self.encoding, x, phi, values)
        else:
            assert not isinstance(self.source, Model)
            values, phi, after = query(self.source, self.encoding, x, n, int(jax.random.bits(key)))
            lost = self._lost(values)
            if lost is None:
                raise divergence_error(self.source, self.encoding, x, phi, after)
        return np.asarray(instead_of_lost(values, reach_of(self.encoding))) if lost else values, lost

    def _lost(self, values: np.ndarray) -> int | None:
        """Return how many draws (n, M, dy) ran away; None: too many, and not all values are finite."""
        lost = len(values) - int(followed(values, reach_of(self.encoding)).sum())
        if lost <= binom.ppf(SURE, len(values), MOST_LOST):  # of few draws more may by chance
            return lost
        return 0 if np.isfinite(values).all() else None

    @property
    def dims(self) -> tuple[int, int]:
        """Numbers of network inputs and outputs, (dx, dy)."""
        return self.encoding.dim_x, self.encoding.dim_y


def system_of(source: Model | World, outputs: tuple[str, ...], stack: int) -> System:
    """Bind a simulator to its coordinates; a model is converted to JAX and checked against CasADi."""
    encoding = encoding_of(source, outputs, stack)
    if encoding.dim_y == 0:
        raise ConfigError(f"sim: {source.name} has neither states nor measured outputs: there is nothing to predict.")
    step = transition(source, encoding) if isinstance(source, Model) else None
    return System(source, encoding, Domain(encoding), step)


def query(
    world: World, encoding: Encoding, x: np.ndarray, n: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run n parameter draws of a world at every input (M, dx).

    Returns:
        Targets (n, M, dy), parameters (n, dp), and states one transition later (n, M, ds).
    """
    states, stacked = encoding.split_x(x)
    inputs = encoding.inputs_now(stacked)
    phi = draw(world.params, np.random.default_rng(seed), n)
    m = len(x)
    after = world.step(np.tile(states, (n, 1)), np.tile(inputs, (n, 1)), np.repeat(phi, m, axis=0))
    targets = encoding.to_y(np.tile(states, (n, 1)), after, np.zeros((n * m, 0)))
    return targets.reshape(n, m, -1), phi, after.reshape(n, m, -1)


def normaliser_of(system: System, key: PRNGKeyArray) -> Normaliser:
    """Return the normaliser of a system, float64.

    Raises:
        ConfigError: an output of the simulator does not vary over domain and parameters.
    """
    key_x, key_phi = jax.random.split(key)
    points, draws = (NORMALISER_POINTS, NORMALISER_DRAWS) if system.transition else (WORLD_POINTS, WORLD_DRAWS)
    x = np.asarray(system.domain.sample(key_x, points, jnp.float64))
    values = system.simulate(key_phi, x, draws).reshape(-1, system.encoding.dim_y)
    y_mean, spread = values.mean(axis=0), values.std(axis=0)
    gap = system.encoding.per_target(system.source.gap, np.nan)
    std = np.sqrt(spread**2 + np.where(np.isnan(gap), DEFAULT_GAP_FRACTION * spread, gap) ** 2)
    size = dict.fromkeys(system.encoding.y_names, 0.0) | {
        q.name: max(abs(q.low), abs(q.high)) for q in system.encoding.states
    }
    for name, value in zip(system.encoding.y_names, std, strict=True):
        if not (np.isfinite(value) and value > 1e-12 * max(1.0, size[name])):
            raise ConfigError(
                f"sim: the change of `{name}` in one transition has standard deviation {value} over the declared ranges. "
                "An output that never changes cannot be learned: check ranges and dynamics."
            )
    for q in system.encoding.states:
        change = 0.0 if q.periodic else std[system.encoding.y_names.index(q.name)]
        if change > MOST_CHANGE * (q.high - q.low):
            raise ConfigError(
                f"sim: in one transition `{q.name}` changes by {change:.3g} {q.unit} (standard deviation), its declared "
                f"range is {q.high - q.low:.3g}. The integration is unstable: raise sim.substeps, or narrow the ranges."
            )
    x_mean, x_std = system.domain.x_moments()
    return Normaliser(x_mean, x_std, y_mean, std)
