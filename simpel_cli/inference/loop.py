"""The one driver of everything that learns: an (init, draw, step) rule run in compiled stretches of fixed length.

Every step's key is fold_in(key, absolute step), every stretch's draws come from fold_in(key, its first step), and
checkpoints lie at the ends of stretches: a resumed run repeats bit for bit what an uninterrupted one does. Seeds are
vmapped; problem arrays are arguments, so that runs of the same shapes share one compiled program.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PRNGKeyArray

from simpel_cli.errors import ConfigError, Interrupted, NumericsError
from simpel_cli.runs.interruption import interruption


@runtime_checkable
class Rule(Protocol):
    """The part of an inference rule that the driver needs; see `simpel_cli.inference.protocols.Inference`."""

    @property
    def init(self) -> Callable[[PRNGKeyArray], Any]:
        """Key to state."""
        ...

    @property
    def draw(self) -> Callable[[PRNGKeyArray, Any], Any]:
        """Key and state at its beginning to what a stretch of steps works on."""
        ...

    @property
    def step(self) -> Callable[[PRNGKeyArray, Any, Any], tuple[Any, Any]]:
        """Key, state and draws to the next state and what to report."""
        ...


class Stretch(NamedTuple):
    """What the host sees after every stretch of steps."""

    step: int  # steps taken so far
    state: Any  # leaves (seeds, ...)
    info: Any  # numpy leaves (seeds, steps of the stretch, ...)


class Program(NamedTuple):
    """A rule compiled for the shapes of its problems."""

    init: Callable[[Any, PRNGKeyArray], Any]
    advance: Callable[[Any, PRNGKeyArray, Any, Array, Array], tuple[Any, Any]]
    problems: Any
    keys: Key[Array, " seeds"]
    stretch: int
    compile_seconds: float


def compiled(bind: Callable[[Any], Rule], problems: Any, keys: Key[Array, " seeds"], stretch: int) -> Program:
    """Compile a rule ahead of time.

    Args:
        bind: problem -> rule, called while tracing.
        problems: problem arrays, leaves (seeds, ...).
        keys: one per seed.
        stretch: longest number of steps of one call.
    """

    def advance(problems: Any, keys: Key[Array, " seeds"], states: Any, start: Array, length: Array) -> tuple[Any, Any]:
        def one(problem: Any, key: PRNGKeyArray, state: Any) -> tuple[Any, Any]:
            rule = bind(problem)
            key_draw, key_step = jax.random.split(key)
            draws = rule.draw(jax.random.fold_in(key_draw, start), state)

            def body(i: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
                state, infos = carry
                state, info = rule.step(jax.random.fold_in(key_step, start + i), state, draws)
                return state, jax.tree.map(lambda buffer, value: buffer.at[i].set(value), infos, info)

            shape = jax.eval_shape(rule.step, key_step, state, draws)[1]
            infos = jax.tree.map(lambda s: jnp.zeros((stretch, *s.shape), s.dtype), shape)
            # a loop of dynamic length: the last, shorter stretch needs no second program
            return jax.lax.fori_loop(jnp.int32(0), length, body, (state, infos))

        return jax.vmap(one)(problems, keys, states)

    began = time.perf_counter()
    count = jnp.int32(0)
    shapes = state_shape(bind, problems, keys)
    # the old state's memory is given to the new one
    ready = jax.jit(advance, donate_argnums=2).lower(problems, keys, shapes, count, count).compile()
    return Program(jax.jit(_init(bind)), ready, problems, keys, stretch, time.perf_counter() - began)


def state_shape(bind: Callable[[Any], Rule], problems: Any, keys: Key[Array, " seeds"]) -> Any:
    """Return shapes and dtypes of the state, as a tree, without compiling anything."""
    return jax.eval_shape(_init(bind), problems, keys)


def _init(bind: Callable[[Any], Rule]) -> Callable[[Any, Key[Array, " seeds"]], Any]:
    def init(problems: Any, keys: Key[Array, " seeds"]) -> Any:
        return jax.vmap(lambda problem, key: bind(problem).init(key))(problems, keys)

    return init


def train(program: Program, steps: int, *, state: Any = None, start: int = 0) -> Iterator[Stretch]:
    """Run a rule for `steps` steps and yield after every stretch.

    Args:
        program: of `compiled`.
        steps: total number of steps, counted from 0.
        state: where to go on; None: initialise.
        start: steps already taken.

    Raises:
        NumericsError: a quantity of a step is not finite; names it and the step.
        Interrupted: Ctrl-C or SIGTERM; the state was yielded before.
    """
    if start % program.stretch and start != steps:
        raise ConfigError(f"the checkpoint lies at step {start}, no multiple of {program.stretch} steps; fit again.")
    state = program.init(program.problems, program.keys) if state is None else state
    with interruption() as interrupted:
        while start < steps:
            length = min(program.stretch, steps - start)
            state, info = program.advance(program.problems, program.keys, state, jnp.int32(start), jnp.int32(length))
            info = jax.tree.map(lambda a, n=length: np.asarray(a)[:, :n], info)
            _refuse_non_finite(info, start)
            start += length
            yield Stretch(start, state, info)
            if interrupted.is_set() and start < steps:
                raise Interrupted(f"stopped at step {start} of {steps}; the state is saved.")


def _refuse_non_finite(info: Any, start: int) -> None:
    """Name the first step and quantity that is not finite."""
    first: tuple[int, str, int] | None = None
    for path, values in jax.tree_util.tree_leaves_with_path(info):
        bad = ~np.isfinite(values).reshape(*values.shape[:2], -1).all(axis=-1)
        if bad.any():
            step = int(bad.any(axis=0).argmax())
            seed = int(bad[:, step].argmax())
            if first is None or step < first[0]:
                first = (step, jax.tree_util.keystr(path, simple=True), seed)
    if first is not None:
        step, name, seed = first
        saved = f"the last good checkpoint is that of step {start}" if start else "there is no checkpoint yet"
        raise NumericsError(
            f"step {start + step + 1}: `{name}` is not finite (seed index {seed}); {saved}. "
            "Try a smaller method.learning_rate (of a policy: policy.learning_rate), run.precision=float64, or narrower ranges."
        )
