"""Commands of inputs that are linear between rows: reached at the next row, along a straight line."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest

from simpel_cli.control.compatibility import check_compatible
from simpel_cli.control.plants.plant import PlantEpisode, write_episode
from simpel_cli.control.plants.policy_files import contract
from simpel_cli.control.plants.returned_episodes import ReturnedEpisodes
from simpel_cli.control.task import Task
from simpel_cli.control.world import beginning_at, learned_world, true_world
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import ConfigError
from simulators.model import Declared, Model
from simulators.worlds.rk4 import RK4

STEPS = 6
TASK = Task(reward="-w**2", horizon=STEPS, initial={"w": 0.5})


def rotor(**between_rows: str) -> Model:
    """Two inputs, the first of which is linear."""
    words = {"u": "linear", "f": "held"} | between_rows
    return Declared(
        "rotor", dt=0.1, substeps=4, states={"w": {"unit": "rad/s", "range": [-4, 4]}},
        inputs={n: {"unit": "V", "range": [-2, 2], "between_rows": words[n]} for n in ("u", "f")},
        dynamics={"w": "2*u - 3*f - w"},
    ).model()  # fmt: skip


@pytest.fixture(scope="module")
def ride() -> PlantEpisode:
    model = rotor()
    encoding = encoding_of(model)
    goal = TASK.bind(encoding)
    world = true_world(encoding, goal, transition(model, encoding).step, jnp.zeros(0), jnp.zeros(1))
    situation = world.reset(jax.random.key(0), 1)
    assert situation.past.shape == (1, 1, 2)  # where a linear input is, the command before says
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 1, 2))
    states = [np.asarray(situation.encoded)[0]]
    for action in actions:
        situation = world.step(jax.random.key(1), situation, jnp.asarray(action)).situation
        states.append(np.asarray(situation.encoded)[0])
    commands = np.asarray(goal.command(jnp.asarray(actions[:, 0])))
    return PlantEpisode(np.array(states), commands, np.zeros(STEPS), np.ones(STEPS, bool))


def test_what_is_written_drives_the_simulator_along_the_same_course(ride: PlantEpisode, tmp_path: Path) -> None:
    model = rotor()
    path = tmp_path / "000.parquet"
    write_episode(path, ride, encoding_of(model), model.dt, (0.0, 0.0))
    table = {name: np.asarray(column) for name, column in pq.read_table(path).to_pydict().items()}
    inputs = np.stack([table["u"], table["f"]], axis=1)
    np.testing.assert_allclose(inputs[1:, 0], ride.commands[:, 0], atol=1e-6)  # reached a row later
    np.testing.assert_allclose(inputs[:-1, 1], ride.commands[:, 1], atol=1e-6)  # taken at once
    assert inputs[0, 0] == 0.0
    state, nothing = ride.states[:1], np.zeros((1, 0))
    for k in range(STEPS):
        state = RK4(model).follow(state, inputs[None, k : k + 1], nothing, inputs[None, k + 1])
        np.testing.assert_allclose(state[0], ride.states[k + 1], atol=1e-5)


def test_an_episode_of_a_rig_has_the_commands_that_were_given(ride: PlantEpisode, tmp_path: Path) -> None:
    model = rotor()
    encoding = encoding_of(model)
    path = tmp_path / "episode_000.parquet"
    write_episode(path, ride, encoding, model.dt, (0.0, 0.0))
    found = ReturnedEpisodes(encoding, TASK.bind(encoding), TASK, model.dt, lambda text: None).read(path)
    np.testing.assert_allclose(found.commands, ride.commands[: len(found.commands)], atol=1e-6)


def test_a_world_that_begins_at_data_knows_where_the_input_is() -> None:
    model = rotor()
    encoding = encoding_of(model)
    goal = TASK.bind(encoding)
    world = true_world(encoding, goal, transition(model, encoding).step, jnp.zeros(0), jnp.zeros(1))
    x = jnp.array([[0.3, 1.5, -0.5, 0.7]])  # state, u, f, and u at the next row
    begun = beginning_at(world, encoding, x, jnp.asarray(1), 1.0).reset(jax.random.key(0), 4)
    np.testing.assert_allclose(begun.past[:, 0, 0], 1.5)


def test_a_policy_says_how_its_commands_are_applied() -> None:
    encoding = encoding_of(rotor())
    facts = contract(encoding, TASK.bind(encoding), encoding.memory, 0.1)
    assert [c["between_rows"] for c in facts["commands"]] == ["linear", "held"]
    assert facts["past_commands"] == 1


def test_a_truth_that_holds_what_the_simulator_does_not_is_refused() -> None:
    encoding = encoding_of(rotor())
    with pytest.raises(
        ConfigError, match=r"u of rotor is held between rows; that of sim is linear or smooth. Say the same"
    ):
        check_compatible("truth", rotor(u="held"), encoding, TASK.bind(encoding), 0.1)


def test_noise_with_heavy_tails_is_in_the_roll_outs() -> None:
    encoding = encoding_of(rotor())
    goal, tail, scale = TASK.bind(encoding), 0.4, 0.3

    def errors(tail: float | None) -> np.ndarray:
        world = learned_world(
            encoding, goal, lambda x: jnp.zeros((*x.shape[:2], 1), x.dtype), jnp.array([scale]), 2,
            tail=None if tail is None else jnp.array([tail]),
        )  # fmt: skip
        situation = world.reset(jax.random.key(0), 20_000)
        after = world.step(jax.random.key(1), situation, jnp.zeros((20_000, 2))).situation
        return np.asarray(after.encoded - situation.encoded)[:, 0] / scale

    heavy, light = errors(tail), errors(None)
    far = lambda e: np.mean(np.abs(e) > 4)  # noqa: E731
    assert far(light) < 1e-3
    assert 0.02 < far(heavy) < 0.05  # 2 (1 - F(4)) of 2.5 degrees of freedom is 0.035
