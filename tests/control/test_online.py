"""Plants, the exchange with a rig, and learning from episodes of the policy's own, from end to end."""

import json
import shutil
import subprocess
import sys
import threading
import time
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from command_line import ROOT, simpel

from simpel_cli.config.build import build
from simpel_cli.config.resolved import load
from simpel_cli.control.agents.policy import Actor, Policy
from simpel_cli.control.agents.rollout import episodes, reflex
from simpel_cli.control.assignment import assignment
from simpel_cli.control.plants.environments import GymnasiumEnvironment, WorldEnvironment
from simpel_cli.control.plants.exchange import Exchange
from simpel_cli.control.plants.plant import PlantEpisode, Simulated, Stepped, earned, write_episode
from simpel_cli.control.plants.policy_files import contract, load_policy, save_policy
from simpel_cli.control.plants.returned_episodes import ReturnedEpisodes
from simpel_cli.control.plants.runner import PolicyRunner
from simpel_cli.control.posterior_world import world_of_posterior
from simpel_cli.control.rounds import own_data
from simpel_cli.control.task import Task
from simpel_cli.control.world import true_world
from simpel_cli.data import Measurements, read
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.inference.networks import MLP
from simpel_cli.reporting.fit import SCREEN
from simpel_cli.runs.files import write_table
from simpel_cli.runs.metrics import read_metrics
from simpel_cli.runs.settings import stream
from simpel_cli.studies.declared import declare
from simpel_cli.studies.fit import learned
from simpel_cli.studies.open import open_study

HORIZON = 12
FLOAT32 = jnp.dtype("float32")


def of_conf(group: str, name: str) -> Any:
    return yaml.safe_load((ROOT / "conf" / group / f"{name}.yaml").read_text())


def policy_in(folder: Path, encoding: Encoding, task: Task, memory: int) -> Actor:
    """Save a policy of random weights."""
    goal, dim_u = task.bind(encoding), len(encoding.inputs)
    actor = Actor(MLP((8,), negative_slope=0.0), dim_u)
    size = encoding.dim_state + memory * dim_u
    policy = Policy(actor.init(jax.random.key(0), size, FLOAT32), jnp.zeros(size), jnp.full(size, 0.3))
    save_policy(folder, policy, contract(encoding, goal, memory, 0.05))
    return actor


@pytest.fixture(scope="module")
def swing() -> tuple[Any, Encoding, Task]:
    model = build(of_conf("sim", "pendulum_high_fidelity"), "sim").model()
    return model, encoding_of(model), build(of_conf("reward", "swing_up"), "reward")


def test_a_simulated_episode_is_what_its_rows_say(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    """Without sensor noise every row follows from the one before, and the reward from both."""
    model, encoding, task = swing
    goal = task.bind(encoding)
    actor = policy_in(tmp_path, encoding, task, 0)
    phi = jnp.asarray([q.middle for q in model.params], jnp.float32)
    step = transition(model, encoding).step
    world = true_world(encoding, goal, step, phi, jnp.zeros(2, jnp.float32))
    plant = Simulated(world, encoding, goal, actor.act, HORIZON, jax.random.key(3))
    ride = plant.episode(0, tmp_path)
    assert ride.states.shape == (HORIZON + 1, 2)
    assert ride.commands.shape == (HORIZON, 1)
    x = jnp.concatenate([encoding.encode(jnp.asarray(ride.states[:-1])), jnp.asarray(ride.commands)], axis=1)
    after = encoding.advance(x[:, : encoding.dim_state], jax.vmap(step, in_axes=(0, None))(x, phi).astype(x.dtype))
    np.testing.assert_allclose(encoding.decode(after), ride.states[1:], atol=2e-5)
    judged = goal.judge(jnp.asarray(ride.states[1:]), jnp.asarray(ride.commands), jnp.asarray(ride.commands))
    np.testing.assert_allclose(judged.reward, ride.reward, atol=2e-5)
    other = plant.episode(1, tmp_path)
    assert not np.allclose(other.states, ride.states)
    np.testing.assert_array_equal(plant.episode(0, tmp_path).states, ride.states)


def test_an_episode_is_read_as_it_was_written(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    model, encoding, task = swing
    goal = task.bind(encoding)
    actor = policy_in(tmp_path, encoding, task, 0)
    phi = jnp.asarray([q.middle for q in model.params], jnp.float32)
    noise = jnp.full(2, 0.05, jnp.float32)
    world = true_world(encoding, goal, transition(model, encoding).step, phi, noise)
    ride = Simulated(world, encoding, goal, actor.act, HORIZON, jax.random.key(3)).episode(0, tmp_path)
    write_episode(tmp_path / "000.parquet", ride, encoding, model.dt, (0.0,) * len(encoding.inputs))
    asked = Measurements(path=(str(tmp_path / "000.parquet"),), time="t", split={"test_fraction": 0})
    recording = read(asked, model, tmp_path, 0)
    assert recording.test == ()
    (episode,) = recording.train
    np.testing.assert_allclose(episode.states, np.unwrap(ride.states, axis=0), atol=1e-6)
    np.testing.assert_allclose(episode.inputs[:-1], ride.commands, atol=1e-6)


def test_the_mujoco_car_is_driven(tmp_path: Path) -> None:
    """Its hidden states begin at rest, its commands act late, its noise is the sensors'."""
    model = build(of_conf("sim", "parking_bicycle"), "sim").model()
    encoding, task = encoding_of(model, stack=3), build(of_conf("reward", "parking"), "reward")
    goal = task.bind(encoding)
    policy_in(tmp_path, encoding, task, 3)
    world = build(of_conf("sim", "rc_car_world"), "sim").model()
    rig = WorldEnvironment(world, encoding, goal, model.dt, np.zeros(6), jax.random.key(0))
    ride = Stepped(rig, encoding, goal, HORIZON).episode(0, tmp_path)
    assert ride.states.shape == (HORIZON + 1, 6)
    low, high = np.array(goal.low), np.array(goal.high)
    assert ((ride.commands >= low) & (ride.commands <= high)).all()
    moved = np.hypot(*(ride.states - ride.states[0])[:, :2].T)
    assert moved[2] < 0.01 < moved[-1]  # nothing arrives within the first three steps
    noisy = WorldEnvironment(world, encoding, goal, model.dt, np.full(6, 0.1), jax.random.key(0))
    assert 0.01 < np.abs(noisy.reset(0) - rig.reset(0)).max() < 0.5
    np.testing.assert_array_equal(noisy.reset(1), noisy.reset(1))
    bare = encoding_of(build(of_conf("sim", "pendulum"), "sim").model())
    with pytest.raises(ConfigError, match=r"states of rc_car_world are x, y, .*; those of sim are phi, omega"):
        WorldEnvironment(world, bare, goal, model.dt, np.zeros(2), jax.random.key(0))
    with pytest.raises(ConfigError, match=r"a step of rc_car_world is 0\.0333.* s; one of sim is 0\.05 s"):
        WorldEnvironment(world, encoding, goal, 0.05, np.zeros(6), jax.random.key(0))


class Cart:
    """An environment of gymnasium's protocol: a mass without friction."""

    def __init__(self, named: bool = True, broken_at: int | None = None) -> None:
        self.named, self.broken_at, self.state, self.steps = named, broken_at, np.zeros(2), 0

    def reset(self, seed: int) -> tuple[Any, dict[str, Any]]:
        self.state, self.steps = np.random.default_rng(seed).normal(size=2), 0
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.state = self.state + 0.05 * np.array([self.state[1], float(action[0])])
        if self.steps == self.broken_at:
            self.state = self.state * np.nan
        return self._seen(), -1.0, False, self.steps == 8, {}

    def _seen(self) -> Any:
        return {"phi": self.state[0], "omega": self.state[1]} if self.named else self.state


@pytest.fixture
def gymnasium(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(name: str) -> Cart:
        made = {"named": Cart(), "plain": Cart(False), "breaks": Cart(broken_at=4), "breaks_at_once": Cart(broken_at=1)}
        if name not in made:
            raise ValueError("no such environment")
        return made[name]

    monkeypatch.setitem(sys.modules, "gymnasium", types.SimpleNamespace(make=make))


@pytest.mark.parametrize(("name", "steps"), [("named", 8), ("plain", 8), ("breaks", 3)])
@pytest.mark.usefixtures("gymnasium")
def test_a_gymnasium_environment_is_driven(
    name: str, steps: int, swing: tuple[Any, Encoding, Task], tmp_path: Path
) -> None:
    """It ends where it says so, and where a state is not finite: that row is no measurement."""
    _, encoding, task = swing
    policy_in(tmp_path, encoding, task, 0)
    ride = Stepped(GymnasiumEnvironment(name, encoding, 0), encoding, task.bind(encoding), HORIZON).episode(0, tmp_path)
    assert ride.states.shape == (steps + 1, 2)
    assert np.isfinite(ride.states).all()
    assert ride.reward.shape == ride.good.shape == (steps,)


def test_what_a_plant_earns_does_not_depend_on_turns(swing: tuple[Any, Encoding, Task]) -> None:
    """A rig counts its turns; the task has angles in [-pi, pi)."""
    _, encoding, task = swing
    goal, states, commands = task.bind(encoding), np.array([[0.3, 1.0], [-0.2, 0.5]]), np.array([[0.1], [-0.4]])
    turned = states + np.array([[4 * np.pi, 0.0]])
    for one, two in zip(
        earned(goal, encoding, states, commands), earned(goal, encoding, turned, commands), strict=True
    ):
        np.testing.assert_allclose(one, two, atol=1e-5)


def test_a_command_before_counts_at_every_step(swing: tuple[Any, Encoding, Task]) -> None:
    """Judged step by step, as a stepped rig is, or all at once: the same."""
    _, encoding, _ = swing
    goal = Task(reward="u_before", horizon=10, stop="u_before > 0.5").bind(encoding)
    states, commands = np.zeros((3, 2)), np.array([[0.6], [0.2], [0.1]])
    whole = earned(goal, encoding, states, commands)
    assert whole[2].tolist() == [False, True, False]
    last = earned(goal, encoding, states[1:2], commands[1:2], commands[0])
    assert (float(last[0][0]), bool(last[2][0])) == (float(whole[0][1]), True)


def test_a_simulator_that_cannot_go_on_ends_the_episode(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    """The step that it could not take is no measurement."""
    _, encoding, task = swing
    goal = task.bind(encoding)
    actor = policy_in(tmp_path, encoding, task, 0)

    def step(x: jax.Array, phi: jax.Array) -> jax.Array:
        turned = jnp.arctan2(x[0], x[1])
        return jnp.array([0.0, 0.0, 1.0], x.dtype) + jnp.where(x[2] > 3.5, jnp.nan, 0.0).astype(x.dtype) * turned

    world = true_world(encoding, goal, step, jnp.zeros(0), jnp.zeros(2, jnp.float32))
    ride = Simulated(world, encoding, goal, actor.act, HORIZON, jax.random.key(3)).episode(0, tmp_path)
    speeds = ride.states[:, 1]
    assert 2 <= len(speeds) <= 6
    np.testing.assert_allclose(np.diff(speeds), 1.0, atol=1e-5)


@pytest.mark.usefixtures("gymnasium")
def test_an_environment_that_cannot_be_used(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    _, encoding, task = swing
    with pytest.raises(ConfigError, match="gymnasium cannot make 'nothing': no such environment"):
        GymnasiumEnvironment("nothing", encoding, 0)
    policy_in(tmp_path, encoding, task, 0)
    rig = GymnasiumEnvironment("breaks_at_once", encoding, 0)
    with pytest.raises(DataError, match="no step was possible"):
        Stepped(rig, encoding, task.bind(encoding), HORIZON).episode(0, tmp_path)


def anything(number: int, ride: PlantEpisode) -> None:
    """Accept every episode."""


def exchange_of(
    folder: Path, encoding: Encoding, task: Task, wait: float, run: str, said: list[str], accept: Any = anything
) -> Exchange:
    answers = ReturnedEpisodes(encoding, task.bind(encoding), replace(task, horizon=HORIZON), 0.05, said.append)
    return Exchange(folder, answers, wait, run, accept, said.append, lambda: None)


def answer_of(folder: Path, rows: int, angle: str = "phi", speed: str = "omega") -> dict[str, Any]:
    """What a rig measures, driven by the runner beside its policy."""
    runner = PolicyRunner(folder)
    state, columns = {angle: 3.0, speed: 0.0}, {angle: [], speed: [], "u": []}
    for _ in range(rows):
        command = runner.command(state)
        for name, value in (state | command).items():
            columns[name].append(value)
        state = {angle: state[angle] + 0.05 * state[speed], speed: state[speed] + 0.05 * command["u"]}
    return {name: np.array(values) for name, values in columns.items()}


def test_a_rig_behind_a_folder(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    """Bad answers are kept, named and asked for again; the good one is used."""
    _, encoding, task = swing
    policy_in(tmp_path / "policy", encoding, task, 0)
    said: list[str] = []
    folder = tmp_path / "rig"
    refused: list[int] = []

    def accept(number: int, ride: PlantEpisode) -> None:
        if not refused:
            refused.append(number)
            raise DataError("a fit can make nothing of it")

    exchange = exchange_of(folder, encoding, task, 60.0, "mine", said, accept)
    target, own = folder / "episode_002.parquet", folder / "episode_002"

    def rig() -> None:
        while not (own / "request.json").exists():
            time.sleep(0.02)
        assert json.loads((own / "request.json").read_text())["answer"] == target.name
        good = answer_of(own, HORIZON + 1)
        wrong = {
            "phi": good | {"phi": np.where(np.arange(HORIZON + 1) == 5, np.nan, good["phi"])},
            "u is 1e+09": good | {"u": np.full(HORIZON + 1, 1e9)},
            "the column omega is missing": {k: v for k, v in good.items() if k != "omega"},
            "1 rows": {k: v[:1] for k, v in good.items()},
            "t is 0.1 s": good | {"t": 0.1 * np.arange(HORIZON + 1)},
            "far outside its range [-5, 5]": good | {"omega": good["omega"] + 1e4 * (np.arange(HORIZON + 1) == 3)},
            "a fit": good,
        }
        for i, columns in enumerate(wrong.values(), 1):
            write_table(target, columns)
            while not (folder / f"episode_002.refused-{i}.txt").exists():
                time.sleep(0.02)
        unseen = np.append(good["u"][:-1], np.nan)  # nobody sees what the last command leads to
        write_table(target, good | {"u": unseen, "t": 7.0 + 0.05 * np.arange(HORIZON + 1)})

    thread = threading.Thread(target=rig, daemon=True)
    thread.start()
    ride = exchange.episode(2, tmp_path / "policy")
    thread.join()
    assert ride.states.shape == (HORIZON + 1, 2)
    problems = [(folder / f"episode_002.refused-{i}.txt").read_text() for i in range(1, 8)]
    expected = (
        "row 5: phi is nan",
        "row 0: u is 1e+09",
        "the column omega is missing",
        "1 rows",
        "row 1: t is 0.1",
        "far outside its range [-5, 5]",
        "a fit",
    )
    for problem, words in zip(problems, expected, strict=True):
        assert words in problem
    assert refused == [2]
    assert len(list(folder.glob("*.refused-*.parquet"))) == 7
    assert "waiting for" in said[0]
    np.testing.assert_allclose(exchange.episode(2, tmp_path / "policy").states, ride.states)  # still there: taken again
    other = exchange_of(folder, encoding, task, 60.0, "another", said)
    with pytest.raises(DataError, match=r"is there, but this run did not ask for it"):
        other.episode(2, tmp_path / "policy")


def test_a_rig_that_does_not_answer(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    _, encoding, task = swing
    policy_in(tmp_path / "policy", encoding, task, 0)
    exchange = exchange_of(tmp_path / "rig", encoding, task, 0.1, "mine", [])
    with pytest.raises(DataError, match=r"did not come within 0.1 s .*--resume"):
        exchange.episode(0, tmp_path / "policy")
    assert (tmp_path / "rig" / "episode_000" / "run_policy.py").exists()


SMALL = (
    "rl-online", "experiment=pendulum_swing_up", "method.steps=100", "method.particles=4", "method.network.hidden=[16,16]",
    "method.pool=64", "method.sets=16", "prior.draws=64",
    "policy.steps=4000", "policy.environments=8", "policy.looks=3", "policy.hidden=[16]",
    "control.episodes=4", "control.fine_tune=0", "reward.horizon=12", "reward.settled=5", "online.episodes=3",
)  # fmt: skip


def test_what_is_odd_about_an_answer_is_said(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    """It is taken all the same: a rig may have its reasons."""
    _, encoding, task = swing
    policy_in(tmp_path / "policy", encoding, task, 0)
    said: list[str] = []
    folder, other = tmp_path / "rig", tmp_path / "rig" / "episode_000"
    exchange = exchange_of(folder, encoding, task, 0.0, "mine", said)
    with pytest.raises(DataError, match="did not come within"):
        exchange.episode(0, tmp_path / "policy")
    good = answer_of(other, HORIZON + 5)
    odd = {"u": 0.9 * np.sign(good["u"] + 1e-9), "omega": good["omega"] + 20 * (np.arange(HORIZON + 5) == 4) + 0.5}
    write_table(folder / "episode_000.parquet", good | odd)
    ride = exchange.episode(0, tmp_path / "policy")
    assert ride.states.shape == (HORIZON + 1, 2)
    every = " ".join(said)
    for words in (
        "has 17 rows: the first 13 are taken",
        "row 4: omega is 2",
        "a spike of the sensor would spoil the model",
        "begins at omega = 0.5 rad/s; the task does in",
        "off what the policy would have given, on average: was it this policy that drove?",
    ):
        assert words in every
    # a second run does not take the folder over
    exchange.withdraw(0)
    theirs = exchange_of(folder, encoding, task, 0.0, "theirs", said)
    with pytest.raises(DataError, match="is of another run, which waits for"):
        theirs.episode(0, tmp_path / "policy")
    (other / "request.json").write_text("{}")  # somebody did
    write_table(folder / "episode_000.parquet", good)
    with pytest.raises(DataError, match="this run did not ask for it"):
        exchange.episode(0, tmp_path / "policy")


def test_a_reward_that_is_no_number(swing: tuple[Any, Encoding, Task]) -> None:
    _, encoding, task = swing
    with pytest.raises(ConfigError, match=r"reward.reward: 'sqrt\(0.15 - omega\)' is nan at phi=.*, omega=.*, u="):
        replace(task, reward="sqrt(0.15 - omega)").bind(encoding)
    goal = replace(task, reward="sqrt(6 - omega)").bind(encoding)  # finite within the ranges
    with pytest.raises(DataError, match=r"the reward is nan after step 1, at phi = 0, omega = 7; see reward.reward"):
        earned(goal, encoding, np.array([[0.0, 1.0], [0.0, 7.0]]), np.zeros((2, 1)))


def test_the_runner_goes_on_after_a_bad_line(swing: tuple[Any, Encoding, Task], tmp_path: Path) -> None:
    _, encoding, task = swing
    policy_in(tmp_path / "policy", encoding, task, 0)
    lines = [
        '{"phi": 3.0, "omega": 0.0}',
        '{"phi": 3.0}',
        "none",
        '{"phi": NaN, "omega": 0}',
        "[1]",
        '{"phi": 3.0, "omega": 0.0}',
    ]
    words = [sys.executable, "-I", str(tmp_path / "policy" / "run_policy.py")]
    shown = subprocess.run(words, input="\n".join(lines), capture_output=True, text=True, timeout=120)
    answers = [json.loads(line) for line in shown.stdout.splitlines()]
    assert (shown.returncode, shown.stderr, len(answers)) == (0, "", 6)
    assert answers[0] == answers[5]
    for answer in answers[1:5]:
        assert answer["error"].startswith(
            "needed is a JSON object with finite numbers for phi [rad], omega [rad/s]; got "
        )


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("online")
    result = simpel(folder, *SMALL, "online.warm_start=true", "hydra.run.dir=run")
    assert result.code == 0, result.err
    assert "episode 2 return" in result.out
    return folder / "run"


def test_the_run_holds_what_is_promised(driven: Path) -> None:
    assert json.loads((driven / "manifest.json").read_text())["status"] == "done"
    for name in ("returns.png", "trajectories.png", "report.html", "rounds/002/policy/run_policy.py"):
        assert (driven / name).exists(), name
    rows = read_metrics(driven / "metrics.parquet")
    assert {r["step"] for r in rows} == {0, 1, 2}
    by = {(r["metric"], r["step"]): r["value"] for r in rows}
    for number in range(3):
        table = pq.read_table(driven / "episodes" / f"{number:03d}.parquet").to_pydict()
        assert len(table["t"]) == 13
        np.testing.assert_allclose(by["return", number], sum(table["reward"]), rtol=1e-6)
    learned = [
        r["n_train"] for i in range(3) for r in read_metrics(driven / "rounds" / f"{i:03d}" / "metrics.parquet")[:1]
    ]
    assert learned == [0, 12, 24]
    judged = simpel(driven, "evaluate", "rounds/002/posterior", "data=pendulum_swing_up", "hydra.run.dir=judged")
    assert judged.code == 0, judged.err
    assert "not used in the fit" in judged.out
    assert by["nll_before", 2] < by["nll_before", 0]  # what was measured helps


def test_no_policy_earns_less_in_the_model_than_the_one_before(driven: Path) -> None:
    """A training that ends in a local optimum costs no episode: what is acted by is at least as good there as what was."""
    config = load(driven / "config.yaml")
    asked = assignment(declare(config))
    folder = driven / "rounds" / "001"
    study = open_study(declare(load(folder / "posterior" / "config.yaml")), driven)
    model = learned(study, folder / "posterior", SCREEN, shown=False)
    arrays = jax.tree.map(lambda a: jnp.asarray(a)[0], (model.fitted.assembled.problems, model.state))
    world = world_of_posterior(model, asked)(arrays, 0.0)
    actor = asked.policy.bind(world, asked.task.horizon, len(asked.encoding.inputs)).actor

    @jax.jit
    def worth(policy: Policy, key: jax.Array) -> jax.Array:
        acting = reflex(lambda seen: actor.act(policy, seen))
        return episodes(world, acting, key, 4, asked.task.horizon).returns.mean()

    own, last = (load_policy(driven / "rounds" / number / "policy")[0] for number in ("001", "000"))
    assert float(worth(own, stream(0, "judge"))) >= float(worth(last, stream(0, "judge"))) - 1e-3
    # what is promised was earned in other episodes than those that it was chosen by
    promised = json.loads((folder / "round.json").read_text())["return_in_model"]
    np.testing.assert_allclose(promised, worth(own, stream(0, "judge anew")), rtol=1e-3, atol=1e-3)


def test_a_run_that_was_killed_goes_on_to_the_same_end(driven: Path, tmp_path: Path) -> None:
    """As a kill leaves it while the third policy is trained, and again before the second episode was kept."""
    for last, gone in ((2, "policy"), (1, "round.json")):
        run = tmp_path / str(last)
        shutil.copytree(driven, run)
        for number in range(last, 3):
            (run / "episodes" / f"{number:03d}.parquet").unlink()
            (run / "rounds" / f"{number:03d}" / "round.json").unlink()
            if gone == "policy" or number > last:
                shutil.rmtree(run / "rounds" / f"{number:03d}")
        record = json.loads((run / "manifest.json").read_text()) | {"status": "running"}
        (run / "manifest.json").write_text(json.dumps(record))
        result = simpel(tmp_path, "rl-online", "--resume", str(last))
        assert result.code == 0, result.err
        for name in ("episodes/002.parquet", "rounds/002/policy/policy.safetensors"):
            assert (run / name).read_bytes() == (driven / name).read_bytes(), name


def test_an_episode_is_taken_back_and_more_are_driven(driven: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(driven, run)
    (run / "episodes" / "002.parquet").unlink()  # the last one: as if a sensor had failed in it
    result = simpel(tmp_path, "rl-online", "--resume", "run", "online.episodes=4", "run.quiet=true")
    assert result.code == 2
    assert "--resume: got run.quiet=true; a resumed run keeps its configuration" in result.err
    result = simpel(tmp_path, "rl-online", "--resume", "run", "online.episodes=4")
    assert result.code == 0, result.err
    assert "its file was deleted" in result.out
    for number in range(3):
        name = f"episodes/{number:03d}.parquet"
        assert (run / name).read_bytes() == (driven / name).read_bytes()
    assert (run / "episodes" / "003.parquet").exists()
    assert (run / "policy" / "policy.safetensors").read_bytes() == (
        run / "rounds/003/policy/policy.safetensors"
    ).read_bytes()
    assert {r["step"] for r in read_metrics(run / "metrics.parquet")} == {0, 1, 2, 3}
    assert "is complete; nothing to do" in simpel(tmp_path, "rl-online", "--resume", "run").out


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda run: (run / "episodes" / "001.parquet").unlink(),
            "001.parquet is missing, but the episodes after it are there",
        ),
        (lambda run: (run / "rounds" / "001" / "round.json").write_text("{"), "round.json: damaged"),
        (lambda run: (run / "config.yaml").write_text("run: {}"), "config.yaml: not as it was when the run began"),
    ],
)
def test_a_run_that_was_damaged(driven: Path, tmp_path: Path, damage: Any, message: str) -> None:
    shutil.copytree(driven, tmp_path / "run")
    (tmp_path / "run" / "report.html").unlink()
    damage(tmp_path / "run")
    result = simpel(tmp_path, "rl-online", "--resume", "run")
    assert result.code == 2
    assert message in result.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("world=foldr:rig",), "world: got 'foldr:rig'; allowed are sim, mujoco, gymnasium:ID and folder:DIR"),
        (("world=mujoco",), "world: mujoco needs a MuJoCo world"),
        (("run.seeds=2",), "rl-online takes one"),
        (("online.episodes=0",), "online.episodes: got 0; it must be at least 1"),
        (("online.warmstart=true",), "online.warmstart: no such key"),
        (("world=folder:/proc/rig",), "world: cannot write to"),
        (("data.n_train=5",), "data.n_train=5: rl-online learns from its own episodes"),
        (("data.noise_std.q=1",), "data.noise_std.q: the simulator has no such quantity (it has: phi, omega)"),
        (
            ("sim@truth=pendulum_high_fidelity", "sim.dt=0.1"),
            "truth: a step of pendulum_high_fidelity is 0.05 s; one of sim",
        ),
    ],
)
def test_wrong_words(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    result = simpel(tmp_path, *SMALL, *words, "run.quiet=true", "hydra.run.dir=run")
    assert result.code in (2, 3)
    assert message in result.err
    assert "Traceback" not in result.err


@pytest.mark.slow  # the exchange is tested above
def test_a_rig_of_a_users_own(tmp_path: Path) -> None:
    """As docs/how-to/control.md has it: no data, a simulator and a task; then what became of the run is not overwritten."""
    text = (ROOT / "conf" / "sim" / "pendulum.yaml").read_text().replace("phi", "angle").replace("omega", "speed")
    node = yaml.safe_load(text)
    lift = {
        "_target_": "simpel_cli.control.task.Task",
        "reward": "cos(angle)",
        "initial": {"angle": [3, 3.2]},
        "horizon": 12,
    }
    for group, name, content in (("sim", "mine", node), ("reward", "lift", lift)):
        (tmp_path / "my" / group).mkdir(parents=True)
        (tmp_path / "my" / group / f"{name}.yaml").write_text(yaml.safe_dump(content))
    small = [word for word in SMALL[2:] if not word.startswith(("reward.", "online."))]
    words = ("rl-online", "--config-dir", "my", "sim=mine", "reward=lift", "world=folder:exchange", *small)
    asked, answer = tmp_path / "exchange" / "episode_000", tmp_path / "exchange" / "episode_000.parquet"

    def rig() -> None:
        while not (asked / "request.json").exists():
            time.sleep(0.02)
        good = answer_of(asked, 13, "angle", "speed")
        write_table(answer, {name: np.zeros(13) for name in good})  # it was switched off
        while answer.exists():
            time.sleep(0.02)
        write_table(tmp_path / "exchange" / "new.parquet", good)
        (tmp_path / "exchange" / "new.parquet").rename(answer)

    thread = threading.Thread(target=rig, daemon=True)
    thread.start()
    result = simpel(tmp_path, *words, "online.episodes=2", "online.wait=1.5", "hydra.run.dir=run")
    assert "refused: episode_000.parquet: nothing changes" in result.out
    assert "episode_001.parquet did not come within 1.5 s" in result.err  # the first was taken, the second asked for
    assert pq.read_table(tmp_path / "run" / "episodes" / "000.parquet").num_rows == 13
    again = simpel(tmp_path, *words, "online.episodes=2", "policy.steps=8000", "hydra.run.dir=run")
    assert again.code == 2
    assert "holds a run already. Go on with `simpel rl-online --resume run`" in again.err


def test_keys_of_the_data_that_episodes_have_no_use_for_are_not_looked_at(tmp_path: Path) -> None:
    """`data=sergio` has the layout `transitions`, in which past inputs are not known; episodes of a plant are trajectories."""
    words = ("rl-online", "experiment=pendulum_swing_up", "+data.stack_actions=1", "+data.layout=transitions")
    result = simpel(tmp_path, *words, "world=gymnasium")
    assert (result.code, "data.layout" in result.err) == (2, True)  # typed, it is named
    config = {"data": {"path": "rows.parquet", "layout": "transitions", "stack_actions": 1, "noise_std": {"phi": 0.1}}}
    assert own_data(config) == {"path": [], "stack_actions": 1, "noise_std": {"phi": 0.1}}
