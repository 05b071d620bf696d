"""A search of a large model begins in few rows of a long record, and goes on in all from what it chose there."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_ranges import DRAG, cart

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery import ground as ground_module
from simpel_cli.discovery.ground import Ground, few_rows
from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.searched import _searched
from simpel_cli.discovery.watch import Watch
from simpel_cli.filtering.measurements.cleaning import Cleaned
from simpel_cli.runs.console import Terminal


def of_states(count: int, groups: Sequence[str] = ()) -> Any:
    return SimpleNamespace(states=[None] * count, groups=dict.fromkeys(groups, ("a", "b")))


def of_lengths(*rows: int) -> Any:
    return SimpleNamespace(train=[SimpleNamespace(time=np.zeros(n)) for n in rows])


@pytest.mark.parametrize(
    ("states", "groups", "rows", "most", "few"),
    [
        (6, (), (6000, 6820), 1500, 512),
        (4, (), (65_000,), 3000, 1000),
        (4, (), (1300, 1300), 3000, 866),
        (3, (), (6000, 6820), 1500, 1500),  # it takes no longer in all
        (6, ("day",), (6000, 6820), 1500, 1500),  # what differs from group to group asks for all of them
        (6, (), (200,) * 30, 3000, 3000),  # of every episode a window counts in any case
        (4, (), (400,), 3000, 3000),  # too short for less
    ],
)
def test_long_records_of_large_models_are_begun_in_a_third_of_their_rows(
    states: int, groups: tuple[str, ...], rows: tuple[int, ...], most: int, few: int, unchecked_ground: Any
) -> None:
    assert unchecked_ground(of_states(states, groups), of_lengths(*rows), most) == few


@pytest.fixture
def unchecked_ground(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let fakes through."""
    return getattr(few_rows, "__wrapped__", few_rows)


def driven(k: float, rows: int) -> Recording:
    """Carts with a drag k, exactly integrated, with 1 mm and 1 mm/s of noise: two long episodes and a short one."""
    random = np.random.default_rng(5)
    episodes = []
    for e, length in enumerate((rows, rows, 200)):
        u = np.repeat(random.uniform(-3, 3, -(-length // 5)), 5)[:length]
        x = np.zeros((length, 2))
        fall = np.exp(-k * 0.1)
        for i in range(length - 1):
            (s, v), end = x[i], 1.2 * u[i] / k
            x[i + 1] = s + end * 0.1 + (v - end) * (1 - fall) / k, end + (v - end) * fall
        noisy = x + 1e-3 * random.normal(size=x.shape)
        episodes.append(Episode(str(e), np.arange(length) * 0.1, noisy, u[:, None], np.zeros((length, 0))))
    noise = {"s": 1e-3, "v": 1e-3}
    return Recording(tuple(episodes[:2]), tuple(episodes[2:]), (), noise, (), (Check("c", True, ""),), ())


def test_what_few_rows_chose_is_judged_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, terminal, lines = driven(0.1, 800), Terminal(quiet=True), list[str]()
    monkeypatch.setattr(ground_module, "LARGE", 2)
    monkeypatch.setattr(terminal, "line", lambda text, *_, **__: lines.append(text))
    options, budget = Discovery(rows=1600, substeps=1), Budget()
    few = few_rows(cart(), recording, options.rows)
    assert few == 533
    ground = Ground(cart(), Cleaned(recording, (), {}), options, (), terminal, budget, Watch(budget), few, few)
    found = _searched(ground, [DRAG])
    begun = lines.index("going on from there in about 1600 rows")
    assert any(line.startswith("drag on v +") for line in lines[:begun])
    assert not any("held-out gain" in line for line in lines[:begun])
    assert any("drag on v: held-out gain" in line for line in lines[begun:])
    assert found.search.plan.windows.ok[..., 0].sum() == 1600
    (t,) = found.selection.chosen.terms
    assert found.search.terms[t].effect == "drag"
    row = found.search.plan.augmented.rows(found.search.terms[t])[0]
    k = found.search.plan.coordinates.value(row, float(found.selection.chosen.optimum.z[row]))
    assert k == pytest.approx(0.1, abs=0.005)
    assert len(found.selection.stages[0].before.terms) == 0  # what was tried in few rows is still told
