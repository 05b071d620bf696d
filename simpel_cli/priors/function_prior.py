"""Priors over functions: a simulator with uncertain parameters plus a Gaussian process for what it lacks.

    h_i(X) = g_i(X, phi) + h~_i(X),   phi ~ p(phi),   h~_i ~ GP(0, kappa_i^2 rho(|x - x'|/l) + w)

The simulator part is sampled, the Gaussian part is known in closed form. `w` is the variance of a small white model
error that keeps the joint law of many points non-degenerate; it belongs to the prior, so every score estimator sees it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import OneStep, Transition
from simpel_cli.errors import ConfigError
from simpel_cli.priors.gaussian_process import Kernel, SquaredExponential, grams
from simpel_cli.runs.settings import current_device
from simulators.model import Quantity

WIDE = 64  # numbers in a transition
CACHED = 2**16  # numbers: a quarter of a megabyte in float32
MOST_CHANGE = 100.0  # times the declared range of a state, in one transition: what goes further has run away


@dataclass(frozen=True)
class GapGP:
    """Gaussian process for the gap between simulator and reality.

    Args:
        kernel: correlation function.
        lengthscale: `auto`: one per input and output, by the marginal likelihood of the training transitions, about
            2 sqrt(dx); null: that, in normalised inputs (unit variance on the domain); or a number.
        lengthscale_units: of the number, `normalised` or `raw`: data units.
        scale: kappa, the standard deviation per output. `auto` maximises the marginal likelihood of the training
            transitions; `declared` takes `gap:` of the simulator, and `auto` for what it leaves out; a number is a
            fraction of the outputs' normalising standard deviation.
    """

    kernel: Kernel = SquaredExponential()
    lengthscale: float | str | None = None
    lengthscale_units: str = "normalised"
    scale: float | str = "auto"

    def __post_init__(self) -> None:
        if self.lengthscale_units not in ("normalised", "raw"):
            raise ConfigError(
                f"prior.gap.lengthscale_units: got {self.lengthscale_units!r}; allowed are normalised and raw."
            )
        if isinstance(self.lengthscale, str) and self.lengthscale != "auto":
            raise ConfigError(
                f"prior.gap.lengthscale: got {self.lengthscale!r}; allowed are auto, null and a positive number."
            )
        if self.lengthscale is not None and not self.learns_lengthscales and not float(self.lengthscale) > 0:
            raise ConfigError(f"prior.gap.lengthscale: got {self.lengthscale}; it must be positive (or auto, or null).")
        if isinstance(self.scale, str) and self.scale not in ("declared", "auto"):
            raise ConfigError(f"prior.gap.scale: got {self.scale!r}; allowed are declared, auto and a number >= 0.")
        if not isinstance(self.scale, str) and not self.scale >= 0:
            raise ConfigError(f"prior.gap.scale: got {self.scale}; a number must be >= 0 (0 switches the gap off).")

    @property
    def learns_lengthscales(self) -> bool:
        """Whether the training transitions choose the lengthscales."""
        return self.lengthscale == "auto"


class FunctionPrior(NamedTuple):
    """A prior bound to a system; see `simpel_cli.inference.protocols.PriorProcess`.

    Args:
        draws: number of simulator draws, N.
        white_variance: variance of the white model error, normalised output units.
        kernel: correlation of the gap; None: no gap.
        input_scale: factor from normalised inputs to units of the lengthscale, shape (dx,).
        params: uncertain parameters of the simulator.
        step: the simulator's one-step map; None: no simulator part (zero).
        width: numbers that the integration of one transition carries.
        dim_y: number of outputs.
        reach: (dy,) how far an output can be in a draw whose integration did not run away; inf: it has to be finite.
    """

    draws: int
    white_variance: float
    kernel: Kernel | None
    input_scale: Float[Array | np.ndarray, " dx"]
    params: tuple[Quantity, ...]
    step: OneStep | None
    width: int
    dim_y: int
    reach: np.ndarray | float = np.inf

    @property
    def simulates(self) -> bool:
        """Whether a simulator is in it that can be run."""
        return self.step is not None

    def simulate(self, key: PRNGKeyArray, x: Float[Array, "M dx"], n: int) -> Float[Array, "n M dy"]:
        """Draw n parameter vectors and run the simulator of each at every input (data units).

        Of a law without ends a few draws are out of what the integration follows: others take their place.
        """
        return instead_of_lost(self.run(key, x, n), self.reach)

    def run(self, key: PRNGKeyArray, x: Float[Array, "M dx"], n: int) -> Float[Array, "n M dy"]:
        """Return the same with every draw as it came out, which of some may not be finite."""
        if self.step is None:
            return jnp.zeros((n, x.shape[0], self.dim_y), x.dtype)
        phi = sample_parameters(key, self.params, n, x.dtype)
        at_all_inputs = jax.vmap(self.step, in_axes=(0, None))
        draws: Array = self.a_few_at_a_time(lambda one: at_all_inputs(x, one), phi, copies=x.shape[0])
        return draws

    def a_few_at_a_time(self, run: Callable[[Array], Array], over: Array, copies: int) -> Array:
        """Apply a function of simulations along the first axis; of wide simulators so many at a time as fit the cache.

        Args:
            run: of one entry.
            over: entries along the first axis.
            copies: transitions that one entry takes.
        """
        if self.width <= WIDE or current_device().platform != "cpu":
            return jax.vmap(run)(over)
        return jax.lax.map(run, over, batch_size=min(max(1, CACHED // (self.width * copies)), over.shape[0]))

    def covariance(
        self,
        x: Float[Array, "M dx"],
        scale: Float[Array | np.ndarray, " dy"],
        relevance: Float[Array | np.ndarray, "dy dx"] | None = None,
    ) -> Float[Array, "dy M M"]:
        """Covariance of the Gaussian part.

        Args:
            x: normalised inputs.
            scale: kappa.
            relevance: see `correlation`.
        """
        white = self.white_variance * jnp.eye(x.shape[0], dtype=x.dtype)
        if self.kernel is None:
            return jnp.broadcast_to(white[None], (self.dim_y, *white.shape))
        variance = jnp.asarray(scale) ** 2
        return variance[:, None, None] * self.correlation(x, x, relevance) + white[None]

    def correlation(
        self,
        x: Float[Array, "n dx"],
        other: Float[Array, "c dx"],
        relevance: Float[Array | np.ndarray, "dy dx"] | None = None,
    ) -> Float[Array, "d n c"]:
        """Correlation of the gap between normalised inputs: one that all outputs share (d = 1), or each its own (d = dy).

        Args:
            x: inputs.
            other: inputs.
            relevance: of every input to every output, one over its lengthscale; None: `input_scale`.
        """
        assert self.kernel is not None
        each = jnp.asarray(self.input_scale)[None] if relevance is None else jnp.asarray(relevance)
        return grams(self.kernel, x, other, each.astype(x.dtype))


@dataclass(frozen=True)
class SimulatorPrior:
    """Simulator with parameter ranges, plus a gap GP.

    Args:
        gap: what the simulator lacks; null = nothing (only the simulator).
        draws: number of parameter draws that the score is estimated from, N.
        white_variance: variance of the white model error, normalised output units; relative to the unit variance that
            outputs have under the prior.
    """

    gap: GapGP | None = GapGP()
    draws: int = 256
    white_variance: float = 1e-4

    uses_simulator = True  # not a field: the targets' normaliser and `fit` ask for it

    def __post_init__(self) -> None:
        if self.draws < 2:
            raise ConfigError(f"prior.draws: got {self.draws}; a covariance needs at least 2.")
        if not self.white_variance > 0:
            raise ConfigError(f"prior.white_variance: got {self.white_variance}; it must be positive.")

    def bind(
        self, system: Transition | None, dim_x: int, dim_y: int, x_std: Float[Array | np.ndarray, " dx"]
    ) -> FunctionPrior:
        """Bind to a simulator (None: it can only be queried, and its draws come as a bank)."""
        step, params, width = (system.step, system.params, system.width) if system is not None else (None, (), 0)
        kernel = self.gap.kernel if self.gap is not None else None
        input_scale = _input_scale(self.gap, x_std) if self.gap is not None else np.ones(dim_x)
        reach = reach_of(system.encoding) if system is not None else np.inf
        return FunctionPrior(self.draws, self.white_variance, kernel, input_scale, params, step, width, dim_y, reach)


@dataclass(frozen=True)
class GPPrior:
    """A Gaussian process without a simulator, on normalised inputs and outputs.

    Args:
        kernel: correlation function.
        lengthscale: in normalised inputs.
        scale: standard deviation in normalised outputs; `auto`: chosen per output by marginal likelihood.
        white_variance: variance of the white model error, normalised output units.
    """

    kernel: Kernel = SquaredExponential()
    lengthscale: float = 0.4
    scale: float | str = 1.0
    white_variance: float = 1e-3

    def __post_init__(self) -> None:
        if isinstance(self.scale, str) and self.scale != "auto":
            raise ConfigError(f"prior.scale: got {self.scale!r}; allowed are auto and a positive number.")
        if isinstance(self.lengthscale, str):
            raise ConfigError(f"prior.lengthscale: got {self.lengthscale!r}; it must be a positive number.")
        for name in ("lengthscale", "scale", "white_variance"):
            value = getattr(self, name)
            if not isinstance(value, str) and not value > 0:
                raise ConfigError(f"prior.{name}: got {value}; it must be positive.")

    uses_simulator = False
    draws = 2  # two zero draws: mean and covariance of the (absent) simulator part are exactly zero

    @property
    def gap(self) -> GapGP:
        """The process itself, as the Gaussian part of a prior whose simulator part is zero."""
        return GapGP(self.kernel, self.lengthscale, "normalised", self.scale)

    def bind(
        self, system: Transition | None, dim_x: int, dim_y: int, x_std: Float[Array | np.ndarray, " dx"]
    ) -> FunctionPrior:
        """Bind to the dimensions of a system; its simulator is not used."""
        return FunctionPrior(
            self.draws, self.white_variance, self.kernel, _input_scale(self.gap, x_std), (), None, 0, dim_y
        )


def reach_of(encoding: Encoding) -> np.ndarray:
    """Return how far every target can be, data units (dy,); an output that has no range and an angle can be anywhere."""
    ranges = {q.name: MOST_CHANGE * (q.high - q.low) for q in encoding.states if not q.periodic}
    return encoding.per_target(ranges, np.inf)


def followed(draws: Array | np.ndarray, reach: np.ndarray | float) -> Array:
    """Return which draws (n, M, dy) the integration followed, (n,): finite, and within reach, everywhere."""
    draws = jnp.asarray(draws)  # before its kind of number is asked for: doubles may become singles here
    most = jnp.minimum(jnp.asarray(reach, draws.dtype), jnp.finfo(draws.dtype).max)
    return jnp.all(jnp.abs(draws) <= jnp.reshape(most, (1, 1, -1)), axis=(1, 2))


def instead_of_lost(draws: Array | np.ndarray, reach: np.ndarray | float) -> Array:
    """Return draws (n, M, dy) with those that the integration followed in place of the others, one after the other."""
    draws = jnp.asarray(draws)
    good = followed(draws, reach)
    order = jnp.argsort(~good, stable=True)[jnp.arange(len(draws)) % jnp.maximum(good.sum(), 1)]
    return jnp.where(good[:, None, None], draws, draws[order])


def _input_scale(gap: GapGP, x_std: Float[Array | np.ndarray, " dx"]) -> Float[Array | np.ndarray, " dx"]:
    if gap.lengthscale is None or isinstance(gap.lengthscale, str):
        return np.full(len(x_std), 0.5 / len(x_std) ** 0.5)
    lengthscale = gap.lengthscale
    return x_std / lengthscale if gap.lengthscale_units == "raw" else np.full(len(x_std), 1 / lengthscale)


def sample_parameters(
    key: PRNGKeyArray, params: tuple[Quantity, ...], n: int, dtype: jnp.dtype
) -> Float[Array, "n dp"]:
    """Draw n parameter vectors from p(phi).

    Uniform on the range; for normal and lognormal priors the range is mean +- 2 standard deviations (of the log).
    """
    low, high = (jnp.asarray([getattr(q, end) for q in params], dtype) for end in ("low", "high"))
    log = np.array([q.prior == "lognormal" for q in params], bool)
    gaussian = np.array([q.prior != "uniform" for q in params], bool)
    low, high = (jnp.where(log, jnp.log(jnp.where(log, b, 1.0)), b) for b in (low, high))
    key_uniform, key_normal = jax.random.split(key)
    uniform = jax.random.uniform(key_uniform, (n, len(params)), dtype)
    normal = jax.random.normal(key_normal, (n, len(params)), dtype)
    middle, width = ((low + high) / 2)[None], (high - low)[None]
    draws = jnp.where(gaussian[None], middle + width / 4 * normal, low[None] + width * uniform)
    return jnp.where(log[None], jnp.exp(jnp.where(log[None], draws, 0.0)), draws)
