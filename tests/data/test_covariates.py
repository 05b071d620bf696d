"""Parameters that a column of the measurements knows, such as the mass of a ball."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from simpel_cli.data import Measurements, read
from simpel_cli.discovery.search.trials import Search
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import DataError
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simulators.model import Declared, Model, ModelError
from simulators.worlds.groups import Covariate
from simulators.worlds.simulate import Simulate

RANGE = [0.2, 3.0]


def slider(**mass) -> Model:
    """A mass that a force drives against friction of its own."""
    return Declared(
        "slider", dt=0.05, substeps=4, states={"v": {"unit": "m/s", "range": [-4, 4]}},
        inputs={"f": {"unit": "N", "range": [-3, 3], "between_rows": "held"}},
        parameters={"m": {"unit": "kg", **mass}, "c": {"unit": "N s/m", "range": [0.1, 2]}, "rate": "c/m"},
        dynamics={"v": "f/m - rate*v"},
    ).model()  # fmt: skip


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    made = Simulate(
        episodes=8, steps=60, seed=3, noise_std={"v": 0.01}, truth={"c": 0.7}, initial={"v": [-1, 1]},
        covariates={"mass_kg": Covariate("m", RANGE)},
    ).run(slider(range=RANGE))  # fmt: skip
    path = tmp_path_factory.mktemp("rig") / "runs.parquet"
    pd.DataFrame(made.columns).to_parquet(path)
    return path


def recorded(file, model: Model, **keys):
    given = {"path": str(file), "time": "t", "episode": "episode", "split": {"column": "split"}} | keys
    return read(Measurements(**given), model, file.parent, 0)


def friction(file, model: Model) -> tuple[float, float]:
    plan = setup(model, recorded(file, model), (), [], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=6))
    base = search.base().optimum
    i = [q.name for q in model.params].index("c")
    where = base.free.index(i)
    high, low = plan.coordinates.high[i], plan.coordinates.low[i]
    return plan.coordinates.value(i, float(base.z[i])), float(np.sqrt(base.covariance[where, where]) * (high - low))


def test_a_column_knows_the_parameter(file) -> None:
    model = slider(range=RANGE, column="mass_kg")
    assert [q.name for q in model.params] == ["c"]
    assert [q.name for q in model.inputs] == ["f", "m"]
    value, sd = friction(file, model)
    assert abs(value - 0.7) < 3 * sd + 1e-3
    assert sd < 0.02


def test_without_the_column_one_mass_is_taken_for_all(file) -> None:
    _, known = friction(file, slider(range=RANGE, column="mass_kg"))
    _, unknown = friction(file, slider(range=RANGE))
    assert unknown > 3 * known


def test_a_transition_takes_the_mass_of_its_row(file) -> None:
    model = slider(range=RANGE, column="mass_kg")
    episode = recorded(file, model).train[0]
    assert np.ptp(episode.inputs[:, 1]) == 0
    step = transition(model, encoding_of(model)).step
    phi = jnp.asarray([0.7])
    heavy, light = (float(step(jnp.asarray([1.0, 2.0, m]), phi)[0]) for m in (3.0, 0.3))
    assert np.isclose(heavy, (2.0 / 3.0 - 0.7 / 3.0) * 0.05, rtol=0.02)
    assert light > 5 * heavy


def test_what_is_wrong_is_said(file) -> None:
    with pytest.raises(DataError, match="column 'payload' is missing") as error:
        recorded(file, slider(range=RANGE, column="payload"))
    assert "sim.parameters.m.column names it" in str(error.value)
    with pytest.raises(ModelError, match=r"sim.parameters.m.prior: unknown key; allowed: unit, range, column"):
        slider(range=RANGE, column="mass_kg", prior="normal")
    with pytest.raises(ModelError, match=r"sim.parameters.m.column: 3 is not the name of a column"):
        slider(range=RANGE, column=3)
    with pytest.raises(ModelError, match=r"sim.parameters.m: no range"):
        slider(column="mass_kg")
    with pytest.raises(ModelError, match=r"simulation.covariates=\{mass_kg"):
        Simulate(episodes=1, steps=3).run(slider(range=RANGE, column="mass_kg"))
