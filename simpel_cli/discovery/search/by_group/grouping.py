"""Whether grouping pays: a model against the same one in which something differs from group to group.

It is asked of every chosen effect, and of those that explained most beside them, since one value for all groups may be why
none of these was accepted; by every column of the data that names groups, in a small program that has these terms alone, by
evidence (which pays for the spread) and on held-out episodes. Where it pays, the search is made once more with such an effect:
what one value for all groups left is no remainder then, nor noise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from simpel_cli.discovery.search.gate.held_out import Gate, gates
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.smaller import carried, small_search
from simpel_cli.discovery.search.trials import ACCEPT, SPREADS, TIE, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import MOST_GROUPED, Setup, key_of
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression, Term
from simulators.effects.term import OPERATORS

Attach = Callable[..., Setup]  # effects -> the setup of a program with the chosen terms and theirs
MOST_LEADERS = 8  # effects that were not accepted


class Grouping(NamedTuple):
    """What it is worth that an effect or a parameter differs from group to group.

    Args:
        effect: its name; empty: a parameter of the simulator.
        per: column that names the groups.
        gain: in evidence, over one value for all of them, and over none where that explains more, nats.
        gate: over the same; None: the evidence was not enough to ask it.
        pays: whether it earns its place, and held-out episodes agree.
        parameter: of the simulator; empty: an effect.
        accepted: whether an effect is one that was chosen with one value for all groups.
    """

    effect: str
    per: str
    gain: float
    gate: Gate | None
    pays: bool
    parameter: str = ""
    accepted: bool = True

    @property
    def subject(self) -> str:
        """What differs."""
        return self.parameter or self.effect


class Question(NamedTuple):
    """One thing that may differ.

    Args:
        of: what is asked, not judged yet.
        trials: the model so far -> the model in which it differs as well, and those that this one has to beat.
    """

    of: Grouping
    trials: Callable[[Trial], tuple[Trial, list[Trial]]]


def judged(small: Search, judge: Assessor, own: Trial, questions: Sequence[Question], most: int) -> list[Grouping]:
    """Answer questions; what pays most is taken for given when the next are asked.

    Args:
        small: search in which all of them can be fitted.
        judge: of errors ahead.
        own: the model in which nothing that is asked about differs.
        questions: of any number.
        most: things that differ.
    """
    found: dict[tuple[str, str], Grouping] = {}
    left, taken = list(questions), 0
    while left and taken < most:
        fits = [question.trials(own) for question in left]
        small.tried += len(left)
        gains = [_gain(whole, parts) for whole, parts in fits]
        best: Grouping | None = None
        for i in sorted(range(len(left)), key=lambda i: -gains[i]):
            asked, (whole, parts), gate = left[i].of, fits[i], None
            if gains[i] > ACCEPT and best is None:
                gate = min(gates(small, judge, whole, parts), key=lambda g: (g.passed, g.low))
            pays = gate is not None and gate.passed
            found[asked.subject, asked.per] = asked._replace(gain=gains[i], gate=gate, pays=pays)
            if pays:
                best, own, taken = asked, whole, taken + 1
        if best is None:
            break
        left = [question for question in left if question.of.subject != best.subject]
    return list(found.values())


def _gain(whole: Trial, parts: Sequence[Trial]) -> float:
    return float(whole.optimum.log_evidence - max(part.optimum.log_evidence for part in parts))


def groupings(
    search: Search,
    assessor: Assessor,
    selection: Selection,
    unexplained: bool,
    effects: Sequence[Expression],
    attach: Attach,
    options: Discovery,
    terminal: Terminal,
) -> list[Grouping]:
    """Return what grouping effects is worth; nothing where no column names groups.

    Args:
        search: that was run.
        assessor: of errors ahead.
        selection: what it ended with.
        unexplained: whether something is left that no effect explains; then those are asked, too, that were not accepted.
            Where none of the accepted ones differs, others are asked in their place: one value for all may make up for what
            differs from group to group of something else.
        effects: of the catalogue.
        attach: (effects, kept, extra) -> the setup of a program with these terms.
        options: of the search.
        terminal: takes lines.
    """
    columns, chosen = list(search.plan.augmented.model.groups), selection.chosen
    if not columns:
        return []
    leaders = _leaders(search, selection) if unexplained or not chosen.terms else []
    known = {search.terms[t].effect for t in (*chosen.terms, *(t.terms[-1] for t in leaders))}
    differs = any(search.terms[t].groupings for t in chosen.terms)
    alone = [] if differs or not chosen.terms else _leaders(search, selection._replace(chosen=selection.base))
    instead = [t for t in alone if search.terms[t.terms[-1]].effect not in known]
    terms = [search.terms[t] for t in (*chosen.terms, *(t.terms[-1] for t in (*leaders, *instead)))]
    alike = [
        e
        for e in effects
        if any(t.effect == e.name and not t.groupings for t in terms) and not (e.operator or e.states)
    ]
    if not alike:
        return []
    terminal.line(f"does {' or '.join(e.name for e in alike)} differ by {' or '.join(columns)}", "groups")
    differing = {_name(e.name, by): replace(e, name=_name(e.name, by), per=by) for e in alike for by in columns}
    small, own = _small(search, chosen, terms, [*effects, *differing.values()], list(differing), attach, options)
    first = {search.terms[t.terms[-1]].effect: t for t in (*leaders, *instead)}
    in_place = {search.terms[t.terms[-1]].effect for t in instead}

    def question(name: str, by: str) -> Question:
        def trials(at: Trial) -> tuple[Trial, list[Trial]]:
            if name in in_place:
                whole = _added(small, small.part(at, ()), search, first[name])
                return _differing(small, whole, name, _name(name, by)), [at]
            whole = _added(small, at, search, first[name]) if name in first else at
            return _differing(small, whole, name, _name(name, by)), [at] if whole is at else [whole, at]

        return Question(Grouping(name, by, 0.0, None, pays=False, accepted=name not in first), trials)

    asked = [question(e.name, by) for e in alike for by in columns]
    several = len({t.effect for t in terms[: len(chosen.terms)]}) < len(chosen.terms)
    most = 1 if several else min(max(len(chosen.terms), 1), MOST_GROUPED)  # what the program has room for
    found = judged(small, assessor.of(small.plan), own, asked, most)
    search.tried += small.tried
    for one in found:
        terminal.line(in_words(one), "groups")
    return found


def _leaders(search: Search, selection: Selection) -> list[Trial]:
    """Return the fits of the effects that explained most beside the chosen ones: of names that contain one another one."""
    here = [s for s in selection.stages if set(s.before.terms) == set(selection.chosen.terms)]
    taken = [search.terms[t] for t in selection.chosen.terms]
    found: list[Trial] = []
    for trial in here[0].trials if here else ():
        term = search.terms[trial.terms[-1]]
        alike = any(
            term.effect == t.effect or term.effect in t.generalises or t.effect in term.generalises for t in taken
        )
        if not (term.depends_on or term.groupings or term.stores or term.kind in OPERATORS or alike):
            taken.append(term)
            found.append(trial)
    return found[:MOST_LEADERS]


def grouped_effects(effects: Sequence[Expression], found: Sequence[Grouping]) -> list[Expression]:
    """Return the effects, of which those that it pays for differ from group to group.

    Of one that was not accepted with one value for all, a rival that does as well differs, too: the search has to choose.
    """
    per = {g.effect: g.per for g in found if g.pays and g.effect}
    for best in (g for g in found if g.pays and not g.accepted):
        rivals = [g for g in found if g.effect and not g.accepted and g.per == best.per and g.gain > best.gain - TIE]
        per |= {g.effect: g.per for g in rivals[:MOST_GROUPED]}
    return [replace(e, per=per[e.name]) if e.name in per else e for e in effects]


def confirmed(found: Sequence[Grouping], search: Search, chosen: Trial) -> list[Grouping]:
    """Return what was found; of effects that pays which a search with it chose."""
    differ = {(search.terms[t].effect, g.by) for t in chosen.terms for g in search.terms[t].groupings}
    return [g if g.parameter else g._replace(pays=(g.effect, g.per) in differ) for g in found]


def in_words(one: Grouping) -> str:
    """Return what a search says of one grouping."""
    does = "pays" if one.pays else "does not pay"
    refused = ""
    if one.gain > ACCEPT and not one.pays:
        refused = ", but another grouping explains more" if one.gate is None else ", but not on held-out episodes"
        if one.gate is not None and one.gate.passed:
            refused = ", but a search with it chose otherwise"
    what = one.parameter or one.effect.replace("_", " ")
    return f"grouping {what} by {one.per} {does} ({one.gain:+.0f} nats{refused})"


def sentence_of(found: Sequence[Grouping]) -> str:
    """Return what a verdict says of grouping, of effects that were not accepted only where it pays; nothing without groups."""
    return "".join(f" {text[0].upper()}{text[1:]}." for text in (in_words(g) for g in found if g.accepted or g.pays))


def _name(effect: str, by: str) -> str:
    return f"{effect}_by_{by}"


def _small(
    search: Search,
    chosen: Trial,
    terms: Sequence[Term],
    every: Sequence[Expression],
    differing: Sequence[str],
    attach: Attach,
    options: Discovery,
) -> tuple[Search, Trial]:
    """Return a search over some terms and the same that differ, and in it the chosen model, whose terms come first."""
    kept = {(name, *key_of(t)[1:]) for t in terms for name in differing if name.startswith(f"{t.effect}_by_")}
    # with the whole catalogue, which says how much of the past is in front of a window
    plan = attach(effects=every, kept=kept, extra=terms)._replace(windows=search.plan.windows, spare=search.plan.spare)
    z = carried(search.plan, chosen.optimum.z, plan)
    settled = carried(search.plan, search.plan.start, plan)
    groups = max(sum(len(g.names) for g in t.groupings) for t in plan.augmented.terms)
    rows = sum(len(t.parameters) + sum(len(g.own) for g in t.groupings) for t in terms)
    small = small_search(plan._replace(start=settled), options.lanes, rows + groups * max(len(chosen.terms), 1))
    keys = [key_of(t) for t in small.terms]
    own = tuple(keys.index(key_of(search.terms[t])) for t in chosen.terms)
    return small, small.best(own, small.fitter([Hypothesis(z, small.free(own), small.ones)]))


def _added(small: Search, own: Trial, search: Search, leader: Trial) -> Trial:
    """Return the model with one of the effects that explained most, one value for all groups."""
    new = [key_of(t) for t in small.terms].index(key_of(search.terms[leader.terms[-1]]))
    terms, there = (*own.terms, new), carried(search.plan, leader.optimum.z, small.plan)
    here = own.optimum.z.copy()
    here[list(small.rows[new])] = there[list(small.rows[new])]
    starts = [here, small.loud(here), there] if own.terms == () else [here, small.loud(here)]
    return small.best(terms, small.fitter([Hypothesis(z, small.free(terms), small.ones) for z in starts]))


def _differing(small: Search, own: Trial, name: str, other: str) -> Trial:
    """Return the model in which the terms of one effect are those that differ."""
    keys = [key_of(t) for t in small.terms]
    swap: Mapping[int, int] = {t: keys.index((other, *keys[t][1:])) for t in own.terms if small.terms[t].effect == name}
    terms = tuple(swap.get(t, t) for t in own.terms)
    starts = []
    for spread in SPREADS:
        z = small.off(own.optimum.z, tuple(swap))
        for before, after in swap.items():
            z[list(small.rows[after])] = own.optimum.z[list(small.rows[before])]
            z[list(small.spreads_of[after])] = spread
        starts.append(Hypothesis(z, small.free(terms), small.ones))
    return small.best(terms, small.fitter(starts))
