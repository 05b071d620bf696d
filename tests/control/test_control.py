"""Tasks, worlds and soft actor-critic against known values; the control verb from end to end."""

import ast
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from command_line import ROOT, simpel

from simpel_cli.config.build import build
from simpel_cli.control.agents.fine_tune import fading, fine_tuned, finite
from simpel_cli.control.agents.planner import ICEM
from simpel_cli.control.agents.policy import Actor, Policy
from simpel_cli.control.agents.replay import Transitions, batches, empty, put
from simpel_cli.control.agents.rollout import episodes, reflex
from simpel_cli.control.agents.sac import SAC, Scaler
from simpel_cli.control.plants.policy_files import contract, load_policy, save_policy
from simpel_cli.control.plants.runner import PolicyRunner
from simpel_cli.control.task import Judged, Task
from simpel_cli.control.world import Situation, Step, World, beginning_at, learned_world, true_world
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import ConfigError
from simpel_cli.inference.networks import MLP
from simulators.model import Quantity
from simulators.worlds.rk4 import RK4

CART = Encoding(
    (Quantity("s", "m", -1.0, 1.0), Quantity("a", "rad", -np.pi, np.pi, periodic=True)),
    (Quantity("u", "N", -2.0, 4.0),),
)
STILL: dict[str, Any] = {"reward": "s", "horizon": 10}


def of_conf(group: str, name: str) -> Any:
    return yaml.safe_load((ROOT / "conf" / group / f"{name}.yaml").read_text())


def parking() -> tuple[Any, Encoding, Task]:
    model = build(of_conf("sim", "parking_car"), "sim").model()
    return model, encoding_of(model, stack=3), build(of_conf("reward", "parking"), "reward")


def test_reward_of_parking() -> None:
    """SYSTEMS.md, section 9: pose; action -> reward."""
    _, encoding, task = parking()
    poses = np.zeros((4, 6))
    poses[:, :3] = [(0.5, -0.2, 0.8), (1.42, -1.04, np.pi), (0.03, 0.04, -0.05), (0, 0, 2 * np.pi - 0.3)]
    actions = np.array([(0.4, -0.6), (0, 0), (1, 1), (0, 0)])
    judged = task.bind(encoding).judge(jnp.asarray(poses), jnp.asarray(actions), jnp.zeros((4, 2)))
    np.testing.assert_allclose(judged.reward, [0.3703901822, 0.03499056254, 0.99, 0.9174311927], rtol=1e-9)
    assert judged.good.tolist() == [False, False, True, False]


def test_a_change_of_command_costs_where_it_is_said_so() -> None:
    _, encoding, task = parking()
    goal = Task(**{**task.__dict__, "names": dict(task.names) | {"change_cost": 0.5}}).bind(encoding)
    zero, one = jnp.zeros((1, 6)), jnp.ones((1, 2))
    first, second = (goal.judge(zero, one, before).reward for before in (one, 0 * one))
    np.testing.assert_allclose(first - second, 1.0, rtol=1e-6)
    assert goal.uses_before


def test_initial_states_follow_their_laws() -> None:
    _, encoding, task = parking()
    start = np.asarray(task.bind(encoding).start(jax.random.key(0), 4000))
    assert (start[:, 0] >= 1.32).all()
    assert (start[:, 0] <= 1.52).all()
    np.testing.assert_allclose(start[:, 5].std(), 0.02, rtol=0.1)
    assert abs(np.corrcoef(start[:, 0], start[:, 2])[0, 1]) < 0.06
    np.testing.assert_allclose(start[:, 2].mean(), np.pi, atol=0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reward": "s + vv"}, "reward.reward: .*vv"),
        ({"names": {"u": 1}}, "reward.names.u: a state or an input is called so"),
        ({"initial": {"ss": 1}}, "reward.initial.ss: no such name; known: s, a. Did you mean s"),
        ({"initial": {"s": [1, 0]}}, r"reward.initial.s: got \[1, 0\]; write a number"),
        (
            {"limits": {"u": [-3, 1]}},
            r"reward.limits.u: got \[-3, 1\]; allowed are low < high within the declared range",
        ),
        ({"initial": {"s": ["a", "b"]}}, r"reward.initial.s: got \['a', 'b'\]; write a number"),
        ({"initial": {"s": {"mean": 0, "std": "x"}}}, "reward.initial.s: got .*; write a number"),
        ({"initial": {"s": float("nan")}}, "reward.initial.s: got nan; write a number"),
        ({"noise_std": {"s": -1.0}}, "reward.noise_std.s: got -1.0; it must be 0 or more, and finite"),
        ({"settled": 11, "success": "s > 0"}, r"reward.settled: got 11; it is at most reward.horizon \(10\)"),
        ({"horizon": 0}, "reward.horizon: got 0; it must be at least 1"),
    ],
)
def test_wrong_tasks(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Task(**STILL | change).bind(CART)


def test_actions_reach_the_limits_and_not_beyond() -> None:
    goal = Task(**STILL, limits={"u": [-1, 2]}).bind(CART)
    np.testing.assert_allclose(goal.command(jnp.array([[-5.0], [-1], [0], [1], [9]]))[:, 0], [-1, -1, 0.5, 2, 2])


def test_the_true_world_is_the_simulator_with_its_delay() -> None:
    model, encoding, task = parking()
    world = true_world(encoding, task.bind(encoding), transition(model, encoding).step, jnp.zeros(0), jnp.zeros(6))
    random = np.random.default_rng(0)
    actions = random.uniform(-1, 1, (6, 2, 2))
    situation = world.reset(jax.random.key(1), 2)
    state = np.asarray(encoding.decode(situation.encoded), float)
    plant = RK4(model)
    given, step = np.zeros((2, 3, 2)), jax.jit(world.step)
    for action in actions:
        given = np.concatenate([given, action[:, None]], axis=1)
        situation = step(jax.random.key(2), situation, jnp.asarray(action, jnp.float32)).situation
        state = plant.follow(state, given[:, -4:], np.zeros((2, 0)))
    np.testing.assert_allclose(encoding.decode(situation.encoded), state, atol=2e-5)
    np.testing.assert_allclose(situation.past, actions[-3:].swapaxes(0, 1), atol=1e-6)
    seen = world.observe(jax.random.key(3), situation)
    assert seen.shape == (2, 13)


def test_noise_is_on_what_is_seen_and_not_on_the_state() -> None:
    goal = Task(**STILL).bind(CART)
    world = true_world(CART, goal, lambda x, phi: jnp.zeros(3), jnp.zeros(0), jnp.array([0.1, 0.2]))
    situation = world.reset(jax.random.key(0), 3000)
    seen = np.asarray(world.observe(jax.random.key(1), situation))
    np.testing.assert_allclose(seen[:, 0].std(), 0.1, rtol=0.1)
    np.testing.assert_allclose(np.arctan2(seen[:, 1], seen[:, 2]).std(), 0.2, rtol=0.1)
    np.testing.assert_allclose(
        world.step(jax.random.key(2), situation, jnp.zeros((3000, 1))).situation.encoded, situation.encoded
    )


@pytest.mark.parametrize("sampling", ["ts1", "tsinf", "mean"])
def test_trajectory_sampling(sampling: str) -> None:
    """Particle l moves s by l: who moved an episode is seen from how far it went."""
    goal, particles, n = Task(**STILL).bind(CART), 5, 4000

    def members(x: jax.Array) -> jax.Array:
        moves = jnp.arange(particles, dtype=x.dtype)[:, None, None] * jnp.array([1.0, 0, 0], x.dtype)[None, None]
        return jnp.broadcast_to(moves, (*x.shape[:2], 3))

    world = learned_world(CART, goal, members, jnp.full(3, 1e-9), particles, sampling)
    situation = world.reset(jax.random.key(0), n)
    moved = []
    for k in range(40):
        after = world.step(jax.random.key(k), situation, jnp.zeros((n, 1))).situation
        moved.append(np.asarray(after.encoded[:, 0] - situation.encoded[:, 0]))
        situation = after
    steps = np.round(np.array(moved), 3)
    if sampling == "mean":
        np.testing.assert_allclose(steps, 2.0, atol=1e-3)
    elif sampling == "tsinf":
        assert (steps == steps[:1]).all()
        np.testing.assert_allclose(np.bincount(steps[0].astype(int)), n / particles)
    else:
        np.testing.assert_allclose([np.mean(steps == k) for k in range(particles)], 1 / particles)  # at every step
        assert len({tuple(row) for row in steps.astype(int)[:, ::800]}) > 1
        np.testing.assert_allclose(steps.mean(axis=0), 2.0, atol=1.2)  # every episode meets them all


def test_aleatoric_noise_is_the_learned_one() -> None:
    goal = Task(**STILL).bind(CART)
    for aleatoric, std in ((True, 0.3), (False, 0.0)):
        world = learned_world(
            CART, goal, lambda x: jnp.zeros((*x.shape[:2], 3), x.dtype), jnp.array([0.3, 0, 0]), 2, aleatoric=aleatoric
        )
        situation = world.reset(jax.random.key(0), 4000)
        after = world.step(jax.random.key(1), situation, jnp.zeros((4000, 1))).situation
        np.testing.assert_allclose(np.std(after.encoded[:, 0]), std, rtol=0.05)


def test_what_is_not_finite_ends_an_episode_and_stays_out_of_the_state() -> None:
    goal = Task(**STILL).bind(CART)
    world = true_world(
        CART, goal, lambda x, phi: jnp.where(x[-1] > 0, jnp.nan, 0.1) * jnp.ones(3), jnp.zeros(0), jnp.zeros(2)
    )
    found = episodes(world, reflex(lambda seen: jnp.array([[1.0], [-1.0]], seen.dtype)), jax.random.key(0), 2, 10)
    assert np.isfinite(found.encoded).all()
    assert found.broken.tolist() == [True, False]
    assert found.lived.sum(axis=0).tolist() == [1, 10]
    np.testing.assert_allclose(found.returns, [0, 5.5], rtol=1e-5)


def test_breaking_a_model_never_pays() -> None:
    """Where rewards are negative, an episode that the world could not go on with earns the least of all at every step."""
    goal = Task(reward="-1 - u**2", horizon=10).bind(CART)
    world = true_world(
        CART, goal, lambda x, phi: jnp.where(x[-1] > 3.0, jnp.nan, 0.1) * jnp.ones(3), jnp.zeros(0), jnp.zeros(2)
    )
    found = episodes(world, reflex(lambda seen: jnp.array([[1.0], [1 / 3]], seen.dtype)), jax.random.key(0), 2, 10)
    assert found.broken.tolist() == [True, False]
    np.testing.assert_allclose(found.returns, [-50, -50], rtol=1e-5)


def test_a_policy_does_not_learn_to_break_the_model() -> None:
    """Every step costs something, and the world breaks where the action is positive: a policy that did so would save it."""
    whole = probe(lambda sign, a, over: -1 - 0.1 * a**2, length=10**6)

    def step(key: Any, situation: Situation, action: Any) -> Step:
        after, broken = whole.step(key, situation, action), action[:, 0] > 0
        judged = after.judged._replace(reward=jnp.where(broken, 0.0, after.judged.reward), over=broken)
        return Step(after.situation, judged, broken)

    rule, state, _ = trained(whole._replace(step=step), discount=0.8, target_entropy=-2.0, episode=5)
    assert float(rule.actor.act(rule.policy(state), jnp.ones((1, 1), jnp.float32))[0, 0]) < -0.2


def test_stop_ends_an_episode_and_nothing_is_earned_after_it() -> None:
    goal = Task(reward="1", horizon=6, stop="s > 0.25", success="s > 0.25", settled=1).bind(CART)
    world = true_world(CART, goal, lambda x, phi: 0.1 * jnp.array([1.0, 0, 0]), jnp.zeros(0), jnp.zeros(2))
    found = episodes(world, reflex(lambda seen: jnp.zeros((1, 1), seen.dtype)), jax.random.key(0), 1, 6)
    assert float(found.returns[0]) == 3
    np.testing.assert_allclose(found.encoded[:, 0, 0], [0, 0.1, 0.2, 0.3, 0.3, 0.3, 0.3], atol=1e-6)
    assert not found.succeeded(1)[0]  # it did not live to the end


def test_a_share_of_the_episodes_begins_at_the_data() -> None:
    encoding = Encoding(CART.states, CART.inputs, stack=2)
    goal = Task(**STILL).bind(encoding)
    world = true_world(encoding, goal, lambda x, phi: jnp.zeros(3), jnp.zeros(0), jnp.zeros(2))
    x = jnp.array([[0.7, 0.0, 1.0, 1.0, 2.0, 3.0], [99.0] * 6], jnp.float32)  # the second row is padding
    begun = beginning_at(world, encoding, x, jnp.int32(1), 0.25).reset(jax.random.key(0), 4000)
    measured = np.isclose(begun.encoded[:, 0], 0.7)
    np.testing.assert_allclose(measured.mean(), 0.25, atol=0.03)
    np.testing.assert_allclose(begun.past[measured][:, :, 0], [[1.0, 2.0]] * measured.sum())
    assert float(jnp.abs(begun.encoded[~measured, 0]).max()) == 0


def test_the_ring_forgets_the_oldest() -> None:
    ring = empty(4, 1, 1, jnp.dtype("float32"))
    for k in range(3):
        column = jnp.full((2, 1), float(k), jnp.float32)
        ring = put(ring, Transitions(column, column, column[:, 0], column, column[:, 0]))
    assert sorted(set(np.asarray(batches(jax.random.key(0), ring, 5, 20).reward).ravel().tolist())) == [1, 2]
    one = jnp.ones((2, 1), jnp.float32)
    few = put(empty(4, 1, 1, jnp.dtype("float32")), Transitions(one, one, one[:, 0], one, one[:, 0]))
    assert float(batches(jax.random.key(0), few, 5, 20).reward.min()) == 1  # nothing is drawn that was not put


def test_running_moments() -> None:
    x = np.random.default_rng(0).normal(3, 2, (50, 2)).astype(np.float32)
    scaler = Scaler(*(jnp.zeros(n, jnp.float32) for n in ((), 2, 2))).add(jnp.asarray(x[:7])).add(jnp.asarray(x[7:]))
    np.testing.assert_allclose(scaler.mean, x.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(scaler.std, x.std(axis=0), rtol=1e-5)


def test_density_of_an_action() -> None:
    """Against the change of variables by automatic differentiation, and in the tails."""
    actor = Actor(MLP((4,)), 1)
    layers = actor.init(jax.random.key(0), 2, jnp.dtype("float64"))
    seen, noise = jnp.array([[0.3, -1.0]]), jnp.array([[0.7]])
    out = actor.network.apply(layers, seen)
    slope = jax.grad(lambda n: actor.sample(layers, seen, n[None, None]).action[0, 0])(noise[0, 0])
    expected = -0.5 * 0.7**2 - 0.5 * np.log(2 * np.pi) - np.log(float(slope))
    np.testing.assert_allclose(actor.sample(layers, seen, noise).log_prob[0], expected, rtol=1e-6)
    assert out.shape == (1, 2)
    assert np.isfinite(actor.sample(layers, seen, jnp.array([[60.0]])).log_prob[0])


def probe(reward: Any, dim_o: int = 1, length: int = 1, signs: bool = False) -> World:
    """A world in which the observation is (sign of the episode, steps left), and a step counts down."""

    def reset(key: Any, n: int) -> Situation:
        sign = jnp.where(jax.random.bernoulli(key, 0.5, (n,)), 1.0, -1.0) if signs else jnp.ones(n)
        return Situation(
            jnp.stack([sign, jnp.full(n, float(length))], axis=1).astype(jnp.float32), jnp.zeros((n, 0, 1))
        )

    def step(key: Any, situation: Situation, action: Any) -> Step:
        after = situation._replace(encoded=situation.encoded - jnp.array([[0.0, 1.0]], jnp.float32))
        over = after.encoded[:, 1] <= 0
        earned = reward(situation.encoded[:, 0], action[:, 0], over)
        return Step(after, Judged(earned.astype(jnp.float32), over, over), jnp.zeros_like(over))

    def at(seen: Any) -> Situation:
        return Situation(seen, jnp.zeros((len(seen), 0, 1)))

    return World(reset, lambda key, s: s.encoded[:, :dim_o] if dim_o == 1 else s.encoded, step, at, 0)


def trained(world: World, **changed: Any) -> tuple[Any, Any, SAC]:
    sac = SAC(
        **{"steps": 16_000, "environments": 16, "collect": 8, "updates": 0.125, "hidden": (32,), "learning_rate": 5e-3}
        | changed
    )
    rule = sac.bind(world, 100, 1)

    def body(i: Any, state: Any) -> Any:
        return rule.step(jax.random.fold_in(jax.random.key(1), i), state, None)[0]

    state = jax.jit(lambda s: jax.lax.fori_loop(0, sac.iterations(1), body, s))(rule.init(jax.random.key(0)))
    return rule, state, sac


def worth(rule: Any, state: Any, seen: jax.Array) -> jax.Array:
    """Values of the policy's own actions."""
    policy = rule.policy(state)
    return rule.values(state, (seen - policy.mean[None]) / policy.std[None], rule.actor.act(policy, seen))


def test_probe_the_best_action_is_found() -> None:
    """One step, reward -(a - 0.5)^2: the policy's mean is 0.5."""
    rule, state, _ = trained(probe(lambda sign, a, over: -((a - 0.5) ** 2)), target_entropy=-3.0)
    act = rule.actor.act(rule.policy(state), jnp.ones((1, 1), jnp.float32))
    np.testing.assert_allclose(act, 0.5, atol=0.06)


def test_probe_the_observation_is_used() -> None:
    """The best action is the sign that is seen."""
    rule, state, _ = trained(probe(lambda sign, a, over: sign * a, signs=True), target_entropy=-2.0)
    act = rule.actor.act(rule.policy(state), jnp.array([[1.0], [-1.0]], jnp.float32))
    assert float(act[0, 0]) > 0.8
    assert float(act[1, 0]) < -0.8


def test_probe_values_are_discounted_and_end_with_the_episode() -> None:
    """Reward 1 at the second and last step: worth 1 there, the discount before; the policy's entropy is held near nothing."""
    rule, state, sac = trained(
        probe(lambda sign, a, over: over.astype(jnp.float32), dim_o=2, length=2),
        discount=0.7, temperature=1e-4, target_entropy=-20.0,
    )  # fmt: skip
    seen = jnp.array([[1.0, 1.0], [1.0, 2.0]], jnp.float32)
    values = worth(rule, state, seen)
    np.testing.assert_allclose(values.mean(axis=0), [1.0, sac.discount], atol=0.06)


def test_a_horizon_is_no_end() -> None:
    """Reward 1 for ever, cut into episodes of 5 steps: worth 1/(1 - discount), not what is left of an episode."""
    rule, state, sac = trained(
        probe(lambda sign, a, over: jnp.ones_like(sign), length=10**6),
        discount=0.8, temperature=1e-4, target_entropy=-20.0, episode=5, polyak=0.05,
    )  # fmt: skip
    values = worth(rule, state, jnp.ones((1, 1), jnp.float32))
    np.testing.assert_allclose(values, 1 / (1 - sac.discount), rtol=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "policy.steps: got 0; it must be at least 1"),
        ({"discount": 1.5}, "policy.discount: got 1.5; it must be above 0 and at most 1"),
        ({"learning_rate": 0.0}, "policy.learning_rate: got 0.0; it must be positive"),
        ({"final_learning_rate": -1.0}, "policy.final_learning_rate: got -1.0; allowed are 0 to 1"),
        ({"target_entropy": float("nan")}, "policy.target_entropy: got nan; it must be a finite number"),
        ({"clip": -1.0}, "policy.clip: got -1.0; it must be positive, or null"),
    ],
)
def test_wrong_settings(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SAC(**change)


def test_a_policy_runs_with_numpy_alone(tmp_path: Path) -> None:
    """Files written and read back, and the runner of a rig, give the actions of the policy, with memory and limits."""
    encoding = Encoding(CART.states, CART.inputs, stack=2)
    goal = Task(**STILL, limits={"u": [-1, 3]}).bind(encoding)
    actor = Actor(MLP((8, 8), negative_slope=0.0), 1)
    policy = Policy(actor.init(jax.random.key(0), 5, jnp.dtype("float32")), jnp.full(5, 0.1), jnp.full(5, 0.7))
    save_policy(tmp_path, policy, contract(encoding, goal, 2, 0.05))
    read, facts = load_policy(tmp_path)
    assert facts["dt"] == 0.05
    runner = PolicyRunner(tmp_path)
    past = jnp.zeros((1, 2), jnp.float32)
    for state in ((0.3, 3.0), (0.1, -1.0), (-0.6, 0.2)):
        seen = jnp.concatenate([encoding.encode(jnp.array([state], jnp.float32)), past], axis=1)
        expected = float(goal.command(actor.act(read, seen))[0, 0])
        got = runner.command({"s": state[0], "a": state[1]})["u"]
        np.testing.assert_allclose(got, expected, rtol=1e-5)
        past = jnp.concatenate([past[:, 1:], jnp.array([[got]], jnp.float32)], axis=1)
    with pytest.raises(ValueError, match="not finite"):
        runner.command({"s": float("nan"), "a": 0.0})
    runner.reset()
    assert all(float(u[0]) == 0 for u in runner.past)
    text = (tmp_path / "run_policy.py").read_text()
    assert "jax" not in text.replace("JAX", "")


def test_a_damaged_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no policy"):
        load_policy(tmp_path)


SMALL = (
    "rl-offline", "experiment=pendulum_swing_up", "method.steps=100", "method.particles=4", "method.network.hidden=[16,16]",
    "method.pool=64", "method.sets=16", "prior.draws=64",
    "policy.steps=4000", "policy.environments=8", "policy.policies=2", "policy.looks=4",
    "policy.hidden=[16]", "control.episodes=4", "control.fine_tune=3", "run.seeds=2",
)  # fmt: skip


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("control")
    result = simpel(folder, *SMALL, "hydra.run.dir=run")
    assert result.code == 0, result.err
    return folder / "run"


def test_the_run_holds_what_is_promised(flown: Path) -> None:
    from simpel_cli.runs.metrics import read_metrics

    assert json.loads((flown / "manifest.json").read_text())["status"] == "done"
    for name in (
        "learning_curves.png",
        "trajectories.png",
        "report.html",
        "policy/policy.json",
        "posterior/metrics.parquet",
    ):
        assert (flown / name).exists(), name
    rows = read_metrics(flown / "metrics.parquet")
    assert {r["metric"] for r in rows if r["split"] == "test"} == {
        "return_in_model",
        "return_in_truth",
        "success",
        "broken_in_model",
    }
    looks = {r["step"] for r in rows if r["split"] == "train"}
    assert len(looks) == 5  # and what fine-tuning came to
    assert {r["seed"] for r in rows} == {0, 1}


def test_an_interrupted_run_goes_on_to_the_same_end(flown: Path, tmp_path: Path) -> None:
    """Stopped after its second look: the files of the first half, and what follows, are those of the whole."""
    from simpel_cli.errors import Interrupted
    from simpel_cli.inference import loop

    kept = loop.train
    calls = []

    def stopping(*words: Any, **more: Any) -> Any:
        calls.append(words)
        for i, one in enumerate(kept(*words, **more)):
            yield one
            if len(calls) == 2 and i == 1:
                raise Interrupted("stopped by the test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "train", stopping)
        assert simpel(tmp_path, *SMALL, "hydra.run.dir=run").code == Interrupted.exit_code
    assert simpel(tmp_path, "rl-offline", "--resume", "run").code == 0
    for name in ("checkpoint/state.safetensors", "policy/policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (flown / name).read_bytes(), name


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("reward=swing_up", "control.sampling=ts2"), "control.sampling: got 'ts2'; allowed are ts1, tsinf, mean"),
        (("method.steps=10",), "reward: missing; name a task"),
        (("reward=swing_up", "sim@truth=racecar"), "truth: states of racecar are x, y"),
        (("reward=swing_upp",), "swing_upp"),
        (("reward=swing_up", "policy.stepz=3"), "policy.stepz"),
    ],
)
def test_wrong_words(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    result = simpel(tmp_path, "rl-offline", *SMALL[2:7], *words, "run.quiet=true")
    assert result.code == 2
    assert message in result.err
    assert "Traceback" not in result.err


def test_the_runner_needs_no_jax(flown: Path) -> None:
    """In a process in which JAX cannot be imported."""
    code = (
        "import sys; sys.modules['jax'] = None; sys.path.insert(0, 'policy')\n"
        "from run_policy import PolicyRunner\n"
        "print(PolicyRunner('policy').command({'phi': 3.0, 'omega': 0.1}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=flown, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "'u':" in done.stdout
    states = '{"phi": 3.0, "omega": 0.1}\n\n{"phi": 3.0, "omega": 0.1}\n'
    lines = subprocess.run(
        [sys.executable, "policy/run_policy.py"], cwd=flown, input=states, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert len(lines) == 2
    assert abs(json.loads(lines[0])["u"] - ast.literal_eval(done.stdout)["u"]) < 1e-12


def test_a_fit_takes_the_experiment_of_a_task(tmp_path: Path) -> None:
    result = simpel(tmp_path, "fit", *SMALL[1:7], "--cfg", "job")
    assert result.code == 0, result.err


def test_fine_tuning_climbs_the_return() -> None:
    """In a world without memory whose reward is highest where the action is half of what is seen."""
    world = probe(lambda sign, a, over: -((a - 0.5 * sign) ** 2), signs=True)
    actor = Actor(MLP((8,), negative_slope=0.0), 1)
    begun = Policy(
        actor.init(jax.random.key(0), 1, jnp.dtype("float32")), *(jnp.full(1, v, jnp.float32) for v in (0, 1))
    )
    better, returns = fine_tuned(world, actor, begun, jax.random.key(1), 1, 300, 0.02, 20.0)
    assert float(returns[0]) < -0.05
    np.testing.assert_allclose(actor.act(better, jnp.array([[-1.0], [1.0]], jnp.float32))[:, 0], [-0.5, 0.5], atol=0.03)


def test_a_gradient_fades_with_the_steps_that_it_goes_back() -> None:
    """The reward is the sum of all actions so far: what one earns k steps later counts exp(-k/reach) as much."""

    def add(key: Any, situation: Situation, action: Any) -> Step:
        total = situation.encoded + action
        never = jnp.zeros(len(action), bool)
        return Step(situation._replace(encoded=total), Judged(total[:, 0], never, never), never)

    world = probe(None)._replace(step=add, observe=lambda key, situation: situation.encoded)
    kept, steps = float(np.exp(-1 / 4.0)), 5

    def returns(shift: jax.Array, world: World) -> jax.Array:
        acting = reflex(lambda seen: jnp.full((len(seen), 1), 0.1, jnp.float32) + shift)
        return episodes(world, acting, jax.random.key(0), 2, steps).returns.mean()

    zero = jnp.zeros((), jnp.float32)
    slopes = [float(jax.grad(returns)(zero, w)) for w in (world, fading(world, 4.0))]
    expected = [sum(share ** (t - k) for t in range(steps) for k in range(t + 1)) for share in (1.0, kept)]
    np.testing.assert_allclose(slopes, expected, rtol=1e-5)
    np.testing.assert_allclose(returns(zero, world), returns(zero, fading(world, 4.0)), rtol=1e-6)


def test_a_gradient_that_is_not_finite_is_left_out() -> None:
    slope = (jnp.array([1.0, jnp.nan]), jnp.array([-jnp.inf, 2.0]))
    np.testing.assert_array_equal(jnp.stack(finite(slope)), [[1.0, 0.0], [0.0, 2.0]])


def test_a_planner_finds_the_action_without_training() -> None:
    """The reward is highest where the action is half of the sign that is seen."""
    world = probe(lambda sign, a, over: -((a - 0.5 * sign) ** 2), dim_o=2, signs=True)
    controller = ICEM(ahead=3, population=64, elites=8, rounds=4).bind(world, 1, 1)
    seen = jnp.array([[1.0, 1.0], [-1.0, 1.0]], jnp.float32)
    plan, action = controller.act(jax.random.key(0), controller.begin(2), seen)
    np.testing.assert_allclose(action[:, 0], [0.5, -0.5], atol=0.08)
    assert plan.mean.shape == (2, 1, 1)  # no further than the horizon


def test_a_plan_is_good_on_the_whole_and_not_by_a_lucky_particle() -> None:
    """Two particles that disagree on the sign of what the input does: the best that is known is to do nothing."""
    goal = Task(reward="s - 0.1*u**2", horizon=1, limits={"u": [-2, 2]}).bind(CART)

    def members(x: jax.Array) -> jax.Array:
        signs = jnp.array([1.0, -1.0], x.dtype)[:, None, None]
        return signs * x[:, :, -1:] * jnp.array([1.0, 0.0, 0.0], x.dtype)[None, None]

    world = learned_world(CART, goal, members, jnp.full(3, 1e-9), 2, "tsinf")
    controller = ICEM(ahead=1, population=64, elites=8, rounds=4).bind(world, 1, 1)
    seen = world.observe(jax.random.key(0), world.reset(jax.random.key(0), 2))
    _, action = controller.act(jax.random.key(0), controller.begin(2), seen)
    np.testing.assert_allclose(action, 0.0, atol=0.1)


@pytest.fixture(scope="module")
def swing() -> tuple[World, Encoding, Task]:
    """The true pendulum of the swing-up."""
    node = of_conf("sim", "pendulum_high_fidelity")
    node["parameters"] |= {"m": 0.6, "l": 0.5, "C_m": 1.1, "c_1": 0.5, "c_2": 0.5}
    model = build(node, "sim").model()
    encoding, task = encoding_of(model), build(of_conf("reward", "swing_up"), "reward")
    step = transition(model, encoding).step
    world = true_world(encoding, task.bind(encoding), step, jnp.zeros(0, jnp.float32), jnp.zeros(2, jnp.float32))
    return world, encoding, task


def test_a_plan_swings_a_pendulum_up(swing: tuple[World, Encoding, Task]) -> None:
    world, _, task = swing
    controller = ICEM(ahead=15, population=64, elites=8, rounds=2).bind(world, task.horizon, 1)
    planned = episodes(world, controller, jax.random.key(0), 2, 60)
    idle = episodes(world, reflex(lambda seen: jnp.zeros((2, 1), seen.dtype)), jax.random.key(0), 2, 60)
    assert float(planned.returns.min()) > 30 > 5 > float(idle.returns.max())
    assert bool(planned.succeeded(5).all())


@pytest.mark.parametrize("ahead", [7, 8])
@pytest.mark.parametrize("colour", [0.0, 2.0])
def test_coloured_noise_has_unit_variance(colour: float, ahead: int) -> None:
    noise = np.asarray(ICEM(colour=colour).coloured(jax.random.key(0), (20_000, ahead, 1)))[:, :, 0]
    np.testing.assert_allclose(noise.var(axis=0), 1.0, rtol=0.05)
    alike = np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]
    assert alike > 0.4 if colour else abs(alike) < 0.03


@pytest.mark.slow  # the planner itself is tested above
def test_a_planner_in_place_of_a_policy(tmp_path: Path) -> None:
    small = ("planner.ahead=4", "planner.population=8", "planner.elites=2", "planner.rounds=1", "reward.horizon=12")
    result = simpel(tmp_path, *SMALL, "planner=icem", *small, "reward.settled=5", "hydra.run.dir=run")
    assert result.code == 0, result.err
    assert "plans of 4 steps" in result.out
    assert not (tmp_path / "run" / "policy").exists()
    assert (tmp_path / "run" / "episodes.parquet").exists()
    wrong = simpel(tmp_path, *SMALL, "planner=icem", "planner.elites=500", "hydra.run.dir=wrong")
    assert "planner.elites: got 500; it is at most planner.population (32)" in wrong.err
