"""An effect that gains in a few places is what an outlier is; one that acts gains in many."""

import numpy as np
import pytest
import yaml
from test_ranges import cart

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search import acceptance
from simpel_cli.discovery.search.acceptance import _of_outliers
from simpel_cli.discovery.search.gate.few_places import PLACES, REACH, in_few_places
from simpel_cli.discovery.search.gate.held_out import Gate
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import ACCEPT, Search, Stage
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter, Hypothesis
from simpel_cli.filtering.setup import setup
from simpel_cli.runs.console import Terminal

ENOUGH = 20.0


def gains(places: int, each: float, noise: float = 0.0) -> np.ndarray:
    """Gains by row of an effect that acts in some places, each of two rows, of five windows."""
    found = noise * np.random.default_rng(0).normal(size=(5, 60))
    for k in range(places):
        found[k % 5, 10 * (k // 5) + 3 : 10 * (k // 5) + 5] += each / 2
    return found


@pytest.mark.parametrize(("places", "few"), [(1, True), (2, True), (PLACES, True), (PLACES + 1, True), (8, False)])
def test_places_are_counted(places: int, few: bool) -> None:
    assert in_few_places(gains(places, 30.0 / places), ENOUGH) == few


def test_what_is_left_may_be_enough_by_itself() -> None:
    assert not in_few_places(gains(PLACES + 1, 25.0), ENOUGH)


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_chance_in_every_row_does_not_hide_an_effect_that_acts_everywhere(noise: float) -> None:
    """Rows gain and lose more than the effect adds to each: the best of them are as good as the worst are bad."""
    found = noise * np.random.default_rng(1).normal(size=(5, 60))
    found += (25.0 - found.sum()) / found.size
    assert not in_few_places(found, ENOUGH)


def test_a_place_takes_the_rows_with_it_in_which_the_filter_comes_back() -> None:
    found = np.zeros((2, 40))
    found[1, 20 : 20 + REACH + 1] = 10.0
    assert in_few_places(found, ENOUGH)
    assert in_few_places(found[:, ::-1], ENOUGH)
    found[0, :] = 0.5
    assert not in_few_places(found, 15.0)


NOISE = 0.004


def limited(top: float, *, outlier: bool) -> Recording:
    """Carts whose speed is read up to a level, or too low where it is the largest of all, once."""
    random, episodes = np.random.default_rng(8), []
    for e in range(4):
        u = np.repeat(random.uniform(-3, 3, 12), 5)
        x = np.zeros((60, 2))
        for i in range(59):
            (s, v), a = x[i], 1.2 * u[i]
            x[i + 1] = s + 0.1 * v + 0.005 * a, v + 0.1 * a
        y = x + NOISE * random.normal(size=x.shape)
        y[:, 1] = np.minimum(y[:, 1], top)
        if outlier and e == 0:
            *_, second, largest = np.argsort(y[:, 1])
            y[largest, 1] = y[second, 1] + NOISE
        episodes.append(Episode(str(e), np.arange(60) * 0.1, y, u[:, None], np.zeros((60, 0))))
    every = {"s": NOISE, "v": NOISE}
    return Recording(tuple(episodes[:3]), tuple(episodes[3:]), (), every, (), (Check("c", True, ""),), ())


@pytest.mark.parametrize(("top", "outlier"), [(np.inf, True), (1.0, False)])
def test_the_noise_does_not_hide_that_an_end_of_a_sensor_is_an_outlier(
    top: float, outlier: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without it the noise is larger, so that every row gains a little by it."""
    ends = build(yaml.safe_load((conf_dir() / "effect" / "sensor_saturation.yaml").read_text()), "effect")
    recording = limited(top, outlier=outlier)
    plan = setup(cart(), recording, (), [ends], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=15))
    (place,) = (t for t, term in enumerate(search.terms) if (term.effect, term.acts_on) == ("sensor_saturation", "v"))
    base = search.base()
    start, row = base.optimum.z.copy(), search.rows[place][0]
    start[row] = plan.coordinates.unit(row, max(e.states[:, 1].max() for e in recording.train))
    chosen = search.best((place,), search.fitter([Hypothesis(start, search.free((place,)), search.ones)]))
    assert chosen.optimum.log_evidence > base.optimum.log_evidence + ENOUGH
    assessor = Assessor(plan, 5)
    assert _of_outliers(search, assessor, chosen, base) is outlier
    gain = chosen.optimum.log_evidence - base.optimum.log_evidence
    selection = Selection(base, chosen, (base, chosen), (), (Stage(base, (chosen,)),), (gain,), None)
    for low, passes in ((0.1, not outlier), (ACCEPT, True)):
        gate = Gate(47.0, low, 139.0, "episode", harm=False, passed=True)
        monkeypatch.setattr(acceptance, "gates", lambda *_, gate=gate: [gate])
        search._answers.clear()
        left, gates, _ = acceptance.gated_selection(search, assessor, selection, Terminal(quiet=True))
        assert left.chosen.terms == ((place,) if passes else ())
        assert gates == ([gate] if passes else [])
