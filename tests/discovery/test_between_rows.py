"""What inputs do between rows, asked of planted data where neither simulator nor data say."""

from functools import partial

import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.between_rows import _better, asked_beside, in_words, preferences, settled, words_of
from simpel_cli.discovery.search.calibration import prepared
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.trials import Search
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import Setup, questions, setup, terms_of
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression
from simulators.model import Declared, Model
from simulators.worlds.simulate import Simulate

NOISE = 0.003
DRAG = Expression(
    "drag", acts_on="w", term="-k*w**3", parameters={"k": {"range": [0, 2], "unit": "1", "starts": [0.2]}}
)
OPTIONS = Discovery(substeps=2, lanes=2)


def rotor(more: str = "", **between_rows: str) -> Model:
    words = {name: {"between_rows": word} for name, word in between_rows.items()}
    return Declared(
        "rotor", dt=0.1, substeps=4, states={"w": {"unit": "rad/s", "range": [-3, 3]}},
        inputs={name: {"unit": "V", "range": [-2, 2], **words.get(name, {})} for name in ("u", "v")},
        parameters={"a": {"unit": "1/s", "range": [0.5, 4]}, "b": {"unit": "rad/s^2/V", "range": [0.5, 4]}},
        dynamics={"w": f"b*u + 0.8*b*v - a*w{more}"},
    ).model()  # fmt: skip


def recording(seed: int, more: str = "", **truth: str) -> Recording:
    made = Simulate(
        episodes=4, steps=80, seed=seed, noise_std={"w": NOISE}, truth={"a": 2.0, "b": 1.5}, between_rows=truth,
        initial={"w": [-1, 1]}, test_fraction=0.0,
    ).run(rotor(more)).columns  # fmt: skip
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


@pytest.mark.parametrize(
    "truth",
    [
        {"u": "linear", "v": "linear"},
        {"u": "linear"},
        {"v": "linear"},
        {},
        {"u": "smooth"},
        {"u": "linear", "v": "smooth"},
    ],
)
def test_every_input_is_what_it_was_planted_as(truth: dict[str, str]) -> None:
    found, _ = asked(rotor(), recording(0, **truth))
    assert {name: p.word for name, p in found.items()} == {"u": "held", "v": "held"} | truth
    assert all(p.gain > 10 for p in found.values())
    assert "by" in in_words(found)


def test_a_curve_is_not_offered_where_rows_follow_a_clock() -> None:
    """It goes by whole rows; with the same input at an even clock it is found."""
    data, random = recording(0, u="smooth"), np.random.default_rng(1)
    late = tuple(e._replace(time=e.time + random.uniform(-0.02, 0.02, len(e.time))) for e in data.train)
    found, search = asked(rotor(), data._replace(train=late))
    assert search.plan.clocked
    assert {name: p.word for name, p in found.items()} == {"u": "linear", "v": "held"}


@pytest.mark.parametrize(
    ("line", "curve", "word"),
    [(400.0, 403.0, "linear"), (400.0, 430.0, "smooth"), (1.0, 30.0, "smooth"), (1.0, 2.0, "held")],
)
def test_a_straight_line_is_taken_where_a_curve_is_hardly_better(line: float, curve: float, word: str) -> None:
    evidence = {("held",): 0.0, ("linear",): line, ("smooth",): curve}
    assert _better({0: "held"}, [{0: w} for (w,) in evidence], evidence) == {0: word}


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


def attached(model: Model, data: Recording, **terms) -> Setup:
    return setup(model, data, (), [DRAG], OPTIONS.substeps, **terms)


def search_of(plan: Setup) -> Search:
    return Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=8))


def test_the_whole_program_takes_the_answer_as_said_and_begins_where_the_small_one_ended() -> None:
    data, model = recording(3, u="linear"), rotor()
    plan, kept, found = prepared(
        partial(attached, data=data), model, terms_of(model, data, [DRAG]), OPTIONS, Terminal(quiet=True)
    )
    assert kept is None
    assert words_of(found) == {"u": "linear", "v": "held"} == plan.augmented.model.between_rows
    assert {t.effect for t in plan.augmented.terms} == {"drag", "unnamed"}  # nothing is asked in it
    everywhere = search_of(plan._replace(optimum=None)).base().optimum
    assert search_of(plan).base().optimum.log_evidence == pytest.approx(everywhere.log_evidence, abs=0.05)
    assert plan.optimum is not None
    np.testing.assert_allclose(plan.optimum[:2], everywhere.z[:2], atol=1e-3)


@pytest.mark.parametrize("truth", ["linear", "smooth"])
def test_beside_an_effect_the_question_is_asked_anew(truth: str) -> None:
    """A drag that the simulator lacks hides what the input does; taken for held, the model chosen beside it is asked."""
    data, model = recording(4, " - 0.6*w**3", u=truth, v="held"), rotor()
    held = attached(rotor(u="held", v="held"), data)
    search = search_of(held)
    base = search.base()
    (drag,) = (i for i, t in enumerate(search.terms) if t.effect == "drag")
    chosen = search.add(base, [drag]).trials[0]
    alone, _ = asked(model, data)
    beside = asked_beside(partial(attached, data=data), model, search, chosen, 2)
    assert words_of(beside) == {"u": truth, "v": "held"}
    print({n: p.gain for n, p in alone.items()}, {n: p.gain for n, p in beside.items()})
    assert beside["u"].gain > 50
    assert beside["u"].gain > abs(alone["u"].gain)


def test_a_delay_that_makes_up_for_the_wrong_way_is_not_in_its_favour() -> None:
    """An input that is held, taken for one that goes straight, is half a row late: held it is not, and needs no delay."""
    data = recording(5)
    late = Expression(
        "late", acts_on="u", operator="delay", parameters={"d": {"range": [0, 0.3], "unit": "s", "starts": [0.03]}}
    )
    attach = partial(setup, recording=data, declared_noise=(), effects=[late], substeps=OPTIONS.substeps)
    search = search_of(attach(rotor(u="linear", v="held")))
    (place,) = (i for i, t in enumerate(search.terms) if t.effect == "late" and t.acts_on == "u")
    chosen = search.add(search.base(), [place]).trials[0]
    (row,) = search.rows[place]
    assert search.plan.coordinates.value(row, float(chosen.optimum.z[row])) == pytest.approx(0.05, abs=0.01)
    beside = asked_beside(attach, rotor(u="linear", v="held"), search, chosen, 2)
    assert beside == {}  # it is said
    beside = asked_beside(attach, rotor(v="held"), search, chosen, 2)
    assert beside["u"].word == "held"
    assert (
        beside["u"].gain > 300
    )  # 293 where a delay of nothing costs the held one its range, and what an effect has to earn
