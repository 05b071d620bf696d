"""Steps of a fit: Levenberg-Marquardt on Fisher information, inside the unit box.

Reference: Levenberg (1944), Marquardt (1963).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

LEAST_CURVATURE = 12.0  # of a uniform prior
ENOUGH = 0.02  # nats: a step that promises less ends a fit
MOST_REJECTED = 6  # steps in a row
LEGS = 8  # of a step, between which unknowns meet the ends of their ranges
FIRST_DAMPING = 1e-2
REFUSED = 8  # times the damping after a step that did not help


class Course(NamedTuple):
    """Where the fits of a batch of hypotheses stand; NumPy outside the program, JAX inside; leading axis: hypotheses."""

    z: Any  # (L, n) where they started
    index: Any  # (L, width) of z that move: every level of noise, in order, then parameters of model and effects
    moves: Any  # (L, width) False: padding
    weight: Any  # (L, W)
    trial: Any  # (L, width) the next point to try
    part: Any  # (L, width) the best so far
    loss: Any
    gradient: Any
    fisher: Any
    damping: Any
    iteration: Any
    done: Any
    rejected: Any


def stepped(now: Course, new_loss: Array, new_gradient: Array, new_fisher: Array) -> Course:
    """One hypothesis after its trial was evaluated: taken or not, and the next trial."""
    better = new_loss < now.loss
    keep = lambda a, b: jnp.where(better, a, b)  # noqa: E731
    part, loss = keep(now.trial, now.part), keep(new_loss, now.loss)
    gradient, fisher = keep(new_gradient, now.gradient), keep(new_fisher, now.fisher)
    damping = jnp.where(better, jnp.maximum(now.damping / 5, 1e-6), jnp.minimum(now.damping * REFUSED, 1e8))
    rejected = jnp.where(better, 0, now.rejected + 1)
    following, promised = proposed(part, gradient, fisher, damping, now.moves)
    done = (promised < ENOUGH) | (rejected >= MOST_REJECTED)
    after = now._replace(
        trial=following, part=part, loss=loss, gradient=gradient, fisher=fisher, damping=damping,
        iteration=now.iteration + 1, done=done, rejected=rejected,
    )  # fmt: skip
    return jax.tree.map(lambda old, new: jnp.where(now.done, old, new), now, after)


def proposed(part: Array, gradient: Array, fisher: Array, damping: Array, moves: Array) -> tuple[Array, Array]:
    """Return the next trial and the gain that the quadratic model promises, inside the unit box.

    Where a step meets a wall it ends, what met it stays there, and the others are solved for again: every leg gains. Were the
    step only cut to the box, what is left of it could promise nothing far from any optimum, and end the fit there.

    Reference: Nocedal and Wright (2006), Numerical optimization, section 16.5 (active sets).
    """
    out = ((part <= 0) & (gradient > 0)) | ((part >= 1) & (gradient < 0)) | ~moves

    def leg(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        step, free = carry
        matrix = jnp.where(free[:, None] & free[None, :], fisher, 0.0)
        scale = jnp.maximum(jnp.diag(matrix), LEAST_CURVATURE)
        matrix = matrix + jnp.diag(jnp.where(free, (damping + 1e-9) * scale, 1.0))
        own = -jnp.linalg.solve(matrix, jnp.where(free, gradient + fisher @ step, 0.0))
        longest = jnp.max(jnp.abs(own))
        own = own * jnp.minimum(1.0, 0.3 / jnp.maximum(longest, 1e-12))  # a third of the prior's range at most
        room = jnp.where(own > 0, 1 - part - step, part + step)
        share = jnp.where(own != 0, room / jnp.maximum(jnp.abs(own), 1e-300), jnp.inf)
        least = jnp.minimum(jnp.min(share), 1.0)
        # a leg that meets no wall is the last one
        return step + least * own, free & (share > least) & (least < 1)

    step, _ = jax.lax.fori_loop(0, LEGS, leg, (jnp.zeros_like(part), ~out))
    following = jnp.clip(part + step, 0.0, 1.0)
    step = following - part
    return following, -(gradient @ step) - 0.5 * step @ fisher @ step
