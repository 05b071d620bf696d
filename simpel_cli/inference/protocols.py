"""What every inference rule takes and gives: a problem in normalised units, and init / draw / step / predict.

A posterior = a functional prior x a score estimator x an inference rule. The rule sees arrays only.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from simpel_cli.inference.noise import NoiseModel, Numbers
from simpel_cli.inference.predictive import Predictive


class Normaliser(NamedTuple):
    """Affine maps between data units and the units in which networks work."""

    x_mean: Float[Numbers, " dx"]
    x_std: Float[Numbers, " dx"]
    y_mean: Float[Numbers, " dy"]
    y_std: Float[Numbers, " dy"]

    def x(self, x: Float[Numbers, "n dx"]) -> Float[Array, "n dx"]:
        """Normalise network inputs."""
        return (jnp.asarray(x) - self.x_mean[None]) / self.x_std[None]

    def y_to_data(self, h: Float[Array, "L n dy"]) -> Float[Array, "L n dy"]:
        """Bring normalised function values to data units."""
        return h * self.y_std[None, None] + self.y_mean[None, None]


class Bank(NamedTuple):
    """Prior draws at fixed points, for simulators that can only be queried: (B, dy, N) at inputs (B, dx).

    The first rows belong to the (padded) training inputs, in their order.
    """

    x: Float[Numbers, "B dx"]
    samples: Float[Numbers, "B dy N"]


class Problem(NamedTuple):
    """Everything a compiled program reads, as one argument of fixed shape (so that runs share programs).

    Training arrays are padded to a common length; only the first `m` rows count. Inputs `x` are in data units,
    targets `y`, `gap_scale`, `noise_init` and `noise_floor` in normalised output units. Where the noise is Student's t, `tail`
    is 1/nu; None: it is Gaussian. `precision` is how much every target counts: its noise has the variance sigma^2/precision, or
    None: all count alike; where `tells` is 0, the target says nothing of sigma (it was estimated, or lies at a sensor's end).
    `weights` is what a rule in closed form takes of both, precision times expected weight under Student's t; None: 1.
    `noise_rms` is the typical scale of every target's noise in the unit of its expression (`noise_scale`); None: it has none.
    `gap_relevance` is one over the gap's lengthscale, of every normalised input to every output; None: those of the prior.
    """

    x: Float[Numbers, "m_padded dx"]
    y: Float[Numbers, "m_padded dy"]
    m: Int[Numbers, ""]
    normaliser: Normaliser
    gap_scale: Float[Numbers, " dy"]
    noise_init: Float[Numbers, " dy"]
    noise_floor: Float[Numbers, " dy"]
    bank: Bank | None = None
    tail: Float[Numbers, " dy"] | None = None
    weights: Float[Numbers, "m_padded dy"] | None = None
    precision: Float[Numbers, "m_padded dy"] | None = None
    tells: Float[Numbers, "m_padded dy"] | None = None
    noise_rms: Float[Numbers, " dy"] | None = None
    gap_relevance: Float[Numbers, "dy dx"] | None = None

    def counted(self, rows: Int[Array, " b"] | None = None) -> "Counted | None":
        """Return how much targets count; rows: which of them, None: all; None: all count alike."""
        if self.precision is None or self.tells is None:
            return None
        found = jnp.asarray(self.precision), jnp.asarray(self.tells)
        return Counted(*(a if rows is None else a[rows] for a in found))

    @property
    def tails(self) -> Float[Array, " dy"] | None:
        """1/nu of Student's t noise as an array of the program; None: the noise is Gaussian."""
        return None if self.tail is None else jnp.asarray(self.tail)


FEWEST = 5  # targets that tell of an output's noise; of fewer, it is what the measurements say of theirs


class Training(NamedTuple):
    """Training transitions of one seed.

    Args:
        x: inputs, (m, dx).
        y: targets, (m, dy).
        precision: how much each target counts, its noise has the variance sigma^2/precision, (m, dy); None: all alike.
        tells: 0 where a target says nothing of sigma, else 1, (m, dy); None: 1.
        beyond: 1 or -1 where a target is the high or the low end of its sensor, and its quantity there or beyond, else 0,
            (m, dy); None: none is. Such a target does not tell, and counts as `inference.censored` makes it.
    """

    x: np.ndarray
    y: np.ndarray
    precision: np.ndarray | None = None
    tells: np.ndarray | None = None
    beyond: np.ndarray | None = None

    @property
    def silent(self) -> np.ndarray:
        """Return the outputs of which too few targets tell of the noise, (dy,)."""
        if self.tells is None or len(self.y) == 0:
            return np.zeros(self.y.shape[1], bool)
        return np.asarray((self.tells > 0).sum(axis=0) < FEWEST)

    def take(self, rows: np.ndarray) -> "Training":
        """Return some of the rows."""
        return Training(*(None if a is None else a[rows] for a in self))  # type: ignore[arg-type]


def multiplied(one: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    """Return the product of two weights, of which None is 1."""
    if one is None or other is None:
        return other if one is None else one
    return one * other


class Counted(NamedTuple):
    """How much targets count, and whether they tell of the noise (`Problem`), (n, dy) each."""

    precision: Float[Array, "n dy"]
    tells: Float[Array, "n dy"]

    def misfit(
        self,
        error: Float[Array, "*L n dy"],
        sigma: Float[Array, " dy"],
        law: Callable[[Float[Array, "*L n dy"]], Float[Array, "*L n dy"]],
    ) -> Float[Array, "*L n dy"]:
        """Return minus the log density of every target, up to a constant.

        Where a target does not tell of sigma, sigma is taken as known.

        Args:
            error: measured minus predicted.
            sigma: scale of the noise.
            law: minus the log density of a standardised error, without the scale's logarithm.
        """
        known = jnp.where(self.tells > 0, sigma[None], jax.lax.stop_gradient(sigma)[None])
        # of every particle alike
        lead = (1,) * (error.ndim - 2)
        root, learned = (
            a.reshape(*lead, *a.shape) for a in (jnp.sqrt(self.precision) / known, jnp.log(sigma)[None] * self.tells)
        )
        return law(error * root) + learned


@runtime_checkable
class PriorProcess(Protocol):
    """A prior over functions: draws of its simulator part, and the covariance of its Gaussian part."""

    @property
    def draws(self) -> int:
        """Number of simulator draws, N."""
        ...

    @property
    def simulates(self) -> bool:
        """Whether there is a simulator part; without one the prior is centred on the mean of the normaliser."""
        ...

    def simulate(self, key: PRNGKeyArray, x: Float[Array, "M dx"], n: int) -> Float[Array, "n M dy"]:
        """Draw the simulator part at inputs in data units; data units out."""
        ...

    def covariance(
        self, x: Float[Array, "M dx"], scale: Float[Numbers, " dy"], relevance: Float[Numbers, "dy dx"] | None = None
    ) -> Float[Array, "dy M M"]:
        """Covariance of the Gaussian part at normalised inputs, in normalised output units; relevance: `gap_relevance`."""
        ...


@runtime_checkable
class ScoreEstimator(Protocol):
    """Score of the joint log density of one output at M points; the caller vmaps over outputs."""

    @property
    def gap_draws(self) -> bool:
        """Whether draws of the Gaussian part are needed, beside its covariance."""
        ...

    def __call__(
        self,
        h: Float[Array, "L M"],
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Float[Array, "L M"]:
        """Return the scores at L function values; see `simpel_cli.scores.estimator`."""
        ...


class Setting(NamedTuple):
    """The static half of a problem: what is called while a program is traced."""

    prior: PriorProcess
    score: ScoreEstimator
    sample_inputs: Callable[[PRNGKeyArray, int], Float[Array, "n dx"]]


class Info(NamedTuple):
    """What a step reports; noise_std: standard deviations; mean_kernel: between particles, 0 where they do not interact."""

    loss: Float[Array, ""]
    noise_std: Float[Array, " dy"]
    mean_kernel: Float[Array, ""]


class Inference(NamedTuple):
    """An inference rule bound to a problem; every function is pure.

    init(key) -> State; draw(key, State at its beginning) -> material for a stretch of steps that is not worth keeping;
    step(key, State, what was drawn) -> (State, Info); predict(State, x in data units) -> Predictive in data units;
    members(State, x of every particle) -> targets of every particle, for roll-outs along each particle's own path.
    Where the noise differs from row to row: typical is predict with the noise of a typical row; relative(x, targets) -> noise
    of every row's targets over the typical one. None: it is the same in every row.
    """

    init: Callable[[PRNGKeyArray], Any]
    draw: Callable[[PRNGKeyArray, Any], Any]
    step: Callable[[PRNGKeyArray, Any, Any], tuple[Any, Any]]
    predict: Callable[[Any, Float[Array, "n dx"]], Predictive]
    members: Callable[[Any, Float[Array, "L n dx"]], Float[Array, "L n dy"]]
    typical: Callable[[Any, Float[Array, "n dx"]], Predictive] | None = None
    relative: Callable[[Float[Array, "n dx"], Float[Array, "n dy"]], Float[Array, "n dy"]] | None = None


@runtime_checkable
class Method(Protocol):
    """A method YAML: hyperparameters first, data last."""

    @property
    def steps(self) -> int:
        """Number of steps to take."""
        ...

    @property
    def particles(self) -> int:
        """Number of members of the posterior, L."""
        ...

    @property
    def pool(self) -> int:
        """Number of domain points that a stretch of steps chooses from."""
        ...

    @property
    def uses_score(self) -> bool:
        """Whether a score of the prior is estimated."""
        ...

    @property
    def noise(self) -> "NoiseModel":
        """Observation noise."""
        ...

    def bind(self, setting: Setting, problem: Problem) -> Inference:
        """Return the rule for this problem; called while tracing, so that arrays stay arguments of the program."""
        ...


def padded_length(m: int) -> int:
    """Return the length that m rows are padded to: powers of two from 32, so that few programs are compiled."""
    return max(32, 1 << (m - 1).bit_length())


def pad_rows(a: np.ndarray, length: int) -> np.ndarray:
    """Repeat the last row until there are `length` rows; padding is never read as data, but must be simulable."""
    return np.concatenate([a, np.repeat(a[-1:], length - len(a), axis=0)]) if len(a) < length else a
