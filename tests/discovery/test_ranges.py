"""Ranges that are too narrow: widened where evidence asks for it, of the simulator and of effects, and said."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search import ranges
from simpel_cli.discovery.search.by_group.own_parameters import written
from simpel_cli.discovery.search.ranges import in_words, narrowed, too_narrow, translated, widened, within
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.trials import Search
from simpel_cli.discovery.search.uses import FREE_RUN, suited
from simpel_cli.discovery.verdict.beyond import beyond, ranges_of, sentence_of
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simpel_cli.filtering.setup import whole_windows as held_out
from simulators.effects import Expression
from simulators.model import Declared, Model

DRAG = Expression(
    "drag", acts_on="v", term="-k*v", parameters={"k": {"range": [0, 0.2], "unit": "1/s", "starts": [0.1]}}
)
WIDTH = Expression(
    "dry", acts_on="v", term="-c*tanh(v/w)",
    parameters={"c": {"range": [0, 2], "unit": "m/s^2"}, "w": {"range": [0.5, 1], "neutral": 0.5, "unit": "m/s"}},
)  # fmt: skip


def cart(low: float = 0.8, high: float = 1.8) -> Model:
    return Declared(
        "cart", dt=0.1,
        states={"s": {"unit": "m", "range": [-30, 30]}, "v": {"unit": "m/s", "range": [-9, 9]}},
        inputs={"u": {"unit": "V", "range": [-3, 3], "between_rows": "held"}},
        parameters={"b": {"unit": "m/s^2/V", "range": [low, high]}},
        dynamics={"s": "v", "v": "b*u"},
    ).model()  # fmt: skip


def measured(b: float, k: float = 0.0) -> Recording:
    """Carts of gain b and drag k, exactly integrated, with 1 mm and 1 mm/s of noise."""
    random = np.random.default_rng(3)
    episodes = []
    for e in range(4):
        u = np.repeat(random.uniform(-3, 3, 8), 5)
        x = np.zeros((40, 2))
        for i in range(39):
            s, v = x[i]
            if k:
                end = b * u[i] / k
                x[i + 1] = s + end * 0.1 + (v - end) * (1 - np.exp(-k * 0.1)) / k, end + (v - end) * np.exp(-k * 0.1)
            else:
                x[i + 1] = s + 0.1 * v + 0.005 * b * u[i], v + 0.1 * b * u[i]
        noisy = x + 1e-3 * random.normal(size=x.shape)
        episodes.append(Episode(str(e), np.arange(40) * 0.1, noisy, u[:, None], np.zeros((40, 0))))
    noise = {"s": 1e-3, "v": 1e-3}
    return Recording(tuple(episodes[:3]), tuple(episodes[3:]), (), noise, (), (Check("c", True, ""),), ())


def searched(recording: Recording, effects: Sequence[Expression] = (DRAG,), model: Model | None = None) -> Search:
    plan = setup(model or cart(), recording, (), effects, 1)
    return Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=13))


@pytest.mark.parametrize(("b", "end"), [(2.4, 1), (0.5, 0)])
def test_a_parameter_outside_its_range_is_found_there(b: float, end: int) -> None:
    search = searched(measured(b))
    base = search.base()
    found = too_narrow(search, base)
    assert found is not None
    low, high = found.ranges["b"]
    assert low < b < high
    assert (low, high)[1 - end] == (0.8, 1.8)[1 - end]  # only the end that the fit stands at moves
    assert low > 0  # never across zero
    assert found.gain > 100
    assert "b at the end of a range" in in_words(found)
    model, effects = widened(cart(), [DRAG], found.ranges)
    wide = searched(measured(b), effects, model)
    chosen = select(wide).chosen
    assert chosen.terms == ()  # nothing has to make up for it
    (out,) = beyond(cart(), wide, chosen, found.gain)
    assert out.low < b < out.high
    assert out.range == (0.8, 1.8)
    assert "Outside the range that sim.parameters gives" in sentence_of([out])
    narrow = narrowed(wide, {"b": (0.8, 1.8)})
    assert narrow is not None
    again = within(wide, narrow, chosen)
    row = [q.name for q in wide.plan.augmented.params].index("b")
    at = narrow.plan.coordinates.value(row, float(again.optimum.z[row]))
    assert at == pytest.approx((0.8, 1.8)[end], abs=0.02)
    assert again.optimum.log_evidence < chosen.optimum.log_evidence - 100


def test_a_range_that_is_far_too_narrow_widens_until_the_fit_is_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    search = searched(measured(7.0))
    base = search.base()
    found = too_narrow(search, base)
    assert found is not None
    low, high = found.ranges["b"]
    assert low == 0.8
    assert 7.0 < high < 10.0  # 3.8 is not enough to be the simpler cause
    monkeypatch.setattr(ranges, "MOST_WIDER", 1)
    assert too_narrow(search, base) is None


@pytest.mark.parametrize(("whole", "steps"), [(False, 1), (True, 2)])
def test_what_is_left_of_a_model_widens_no_further_than_is_asked(
    whole: bool, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rest might make up for what it lacks; the whole model lacks nothing that is known, and goes on where it pays."""
    search = searched(measured(7.0))
    asked = list[int]()
    fitted = ranges._fitted

    def counted(*given: Any) -> Any:
        asked.append(1)
        return fitted(*given)

    monkeypatch.setattr(ranges, "_fitted", counted)
    found = ranges._paying(search, search.base(), 0.0, whole=whole)
    assert found is not None
    assert len(asked) == steps
    assert found.ranges["b"][1] == pytest.approx(3.8 if steps == 1 else 9.8)


def test_a_range_that_holds_the_truth_stays() -> None:
    search = searched(measured(1.2))
    chosen = search.base()
    assert too_narrow(search, chosen) is None
    assert beyond(cart(), search, chosen, 0.0) == []
    assert narrowed(search, {"b": (0.8, 1.8)}) is None
    assert sentence_of([]) == ""


def test_a_fit_is_the_same_in_other_coordinates() -> None:
    wide = searched(measured(1.2), model=cart(0.5, 5.0))
    narrow = narrowed(wide, {"b": (0.8, 1.8)})
    assert narrow is not None
    there = translated(wide, narrow, wide.base())
    back = translated(narrow, wide, there)
    for name in ("z", "centre", "covariance", "fisher", "gradient"):
        np.testing.assert_allclose(
            getattr(back.optimum, name), getattr(wide.base().optimum, name), rtol=1e-9, atol=1e-12
        )
    own = narrow.base().optimum
    i = own.free.index(0)
    assert there.optimum.z[0] == pytest.approx(own.z[0], abs=1e-3)
    assert there.optimum.covariance[i, i] == pytest.approx(own.covariance[i, i], rel=0.05)


def test_before_is_in_the_declared_ranges_for_every_use() -> None:
    """Calibrated for a free run, too, the simulator as it was declared stays within what it declares."""
    recording = measured(2.4)
    wide = searched(recording, model=cart(0.8, 5.0))
    narrow = narrowed(wide, {"b": (0.8, 1.8)})
    assert narrow is not None
    base = within(wide, narrow, wide.base())
    windows = held_out(wide.plan, recording.train, ())
    suited_one = translated(narrow, wide, suited(narrow, Assessor(narrow.plan, 10), base, windows, FREE_RUN))
    assert wide.plan.coordinates.value(0, float(suited_one.optimum.z[0])) <= 1.8 + 1e-9


def test_an_effect_stronger_than_its_range_is_not_cut_there() -> None:
    search = searched(measured(1.2, k=0.5))
    chosen = select(search).chosen
    assert [search.terms[t].effect for t in chosen.terms] == ["drag"]
    found = too_narrow(search, chosen)
    assert found is not None
    ((name, ends),) = found.ranges.items()
    assert ends[0] == 0.0 < 0.5 < ends[1]
    model, effects = widened(cart(), [DRAG], {name: (0.0, 0.7)})
    (term,) = (t for t in searched(measured(1.2, k=0.5), effects, model).terms if t.effect == "drag")
    assert term.parameters[0][3:5] == (0.0, 0.7)
    assert model.params == cart().params


def test_the_simulator_alone_is_no_reason_where_an_effect_explains_more() -> None:
    """With a drag of 0.5 1/s and none in the simulator a gain too small fits better; the drag itself explains far more."""
    wide = Expression(
        "drag", acts_on="v", term="-k*v", parameters={"k": {"range": [0, 2], "unit": "1/s", "starts": [0.3]}}
    )
    search = searched(measured(0.82, k=0.5), [wide])
    base = search.base()
    row = [q.name for q in search.plan.augmented.params].index("b")
    assert base.optimum.z[row] < 0.01  # it stands at the end
    assert too_narrow(search, base) is None


def test_what_an_effect_is_has_no_wider_range() -> None:
    search = searched(measured(1.2, k=0.5), [WIDTH])
    chosen = select(search).chosen
    found = too_narrow(search, chosen)
    assert found is None or not any(name.endswith("_w") for name in found.ranges)


def test_the_corrected_simulator_says_the_wider_range() -> None:
    search = searched(measured(2.4), model=cart(0.8, 5.0))
    (out,) = beyond(cart(), search, search.base(), 9.0)
    sim = {"parameters": {"b": {"unit": "A", "range": [0.8, 1.8]}, "m": 2.0}}
    low, high = written(sim, ranges_of([out]))["parameters"]["b"]["range"]
    assert low == 0.8
    assert 2.39 < high < 2.5
    assert written(sim, ranges_of([])) == sim
    based = written({"base": sim, "parameters": {}}, ranges_of([out]))
    assert based["base"]["parameters"]["b"]["range"] == [low, high]
    assert sim["parameters"]["b"] == {"unit": "A", "range": [0.8, 1.8]}


def test_an_effect_that_only_makes_up_for_a_range_gives_way_to_a_wider_one() -> None:
    boost = Expression(
        "boost", acts_on="v", term="k*rate", parameters={"k": {"range": [0, 1.5], "unit": "1", "starts": [0.3]}}
    )
    search = searched(measured(2.4), [boost])
    base = search.base()
    (with_it,) = [t for t in search.add(base, search.candidates(())).trials if not search.terms[t.terms[-1]].depends_on]
    assert with_it.optimum.log_evidence > base.optimum.log_evidence + 50
    found = too_narrow(search, with_it)
    assert found is not None
    assert list(found.ranges) == ["b"]
    right = searched(measured(1.2, k=0.15))
    assert too_narrow(right, right.add(right.base(), [0]).trials[0]) is None
