"""The driver: stretches, resume, seeds, the non-finite guard, Ctrl-C; with a rule small enough to check by hand."""

import signal
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.errors import ConfigError, Interrupted, NumericsError
from simpel_cli.inference import loop
from simpel_cli.runs.interruption import interruption

RATE, DIM = 0.1, 3


class Info(NamedTuple):
    loss: jax.Array
    position: jax.Array
    noise: jax.Array
    offset: jax.Array


class Descent(NamedTuple):
    """Stochastic gradient on |z - target|^2 / 2, with the noise of the step's key and an offset of the stretch's draw."""

    init: Any
    draw: Any
    step: Any


def bind(target: jax.Array) -> Descent:
    def step(key: jax.Array, z: jax.Array, offset: jax.Array) -> tuple[jax.Array, Info]:
        noise = 0.01 * jax.random.normal(key, z.shape, z.dtype)
        after = z - RATE * (z - target + offset) + noise
        return after, Info(jnp.sum((z - target) ** 2) / 2, after, noise, offset)

    return Descent(
        lambda key: jax.random.normal(key, (DIM,), jnp.float64),
        lambda key, state: 0.01 * jax.random.normal(key, (DIM,), jnp.float64),
        step,
    )


TARGETS = jnp.asarray(np.random.default_rng(0).normal(size=(3, DIM)))
KEYS = jnp.stack([jax.random.key(seed) for seed in (5, 6, 7)])


def program(stretch: int = 10, seeds: slice = slice(0, 3), rule: Any = bind) -> loop.Program:
    return loop.compiled(rule, TARGETS[seeds], KEYS[seeds], stretch)


@pytest.fixture(scope="module")
def tens() -> loop.Program:
    return program()


def run(p: loop.Program, steps: int, **start: Any) -> list[loop.Stretch]:
    # the state's memory is given to the next stretch: keep copies
    return [s._replace(state=np.array(s.state)) for s in loop.train(p, steps, **start)]


def test_it_learns_and_says_what_happened(tens: loop.Program) -> None:
    stretches = run(tens, 200)
    loss = np.concatenate([s.info.loss for s in stretches], axis=1)
    assert loss.shape == (3, 200)
    assert np.all(loss[:, -1] < 0.02)
    assert np.all(loss[:, 0] > 0.3)
    position = np.concatenate([s.info.position for s in stretches], axis=1)
    np.testing.assert_array_equal(position[:, -1], stretches[-1].state)
    np.testing.assert_allclose(np.sum((position[:, :-1] - TARGETS[:, None]) ** 2, axis=-1) / 2, loss[:, 1:], rtol=1e-12)


@pytest.mark.parametrize("steps", [1, 9, 10, 11, 37])
def test_the_last_stretch_may_be_shorter(tens: loop.Program, steps: int) -> None:
    stretches = run(tens, steps)
    assert [s.step for s in stretches] == [*range(10, steps, 10), steps]
    longer = run(tens, 40)
    loss, more = (np.concatenate([s.info.loss for s in run_], axis=1) for run_ in (stretches, longer))
    assert loss.shape == (3, steps)
    np.testing.assert_array_equal(loss, more[:, :steps])
    np.testing.assert_array_equal(stretches[-1].state, stretches[-1].info.position[:, -1])


@pytest.mark.parametrize("steps", [40, 37])
def test_resumed_is_bit_for_bit_the_uninterrupted_run(tens: loop.Program, steps: int) -> None:
    whole = run(tens, steps)
    again = run(program(), steps, state=jnp.asarray(whole[1].state), start=20)
    assert [s.step for s in again] == [s.step for s in whole[2:]]
    for ours, theirs in zip(again, whole[2:], strict=True):
        np.testing.assert_array_equal(ours.state, theirs.state)
        np.testing.assert_array_equal(ours.info.loss, theirs.info.loss)


def test_every_step_and_stretch_has_its_own_randomness(tens: loop.Program) -> None:
    stretches = run(tens, 40)
    noise, offset = (np.concatenate([getattr(s.info, n) for s in stretches], axis=1) for n in ("noise", "offset"))
    assert len(np.unique(noise)) == noise.size == 3 * 40 * DIM  # no step or seed shares its noise with another
    assert len(np.unique(offset)) == 3 * 4 * DIM  # one draw per stretch and seed
    np.testing.assert_array_equal(offset[:, 10:20], np.repeat(offset[:, 10:11], 10, axis=1))


def test_seeds_in_one_program_are_seeds_alone(tens: loop.Program) -> None:
    together = run(tens, 25)[-1].state
    for i in range(3):
        alone = run(program(seeds=slice(i, i + 1)), 25)[-1].state
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-12)
    assert np.abs(together[0] - together[1]).max() > 0.01


def test_a_checkpoint_elsewhere_is_refused(tens: loop.Program) -> None:
    with pytest.raises(ConfigError, match="the checkpoint lies at step 15, no multiple of 10 steps; fit again"):
        next(loop.train(tens, 40, state=jnp.zeros((3, DIM)), start=15))
    assert list(loop.train(tens, 15, state=jnp.zeros((3, DIM)), start=15)) == []  # all steps taken


def breaking_at(number: int) -> Any:
    """A rule whose state counts steps; in seed 1, `loss` is infinite from that step on."""

    def rule(seed: jax.Array) -> Descent:
        def step(key: jax.Array, n: jax.Array, draws: Any) -> tuple[jax.Array, Info]:
            bad = (n + 1 >= number) & (seed == 1)
            return n + 1, Info(jnp.where(bad, jnp.inf, 0.0), *[jnp.zeros(2)] * 3)

        return Descent(lambda key: jnp.int32(0), lambda key, n: jnp.zeros(()), step)

    return rule


@pytest.mark.parametrize(
    ("number", "saved"), [(4, "there is no checkpoint yet"), (24, "the last good checkpoint is that of step 20")]
)
def test_what_is_not_finite_is_named(number: int, saved: str) -> None:
    p = loop.compiled(breaking_at(number), jnp.arange(3), KEYS, 10)
    seen: list[int] = []
    with pytest.raises(NumericsError, match=rf"step {number}: `loss` is not finite \(seed index 1\); {saved}"):
        seen.extend(s.step for s in loop.train(p, 40))
    assert seen == list(range(10, number, 10))  # the stretch that broke is never handed out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_its_state_was_handed_out(tens: loop.Program, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    seen = []

    def stretches() -> None:
        for stretch in loop.train(tens, 40):
            seen.append(stretch.step)
            if stretch.step == 20:
                signal.raise_signal(number)

    with pytest.raises(Interrupted, match="stopped at step 20 of 40; the state is saved"):
        stretches()
    assert seen == [10, 20]
    assert signal.getsignal(number) is before


def test_a_signal_during_the_last_stretch_changes_nothing(tens: loop.Program) -> None:
    for stretch in loop.train(tens, 20):
        if stretch.step == 20:
            signal.raise_signal(signal.SIGINT)
    assert stretch.step == 20


def test_a_second_signal_acts_at_once() -> None:
    with interruption() as event:
        signal.raise_signal(signal.SIGINT)
        assert event.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
