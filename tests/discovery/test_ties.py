"""What makes a verdict ambiguous, how its class is told, and what a search looks at of a long record."""

from inspect import unwrap
from types import SimpleNamespace

import numpy as np
import pytest
import searches

from simpel_cli.data.recording import Episode
from simpel_cli.discovery.verdict.verdict import _distinct, sentence
from simpel_cli.filtering.measurements.windows import Windows, thinned, windows_of


@pytest.mark.parametrize(
    ("others", "told"),
    [
        ([], ["sensor scale"]),
        ([("sensor_scale", "h_2", False)], ["sensor scale on h_1", "sensor scale on h_2"]),
        ([("sensor_scale", "h_2", True)], ["sensor scale on h_1"]),
        ([("leak", "h_2", False)], ["sensor scale", "leak"]),
        ([("leak", "h_2", True)], ["sensor scale"]),
        ([("leak", "h_1", False), ("leak", "h_2", False)], ["sensor scale", "leak on h_1", "leak on h_2"]),
    ],
)
def test_a_name_at_two_places_is_two_causes(others: list[tuple[str, str, bool]], told: list[str]) -> None:
    members = [("sensor_scale", "h_1", True), *others]
    effect = {
        "name": "sensor_scale",
        "class_members": [dict(zip(("name", "acts_on", "same"), m, strict=True)) for m in members],
    }
    assert _distinct(effect) == told


def cut(lengths: list[int]) -> Windows:
    episodes = [
        Episode(f"{i}", np.arange(n) * 0.1, np.arange(n)[:, None] + 1000.0 * i, np.zeros((n, 1)), np.zeros((n, 0)))
        for i, n in enumerate(lengths)
    ]
    return windows_of(episodes, ["s"], ["s"], [], np.zeros(1), np.ones(1), lead=2, dt=0.1, longest=10)


def test_a_long_record_is_thinned_evenly_and_windows_know_their_rows() -> None:
    windows = cut([100, 40])
    few, rest = thinned(windows, 50)
    assert len(few.episode) == 5
    assert set(few.episode.tolist()) == {0, 1}
    for y, episode, begin in zip(few.y, few.episode, few.begin, strict=True):
        assert y[0, 0] == 1000 * episode + begin
    assert few.begin.tolist() == [0, 30, 60, 0, 30]
    assert rest is not None
    every = {(e, b) for part in (few, rest) for e, b in zip(part.episode.tolist(), part.begin.tolist(), strict=True)}
    assert len(few.episode) + len(rest.episode) == len(windows.episode) == len(every)
    assert thinned(windows, 1000) == (windows, None)
    assert len(thinned(cut([100, 40]), 1)[0].episode) == 2  # one of each episode


def test_a_tie_says_which_two_effects_do_as_well() -> None:
    found = searches.verdict("ambiguous")
    load = {"name": "constant_load", "acts_on": "tau_1"}
    found["effects"][0]["same_as_two"] = [[load, {"name": n, "acts_on": "u_1"}] for n in ("input_lag", "input_scale")]
    found["share_explained"] = 0.98
    before, after = (SimpleNamespace(ahead=np.full((1, 1, 1), error)) for error in (0.4, 0.04))
    told = unwrap(sentence)(found, before, after, ("omega",))
    assert told.startswith(
        "Causes that fit these data equally well: coulomb friction or viscous friction, "
        "or constant load on tau_1 with input lag or input scale on u_1. "
    )
