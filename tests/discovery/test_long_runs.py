"""An effect that helps in the windows of a search, and does harm in a free run of a whole episode."""

import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.acceptance import gated_selection, harmless
from simpel_cli.discovery.search.gate.long_runs import gone_astray
from simpel_cli.discovery.search.sets.forward import selected
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained import interactions
from simpel_cli.discovery.search.unexplained.function_screening import Promise
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.search.uses import FREE_RUN, windows_for
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup, with_memory
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression, Term
from simulators.effects.term import RATE
from simulators.model import Declared

DT, TRAIN, ROWS, NOISE, MEMORY = 0.1, 4000, 4500, 0.01, 2.0
TAU = {"range": [3 * DT, 3000 * DT], "unit": "s", "prior": "loguniform", "neutral": 3.0, "starts": [2.0, 100.0]}
SLOW = Expression(
    "slow", acts_on="x", term="k*z", parameters={"k": {"range": [-3, 3], "unit": "1/s", "starts": [0.3]}, "tau": TAU},
    states={"z": {"rate": "(given - z)/tau", "unit": "U", "range": ["-U", "U"], "begins": "given"}},
)  # fmt: skip


def recording() -> Recording:
    """A first-order lag with one more state behind its input."""
    random = np.random.default_rng(2)
    u = np.repeat(random.uniform(-1, 1, ROWS // 10), 10)
    h = DT / 20
    x, z, rows = 0.0, 0.0, []
    for k in range(ROWS):
        rows.append(x)
        for _ in range(20):
            x, z = x + h * (u[k] - x + 0.5 * z), z + h * (u[k] - z) / MEMORY
    read = np.array(rows) + NOISE * random.normal(size=ROWS)
    time, parts = DT * np.arange(ROWS), [slice(0, TRAIN), slice(TRAIN, ROWS)]
    train, test = (
        Episode(str(k), time[own], read[own, None], u[own, None], np.zeros((own.stop - own.start, 0)))
        for k, own in enumerate(parts)
    )
    return Recording((train,), (test,), (), {"x": NOISE}, (), (), ())


@pytest.fixture(scope="module")
def found() -> tuple[Recording, Search, Assessor, Trial]:
    model = Declared(
        "lag", dt=DT, states={"x": {"unit": "1", "range": [-2, 2]}}, inputs={"u": {"unit": "1", "range": [-1, 1]}},
        parameters={"a": {"unit": "1/s", "range": [0.5, 2]}}, dynamics={"x": "u - a*x"},
    ).model()  # fmt: skip
    data = recording()
    plan = setup(model, data, (), [], 1, extra=with_memory(model, data, [SLOW]))
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=10))
    (slow,) = (t for t, term in enumerate(search.terms) if term.effect == "slow")
    return data, search, Assessor(plan, 10), search.add(search.base(), [slow]).trials[0]


def turned(search: Search, chosen: Trial) -> Trial:
    """Return the model with the strength of its effect the other way."""
    z = chosen.optimum.z.copy()
    (k,) = (i for i, q in enumerate(search.plan.augmented.params) if q.name.startswith("slow") and q.name.endswith("k"))
    z[k] = 1 - z[k]
    return Trial(chosen.terms, chosen.optimum._replace(z=z))


@pytest.mark.parametrize("harm", [True, False])
def test_what_goes_astray_over_long_runs_goes(found: tuple[Recording, Search, Assessor, Trial], harm: bool) -> None:
    data, search, assessor, chosen = found
    terminal = Terminal(quiet=True)
    selection = selected(search, search.base(), 0, (search.base(), chosen), settled=True)
    selection, gates, _ = gated_selection(search, assessor, selection, terminal)
    assert selection.chosen.terms == chosen.terms
    if harm:  # what a start of every window's own may hide
        worse = turned(search, selection.chosen)
        selection = selection._replace(chosen=worse, path=(*selection.path[:-1], worse))
    runs = windows_for(search.plan, data, FREE_RUN)
    after, left = harmless(search, assessor, selection, gates, runs, terminal)
    assert (after.chosen.terms == ()) == (left == []) == (set(chosen.terms) <= search.banned) == harm
    search.banned -= set(chosen.terms)


def test_for_a_use_both_models_are_calibrated_for_it(found: tuple[Recording, Search, Assessor, Trial]) -> None:
    """Calibrated for free runs the strength comes back, and nothing grows."""
    data, search, assessor, chosen = found
    worse, runs = turned(search, chosen), windows_for(search.plan, data, FREE_RUN)
    astray = gone_astray(search, assessor, worse, runs)
    assert astray is not None
    assert (astray.place, astray.channel) == (0, "x")
    assert astray.times > 1.5
    assert gone_astray(search, assessor, worse, runs, FREE_RUN) is None
    assert gone_astray(search, assessor, worse, runs, 2.0) is None  # windows are longer than that


def test_windows_as_long_as_the_episodes_are_not_looked_at_again(
    found: tuple[Recording, Search, Assessor, Trial], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, search, assessor, chosen = found
    monkeypatch.setattr(Assessor, "free_runs", None)
    assert gone_astray(search, assessor, turned(search, chosen), search.plan.windows) is None


def test_a_state_that_an_effect_brought_is_no_argument_of_a_function(
    found: tuple[Recording, Search, Assessor, Trial], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, search, assessor, chosen = found
    asked: list[Term] = []

    def promised(levels: NoiseProfile, terms: list[Term]) -> list[Promise]:
        asked.extend(terms)
        return []

    monkeypatch.setattr(interactions, "promised", promised)
    monkeypatch.setattr(interactions, "_worth_a_fit", lambda *_: [])
    levels = NoiseProfile(search, assessor, chosen)
    assert interactions.interaction(levels, levels, setup, 2) is None
    of_two = {(t.acts_on, t.depends_on) for t in asked if t.kind == RATE}
    assert of_two == {("x", ("x", "u"))}
    brought = {store.name for t in search.terms for store in t.stores}
    assert brought
    assert len(asked) > len(of_two)
    assert not brought & {name for t in asked for name in (t.acts_on, *t.depends_on)}
