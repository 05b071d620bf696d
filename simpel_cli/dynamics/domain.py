"""The box on which functions are compared: the measurement distribution zeta of the functional prior."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.dynamics.encoding import Encoding


@dataclass(frozen=True)
class Domain:
    """Uniform distribution on the declared ranges of states and inputs.

    Args:
        encoding: gives the quantities (with ranges) and the map to network inputs.
    """

    encoding: Encoding

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner in physical units, each (ds + dim_inputs,)."""
        enc = self.encoding
        quantities = [*enc.states, *(list(enc.inputs) * (enc.stack + 1)), *(enc.inputs[i] for i in enc.linear)]
        return np.array([q.low for q in quantities]), np.array([q.high for q in quantities])

    def sample(self, key: PRNGKeyArray, n: int, dtype: DTypeLike) -> Float[Array, "n dx"]:
        """Draw n network inputs (data units), uniform in the box, angles encoded; each of one group."""
        low, high = (jnp.asarray(b, dtype) for b in self.bounds())
        points = jax.random.uniform(key, (n, low.shape[0]), dtype) * (high - low)[None] + low[None]
        for columns in self._one_of():
            key, key_group = jax.random.split(key)
            group = jax.random.randint(key_group, (n,), 0, columns.shape[1], jnp.int32)
            for row in columns:
                points = points.at[:, row].set(jax.nn.one_hot(group, len(row), dtype=dtype))
        ds = len(self.encoding.states)
        return self.encoding.to_x(points[:, :ds], points[:, ds:])

    def x_moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation of a network input: (high+low)/2 and (high-low)/sqrt(12); angles 0, 1/sqrt 2."""
        low, high = self.bounds()
        mean, std = [], []
        angles = [*(q.periodic for q in self.encoding.states), *[False] * (len(low) - len(self.encoding.states))]
        for a, b, periodic in zip(low, high, angles, strict=True):
            mean.extend([0.0, 0.0] if periodic else [(a + b) / 2])
            std.extend([np.sqrt(0.5)] * 2 if periodic else [(b - a) / np.sqrt(12)])
        found = np.array(mean), np.array(std)
        for columns in self._one_of():
            share = 1 / columns.shape[1]
            for row in columns:
                at = row - len(self.encoding.states) + self.encoding.dim_state
                found[0][at], found[1][at] = share, np.sqrt(share * (1 - share))
        return found

    def _one_of(self) -> list[np.ndarray]:
        """Columns of the box that say which group a row is of, (stack + 1, groups) each."""
        enc = self.encoding
        first = len(enc.states) + np.arange(enc.stack + 1)[:, None] * len(enc.inputs)
        return [first + np.array(slots)[None] for slots in enc.one_of]
