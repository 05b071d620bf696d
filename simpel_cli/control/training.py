"""Training of policies in the posteriors of a fit."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.control.agents.fine_tune import fine_tuned
from simpel_cli.control.agents.policy import Policy
from simpel_cli.control.agents.rollout import Episodes, episodes, reflex
from simpel_cli.control.agents.sac import Rule
from simpel_cli.control.assignment import Assignment
from simpel_cli.control.posterior_world import multiple_of_rollouts, world_of_posterior
from simpel_cli.inference import loop
from simpel_cli.inference.protocols import Problem
from simpel_cli.runs.checkpoint import keep, restored
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.interruption import interruption, stop_if
from simpel_cli.runs.metrics import MetricStream
from simpel_cli.runs.settings import stream
from simpel_cli.studies.fit import Learned

Judge = Callable[[Policy, PRNGKeyArray], Episodes]  # leaves of the policy (runs, ...)


class Best(NamedTuple):
    """Policies of the largest return in the model so far, of every run (seeds times policies)."""

    policy: Policy
    returns: Float[Array, " runs"]


class TrainedPolicies(NamedTuple):
    """What training a policy came to, or planning.

    Args:
        policies: the best of every seed, leaves (seeds, ...); None: there is only a plan.
        model_returns: what they earn in the model, per seed, in other episodes than those that they were chosen by.
        broken: share of these episodes with which the model could not go on, per seed.
        seconds: of training.
        compile_seconds: of it.
    """

    policies: Policy | None
    model_returns: np.ndarray
    broken: np.ndarray
    seconds: float
    compile_seconds: float


def train(
    learned: Learned,
    asked: Assignment,
    terminal: Terminal,
    metrics: MetricStream,
    directory: Path,
    *,
    label: str = "policy",
    before: Path | None = None,
    rival: Policy | None = None,
) -> TrainedPolicies:
    """Train policies in every seed's posterior; the best of each seed, by what it earns in the model, is kept.

    A checkpoint in the directory is gone on with.

    Args:
        learned: the posteriors.
        asked: the task.
        terminal: for a progress bar.
        metrics: for learning curves.
        directory: of the checkpoint.
        label: of the progress bar.
        before: directory of a training on another posterior, whose policies and critics this one begins with.
        rival: a policy that is kept, and fine-tuned, in place of those that earn less in the model.
    """
    sac, control, task = asked.policy, asked.control, asked.task
    study, fitted = learned.study, learned.fitted
    seeds, runs = study.settings.all_seeds, len(study.settings.all_seeds) * sac.policies
    world_at, dim_u = world_of_posterior(learned, asked), len(study.system.encoding.inputs)

    def bind(arrays: tuple[Problem, Any]) -> Rule:
        return sac.bind(world_at(arrays, control.data_share), task.horizon, dim_u)

    problems = jax.tree.map(
        lambda a: jnp.repeat(jnp.asarray(a), sac.policies, axis=0), (fitted.assembled.problems, learned.state)
    )
    keys = jnp.stack([jax.random.fold_in(stream(s, "policy"), i) for s in seeds for i in range(sac.policies)])
    multiple = multiple_of_rollouts(learned, asked)
    iterations = sac.iterations(multiple)
    stretch = max(1, -(-iterations // sac.looks))
    judged = -(-control.episodes // multiple) * multiple

    def in_model(arrays: tuple[Problem, Any], policy: Policy, key: PRNGKeyArray) -> tuple[Any, Any]:
        acting = reflex(lambda seen: bind(arrays).actor.act(policy, seen))
        found = episodes(world_at(arrays, 0.0), acting, key, judged, task.horizon)
        return jnp.mean(found.returns), jnp.mean(found.broken.astype(jnp.float32))

    model_judge = jax.jit(jax.vmap(in_model, in_axes=(0, 0, None)))
    truth_judge = judge_of(asked, dim_u) if asked.truth is not None else None
    policies_of = jax.jit(jax.vmap(lambda arrays, state: bind(arrays).policy(state)))

    def in_truth(policies: Policy) -> np.ndarray | None:
        if truth_judge is None:
            return None
        return np.asarray(truth_judge(policies, stream(0, "truth")).reward.sum(axis=1).mean(axis=1))

    def improved(arrays: tuple[Problem, Any], policy: Policy, key: PRNGKeyArray) -> Policy:
        return fine_tuned(
            world_at(arrays, 0.0),
            bind(arrays).actor,
            policy,
            key,
            task.horizon,
            control.fine_tune,
            control.fine_tune_rate,
            control.fine_tune_reach,
        )[0]

    program = loop.compiled(bind, problems, keys, stretch)
    shape = loop.state_shape(bind, problems, keys)

    def empty() -> Any:
        return jax.eval_shape(lambda p, s: Best(policies_of(p, s), jnp.zeros(runs, jnp.float32)), problems, shape)

    start, state, best = 0, None, None
    if (directory / "checkpoint" / "state.safetensors").exists():
        (state, best), facts = restored(directory, (shape, empty()))
        start = int(facts["step"])
    elif before is not None:
        (last, _), _ = restored(before, (shape, empty()))
        state = sac.begun_with(program.init(problems, keys), last)
    began = time.perf_counter()
    per = sac.side_by_side(multiple) * sac.collect
    with interruption() as interrupted, terminal.progress(label, iterations, start) as update:
        for one in loop.train(program, iterations, state=state, start=start):
            now = policies_of(problems, one.state)
            earned, broken = model_judge(problems, now, stream(0, "judge"))
            best = Best(now, earned) if best is None else _better(best, Best(now, earned))
            true = in_truth(now)
            metrics.add(_rows(seeds, sac.policies, one.step * per, np.asarray(earned), np.asarray(broken), true))
            keep(directory, (one.state, best), {"step": one.step, "world_steps": one.step * per, "command": "policy"})
            update(one.step, _said(best, true))
        stop_if(interrupted)
    assert best is not None
    if rival is not None:
        own = jax.tree.map(lambda a, b: jnp.broadcast_to(jnp.asarray(a, b.dtype), b.shape), rival, best.policy)
        best = _better(best, Best(own, model_judge(problems, own, stream(0, "judge"))[0]))
    if control.fine_tune:
        began_tuning = jnp.stack([jax.random.fold_in(key, sac.policies) for key in keys])
        with terminal.progress(f"fine-tuning {label}", control.fine_tune, 0) as update:
            tuned = jax.jit(jax.vmap(improved))(problems, best.policy, began_tuning)
            earned, broken = model_judge(problems, tuned, stream(0, "judge"))
            true = in_truth(tuned)
            at = iterations * per + control.fine_tune
            metrics.add(_rows(seeds, sac.policies, at, np.asarray(earned), np.asarray(broken), true))
            best = _better(best, Best(tuned, earned))
            update(control.fine_tune, _said(best, true))
    anew = model_judge(problems, best.policy, stream(0, "judge anew"))
    chosen = np.asarray(best.returns).reshape(len(seeds), -1).argmax(axis=1) + np.arange(len(seeds)) * sac.policies
    policies, earned, broken = jax.tree.map(lambda a: a[chosen], (best.policy, *map(np.asarray, anew)))
    return TrainedPolicies(policies, earned, broken, time.perf_counter() - began, program.compile_seconds)


def _said(best: Best, true: np.ndarray | None) -> str:
    note = f"return in the model {float(best.returns.max()):.4g}"
    return note + (f", in the truth {true.max():.4g}" if true is not None else "")


def judge_of(asked: Assignment, dim_u: int) -> Judge:
    """Return the compiled judge of policies in the true world; leaves of the episodes (runs, ...)."""
    world, sac, task = asked.truth, asked.policy, asked.task
    assert world is not None
    actor = sac.bind(world, task.horizon, dim_u).actor

    def one(policy: Policy, key: PRNGKeyArray) -> Episodes:
        return episodes(world, reflex(lambda seen: actor.act(policy, seen)), key, asked.control.episodes, task.horizon)

    judged: Judge = jax.jit(jax.vmap(one, in_axes=(0, None)))
    return judged


def _better(old: Best, new: Best) -> Best:
    """Keep, run by run, what earns more in the model."""
    more = new.returns > old.returns
    return jax.tree.map(lambda a, b: jnp.where(more.reshape(-1, *[1] * (a.ndim - 1)), b, a), old, new)


def _rows(
    seeds: list[int], policies: int, step: int, model: np.ndarray, broken: np.ndarray, truth: np.ndarray | None
) -> list[dict[str, Any]]:
    """Metric rows of one look; output: which of the policies."""
    rows = []
    for i, seed in enumerate(np.repeat(seeds, policies).tolist()):
        base = {"seed": seed, "step": step, "split": "train", "output": f"policy {i % policies}", "unit": "1"}
        rows.append(base | {"metric": "return_in_model", "value": float(model[i])})
        rows.append(base | {"metric": "broken_in_model", "value": float(broken[i])})
        if truth is not None:
            rows.append(base | {"metric": "return_in_truth", "value": float(truth[i])})
    return rows
