"""Soft actor-critic on the true parking car: returns and time.

    python -m tests.benchmarks.control [--seeds 3] [--fine-tune 100] [--starts 16] [batch=256 ...]

Words set what stands in conf/policy/sac.yaml.

Trained one after the other, 20 looks at the same 256 episodes, deterministic; the best look counts. The ceiling is what
trajectory optimisation reaches: from each of `--starts` initial states, without noise, the commands of all steps are
optimised with the gradients of the simulator, beginning at what every trained policy does there and at disturbed copies; the
best is taken. The share of the ceiling is that of the same initial states, without noise. Fine-tuning is gradient ascent on
the return through the simulator, from the best look on.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import yaml

from simpel_cli.config.build import build
from simpel_cli.control.agents.fine_tune import fine_tuned
from simpel_cli.control.agents.policy import Policy
from simpel_cli.control.agents.rollout import Controller, episodes, reflex
from simpel_cli.control.agents.sac import SAC, Rule
from simpel_cli.control.settings import Control
from simpel_cli.control.world import World, true_world
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.inference import loop
from simpel_cli.runs.settings import Settings, configure

CONF = Path(__file__).parents[2] / "conf"
HORIZONS = (200, 100)
EPISODES = 256
ASCENT = 400  # steps of gradient ascent
DISTURBED = 0.3  # standard deviation of what is added to a policy's actions


def main() -> None:
    """Train, judge and print."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.control", description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--fine-tune", type=int, default=Control.fine_tune)
    parser.add_argument("--starts", type=int, default=16)
    asked = parser.parse_args()
    configure(Settings())
    node = lambda *parts: yaml.safe_load(CONF.joinpath(*parts).read_text())  # noqa: E731
    model = build(node("sim", "parking_car.yaml"), "sim").model()
    task = build(node("reward", "parking.yaml"), "reward")
    words = dict(word.split("=", 1) for word in asked.words)
    policy = node("policy", "sac.yaml") | {"policies": 1} | {key: yaml.safe_load(value) for key, value in words.items()}
    sac: SAC = build(policy, "policy")
    encoding = encoding_of(model, stack=3)
    goal, one = task.bind(encoding), transition(model, encoding).step
    noise = jnp.asarray([task.noise_std.get(q.name, 0.0) for q in encoding.states], jnp.float32)
    world = true_world(encoding, goal, one, jnp.zeros(0, jnp.float32), noise)

    def bind(problem: None) -> Rule:
        return sac.bind(world, task.horizon, len(encoding.inputs))

    @jax.jit
    def judged(policy: Policy) -> tuple[jax.Array, jax.Array]:
        found = episodes(world, acting(policy), jax.random.key(9), EPISODES, task.horizon)
        return jnp.stack([jnp.mean(jnp.sum(found.reward[:n], axis=0)) for n in HORIZONS]), found.succeeded(
            task.settled
        ).mean()

    def policy_of(state: Any) -> Policy:
        return bind(None).policy(jax.tree.map(lambda a: a[0], state))

    def acting(policy: Policy) -> Controller:
        return reflex(lambda seen: bind(None).actor.act(policy, seen))

    improved = jax.jit(
        lambda policy, key: fine_tuned(
            world,
            bind(None).actor,
            policy,
            key,
            task.horizon,
            asked.fine_tune,
            Control.fine_tune_rate,
            Control.fine_tune_reach,
        )
    )
    iterations = sac.iterations(1)
    updates = iterations * round(sac.updates * sac.environments * sac.collect)
    print("| seed | return over 200 | over 100 | parked | updates | training, s | us per update |")
    print("|---" * 7 + "|")
    policies = []
    for seed in range(asked.seeds):
        program = loop.compiled(bind, jnp.zeros((1, 0)), jax.random.key(seed)[None], max(1, iterations // sac.looks))
        best, parked, seconds, kept = np.zeros(len(HORIZONS)), 0.0, 0.0, None
        began = time.perf_counter()
        for stretch in loop.train(program, iterations):
            jax.block_until_ready(stretch.state)
            seconds += time.perf_counter() - began
            returns, success = judged(policy_of(stretch.state))
            if returns[0] > best[0]:
                best, parked, kept = np.asarray(returns), float(success), policy_of(stretch.state)
            began = time.perf_counter()
        assert kept is not None
        print(
            f"| {seed} | {best[0]:.1f} | {best[1]:.1f} | {100 * parked:.0f} % | {updates} | {seconds:.1f} "
            f"| {1e6 * seconds / updates:.0f} |",
            flush=True,
        )
        policies.append(kept)
        if asked.fine_tune:
            began = time.perf_counter()
            better, _ = jax.block_until_ready(improved(kept, jax.random.key(100 + seed)))
            seconds = time.perf_counter() - began
            returns, success = judged(better)
            shown = f"| {seed}, fine-tuned | {returns[0]:.1f} | {returns[1]:.1f} | {100 * float(success):.0f} % |"
            print(f"{shown} {asked.fine_tune} | {seconds:.1f}, compiled | |", flush=True)
            policies.append(better)

    quiet = true_world(encoding, goal, one, jnp.zeros(0, jnp.float32), jnp.zeros_like(noise))
    for horizon in HORIZONS if asked.starts else ():
        flown = [episodes(quiet, acting(p), jax.random.key(5), asked.starts, horizon) for p in policies]
        began = time.perf_counter()
        found = ceiling(quiet, jnp.stack([f.action for f in flown]), asked.starts, horizon)
        own = [float(jnp.mean(f.returns)) for f in flown]
        shares = ", ".join(f"{v:.1f} ({100 * v / found:.1f} %)" for v in own)
        print(
            f"\nceiling over {horizon} steps: {found:.1f} ({time.perf_counter() - began:.0f} s); policies there: {shares}",
            flush=True,
        )


def ceiling(world: World, begun: jax.Array, starts: int, horizon: int) -> float:
    """Return the mean over initial states of the best return that gradient ascent on the commands finds.

    Args:
        world: without noise.
        begun: actions that policies took, (policies, horizon, starts, du).
        starts: initial states, those of key 5 (see `episodes`).
        horizon: steps.
    """
    first = world.reset(jax.random.split(jax.random.key(5))[0], starts)
    key = jax.random.key(11)
    disturbed = begun + DISTURBED * jax.random.normal(key, begun.shape, begun.dtype)
    raw = jnp.arctanh(jnp.clip(jnp.concatenate([begun, disturbed]), -0.999, 0.999))
    adam = optax.adam(optax.cosine_decay_schedule(0.03, ASCENT))

    def returns(raw: jax.Array) -> jax.Array:
        def one(situation: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            after = world.step(key, situation, jnp.tanh(action))
            return after.situation, after.judged.reward

        return jnp.sum(jax.lax.scan(one, first, raw)[1], axis=0)

    @jax.jit
    def ascended(raw: jax.Array) -> jax.Array:
        """Best return of every initial state from one beginning."""

        def step(carry: Any, _: None) -> tuple[Any, None]:
            raw, state, best = carry
            value, pull = jax.vjp(returns, raw)
            (slope,) = pull(-jnp.ones_like(value))
            with jax.numpy_dtype_promotion("standard"):
                change, state = adam.update(jnp.nan_to_num(slope), state)
            return (optax.apply_updates(raw, change), state, jnp.fmax(best, value)), None

        with jax.numpy_dtype_promotion("standard"):
            begun = adam.init(raw)
        (_, _, best), _ = jax.lax.scan(step, (raw, begun, returns(raw)), None, ASCENT)
        return best

    return float(jnp.mean(jnp.max(jnp.stack([ascended(r) for r in raw]), axis=0)))


if __name__ == "__main__":
    main()
