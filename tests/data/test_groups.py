"""Parameters that differ from group to group, on planted groups."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from simpel_cli.data import Measurements, Recording, read, transitions
from simpel_cli.discovery.search.by_group.spreads import other_slots, slots_of
from simpel_cli.discovery.search.trials import Search
from simpel_cli.dynamics.domain import Domain
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import DataError
from simpel_cli.evaluation import test_arrays as arrays_of
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simpel_cli.inference.assemble import assemble
from simpel_cli.inference.protocols import Training
from simpel_cli.inference.system import normaliser_of, system_of
from simpel_cli.methods.sysid import SysID, identified
from simpel_cli.priors.function_prior import SimulatorPrior
from simpel_cli.scores.gaussian import Gaussian
from simulators.effects import Expression
from simulators.groups import UNSEEN, grouped, spreads_of
from simulators.model import Declared, Model, ModelError
from simulators.worlds.groups import Group, Spread
from simulators.worlds.simulate import Simulate

GROUPS, SPREAD = 6, 0.35


def slider(**keys) -> Model:
    return Declared(
        "slider", dt=0.05, substeps=4, states={"v": {"unit": "m/s", "range": [-4, 4]}},
        inputs={"f": {"unit": "N", "range": [-3, 3], "between_rows": "held"}},
        parameters={"c": {"unit": "1/s", "range": [0.3, 4], **keys}, "b": {"unit": "1/kg", "range": [0.5, 2]}},
        dynamics={"v": "b*f - c*v"},
    ).model()  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    found = Simulate(
        episodes=4 * GROUPS, steps=40, seed=2, noise_std={"v": 0.01}, truth={"c": 1.2, "b": 1.0}, initial={"v": [-2, 2]},
        groups={"ball": Group(GROUPS, {"c": Spread(SPREAD, "lognormal")})},
    ).run(slider())  # fmt: skip
    path = tmp_path_factory.mktemp("rig") / "runs.parquet"
    pd.DataFrame(found.columns).to_parquet(path)
    return path, found.card["truth_by_group"]["ball"]


def recorded(path, model: Model, **keys) -> Recording:
    given = {"path": str(path), "time": "t", "episode": "episode", "split": {"column": "split"}} | keys
    return read(Measurements(**given), model, path.parent, 0)


def fitted(model: Model, data: Recording) -> tuple[dict[str, float], dict[str, float], float]:
    """Values, standard deviations, and process noise of the calibrated simulator."""
    plan = setup(model, data, (), [], 2)
    width = len(model.params) + plan.coordinates.sizes[1] + plan.coordinates.sizes[2]
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=width))
    base = search.base().optimum
    values = {q.name: plan.coordinates.value(i, float(base.z[i])) for i, q in enumerate(model.params)}
    span = plan.coordinates.high - plan.coordinates.low
    sds = {
        q.name: float(np.sqrt(base.covariance[base.free.index(i), base.free.index(i)]) * span[i])
        for i, q in enumerate(model.params)
        if i in base.free
    }
    return values, sds, _last(plan, base.z)


def _last(plan, z: np.ndarray) -> float:
    i = sum(plan.coordinates.sizes) - 1
    return plan.coordinates.value(i, float(z[i]))


def test_every_group_has_its_own_value_about_a_common_one(made) -> None:
    path, truth = made
    model = slider(per="ball")
    data = recorded(path, model)
    assert len(data.groups["ball"]) == GROUPS
    whole = grouped(model, data.groups)
    values, sds, noise = fitted(whole, data)
    for name in data.groups["ball"]:
        own = values["c"] * np.exp(values["c_spread"] * values[f"c_of_{name}"])
        assert abs(own / truth[name]["c"] - 1) < 0.05
    logs = np.log([truth[name]["c"] for name in data.groups["ball"]])
    assert 0.5 * logs.std() < values["c_spread"] < 2 * logs.std()
    assert f"c_of_{UNSEEN}" not in sds  # nothing is known of it but the population: no fit moves it
    _, _, alike = fitted(slider(), recorded(path, slider()))
    assert noise < 0.3 * alike  # one value for all of them leaves much to noise


def test_a_group_that_was_never_seen_is_another(made) -> None:
    path, _ = made
    model = slider(per="ball")
    known = {"ball": recorded(path, model).groups["ball"][:3]}
    data = recorded(path, grouped(model, known))
    rows = np.concatenate([e.inputs for e in (*data.train, *data.test)])
    assert rows.shape[1] == 1 + 3 + 1
    assert np.all(rows[:, 1:].sum(axis=1) == 1)
    assert 0.4 < rows[:, -1].mean() < 0.6


def test_a_transition_is_that_of_the_group() -> None:
    whole = grouped(slider(per="ball"), {"ball": ("a ball", "b")})
    assert [q.name for q in whole.inputs] == ["f", "ball_is_a_ball", "ball_is_b", "ball_is_another"]
    assert [q.name for q in whole.params] == ["c", "b", "c_spread", "c_of_a_ball", "c_of_b", "c_of_another"]
    with jax.enable_x64(True):
        step = transition(whole, encoding_of(whole)).step
        phi = jnp.array([1.0, 1.0, 0.5, 1.0, -1.0, 0.0])
        found = [float(step(jnp.array([2.0, 0.0, *slot]), phi)[0]) for slot in np.eye(3)]
    rates = np.exp([0.5, -0.5, 0.0])
    np.testing.assert_allclose(found, 2 * (np.exp(-rates * 0.05) - 1), rtol=1e-6)


def test_a_group_that_is_known_has_its_own_value_whatever_the_population() -> None:
    known = slider(per="ball", groups={"b": [2.0, 3.0]})
    whole = grouped(known, {"ball": ("a ball", "b")})
    assert [q.name for q in whole.params] == ["c", "b", "c_spread", "c_of_a_ball", "c_of_another", "c_of_b"]
    value = whole.params[-1]
    assert (value.low, value.high, value.unit, value.prior, value.role) == (2.0, 3.0, "1/s", "lognormal", "")
    with jax.enable_x64(True):
        step = transition(whole, encoding_of(whole)).step
        phi = jnp.array([1.0, 1.0, 0.5, 1.0, 0.0, 2.5])
        found = [float(step(jnp.array([2.0, 0.0, *slot]), phi)[0]) for slot in np.eye(3)]
    np.testing.assert_allclose(found, 2 * (np.exp(-np.array([np.exp(0.5), 2.5, 1.0]) * 0.05) - 1), rtol=1e-6)
    assert spreads_of(whole.params) == {2: [3]}
    every = grouped(slider(per="ball", groups={"b": [2.0, 3.0], "a ball": [1.0, 2.0]}), {"ball": ("a ball", "b")})
    assert spreads_of(every.params) == {}  # nothing tells of the spread


def test_what_the_simulator_knows_of_groups_is_known_without_training_rows_of_them(made, tmp_path) -> None:
    path, _ = made
    table = pd.read_parquet(path)
    first, *others, last = recorded(path, slider(per="ball")).groups["ball"]
    table.loc[table["ball"] == last, "split"] = "test"
    file = tmp_path / "runs.parquet"
    table.to_parquet(file)
    known = {"elsewhere": [1.0, 2.0], first: [1.0, 2.0], last: [1.0, 2.0]}
    assert recorded(file, slider(per="ball", groups=known)).groups["ball"] == (first, *others, last)
    assert recorded(file, slider(per="ball")).groups["ball"] == (first, *others)


def test_a_search_knows_some_groups_and_learns_the_others(made) -> None:
    path, truth = made
    (first, own), *others = truth.items()
    model = slider(per="ball", groups={first: [0.9 * own["c"], 1.1 * own["c"]]})
    data = recorded(path, model)
    whole = grouped(model, data.groups)
    values, _, _ = fitted(whole, data)
    assert values[f"c_of_{first}"] == pytest.approx(own["c"], rel=0.05)
    for name, each in others:
        assert values["c"] * np.exp(values["c_spread"] * values[f"c_of_{name}"]) == pytest.approx(each["c"], rel=0.05)
    plan = setup(whole, data, (), [], 2)
    inputs = [q.name for q in whole.inputs]
    rows = {q.name: i for i, q in enumerate(whole.params)}
    expected = {rows[f"c_of_{name}"]: inputs.index(f"ball_is_{name}") for name, _ in others}
    assert slots_of(plan, spreads_of(whole.params)) == expected
    assert other_slots(plan) == {rows["c_spread"]: inputs.index("ball_is_another")}


def test_a_group_may_be_called_another() -> None:
    whole = grouped(slider(per="ball"), {"ball": (UNSEEN, "b")})
    assert len({q.name for q in whole.params}) == len(whole.params) == 6
    known = grouped(slider(per="ball", groups={UNSEEN: [1.0, 2.0]}), {"ball": ("a", "b")})
    assert len(known.params) == 6  # which is no group of these data


def test_an_identified_simulator_begins_with_what_is_known_of_groups(made) -> None:
    path, truth = made
    ends = {name: [0.9 * own["c"], 1.1 * own["c"]] for name, own in truth.items()}
    values = values_identified(slider(per="ball", groups=ends), path)
    for name, own in truth.items():
        assert values[f"c_of_{name}"] == pytest.approx(own["c"], rel=0.1)


def test_what_is_wrong_is_said(made, tmp_path) -> None:
    path, _ = made
    with pytest.raises(DataError, match="column 'subject' is missing"):
        recorded(path, slider(per="subject"))
    table = pd.read_parquet(path)
    file = tmp_path / "runs.parquet"
    for change, message in (
        ({"ball": "one"}, "has 1 group in the training rows \\(one\\), which tells nothing of a spread"),
        ({"ball": np.arange(len(table)).astype(str)}, "it names rows, not groups"),
        ({"ball": np.where(np.arange(len(table)) % 40 < 20, "x", "y")}, "changes from 'x' to 'y' within episode 0"),
    ):
        table.assign(**change).to_parquet(file)
        with pytest.raises(DataError, match=message):
            recorded(file, slider(per="ball"))
    with pytest.raises(ModelError, match=r"sim.parameters.c.per: 3 is not the name of a column"):
        slider(per=3)
    with pytest.raises(
        ModelError, match=r"sim.parameters.c.groups: only of a parameter that differs .* add `per: COLUMN`"
    ):
        slider(groups={"a": [1, 2]})
    with pytest.raises(ModelError, match=r"sim.parameters.c.groups.a: low = 2 is not below high = 1; swap them"):
        slider(per="ball", groups={"a": [2, 1]})
    with pytest.raises(ModelError, match=r"sim.parameters.c.groups: 3 is not a mapping"):
        slider(per="ball", groups=3)


def test_what_is_wrong_with_groups_of_an_effect_names_its_key(made, tmp_path) -> None:
    table = pd.read_parquet(made[0])
    file = tmp_path / "runs.parquet"
    asks = replace(slider(), asked={"ball": "effect.drag.per"})
    for change, message in (
        ({"ball": "one"}, "effect.drag.per: column 'ball' has 1 group"),
        ({"ball": np.arange(len(table)).astype(str)}, "effect.drag.per: .* it names rows, not groups"),
    ):
        table.assign(**change).to_parquet(file)
        with pytest.raises(DataError, match=message):
            recorded(file, asks)
    assert DataError.exit_code == 3
    for operator in ("delay", "lag"):
        with pytest.raises(
            ModelError, match=f"effect.late.per: a {operator} is the same for all groups; leave `per` out"
        ):
            Expression("late", acts_on="input", operator=operator, parameters={"d": {"range": [0, 1]}}, per="ball")


def values_identified(model: Model, path) -> dict[str, float]:
    data = recorded(path, model)
    whole = grouped(model, data.groups)
    with jax.enable_x64(True):
        system = system_of(whole, (), 0)
        x, y = arrays_of(transitions(data.train, 0), system.encoding)
        normaliser = normaliser_of(system, jax.random.key(0))
        method = SysID(starts=4)
        done = assemble(
            system, normaliser, SimulatorPrior(gap=None), Gaussian(), [Training(x, y)], data.noise_std, {},
            noise=method.noise, pool=1,
            keys=[jax.random.key(1)], precision="float64", law="gaussian",
        )  # fmt: skip
        problem = jax.tree.map(lambda a: a[0], done.problems)
        found = np.asarray(identified(method, done.setting, problem, jax.random.key(2), 1).phi)
    return dict(zip([q.name for q in whole.params], found, strict=True))


def test_an_identified_simulator_knows_every_group_and_their_spread(made) -> None:
    path, truth = made
    values = values_identified(slider(per="ball"), path)
    for name in truth:
        own = values["c"] * np.exp(values["c_spread"] * values[f"c_of_{name}"])
        assert abs(own / truth[name]["c"] - 1) < 0.1
    logs = np.log([truth[name]["c"] for name in truth])
    assert values["c_spread"] == pytest.approx(logs.std(ddof=1), rel=0.15)


def test_points_of_the_domain_are_of_one_group_each() -> None:
    whole = grouped(slider(per="ball"), {"ball": ("a", "b")})
    domain = Domain(encoding_of(whole, stack=1))
    points = np.asarray(domain.sample(jax.random.key(0), 300, jnp.float32))
    assert points.shape == (300, 1 + 2 * 4)
    for block in (points[:, 2:5], points[:, 6:9]):
        assert set(np.unique(block)) == {0.0, 1.0}
        assert np.all(block.sum(axis=1) == 1)
    assert np.array_equal(points[:, 2:5], points[:, 6:9])
    mean, std = domain.x_moments()
    np.testing.assert_allclose(mean[2:5], 1 / 3)
    np.testing.assert_allclose(std[6:9], np.sqrt(2) / 3)
