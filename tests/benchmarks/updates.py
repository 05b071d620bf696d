"""Soft actor-critic: microseconds per update at 64 x 64, batch 64 and 256, beside sbx in an environment of its own.

    python -m venv /somewhere && /somewhere/bin/pip install sbx-rl
    python -m tests.benchmarks.updates [--sbx /somewhere/bin/python] [--rounds 5]

13 observations, 2 actions, as in parking. Only updates count: 2000 in one call, with the draw of their batches and noise, no
roll-outs. Ours and theirs alternate; medians, and the median of the ratios of neighbours. The share of the arithmetic limit is
that of the floating-point operations of an update (counted by hand below) at the rate of a product of two 1024 x 1024 matrices.
For one core: taskset -c 0.
"""

import argparse
import json
import statistics
import subprocess
import time
from typing import Any

import jax
import jax.numpy as jnp

from simpel_cli.control.agents.sac import SAC
from simpel_cli.control.task import Judged
from simpel_cli.control.world import Situation, Step, World
from simpel_cli.runs.settings import Settings, configure

OBSERVATIONS, ACTIONS, UPDATES = 13, 2, 2000
BATCHES = (64, 256)
THEIRS = """
import json, sys, time
import gymnasium as gym, numpy as np
from sbx import SAC

class World(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, ({observations},), np.float32)
    action_space = gym.spaces.Box(-1, 1, ({actions},), np.float32)
    def reset(self, seed=None, options=None):
        return self.observation_space.sample(), {{}}
    def step(self, action):
        return self.observation_space.sample(), float(-(action**2).sum()), False, False, {{}}

models = {{}}
for batch in {batches}:
    model = SAC("MlpPolicy", World(), learning_starts=200, batch_size=batch, buffer_size=50_000,
                policy_kwargs=dict(net_arch=[64, 64]), device="cpu", verbose=0)
    model.learn(1000)
    model.train({updates}, batch)
    models[batch] = model
print("ready", flush=True)
for line in sys.stdin:
    batch = int(line)
    began = time.perf_counter()
    models[batch].train({updates}, batch)
    import jax
    jax.block_until_ready(models[batch].policy.actor_state.params)
    print(json.dumps((time.perf_counter() - began) / {updates}), flush=True)
"""


def nowhere() -> World:
    """Return a world that costs nothing: what is seen is noise."""

    def reset(key: Any, n: int) -> Situation:
        return Situation(
            jax.random.normal(key, (n, OBSERVATIONS), jnp.float32), jnp.zeros((n, 0, ACTIONS), jnp.float32)
        )

    def step(key: Any, situation: Situation, action: Any) -> Step:
        never = jnp.zeros(len(action), bool)
        return Step(reset(key, len(action)), Judged(-jnp.sum(action**2, axis=1), never, never), never)

    def at(seen: Any) -> Situation:
        return Situation(seen, jnp.zeros((len(seen), 0, ACTIONS), jnp.float32))

    return World(reset, lambda key, situation: situation.encoded, step, at, 0)


def operations(batch: int) -> float:
    """Return the floating-point operations of an update: backward passes cost as much again for weights, and for inputs."""
    wide = 64 * 64
    actor = 2.0 * (OBSERVATIONS * 64 + wide + 64 * 2 * ACTIONS)
    critic = 2.0 * ((OBSERVATIONS + ACTIONS) * 64 + wide + 64)
    # actor: at the next state forwards, now with its gradient; two critics: targets, with their gradients, and for the actor
    return batch * (actor * (1 + 3) + 2 * critic * (1 + 3 + 2))


def rate() -> float:
    """Return floating-point operations per second of a product of matrices."""
    a = jax.random.normal(jax.random.key(0), (1024, 1024), jnp.float32)
    product = jax.jit(lambda a: a @ a)
    jax.block_until_ready(product(a))
    seconds = []
    for _ in range(10):
        began = time.perf_counter()
        jax.block_until_ready(product(a))
        seconds.append(time.perf_counter() - began)
    return 2 * 1024**3 / min(seconds)


def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.updates", description=__doc__)
    parser.add_argument("--sbx", help="a Python that has sbx")
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args()
    configure(Settings())
    ours = {}
    for batch in BATCHES:
        sac = SAC(environments=16, collect=1, updates=UPDATES / 16, batch=batch, policies=1)
        rule = sac.bind(nowhere(), 100, ACTIONS)
        step = jax.jit(rule.step)
        state = jax.jit(rule.init)(jax.random.key(0))
        ours[batch] = (step, jax.block_until_ready(step(jax.random.key(1), state, None))[0])
    other = None
    if asked.sbx:
        text = THEIRS.format(observations=OBSERVATIONS, actions=ACTIONS, batches=BATCHES, updates=UPDATES)
        other = subprocess.Popen([asked.sbx, "-c", text], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert other.stdin is not None
        assert other.stdout is not None
        while other.stdout.readline().strip() != "ready":
            if other.poll() is not None:
                raise SystemExit(f"{asked.sbx} ended with {other.returncode}; does it have sbx?")
    limit = rate()
    print(f"{limit / 1e9:.0f} GFLOP/s\n")
    print("| batch | us per update | share of the arithmetic limit | sbx, us | ratio |")
    print("|---" * 5 + "|")
    for batch, (step, state) in ours.items():
        mine, theirs = [], []
        for i in range(asked.rounds):
            began = time.perf_counter()
            state, _ = jax.block_until_ready(step(jax.random.key(2 + i), state, None))
            mine.append((time.perf_counter() - began) / UPDATES)
            if other is not None:
                assert other.stdin is not None
                assert other.stdout is not None
                print(batch, file=other.stdin, flush=True)
                theirs.append(float(json.loads(other.stdout.readline())))
        middle = statistics.median(mine)
        beside = ["-", "-"]
        if theirs:
            ratio = statistics.median(t / m for t, m in zip(theirs, mine, strict=True))
            beside = [f"{1e6 * statistics.median(theirs):.0f}", f"{ratio:.2f}"]
        print(
            f"| {batch} | {1e6 * middle:.0f} | {100 * operations(batch) / limit / middle:.0f} % | {' | '.join(beside)} |",
            flush=True,
        )
    if other is not None:
        other.terminate()


if __name__ == "__main__":
    main()
