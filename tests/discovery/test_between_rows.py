"""What inputs do between rows, asked of planted data where neither simulator nor data say."""

import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.between_rows import in_words, preferences, settled, words_of
from simpel_cli.discovery.search.trials import Search
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import questions, setup
from simulators.model import Declared, Model
from simulators.worlds.simulate import Simulate

NOISE = 0.003


def rotor(**between_rows: str) -> Model:
    words = {name: {"between_rows": word} for name, word in between_rows.items()}
    return Declared(
        "rotor", dt=0.1, substeps=4, states={"w": {"unit": "rad/s", "range": [-3, 3]}},
        inputs={name: {"unit": "V", "range": [-2, 2], **words.get(name, {})} for name in ("u", "v")},
        parameters={"a": {"unit": "1/s", "range": [0.5, 4]}, "b": {"unit": "rad/s^2/V", "range": [0.5, 4]}},
        dynamics={"w": "b*u + 0.8*b*v - a*w"},
    ).model()  # fmt: skip


def recording(seed: int, **truth: str) -> Recording:
    made = Simulate(
        episodes=4, steps=80, seed=seed, noise_std={"w": NOISE}, truth={"a": 2.0, "b": 1.5}, between_rows=truth,
        initial={"w": [-1, 1]}, test_fraction=0.0,
    ).run(rotor()).columns  # fmt: skip
    episodes = []
    for k in range(4):
        own = made["episode"] == k
        rows = {name: made[name][own] for name in ("t", "w", "u", "v")}
        inputs = np.stack([rows["u"], rows["v"]], axis=1)
        episodes.append(Episode(str(k), rows["t"], rows["w"][:, None], inputs, np.empty((own.sum(), 0))))
    return Recording(tuple(episodes[:3]), tuple(episodes[3:]), (), {"w": NOISE}, (), (), ())


def asked(model: Model, data: Recording):
    plan = setup(model, data, (), [], 2, extra=questions(model))
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=6)
    search = Search(plan, fitter)
    base = search.base()
    found = preferences(search, base)
    return found, Search(plan._replace(start=settled(search, words_of(found))), fitter)


@pytest.mark.parametrize("truth", [{"u": "linear", "v": "linear"}, {"u": "linear"}, {"v": "linear"}, {}])
def test_every_input_is_what_it_was_planted_as(truth: dict[str, str]) -> None:
    found, _ = asked(rotor(), recording(0, **truth))
    assert {name: p.word for name, p in found.items()} == {"u": "held", "v": "held"} | truth
    assert all(p.gain > 10 for p in found.values())
    assert "by" in in_words(found)


def test_parameters_follow_the_inputs() -> None:
    """With linear inputs taken for held ones the rate constant is off by a tenth and more."""
    data = recording(1, u="linear", v="linear")
    _, search = asked(rotor(), data)
    at = search.base()
    values = [search.plan.coordinates.value(i, float(at.optimum.z[i])) for i in range(2)]
    assert np.allclose(values, [2.0, 1.5], rtol=0.02)
    held, _ = asked(rotor(u="held", v="held"), data)
    assert held == {}


def test_what_is_declared_is_not_asked() -> None:
    found, _ = asked(rotor(u="linear", v="held"), recording(2, u="linear"))
    assert found == {}
    found, _ = asked(rotor(u="linear"), recording(2, u="linear"))
    assert list(found) == ["v"]
    assert found["v"].word == "held"
