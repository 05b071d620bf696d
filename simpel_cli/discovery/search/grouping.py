"""Whether grouping pays: the chosen model, against the same model with an effect that differs from group to group.

Asked of every chosen effect and every column of the data that names groups, in a small program that has these terms alone, by
evidence (which pays for the spread) and on held-out episodes. Where it pays, the search is made once more with such an effect:
what one value for all groups left is no remainder then, nor noise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from simpel_cli.discovery.search.held_out_gate import Gate, gates
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.smaller import carried, small_search
from simpel_cli.discovery.search.trials import ACCEPT, SPREADS, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import MOST_GROUPED, Setup, key_of
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression

Attach = Callable[..., Setup]  # effects -> the setup of a program with the chosen terms and theirs


class Grouping(NamedTuple):
    """What it is worth that an effect differs from group to group.

    Args:
        effect: its name.
        per: column that names the groups.
        gain: in evidence, over one value for all of them, nats.
        gate: over the same; None: the evidence was not enough to ask it.
        pays: whether it earns its place, and held-out episodes agree.
    """

    effect: str
    per: str
    gain: float
    gate: Gate | None
    pays: bool


def groupings(
    search: Search,
    assessor: Assessor,
    chosen: Trial,
    effects: Sequence[Expression],
    attach: Attach,
    options: Discovery,
    terminal: Terminal,
) -> list[Grouping]:
    """Return what grouping each of the chosen effects is worth; nothing where no column names groups.

    What pays most is taken for given when the next effect is asked.

    Args:
        search: that was run.
        assessor: of errors ahead.
        chosen: the model that it ended with.
        effects: of the catalogue.
        attach: (effects, kept, extra) -> the setup of a program with these terms.
        options: of the search.
        terminal: takes lines.
    """
    columns = list(search.plan.augmented.model.groups)
    terms = [search.terms[t] for t in chosen.terms]
    alike = [e for e in effects if any(t.effect == e.name and not t.groupings for t in terms) and not e.operator]
    asked = {
        f"{e.name}_by_{by}": (e.name, by, replace(e, name=f"{e.name}_by_{by}", per=by)) for e in alike for by in columns
    }
    if not asked:
        return []
    terminal.line(f"does {' or '.join(e.name for e in alike)} differ by {' or '.join(columns)}", "groups")
    small, own = _small(search, chosen, effects, list(asked.values()), attach, options)
    judge = Assessor(small.plan, assessor.horizon)
    found: dict[str, Grouping] = {}
    left, taken = dict(asked), 0
    while left and taken < MOST_GROUPED:
        trials = {key: _differing(small, own, name, key) for key, (name, _, _) in left.items()}
        search.tried += len(trials)
        best = ""
        for key in sorted(trials, key=lambda key: -trials[key].optimum.log_evidence):
            gain = float(trials[key].optimum.log_evidence - own.optimum.log_evidence)
            gate = gates(small, judge, trials[key], [own])[0] if gain > ACCEPT and not best else None
            pays = gate is not None and gate.passed
            found[key] = Grouping(*asked[key][:2], gain, gate, pays)
            best = key if pays else best
        if not best:
            break
        own, taken = trials[best], taken + 1
        left = {key: each for key, each in left.items() if each[0] != left[best][0]}
    for one in found.values():
        terminal.line(in_words(one), "groups")
    return list(found.values())


def grouped_effects(effects: Sequence[Expression], found: Sequence[Grouping]) -> list[Expression]:
    """Return the effects, of which those that it pays for differ from group to group."""
    per = {g.effect: g.per for g in found if g.pays}
    return [replace(e, per=per[e.name]) if e.name in per else e for e in effects]


def confirmed(found: Sequence[Grouping], search: Search, chosen: Trial) -> list[Grouping]:
    """Return what was found; a grouping that a search with it did not choose does not pay."""
    differ = {search.terms[t].effect for t in chosen.terms if search.terms[t].groupings}
    return [g._replace(pays=g.pays and g.effect in differ) for g in found]


def in_words(one: Grouping) -> str:
    """Return what a search says of one grouping."""
    does = "pays" if one.pays else "does not pay"
    refused = ""
    if one.gain > ACCEPT and not one.pays:
        refused = ", but another grouping explains more" if one.gate is None else ", but not on held-out episodes"
        if one.gate is not None and one.gate.passed:
            refused = ", but a search with it chose otherwise"
    return f"grouping {one.effect.replace('_', ' ')} by {one.per} {does} ({one.gain:+.0f} nats{refused})"


def sentence_of(found: Sequence[Grouping]) -> str:
    """Return what a verdict says of grouping; nothing where no column names groups."""
    return "".join(f" {text[0].upper()}{text[1:]}." for text in map(in_words, found))


def _small(
    search: Search,
    chosen: Trial,
    effects: Sequence[Expression],
    asked: Sequence[tuple[str, str, Expression]],
    attach: Attach,
    options: Discovery,
) -> tuple[Search, Trial]:
    """Return a search over the chosen terms and the same that differ, and the chosen model in it."""
    own = [search.terms[t] for t in chosen.terms]
    kept = {(e.name, *key_of(t)[1:]) for t in own for name, _, e in asked if t.effect == name}
    # with the whole catalogue, which says how much of the past is in front of a window
    every = [*effects, *(e for _, _, e in asked)]
    plan = attach(effects=every, kept=kept, extra=own)._replace(windows=search.plan.windows, spare=search.plan.spare)
    z = carried(search.plan, chosen.optimum.z, plan)
    settled = carried(search.plan, search.plan.start, plan)
    groups = max(sum(len(g.names) for g in t.groupings) for t in plan.augmented.terms)
    room = sum(len(search.all_rows(t)) for t in chosen.terms) + groups * len(own)
    small = small_search(plan._replace(start=settled), options.lanes, room)
    keys = [key_of(t) for t in small.terms]
    terms = tuple(keys.index(key_of(t)) for t in own)
    return small, small.best(terms, small.fitter([Hypothesis(z, small.free(terms), small.ones)]))


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
