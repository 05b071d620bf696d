"""What a search makes of fits, with fits that are made up."""

from collections.abc import Sequence
from inspect import unwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_aliases import searched
from test_disturbances import pushed

from simpel_cli.data.recording import Recording
from simpel_cli.discovery import searched as searched_module
from simpel_cli.discovery.search import acceptance, calibration
from simpel_cli.discovery.search.acceptance import MOST_SEARCHES, accepted, gated_selection, judgement, proposed
from simpel_cli.discovery.search.again import Earlier, path_in
from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.calibration import Calibrated, calibrated
from simpel_cli.discovery.search.gate.held_out import Gate
from simpel_cli.discovery.search.integration import Finer
from simpel_cli.discovery.search.ranges import Wider
from simpel_cli.discovery.search.score_test import Score
from simpel_cli.discovery.search.sets import forward, merging
from simpel_cli.discovery.search.sets import selection as selection_module
from simpel_cli.discovery.search.sets.forward import MOST_MERGERS, further, select, selected
from simpel_cli.discovery.search.sets.merging import _through, merged
from simpel_cli.discovery.search.sets.rivals import CERTAINLY, rivalled
from simpel_cli.discovery.search.sets.selection import Selection, beaten, cut, steps
from simpel_cli.discovery.search.trials import ACCEPT, QUIETER, SAME, TIE, Search, Stage, Trial, asked
from simpel_cli.discovery.searched import _chosen_in
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter, Hypothesis, Optimum
from simpel_cli.filtering.measurements.cleaning import Cleaned
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression


class MadeUp:
    """Fits that go astray unless they begin beside the smaller model."""

    width = 12

    def __init__(self, row: int, neutral: float, near: float = 0.02) -> None:
        self.row, self.neutral, self.near, self.far = row, neutral, near, 0

    def __call__(self, hypotheses: Sequence[Hypothesis], most: int = 0, hopes: Any = None) -> list[Optimum]:
        found = []
        for hypothesis in hypotheses:
            far = abs(hypothesis.z[self.row] - self.neutral) > self.near
            self.far += far and most == 0
            eye, d = np.eye(len(hypothesis.free)), len(hypothesis.free)
            loss = 500.0 if far else 80.0
            found.append(
                Optimum(
                    hypothesis.z, hypothesis.free, loss, -loss, np.ones(d), 1e3 * eye, np.full(d, 0.5), eye, 1, True
                )
            )
        return found


@pytest.mark.parametrize("near", [0.02, 0.001])
def test_a_fit_that_is_worse_than_the_model_it_contains_begins_again_beside_it(near: float) -> None:
    """An effect of a thousandth of its range is lost in a start of a hundredth."""
    search: Any = searched("b")
    t = next(i for i, term in enumerate(search.terms) if term.effect == "drag")
    fitter = MadeUp(search.rows[t][0], search.plan.start[search.rows[t][0]], near)
    search.fitter = fitter
    z, free = search.plan.start, search.free(())
    eye = np.eye(len(free))
    before = Trial((), Optimum(z, free, 100.0, -100.0, np.zeros(len(free)), eye, z[list(free)], eye, 1, True))
    (trial,) = search.add(before, [t]).trials
    assert fitter.far > 0  # the start of the effect was tried first
    assert trial.optimum.loss == 80.0
    assert isinstance(searched("b").fitter, Fitter)


def test_a_candidate_starts_with_noise_that_a_wrong_size_can_hide_in() -> None:
    search: Any = searched("b")
    n_p, n_r, n_q = search.plan.coordinates.sizes
    z = search.plan.start.copy()
    z[n_p : n_p + n_r + n_q] = 0.0  # a filter that is sure of everything
    for hypothesis in (
        *search.hypotheses((0,), 0, z),
        search.beside(Trial((), search.base().optimum._replace(z=z)), 0)[0],
    ):
        r, q = hypothesis.z[n_p : n_p + n_r], hypothesis.z[n_p + n_r : n_p + n_r + n_q]
        np.testing.assert_array_equal(r, search.plan.start[n_p : n_p + n_r])
        assert (q >= search.plan.start[n_p + n_r : n_p + n_r + n_q] - QUIETER).all()
    quiet = search.beside(Trial((), search.base().optimum._replace(z=z)), 0)[1].z
    np.testing.assert_array_equal(quiet[n_p : n_p + n_r + n_q], z[n_p : n_p + n_r + n_q])
    loud = z.copy()
    loud[n_p : n_p + n_r + n_q] = 0.95
    np.testing.assert_array_equal(search.loud(loud), loud)


def test_what_did_harm_is_no_candidate() -> None:
    search: Any = searched("b")
    first, *others = search.candidates(())
    search.banned.add(first)
    assert search.candidates(()) == others


def force(name: str) -> Expression:
    return Expression(name, acts_on="v", term="k*v", parameters={"k": {"range": [-1, 1], "unit": "1/T"}})


class Racing:
    """Fits of which those with one term are left behind wherever fits race, with more evidence than any other."""

    width = 12

    def __init__(self, row: int, neutral: float, loss: float) -> None:
        self.row, self.neutral, self.loss = row, neutral, loss

    def __call__(self, hypotheses: Sequence[Hypothesis], most: int = 0, hopes: Any = None) -> list[Optimum]:
        found = []
        for h in hypotheses:
            d, left = len(h.free), hopes is not None and self.row in h.free
            beside = self.row in h.free and abs(h.z[self.row] - self.neutral) < 0.02
            loss = self.loss if left else 60.0 if beside else 80.0
            slope, eye = np.full(d, 200.0), np.eye(d)
            found.append(
                Optimum(
                    h.z, h.free, loss, 1e4 if left else -loss, slope, 1e3 * eye, h.z[list(h.free)], eye, 8, False, left
                )
            )
        return found


@pytest.mark.parametrize(("loss", "again"), [(95.0, False), (500.0, True)])
def test_a_fit_that_is_left_is_no_fit_of_its_model(loss: float, again: bool) -> None:
    """Where every start of a term was left in a valley that is worse than the model without it, it begins beside that."""
    search: Any = searched("b", [force("A"), force("B")])
    a, b = (next(t for t, term in enumerate(search.terms) if term.effect == name) for name in "AB")
    search.fitter = Racing(search.rows[a][0], search.plan.start[search.rows[a][0]], loss)
    z, free = search.plan.start, search.free(())
    eye = np.eye(len(free))
    before = Trial((), Optimum(z, free, 100.0, -100.0, np.zeros(len(free)), eye, z[list(free)], eye, 1, True))
    stage = search.add(before, [a, b])
    assert {t.terms[-1] for t in stage.trials} == ({a, b} if again else {b})
    assert all(t.optimum.log_evidence < 0 for t in stage.trials)
    assert not any(optimum.left for optimum in search.known.values())
    if not again:
        assert [t for t, _ in stage.screened] == [a]


class Table:
    """Fits whose evidence stands in a table of sets of names; a set that is not there is a nat worse than its best part."""

    width = 12

    def __init__(self, evidence: dict[str, float]) -> None:
        self.search: Any = searched("b", [force(name) for name in "ABCDE"])
        self.search.fitter = self
        self.evidence = {frozenset(names): value for names, value in evidence.items()}
        self.slopes = dict[str, float]()  # of names whose promise is another
        self.search.banned |= {i for i, term in enumerate(self.search.terms) if term.depends_on}

    def name(self, term: int) -> str:
        return "?" if self.search.terms[term].depends_on else self.search.terms[term].effect

    def of(self, names: frozenset[str]) -> float:
        if names in self.evidence:
            return self.evidence[names]
        return max(self.of(names - {name}) for name in names) - 1

    def __call__(self, hypotheses: Sequence[Hypothesis], most: int = 0, hopes: Any = None) -> list[Optimum]:
        found = []
        for hypothesis in hypotheses:
            on = {i for i, rows in enumerate(self.search.rows) if set(rows) <= set(hypothesis.free)}
            value = float(self.of(frozenset(self.name(i) for i in on)))
            d, eye = len(hypothesis.free), np.eye(len(hypothesis.free))
            slope = np.full(d, 1000.0)  # everything promises the same, and enough to be fitted
            for i in on:
                slope[hypothesis.free.index(self.search.rows[i][0])] *= self.slopes.get(self.name(i), 1.0)
            found.append(
                Optimum(hypothesis.z, hypothesis.free, -value, value, slope, 1e3 * eye, np.full(d, 0.5), eye, 1, True)
            )
        return found

    def terms(self, names: str) -> tuple[int, ...]:
        return tuple(next(t for t, term in enumerate(self.search.terms) if term.effect == name) for name in names)

    def chosen(self, **options: int) -> str:
        found = select(self.search, **options)
        assert [t.terms for t in found.path][-1] == found.chosen.terms
        assert len(found.classes) == len(found.gains) == len(found.chosen.terms)
        return "".join(sorted(self.search.terms[t].effect for t in found.chosen.terms))


def test_every_further_effect_has_to_earn_more() -> None:
    assert asked(1) == ACCEPT < asked(2) < asked(3)
    enough = asked(2) + 0.1
    assert Table({"": 0, "A": 30, "AB": 30 + enough}).chosen() == "AB"
    assert Table({"": 0, "A": 30, "AB": 30 + ACCEPT + 0.1}).chosen() == "A"
    assert Table({"": 0, "A": ACCEPT + 0.1}).chosen() == "A"


def test_what_did_harm_takes_no_place_of_two() -> None:
    """What could stand for two effects is asked again after it was refused: memory would bring it back for ever."""
    gains = {"": 0.0, "A": 20.0, "E": 15.0, "D": 14.0, "AB": 40.0, "AD": 35.0, "ABD": 61.0, "DE": 60.0}
    search = Table(gains).search
    terms = {term.effect: t for t, term in enumerate(search.terms)}
    chosen = search.part(search.base(), tuple(terms[name] for name in "ABD"))
    stage = merged(search, chosen)
    assert stage is not None
    assert stage.trials[0].terms[-1] == terms["E"]
    assert merged(search, chosen) is stage
    search.banned.add(terms["E"])
    assert merged(search, chosen) is None


def test_two_for_which_nothing_stands_are_not_asked_about_again(monkeypatch: pytest.MonkeyPatch) -> None:
    gains = {"": 0.0, "A": 20.0, "B": 15.0, "AB": 40.0, "ABD": 61.0}
    table, later = Table(gains), Table(gains)
    terms = {term.effect: t for t, term in enumerate(table.search.terms)}
    asked_of = list[tuple[int, int]]()
    monkeypatch.setattr(merging, "_alike", lambda _, __, pair: asked_of.append(pair) or [])

    def merge(search: Search, names: str) -> set[str]:
        asked_of.clear()
        assert merged(search, search.part(search.base(), tuple(terms[name] for name in names))) is None
        return {"".join(sorted(search.terms[t].effect for t in pair)) for pair in asked_of}

    assert merge(table.search, "AB") == {"AB"}
    assert merge(table.search, "ABD") == {"AD", "BD"}
    # nor in a search that is made after it, in the same ranges and noise
    chosen = table.search.part(table.search.base(), (terms["A"], terms["B"]))
    for settled in (False, True):
        path_in(later.search, later.search.base(), Earlier(table.search, chosen, settled=settled))
        assert bool(later.search.together) == settled
    assert merge(later.search, "ABD") == set()


def test_a_search_begins_with_what_was_settled_alone() -> None:
    search = Table({"": 0.0, "A": 30.0, "B": 20.0, "AB": 20.5}).search
    base = search.base()
    (b,) = (t for t, term in enumerate(search.terms) if term.effect == "B")
    begun = (base, search.part(base, (b,)))
    for settled, name in ((False, "A"), (True, "B")):
        found = selected(search, base, 0, begun, settled=settled)
        assert [search.terms[t].effect for t in found.chosen.terms] == [name]


def test_one_effect_takes_the_place_of_two_where_it_explains_as_much() -> None:
    gains = {"": 0.0, "A": 20.0, "E": 15.0, "D": 14.0, "AB": 40.0, "AD": 35.0, "ABD": 61.0}
    assert Table(gains).chosen() == "ABD"
    assert Table(gains | {"DE": 60.0}).chosen(beginnings=0) == "DE"
    assert Table(gains | {"DE": 61.1 - asked(3)}).chosen(beginnings=0) == "DE"
    assert Table(gains | {"DE": 60.9 - asked(3)}).chosen(beginnings=0) == "ABD"


def test_the_search_begins_with_another_effect_where_one_is_not_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    gains = {"": 0.0, "A": 30.0, "AD": 41.0, "B": 25.0, "BC": 80.0}
    assert Table(gains).chosen(beginnings=0) == "BC"  # as a pair, which makes the rest superfluous
    monkeypatch.setattr(forward, "together", lambda *_: None)
    assert Table(gains).chosen() == "BC"
    assert Table(gains).chosen(beginnings=0) == "AD"
    assert Table(gains | {"BC": 41.0}).chosen() == "AD"  # that explains more with as many effects
    assert Table({"": 0.0, "A": 30.0, "B": 25.0, "BC": 80.0}).chosen() == "A"  # one was enough: nothing was left


def test_a_function_that_promises_much_keeps_no_name_from_being_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table({"": 0.0})
    table.search.banned = set(sorted(table.search.banned)[2:])

    def promised(_: Any, starts: Sequence[tuple[int, Hypothesis]]) -> list[Score]:
        size = {"?": 250.0, "A": 20.0, "E": 1.6}
        return [Score(size.get(table.name(t), 19.0), 1.0, size.get(table.name(t), 19.0)) for t, _ in starts]

    monkeypatch.setattr(table.search, "promises", promised)
    base = table.search.base()
    trials = table.search.add(base, table.search.candidates(())).trials
    assert {table.name(t.terms[-1]) for t in trials} == {
        "?",
        *"ABCD",
    }  # what promises a twelfth of the best name is left


@pytest.mark.parametrize(
    ("evidence", "left", "asked_for"),
    [
        ({"A": 30, "?": 33, "A?": 34}, "A", None),  # a function that is not clearly better
        ({"A": 30, "?": 50, "A?": 51}, "", 50),  # one that makes the name superfluous
        (
            {"A": 30, "?": 50, "A?": 50 + ACCEPT + 0.1},
            "A",
            20 + ACCEPT + 0.1,
        ),  # one beside which the name earns its place
        ({"A": 30, "B": 9, "AB": 45, "A?": 61, "B?": 40, "?": 31, "AB?": 62}, "A", 31),  # in place of one of two
        # each is superfluous beside the other and the function, both are not
        ({"A": 30, "B": 28, "AB": 45, "?": 20, "A?": 61, "B?": 60, "AB?": 62}, "A", 31),
        (
            {"A": 30, "B": 9, "AB": 45, "A?": 61, "B?": 40, "?": 31, "AB?": 61 + asked(2) + 0.1},
            "AB",
            16 + asked(2) + 0.1,
        ),
    ],
)
def test_a_function_that_does_better_than_a_name_leaves_it_where_it_still_earns_its_place(
    evidence: dict[str, float], left: str, asked_for: float | None
) -> None:
    table = Table({"": 0.0, **evidence})
    table.search.banned = set(sorted(table.search.banned)[1:])
    found = select(table.search)
    assert "".join(sorted(table.name(t) for t in found.chosen.terms)) == left
    assert len(found.classes) == len(found.gains) == len(left)
    assert not any(table.name(t.terms[-1]) == "?" for rivals in found.classes for t in rivals)
    assert (found.remainder[1] if found.remainder else None) == pytest.approx(asked_for)


def test_an_effect_stays_where_the_program_has_no_room_to_set_a_function_beside_it() -> None:
    table = Table({"": 0.0, "A": 30.0, "?": 50.0, "A?": 51.0})
    table.search.banned = set(sorted(table.search.banned)[1:])
    (function,) = (t for t in table.search.candidates(()) if table.name(t) == "?")
    table.width = len(table.search.free((function,)))
    found = select(table.search)
    assert [table.name(t) for t in found.chosen.terms] == ["A"]
    assert found.remainder is not None
    assert found.remainder[1] == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("worse_fit", "less_evidence", "tied"),
    [(0.0, TIE - 0.1, True), (SAME - 0.1, TIE + 9, True), (SAME + 0.1, TIE + 9, False), (SAME + 0.1, TIE - 0.1, True)],
)
def test_names_are_tied_by_evidence_or_by_fits_that_differ_in_the_width_of_priors_alone(
    worse_fit: float, less_evidence: float, tied: bool
) -> None:
    search: Any = Table({"": 0.0, "A": 30.0}).search
    a, b = (next(i for i, t in enumerate(search.terms) if t.effect == name) for name in "AB")
    chosen = Trial((a,), search.fitter(search.beside(search.base(), a))[0])
    there = chosen.optimum
    other = Trial((b,), there._replace(loss=there.loss + worse_fit, log_evidence=there.log_evidence - less_evidence))
    assert search.as_good(other, chosen, a) is tied


def test_a_delay_of_several_rows_promises_what_it_reaches_where_it_begins_whatever_its_slope_at_none_says() -> None:
    parameter = {"range": ["0", "8*dt"], "unit": "s", "starts": ["0.5*dt", "5*dt"]}
    late = Expression("late", acts_on="input", operator="delay", parameters={"d": parameter})
    search: Any = searched("b", [late])
    search.fitter = MadeUp(search.rows[0][0], 0.0)
    before = Trial((), search.base().optimum)
    short, long = search.promises(before, search.starts(before, [0]))
    assert short.switched_off
    assert not long.switched_off
    assert long.gain >= long.sure


@pytest.mark.parametrize(
    ("fails", "harm", "left", "again"),
    [
        ("A", False, "B", ""), ("B", False, "A", ""), ("B", True, "A", "B"), ("", False, "AB", ""), ("AB", False, "", ""),
        ("one of two", False, "A", ""),  # each can stand for the other: the one with less evidence goes
        ("A alone", False, "AB", ""),  # both together certainly help, and A has strong evidence
        ("A alone, hardly", False, "B", ""),  # which held-out parts do not bear out
        ("A alone", True, "B", "A"),
    ],
)  # fmt: skip
def test_what_the_gate_refuses_hides_no_other_effect(
    fails: str, harm: bool, left: str, again: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    search: Any = Table({"": 0.0, "A": 30.0, "B": 10.0, "AB": 60.0}).search
    found = select(search)

    def judge(_: Any, __: Any, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
        names = [search.terms[t].effect for t in whole.terms]
        if len(parts) == 1 and len(names) > 1:  # both against the simulator alone
            return [Gate(1.0, 1.0 if "alone" in fails else -1.0, 2.0, "episode", False, "alone" in fails)]
        fail = fails.split(" alone")[0] if fails != "one of two" else "AB" if len(names) == 2 else ""
        assert [set(whole.terms) - set(part.terms) for part in parts] == [{t} for t in whole.terms]
        # the first is the more uncertain one
        gain = 1.0 if "hardly" in fails else 20.0
        return [Gate(gain, i - 9.0, 30.0, "episode", harm and n in fail, n not in fail) for i, n in enumerate(names)]

    monkeypatch.setattr(acceptance, "gates", judge)
    kept, judged, without = gated_selection(
        search, Assessor(search.plan, 5), found, Terminal(True, tmp_path / "run.log")
    )
    assert [search.terms[t].effect for t in kept.chosen.terms] == list(left)
    assert len(judged) == len(kept.gains) == len(left)
    assert len(rivalled(search, kept).classes) == len(left)
    assert [search.terms[t].effect for t in without] == list(again)


def test_of_effects_that_do_harm_the_one_goes_first_that_gains_least_on_held_out_parts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    search: Any = Table({"": 0.0, "A": 30.0, "B": 90.0, "AB": 130.0}).search

    def judge(_: Any, __: Any, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
        both = len(whole.terms) == 2
        gain = {"A": 50.0, "B": 10.0}  # by evidence B is worth more
        return [
            Gate(gain[search.terms[t].effect], 1.0, 99.0, "episode", both, not both) for t in whole.terms[: len(parts)]
        ]

    monkeypatch.setattr(acceptance, "gates", judge)
    kept, _, _ = gated_selection(search, Assessor(search.plan, 5), select(search), Terminal(True, tmp_path / "run.log"))
    assert [search.terms[t].effect for t in kept.chosen.terms] == ["A"]


@pytest.mark.parametrize(("use", "grows", "stays"), [("free_run", (), True), ("free_run", ("v in free run",), False),
                                                     ("free_run", None, False), ("one_step", (), False)])  # fmt: skip
def test_harm_is_what_is_left_of_it_with_both_models_calibrated_for_the_use(
    use: str, grows: tuple[str, ...] | None, stays: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    search: Any = Table({"": 0.0, "A": 30.0}).search

    def judge(_: Any, __: Any, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
        return [Gate(20.0, 5.0, 35.0, "episode", True, False, ("v some rows ahead",)) for _ in parts]

    monkeypatch.setattr(acceptance, "gates", judge)
    monkeypatch.setattr(acceptance, "growing_for", lambda *_: grows)
    kept, judged, harmful = gated_selection(
        search, Assessor(search.plan, 5), select(search), Terminal(True, tmp_path / "run.log"), use
    )
    assert bool(kept.chosen.terms) is stays
    assert [g.passed for g in judged] == [True] * stays
    assert len(harmful) == (not stays)


@pytest.mark.parametrize(
    ("evidence", "ends"),
    [
        ({"": 0, "A": 60, "B": 20, "AB": 61, "C": 1, "AC": 68, "BC": 22, "ABC": 62}, "AC"),
        ({"": 0, "A": 60, "B": 20, "AB": 90}, "AB"),
    ],
)
def test_what_is_not_needed_any_more_hides_no_other_effect(evidence: dict[str, float], ends: str) -> None:
    """An effect of the earlier search made up for coarse steps, and another one now stands beside what is left."""
    table = Table(evidence)
    search: Any = table.search
    base = search.base()
    begun = tuple(search.part(base, table.terms("AB")[:k]) for k in range(3))
    found = selected(search, base, 0, begun, settled=True)
    assert "".join(sorted(search.terms[t].effect for t in found.chosen.terms)) == ends
    assert set(found.stages[-1].before.terms) == set(found.chosen.terms)  # which says what else there is not


def test_a_search_that_began_with_what_an_earlier_one_chose_tells_its_steps_from_the_start() -> None:
    table = Table({"": 0.0, "A": 30.0, "B": 20.0, "AB": 60.0})
    search: Any = table.search
    whole = select(search)
    assert steps(search, whole) == whole.stages  # which tells them itself
    settled = selected(search, whole.base, 0, whole.path, settled=True)
    assert settled.stages[0].before.terms == whole.chosen.terms
    told = steps(search, settled)
    assert [len(stage.before.terms) for stage in told] == [0, 1, 2]
    assert [stage.trials[0].terms for stage in told[:2]] == [whole.chosen.terms[:1], whole.chosen.terms]
    assert [len(stage.before.terms) for stage in steps(search, settled._replace(stages=()))] == [0, 1]


def test_what_the_gate_leaves_must_earn_its_place_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    search: Any = Table({"": 0.0, "A": 30.0, "B": 2.0, "AB": 60.0}).search

    def judge(_: Any, __: Any, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
        names = [search.terms[t].effect for t in whole.terms]
        return [Gate(1.0, -1.0, 2.0, "episode", False, name == "B") for name in names[: len(parts)]]

    monkeypatch.setattr(acceptance, "gates", judge)
    kept, judged, _ = gated_selection(
        search, Assessor(search.plan, 5), select(search), Terminal(True, tmp_path / "run.log")
    )
    assert kept.chosen.terms == ()
    assert judged == []


@pytest.mark.parametrize(
    ("few", "leans", "left"), [(True, (), "A"), (False, (), "AB"), (False, ("v in free run",), "A")]
)
def test_what_few_held_out_parts_cannot_tell_stays_unless_it_explains_a_few_places_alone_or_an_error_may_grow(
    few: bool, leans: tuple[str, ...], left: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    search: Any = Table({"": 0.0, "A": 60.0, "B": 40.0, "AB": 100.0}).search
    found = select(search)

    def judge(_: Any, __: Any, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
        names = [search.terms[t].effect for t in whole.terms] if len(parts) == len(whole.terms) else ["both"]
        return [
            Gate(30.0, -1.0 if n == "B" else 5.0, 70.0, "episode", False, n != "B", leans=leans if n == "B" else ())
            for n in names
        ]

    def by_row(_: Any, __: Any, trial: Trial) -> np.ndarray:
        likelihood = np.zeros((3, 50))
        if "B" in [search.terms[t].effect for t in trial.terms]:
            likelihood[:, 0 :: 50 if few else 10] = 4.0
        return likelihood

    monkeypatch.setattr(acceptance, "gates", judge)
    monkeypatch.setattr(acceptance, "_by_row", by_row)
    kept, *_ = gated_selection(search, Assessor(search.plan, 5), found, Terminal(True, tmp_path / "run.log"))
    assert sorted(search.terms[t].effect for t in kept.chosen.terms) == list(left)


@pytest.mark.parametrize(("helps", "gain"), [(True, 5.0), (False, 5.0), (True, -5.0)])
def test_effects_stay_together_that_fall_without_an_uncertain_one(
    helps: bool, gain: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """An overflow does harm without the outflow that belongs to it, of which held-out parts are not certain."""
    search: Any = Table({"": 0.0, "A": 60.0, "B": 70.0, "AB": 130.0}).search
    found = select(search)
    first, *_ = found.chosen.terms

    def judge(_: Any, __: Any, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
        if len(whole.terms) == 2 and len(parts) == 1:
            assert parts[0].terms == ()
            return [Gate(30.0, 10.0 if helps else -10.0, 50.0, "episode", False, helps)]
        gates = {search.terms[first].effect: Gate(gain, -9.0, 30.0, "episode", False, False)}
        alone = len(whole.terms) == 1
        sure = Gate(20.0, 5.0, 30.0, "episode", alone, not alone)
        return [gates.get(search.terms[t].effect, sure) for t in whole.terms]

    monkeypatch.setattr(acceptance, "gates", judge)
    # the uncertain one is worth less by evidence, and goes first
    search.banned, before = set(search.banned), set(search.banned)
    assert search.terms[first].effect == "B"
    kept, judged, harmful = gated_selection(
        search, Assessor(search.plan, 5), found._replace(gains=(60.0, 70.0)), Terminal(True, tmp_path / "run.log")
    )
    stays = helps and gain > 0
    assert len(kept.chosen.terms) == len(judged) == 2 * stays
    assert bool(harmful) != stays
    assert (search.banned == before) == stays


def test_values_that_stand_out_where_nothing_is_fitted_are_left_out_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    real, table = searched("b"), Table({"": 0.0})
    test = real.plan.windows._replace(begin=real.plan.windows.begin + 1)
    none_left = np.zeros_like(test.ok)
    data = Recording((), (), (), {}, (), (), ())
    seen: list[tuple[bool, Any]] = []

    def begun(_: Any, __: Any, windows: Windows, rows: int | None) -> Windows:
        seen.append((windows is test, rows))
        return windows

    for name, stub in {
        "whole_windows": lambda *_: test,
        "begun": begun,
        "gated": lambda _, __, windows: windows._replace(ok=none_left) if windows.begin[0] else windows,
        "without_new": lambda clean, _, after, __: (clean, after),
        "Search": lambda *_: table.search,
    }.items():
        monkeypatch.setattr(calibration, name, stub)
    terminal = Terminal(True, tmp_path / "run.log")
    plan = real.plan._replace(spare=test._replace(begin=test.begin + 1))
    found = calibrated(plan, real.fitter, Assessor(real.plan, 5, 5), Cleaned(data, (), {}), terminal)
    assert {rows for of_test, rows in seen[:3] if of_test} == {5}  # of a test its first rows alone
    assert {rows for of_test, rows in seen[:3] if not of_test} == {None}
    np.testing.assert_array_equal(found.test.ok, none_left)
    np.testing.assert_array_equal(found.search.plan.spare.ok, none_left)  # what is held out to judge effects


def test_a_search_goes_on_from_what_is_left_of_it() -> None:
    search = pushed(lambda _, __, v: -0.4 * v, 0.0, 1).search
    found = select(search)
    assert [search.terms[t].effect for t in found.chosen.terms] == ["friction"]
    left = cut(search, found, ())
    again = further(search, left)
    assert again.chosen.terms == found.chosen.terms
    assert len(again.stages) > len(left.stages)
    search.banned.update(found.chosen.terms)
    none = further(search, left)
    assert none.chosen.terms == ()
    assert none.remainder is not None
    assert none.remainder[0].depends_on == ("v",)
    assert none.stages[-1].before.terms == ()
    assert not {t.terms[-1] for t in none.stages[-1].trials} & search.banned


def test_a_base_that_had_not_found_its_place_is_left_for_a_better_one() -> None:
    """What an effect seems to add may be a better fit of the simulator alone, which the effect led to."""
    search = pushed(lambda _, __, v: -0.4 * v, 0.0, 1).search
    good = search.base()
    z = good.optimum.z.copy()
    z[0] = 0.02  # far from where the gain of the input belongs
    lost = good.optimum._replace(z=z, log_evidence=good.optimum.log_evidence - 300, loss=good.optimum.loss + 300)
    search.known.clear()
    search.known[frozenset()] = lost
    found = select(search, Trial((), lost))
    assert [search.terms[t].effect for t in found.chosen.terms] == ["friction"]
    assert found.base.optimum.log_evidence > good.optimum.log_evidence - 1
    earned = found.chosen.optimum.log_evidence - found.base.optimum.log_evidence
    assert found.gains == pytest.approx((earned,), abs=0.5)

    still = pushed(lambda _, __, ___: 0.0, 0.0, 2).search
    good = still.base()
    z = np.where(np.arange(len(z)) == 0, 0.02, good.optimum.z)
    lost = good.optimum._replace(z=z, log_evidence=good.optimum.log_evidence - 300, loss=good.optimum.loss + 300)
    still.known.clear()
    still.known[frozenset()] = lost
    none = select(still, Trial((), lost))
    assert none.chosen.terms == ()
    assert none.chosen.optimum.log_evidence > good.optimum.log_evidence - 1
    assert none.stages[0].before.optimum.log_evidence == none.chosen.optimum.log_evidence


def test_what_a_search_returns_has_been_judged_though_harm_never_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    judged: list[str] = []

    def gated(_: Any, __: Any, selection: str, *___: Any) -> tuple[str, list[str], list[int]]:
        judged.append(selection)
        return selection, [selection], [1]

    count = iter(range(100))
    monkeypatch.setattr(acceptance, "gated_selection", gated)
    monkeypatch.setattr(acceptance, "further", lambda *_: SimpleNamespace(chosen=SimpleNamespace(terms=(next(count),))))
    none: Any = None
    search: Any = SimpleNamespace(banned=set(), budget=Budget())
    first: Any = SimpleNamespace(chosen=SimpleNamespace(terms=()))
    monkeypatch.setattr(acceptance, "condensed", lambda _, found: found)
    selection, gates = unwrap(judgement)(search, none, first, none)
    assert len(judged) == MOST_SEARCHES
    assert gates == [selection]


@pytest.mark.parametrize("refused", [False, True])
def test_what_is_left_where_a_function_makes_an_effect_superfluous_is_judged_again(
    refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rivals are asked of what was accepted; where that takes an effect out, the others have not been judged alone."""
    judged: list[tuple[int, ...]] = []
    both, one, none = (SimpleNamespace(chosen=SimpleNamespace(terms=terms)) for terms in ((1, 2), (1,), ()))

    def gated(_: Any, __: Any, selection: Any, *___: Any) -> tuple[Any, list[str], list[int]]:
        judged.append(selection.chosen.terms)
        return (none, [], []) if selection is one and refused else (selection, ["judged"], [])

    monkeypatch.setattr(acceptance, "gated_selection", gated)
    monkeypatch.setattr(acceptance, "rivalled", lambda _, found: one if found is both else found)
    nothing: Any = None
    first: Any = both
    assert unwrap(accepted)(nothing, nothing, first, [], nothing)[0] is (none if refused else one)
    assert judged == [(1,)]


def test_an_accepted_effect_stays_where_the_one_in_its_place_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    old, new, none = (SimpleNamespace(chosen=SimpleNamespace(terms=terms)) for terms in ((1,), (2,), ()))

    def gated(_: Any, __: Any, selection: Any, *___: Any) -> tuple[Any, list[str], list[int]]:
        return (none, [], [2]) if selection is new else (selection, ["judged"], [])

    search: Any = SimpleNamespace(banned=set(), budget=Budget())
    monkeypatch.setattr(acceptance, "gated_selection", gated)
    monkeypatch.setattr(acceptance, "rivalled", lambda search, found: found if 2 in search.banned else new)
    nothing: Any = None
    first: Any = old
    assert unwrap(accepted)(search, nothing, first, ["judged"], nothing) == (old, ["judged"])
    assert search.banned == {2}


def test_a_late_signal_stands_for_two_signals_on_their_channels_or_before_them() -> None:
    terms = [SimpleNamespace(kind=kind, acts_on=place) for kind, place in (
        ("delay", "u"), ("sensor_delay", "v"), ("sensor_lag", "s"), ("sensor_lag", "y"), ("rate", "v"))]  # fmt: skip
    model = SimpleNamespace(inputs=(SimpleNamespace(name="u"),))
    search: Any = SimpleNamespace(terms=terms, plan=SimpleNamespace(augmented=SimpleNamespace(model=model)))
    through = unwrap(_through)
    assert through(search, 0, (1, 2))  # an input that arrives late makes two sensors seem late
    assert through(search, 1, (1, 2))
    assert not through(search, 3, (1, 2))  # another sensor does not
    assert not through(search, 0, (1, 4))  # and a force is no signal


def test_what_stands_for_two_is_asked_about_before_it_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its ranges are not known yet."""
    two, one, asked_of, judged_of = chosen_so("two", 2), chosen_so("one", 1), list[Any](), list[Any]()

    def ask(selection: Any, _: bool) -> str | None:
        asked_of.append(selection.chosen.optimum)
        return "wider" if selection is one else None

    monkeypatch.setattr(acceptance, "condensed", lambda *_: one)
    monkeypatch.setattr(acceptance, "gated_selection", lambda *_: judged_of.append(1))
    none: Any = None
    search: Any = SimpleNamespace(budget=Budget())
    assert unwrap(judgement)(search, none, two, none, ask=ask) == "wider"
    assert asked_of == ["two", "one"]
    assert not judged_of


@pytest.mark.parametrize("answers", [True, False])
def test_what_is_left_is_asked_about_before_another_effect_is_looked_for(
    answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What did harm may have made up for a range; what would stand in its place then makes up for it, too."""
    two, one, three, asked_of, grown = (
        chosen_so("two", 2),
        chosen_so("one", 1),
        chosen_so("three", 3),
        list[Any](),
        list[Any](),
    )

    def ask(selection: Any, tails: bool) -> str | None:
        asked_of.append((selection.chosen.optimum, tails))
        return "wider" if answers and selection is one else None

    def further(_: Any, left: Any) -> Any:
        grown.append(left.chosen.optimum)
        return three

    monkeypatch.setattr(acceptance, "condensed", lambda _, found: found)
    monkeypatch.setattr(acceptance, "further", further)
    judged = iter([(one, ["judged"], [1]), (three, ["judged"], [])])
    monkeypatch.setattr(acceptance, "gated_selection", lambda *_: next(judged))
    none: Any = None
    search: Any = SimpleNamespace(budget=Budget())
    outcome = unwrap(judgement)(search, none, two, none, ask=ask)
    assert outcome == ("wider" if answers else (three, ["judged"]))
    # what the refused effect explains looks like heavy tails: these are asked of what stands in the end
    assert asked_of == [("two", True), ("one", False)] + ([] if answers else [("three", True)])
    assert grown == ([] if answers else ["one"])


@pytest.mark.parametrize("named", [0, MOST_MERGERS])
def test_a_function_in_place_of_two_is_kept_in_mind_after_mergers(named: int, monkeypatch: pytest.MonkeyPatch) -> None:
    optimum: Any = SimpleNamespace(log_evidence=0.0)
    function = Trial((9,), optimum)
    merger = Stage(function, (Trial((0,), optimum),))
    found = iter([*[merger] * named, Stage(function, (function,))])
    monkeypatch.setattr(forward, "merged", lambda *_: next(found))
    monkeypatch.setattr(forward, "nameless", lambda _, trial: trial is function)
    monkeypatch.setattr(forward, "path_of", lambda *_: ())
    monkeypatch.setattr(forward, "_grow", lambda *_: SimpleNamespace(stages=(), _replace=lambda **_: None))
    monkeypatch.setattr(forward, "_ended", lambda *_: chosen_so("two", 2))
    search: Any = SimpleNamespace(report=lambda _: None, terms=[SimpleNamespace(label="one")])
    assert unwrap(forward.condensed)(search, chosen_so("two", 2)).instead is function


@pytest.mark.parametrize(("function", "ahead"), [(20.0, True), (14.0, False), (None, False)])
def test_a_function_that_did_better_than_a_step_took_is_known(
    function: float | None, ahead: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    at = lambda value: SimpleNamespace(log_evidence=value)  # noqa: E731
    monkeypatch.setattr(selection_module, "nameless", lambda _, trial: trial.terms[-1] == 1)
    search: Any = None
    base: Any = Trial((), at(0.0))
    taken: Any = Trial((0,), at(12.0))
    others: tuple[Any, ...] = () if function is None else (Trial((1,), at(function)),)
    last: Any = Trial((0, 1), at(99.0))  # what is still asked for after the last step is `remainder`
    found = Selection(base, taken, (base, taken), (), (Stage(base, (taken, *others)), Stage(taken, (last,))), (), None)
    assert unwrap(beaten)(search, found) == ahead


def test_noise_that_was_heavy_is_so_from_the_beginning_of_the_next_search(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = chosen_so("chosen", 1)
    gaussian, heavy = in_noise("gaussian", {}), in_noise("heavy", {"y": 3.0})
    asked, searches = list[str](), list[str]()

    def tails(_: Any, __: Any, trial: Any, ___: Any) -> Any:
        asked.append(trial)
        return heavy

    def propose(search: Any, *_: Any, **__: Any) -> Any:
        searches.append(search.name)
        return kept

    monkeypatch.setattr(
        searched_module, "path_in", lambda *_: (None, SimpleNamespace(optimum=SimpleNamespace(z="earlier")))
    )
    monkeypatch.setattr(searched_module, "proposed", propose)
    monkeypatch.setattr(acceptance, "condensed", lambda _, selection: selection)
    monkeypatch.setattr(acceptance, "gated_selection", lambda *_: (kept, [], []))
    monkeypatch.setattr(searched_module, "with_heavy_tails", tails)
    none: Any = None
    ground: Any = SimpleNamespace(options=SimpleNamespace(for_=None), terminal=None, budget=Budget())
    unchecked(monkeypatch)
    monkeypatch.setattr(searched_module, "_heavy", unwrap(searched_module._heavy))
    monkeypatch.setattr(searched_module, "_with_tails", unwrap(searched_module._with_tails))
    found, _, _ = unwrap(_chosen_in)(gaussian, none, ground, lambda *_: None, Earlier(none, none, heavy=True))
    assert found is heavy
    assert (asked, searches) == (["earlier"], ["heavy"])


def test_where_errors_stay_far_above_the_noise_effects_begin_anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    none: Any = None
    first = SimpleNamespace(chosen=1)
    monkeypatch.setattr(acceptance, "selected", lambda *_: first)
    monkeypatch.setattr(acceptance, "widely", lambda _, found: (found, "anywhere"))
    monkeypatch.setattr(acceptance, "far", lambda _, __, chosen: chosen == 1)
    options: Any = SimpleNamespace(beginnings=0)
    assert unwrap(proposed)(none, none, none, options) == (first, "anywhere")
    monkeypatch.setattr(acceptance, "far", lambda *_: False)
    assert unwrap(proposed)(none, none, none, options) is first


def chosen_so(name: str, count: int) -> Selection:
    """A selection of so many effects, by a name."""
    called: Any = name
    chosen = Trial(tuple(range(count)), called)
    return Selection(chosen, chosen, (), (), (), (), None)


def in_noise(name: str, degrees_of_freedom: dict[str, float]) -> Calibrated:
    search: Any = SimpleNamespace(name=name, budget=Budget())
    none: Any = None
    return Calibrated(search, none, none, none, degrees_of_freedom)


def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let fakes through."""
    monkeypatch.setattr(searched_module, "judgement", unwrap(judgement))
    monkeypatch.setattr(searched_module, "chosen_of", unwrap(searched_module.chosen_of))
    monkeypatch.setattr(searched_module, "beaten", lambda *_: False)


@pytest.mark.parametrize("first", [Wider({"k": (0.0, 2.0)}, 9.0), Finer()])
@pytest.mark.parametrize(
    ("asks", "kept", "questions"),
    [("proposed", 1, ["proposed"]), ("judged", 0, ["proposed", "judged"]), ("", 1, ["proposed"])],
)
def test_ranges_and_steps_are_asked_before_anything_is_judged_and_after_something_was_refused(
    asks: str, kept: int, questions: list[str], first: Wider | Finer, monkeypatch: pytest.MonkeyPatch
) -> None:
    proposal, judged = (chosen_so(name, n) for name, n in (("proposed", 1), ("judged", kept)))
    asked_of, judgements = list[str](), list[object]()

    def ends(_: Any, selection: Any) -> Wider | Finer | None:
        asked_of.append(selection.chosen.optimum)
        return first if selection.chosen.optimum == asks else None

    def judge(_: Any, __: Any, selection: Any, *___: Any) -> tuple[Any, list[Any], list[int]]:
        judgements.append(selection)
        return judged, [], []

    monkeypatch.setattr(searched_module, "proposed", lambda *_, **__: proposal)
    monkeypatch.setattr(acceptance, "condensed", lambda _, selection: selection)
    monkeypatch.setattr(acceptance, "gated_selection", judge)
    unchecked(monkeypatch)
    monkeypatch.setattr(searched_module, "_heavy", unwrap(searched_module._heavy))
    none: Any = None
    found = Calibrated(none, none, none, none, {"y": 3.0})
    ground: Any = SimpleNamespace(options=SimpleNamespace(for_=None), terminal=None)
    outcome = unwrap(_chosen_in)(found, none, ground, ends)
    chosen = proposal.chosen if asks == "proposed" else judged.chosen
    earlier = Earlier(none, chosen, heavy=True, settled=isinstance(first, Finer))  # in finer steps the same is asked
    assert outcome == (first._replace(earlier=earlier) if asks else (found, judged, []))
    assert asked_of == questions
    assert judgements == ([] if asks == "proposed" else [proposal])


@pytest.mark.parametrize("shown_by", ["proposed", "judged"])
def test_what_is_judged_last_has_the_noise_that_its_own_residuals_show(
    shown_by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heavy tails are asked before anything is judged, and again where something was refused, which may have hidden them."""
    proposal, kept = chosen_so("proposed", 2), chosen_so("judged", 1)
    searches: list[tuple[str, object]] = []
    gaussian, heavy = in_noise("gaussian", {}), in_noise("heavy", {"y": 3.0})

    def propose(search: Any, *_: Any, earlier: Any = None, **__: Any) -> Any:
        searches.append((search.name, earlier and earlier.search.name))
        return proposal if search is gaussian.search else kept

    judgements: list[tuple[str, str]] = []

    def judge(search: Any, _: Any, selection: Any, *___: Any) -> tuple[Any, list[Any], list[int]]:
        judgements.append((search.name, selection.chosen.optimum))
        return kept, [], []

    def tails(found: Any, _: Any, selection: Any, __: Any) -> Any:
        return heavy if found is gaussian and selection.chosen.optimum == shown_by else None

    monkeypatch.setattr(searched_module, "proposed", propose)
    monkeypatch.setattr(acceptance, "condensed", lambda _, selection: selection)
    monkeypatch.setattr(acceptance, "gated_selection", judge)
    monkeypatch.setattr(searched_module, "_heavy", tails)
    none: Any = None
    ground: Any = SimpleNamespace(options=SimpleNamespace(for_=None), terminal=None)
    unchecked(monkeypatch)
    outcome = unwrap(_chosen_in)(gaussian, none, ground, lambda *_: None)
    assert outcome == (heavy, kept, [])
    assert searches == [("gaussian", None), ("heavy", "gaussian")]
    assert judgements[-1] == ("heavy", "judged")
    assert (("gaussian", "proposed") in judgements) == (shown_by == "judged")


def test_a_name_that_does_better_beside_what_came_later_takes_the_place_of_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(forward, "together", lambda *_: None)
    gains = {"": 0.0, "A": 30.0, "AB": 50.0, "B": 5.0, "C": 6.0}
    assert Table(gains | {"BC": 50.1 + CERTAINLY}).chosen(beginnings=0) == "BC"
    assert Table(gains | {"BC": 49.9 + CERTAINLY}).chosen(beginnings=0) == "AB"
    assert Table(gains | {"BC": 66.0, "C": 62.0}).chosen(beginnings=0) == "C"  # beside which B earns nothing


def test_a_path_that_stays_behind_the_best_one_goes_no_further() -> None:
    gains = {
        "": 0.0,
        "A": 30.0,
        "AD": 60.0,
        "ADE": 90.0,
        "ABDE": 120.0,
        "C": 29.0,
        "BC": 58.0,
        "BCD": 85.0,
        "ABCD": 99.0,
    }
    table = Table(gains)
    ways = list[str]()
    table.search.report = ways.append
    leader = tuple(
        table.search.part(table.search.base(), table.terms(names)) for names in ("", "A", "AD", "ADE", "ADEB")
    )
    start = leader[0], table.search.part(leader[0], table.terms("C"))
    assert len(forward._grow(table.search, start, leader=leader).path[-1].terms) == 3
    assert len(forward._grow(table.search, start).path[-1].terms) == 5
    start = leader[0], table.search.part(leader[0], table.terms("D"))
    assert set(forward._grow(table.search, start, leader=leader).path[-1].terms) == set(table.terms("AD"))


@pytest.mark.parametrize("useless", ["", "CD"])
def test_a_path_that_was_cut_and_is_worth_more_goes_on(useless: str) -> None:
    """What was chosen in other ranges may hold effects that earn nothing here; a part of it that is worth more is no end."""
    gains = {"": 0.0, "A": 100.0, "AB": 140.0, "ABE": 155.0, "B": 40.0, "E": 15.0}
    names = "ABE" + useless
    whole = {names[: k + 1]: 155.0 for k in range(3, len(names))}
    table = Table(gains | whole)
    begun = tuple(table.search.part(table.search.base(), table.terms(names[:k])) for k in range(len(names) + 1))
    found = forward.selected(table.search, begun[0], 0, begun)
    assert {table.search.terms[t].effect for t in found.chosen.terms} == {*"ABE"}


@pytest.mark.parametrize(
    ("promise", "more", "ends"),
    [
        ({"E": 1.5}, {}, 3),
        ({"E": 1.5}, {"AD": 27.0}, 3),
        ({"E": 1.5}, {"AD": 35.0}, 4),  # it is ahead of the best one with as many effects, AE
        ({"E": 1.5, "C": 1.4}, {}, 4),
        ({"C": 1.5}, {}, 4),
        ({}, {}, 4),
    ],
)
def test_a_path_that_follows_the_best_one_goes_no_further(
    promise: dict[str, float], more: dict[str, float], ends: int
) -> None:
    """With D and A it has a part of what the best one has: it goes on only where something else promises about as much."""
    gains = {"": 0.0, "A": 20.0, "AE": 30.0, "AD": 29.0, "ADE": 90.0, "ACD": 95.0, "D": 15.0}
    table = Table(gains | more)
    leader = tuple(table.search.part(table.search.base(), table.terms(names)) for names in ("", "A", "AE", "AED"))
    table.slopes = promise
    start = leader[0], table.search.part(leader[0], table.terms("D"))
    assert len(forward._grow(table.search, start, leader=leader).path) == ends


def test_a_search_that_is_made_again_begins_with_what_the_last_one_chose() -> None:
    gains = {"": 0.0, "A": 30.0, "AB": 50.0, "CD": 55.0 + asked(1)}
    earlier, table = Table(gains), Table(gains)
    chosen = earlier.search.part(earlier.search.base(), earlier.terms("CD"))
    path = path_in(table.search, table.search.base(), Earlier(earlier.search, chosen))
    assert [t.terms for t in path] == [(), table.terms("C"), table.terms("CD")]
    none: Any = None
    found = unwrap(proposed)(table.search, none, path[0], none, earlier=Earlier(earlier.search, chosen))
    assert set(found.chosen.terms) == set(table.terms("CD"))
    assert found.stages[0].before.terms == ()
    table.search.banned |= set(table.terms("CD"))
    assert path_in(table.search, path[0], Earlier(earlier.search, chosen)) == ()


@pytest.mark.parametrize(("formula", "stays"), [(96.0, True), (85.0, False)])
def test_a_formula_that_explains_nearly_what_a_function_does_keeps_its_name(formula: float, stays: bool) -> None:
    """The function does better by more than it has to, and the formula earns nothing beside it."""
    table = Table({"": 0.0, "A": formula, "?": 104.0, "A?": 104.5})
    functions = [t for t, term in enumerate(table.search.terms) if term.depends_on]
    table.search.banned -= {functions[0]}
    found = select(table.search, beginnings=0)
    assert [table.search.terms[t].effect for t in found.chosen.terms] == (["A"] if stays else [])
    assert found.remainder is not None
    assert found.remainder[0].depends_on
