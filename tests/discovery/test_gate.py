"""What is held out to judge an effect, and when errors ahead grow so surely that it is refused."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_aliases import searched
from test_ranges import cart
from test_ranges import searched as measured_search

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.gate.held_out import (
    AHEAD,
    LEAST_BLOCKS,
    LEAST_OF_BLOCK,
    MOST_FOLDS,
    RUNAWAY,
    _blocks,
    _judged,
    _refitted,
    _tempered,
    gates,
    growing,
)
from simpel_cli.discovery.search.trials import Trial
from simpel_cli.filtering.errors_ahead import Assessment, Assessor
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.measurements.windows import Windows
from simulators.effects import Expression

FREE = AHEAD["free"]


@pytest.mark.parametrize(
    ("factors", "grows"),
    [
        ((1.5, 1.5), ("a in free run", "b in free run")), ((0.7, 0.7), ()), ((1.5, 0.7), ("a in free run",)),
        ((1.0, 1.0), ()), ((1.0, 1.01), ()),
    ],
)  # fmt: skip
def test_an_error_that_grows_in_one_channel_is_harm(factors: tuple[float, float], grows: tuple[str, ...]) -> None:
    random = np.random.default_rng(0)
    before = random.normal(size=(8, 50, 2))
    after = before * np.array(factors) + 1e-3 * random.normal(size=before.shape)
    before[:, :5] = after[:, :5] = np.nan  # rows that have no horizon behind them
    errors = ({"one row ahead": before, "in free run": e} for e in (before, after))
    assert growing(*errors, ("a", "b"), np.arange(8)) == grows


def test_an_error_that_is_more_likely_than_not_to_grow_leans() -> None:
    """Of four parts one loses much and three gain a little: no growth is certain, but the sum of squares is larger."""
    before = np.random.default_rng(0).normal(size=(4, 50, 1))
    after = before * np.array([1.8, 0.95, 0.95, 0.95])[:, None, None]
    assert growing({FREE: before}, {FREE: after}, ("a",), np.arange(4)) == ()
    assert growing({FREE: before}, {FREE: after}, ("a",), np.arange(4), sure=0.5) == ("a in free run",)
    judged = _judged(np.array([50.0, 5.0, 5.0, 5.0]), {FREE: before}, {FREE: after}, ["a"], np.arange(4), "episode")
    assert judged.leans == ("a in free run",)
    assert not judged.harm


@pytest.mark.parametrize(("factor", "grows"), [(1.05, ()), (1.2, ("a one row ahead",))])
def test_one_row_ahead_a_little_may_be_lost(factor: float, grows: tuple[str, ...]) -> None:
    before = np.random.default_rng(0).normal(size=(8, 50, 1))
    assert growing({AHEAD["one_step"]: before}, {AHEAD["one_step"]: factor * before}, ("a",), np.arange(8)) == grows


def test_a_model_that_runs_away_has_no_small_error() -> None:
    before = np.random.default_rng(0).normal(size=(8, 50, 1))
    after = 0.9 * before
    after[:, 10:] = np.nan
    assert growing({FREE: before}, {FREE: after}, ("a",), np.arange(8)) == ("a in free run",)
    assert growing({FREE: after}, {FREE: before}, ("a",), np.arange(8)) == ()


def test_noise_is_no_harm() -> None:
    """Twenty effects that change nothing, three horizons, four channels, eight episodes."""
    random = np.random.default_rng(0)
    said = 0
    for _ in range(20):
        draw = [{words: random.normal(size=(8, 50, 4)) for words in AHEAD.values()} for _ in range(2)]
        said += bool(growing(*draw, "abcd", np.arange(8)))
    assert said <= 2


@pytest.mark.parametrize(
    ("total", "falls_ahead", "other", "passes"),
    [(60.0, 0.7, 1.0, True), (-60.0, 0.7, 1.0, False), (60.0, 1.0, 1.0, False), (60.0, 0.7, 1.3, False)],
)
def test_an_error_ahead_that_certainly_falls_passes_what_gains_in_few_parts(
    total: float, falls_ahead: float, other: float, passes: bool
) -> None:
    """Of ten parts two gain much, which resampling cannot be sure of."""
    random = np.random.default_rng(0)
    gains = np.array([total, total, *np.full(8, -total / 10)])
    before = {words: random.normal(size=(10, 50, 2)) for words in AHEAD.values()}
    after = dict(before) | {AHEAD["ahead"]: before[AHEAD["ahead"]] * np.array([falls_ahead, other])}
    judged = _judged(gains, before, after, ("a", "b"), np.arange(10), "block")
    assert judged.low < 0
    assert judged.passed == passes
    assert judged.falls == (("a some rows ahead",) if falls_ahead < 1 else ())


def test_of_few_parts_an_error_that_falls_passes_nothing() -> None:
    random = np.random.default_rng(0)
    gains = np.array([60.0, 60.0, *np.full(8, -6.0)])
    before = {words: random.normal(size=(10, 50, 1)) for words in AHEAD.values()}
    after = dict(before) | {FREE: 0.3 * before[FREE]}
    parts = np.arange(10)
    assert _judged(gains, before, after, ("a",), parts, "block", parts).passed
    assert not _judged(gains, before, after, ("a",), parts, "block", np.zeros(10)).passed
    assert not _judged(gains - gains.mean() + 0.01, before, after, ("a",), parts, "block", parts).passed


def test_one_row_ahead_a_smaller_error_passes_nothing() -> None:
    random = np.random.default_rng(0)
    before = {words: random.normal(size=(10, 50, 1)) for words in AHEAD.values()}
    after = dict(before) | {AHEAD["one_step"]: 0.5 * before[AHEAD["one_step"]]}
    gains = np.array([60.0, 60.0, *np.full(8, -6.0)])
    assert not _judged(gains, before, after, ("a",), np.arange(10), "block").passed


def test_a_channel_without_errors_says_nothing() -> None:
    before = np.random.default_rng(0).normal(size=(8, 50, 2))
    before[..., 1] = np.nan
    nothing = np.full_like(before, np.nan)
    assert growing({FREE: before}, {FREE: 2 * before}, "ab", np.arange(8)) == ("a in free run",)
    assert not growing({FREE: nothing}, {FREE: nothing}, "ab", np.arange(8))


def windows_of(episode: Sequence[int], first: int) -> Windows:
    """Windows numbered from `first` on."""
    count = len(episode)
    y = np.zeros((count, 9, 1))
    begin = np.arange(first, first + count)
    return Windows(
        y, y + 1, y, np.zeros((count, 1)), np.ones((count, 1)), np.array(episode), begin, np.zeros((*y.shape[:2], 0))
    )


class Fits:
    """Fits that remember what they were not fitted to: z is [model, first rows of the windows held out; -1: left out]."""

    def __init__(self, noise: tuple[int, ...], windows: Windows) -> None:
        self.noise, self.at = noise, windows

    def on(self, windows: Windows) -> "Fits":
        return Fits(self.noise, windows)

    def of_noise(self) -> "Fits":
        return self

    def __call__(self, hypotheses: Sequence[Hypothesis], most: int = 0, hopes: Any = None) -> list[Optimum]:
        return [optimum(self.fitted(hypothesis)) for hypothesis in hypotheses]

    def fitted(self, hypothesis: Hypothesis) -> np.ndarray:
        if hypothesis.free == self.noise:
            return hypothesis.z  # parameters stay
        return np.concatenate([hypothesis.z[:1], self.at.begin[hypothesis.weight == 0]])


class Likelihoods(Assessor):
    """Likelihoods that are absurd where a window had a part in the parameters."""

    def __init__(self, lost: int = -1) -> None:
        self.seen, self.lost = list[int](), lost  # a model that runs away in the window that begins in row 3

    def __call__(self, z: np.ndarray, windows: Windows) -> Any:
        model, held_out = z[0], z[1:]
        fair = np.isin(windows.begin, held_out) | ((held_out == -1).any() & (windows.begin >= 100))
        self.seen += windows.begin[fair].tolist() if model == 0 else []
        gain = np.where(fair, 1.0 + 0.01 * windows.begin, 1e6) * (model == 0)
        errors = np.full(windows.y.shape, 1.0 + model)
        innovation = np.where((model == self.lost) & (windows.begin == 3), np.nan, 0.0)[:, None, None] + 0 * errors
        track: Any = SimpleNamespace(innovation=innovation)
        return Assessment(errors, errors, errors, errors, gain, errors, track)


def optimum(z: np.ndarray) -> Optimum:
    nothing, eye = np.zeros(1), np.eye(1)
    return Optimum(z, (0,), 0.0, 0.0, nothing, eye, nothing, eye, 1, True)


@pytest.mark.parametrize(
    ("episode", "unit", "held_out"),
    [([0, 0, 0, 1, 1, 1], "window", [*range(6), *range(100, 108)]), ([0, 0, 1, 1, 2, 2], "episode", [*range(6)])],
)
def test_an_effect_is_judged_on_every_window_that_had_no_part_in_its_parameters(
    episode: list[int], unit: str, held_out: list[int]
) -> None:
    search: Any = searched("b")
    windows, spare = windows_of(episode, 0), windows_of([0] * 5 + [1] * 3, 100)
    search.plan = search.plan._replace(windows=windows, spare=spare)
    search.fitter, assessor = Fits(search.noise, windows), Likelihoods()
    loud = list[np.ndarray]()
    search.loud = lambda z: (loud.append(z), z)[1]
    trials = [Trial((), optimum(np.array([k, -1.0]))) for k in range(3)]
    first, second = gates(search, assessor, trials[0], trials[1:])
    folds = min(MOST_FOLDS, 3 if unit == "episode" else len(episode))
    assert len(loud) == folds * len(trials)  # each model is fitted from two beginnings, without each fold
    assert sorted(set(assessor.seen)) == held_out
    assert first[:4] == second[:4]
    assert first.unit == unit
    assert first.gain == pytest.approx(sum(1 + 0.01 * i for i in held_out))
    assert 0 < first.low < first.gain < first.high
    assert first.passed
    (worse,) = gates(search, assessor, trials[1], trials[:1])
    assert worse.gain == pytest.approx(-first.gain)
    assert worse.harm
    assert not worse.passed
    (lost,) = gates(
        search, Likelihoods(lost=0), trials[0], trials[1:2]
    )  # it would else count as a window without an error
    assert lost.gain == pytest.approx(first.gain - 1.03 - RUNAWAY)
    assert not lost.passed


def test_a_single_window_cannot_be_held_out() -> None:
    search: Any = searched("b")
    windows = windows_of([0], 0)
    search.plan = search.plan._replace(windows=windows, spare=None)
    search.fitter, search.loud = Fits(search.noise, windows), lambda z: z
    trials = [Trial((), optimum(np.array([k, -1.0]))) for k in range(2)]
    (judged,) = gates(search, Likelihoods(), trials[0], trials[1:])
    assert not judged.passed


def test_without_some_rows_the_better_of_two_optima_counts() -> None:
    """The first model is in a poor optimum where it stands, the second with loud noise; the third begins in one place."""
    worth, asked = {0.1: 1.0, 0.2: 9.0, 0.5: 5.0, 0.7: 3.0}, list[float]()

    def fitter(hypotheses: Sequence[Hypothesis]) -> list[Optimum]:
        asked.extend(float(h.z[0]) for h in hypotheses)
        return [optimum(h.z)._replace(log_evidence=worth[float(h.z[0])]) for h in hypotheses]

    begun = [Hypothesis(np.array([z]), (0,), np.ones(1)) for z in (0.1, 0.2, 0.7)]
    found = _refitted(lambda z: np.maximum(z, 0.5), fitter, begun)
    assert [o.log_evidence for o in found] == [5.0, 9.0, 3.0]
    assert asked == [0.1, 0.2, 0.7, 0.5, 0.5]


def test_blocks_of_a_short_record_cover_it_once() -> None:
    windows = windows_of([0] * 3, 0)
    ok = np.ones((3, 40, 1))
    ok[2, 30:] = 0.0  # the last window is shorter
    blocks = _blocks(windows._replace(ok=ok))
    np.testing.assert_array_equal(np.sum(blocks, axis=0), ok[..., 0])
    assert min(b.sum() for b in blocks) >= LEAST_OF_BLOCK
    assert all(len(set(np.argwhere(b)[:, 0])) == 1 for b in blocks)
    many = _blocks(windows._replace(ok=np.ones((3, 200, 1))))
    assert LEAST_BLOCKS <= len(many) <= LEAST_BLOCKS + 3


def test_one_odd_block_decides_nothing_of_the_likelihood() -> None:
    random = np.random.default_rng(0)
    gains = random.uniform(2, 6, 20)
    errors = {"in free run": random.normal(size=(20, 9, 1))}
    odd = gains.copy()
    odd[0] = -300.0
    judged = [_judged(_tempered(g), errors, errors, ("y",), np.arange(20), "block") for g in (gains, odd, -odd)]
    assert [j.passed for j in judged] == [True, True, False]
    seldom = np.where(np.arange(20) < 4, 100.0, -0.05)  # an end stop that is reached in four blocks
    assert _judged(_tempered(seldom), errors, errors, ("y",), np.arange(20), "block").gain == pytest.approx(
        seldom.sum()
    )
    assert not _judged(_tempered(-seldom), errors, errors, ("y",), np.arange(20), "block").passed
    half = {"in free run": np.where(np.arange(20) < 10, 1.0, 3.0)[:, None, None] * errors["in free run"]}
    told = _judged(_tempered(gains), errors, half, ("y",), np.arange(20), "block", np.arange(20) // 10)
    assert told.grows == ()  # two windows: what grows in one of them is not certain
    grown = {"in free run": 2 * errors["in free run"]}
    assert _judged(_tempered(gains), errors, grown, ("y",), np.arange(20), "block").grows == ("y in free run",)


def test_a_short_record_is_judged_on_blocks_that_lie_between_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A load of 0.5 m/s^2 that acts in the last quarter alone: no fit without that quarter knows of it."""
    load = Expression("load", acts_on="v", term="c*(u > 2)", parameters={"c": {"range": [-2, 2], "unit": "1/T^2"}})
    random = np.random.default_rng(1)
    x, u = np.zeros((160, 2)), np.zeros((160, 1))
    u[120:] = 3.0
    u[:120, 0] = np.repeat(random.uniform(-2, 2, 24), 5)
    for i in range(159):
        a = u[i, 0] + 0.5 * (u[i, 0] > 2)
        x[i + 1] = x[i, 0] + 0.1 * x[i, 1] + 0.005 * a, x[i, 1] + 0.1 * a
    x += 1e-3 * random.normal(size=x.shape)
    episode = Episode("0", np.arange(160) * 0.1, x, u, np.zeros((160, 0)))
    recording = Recording((episode,), (episode,), (), {"s": 1e-3, "v": 1e-3}, (), (), ())
    search = measured_search(recording, [load], cart(0.5, 1.5))
    base = search.base()
    trial = next(t for t in search.add(base, [0]).trials)
    begun, loud = list[np.ndarray](), search.loud
    monkeypatch.setattr(search, "loud", lambda z: (begun.append(z), loud(z))[1])
    (judged,) = gates(search, Assessor(search.plan, 5), trial, [base])
    assert len(begun) == 2 * MOST_FOLDS  # both models, without each fold, from two beginnings
    assert judged.unit == "block"
    assert judged.passed
    (other,) = gates(search, Assessor(search.plan, 5), base, [trial])
    assert not other.passed
    assert other.harm
