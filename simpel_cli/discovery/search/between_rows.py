"""Whether an input is held from a row to the next or goes there in a straight line, where neither simulator nor data say.

Both are the same program: an unknown share of the way, at 0 or at 1, which no fit moves. It is the first hypothesis of all:
half a row's shift of an input looks like a delay, a lag or a spring. And it is asked again of the model that was chosen, since
a missing effect may look like that shift. A share takes every stage of every step an input of its own: it is asked in a small
program, and the whole one takes the answer as said.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.smaller import fitted_again, small_search
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import Setup, key_of, questions
from simulators.effects.term import BETWEEN_ROWS
from simulators.model import Model

HELD, LINEAR = "held", "linear"


class Preference(NamedTuple):
    """What the data say of one input.

    Args:
        word: held or linear.
        gain: nats of evidence by which it is ahead of the other; negative where linear was ahead, but by too little to leave
            the usual assumption for it.
    """

    word: str
    gain: float


def asked_inputs(search: Search) -> dict[int, str]:
    """Return the terms that ask, with their inputs."""
    return {i: t.acts_on for i, t in enumerate(search.terms) if t.kind == BETWEEN_ROWS}


def saying(model: Model, found: dict[str, Preference]) -> Model:
    """Return the simulator that says what was found."""
    return replace(model, between_rows=model.between_rows | words_of(found))


def asked_beside(
    attach: Callable[..., Setup], model: Model, search: Search, chosen: Trial, side_by_side: int
) -> dict[str, Preference]:
    """Compare held and linear inputs beside the effects that were chosen.

    Args:
        attach: (model, kept, extra) -> the setup of a program with these terms alone.
        model: as it was declared.
        search: in which the model was chosen.
        chosen: it.
        side_by_side: fits that run side by side.
    """
    kept = frozenset(key_of(search.terms[t]) for t in chosen.terms)
    plan = attach(model, kept=kept, extra=questions(model))._replace(windows=search.plan.windows)
    small = small_search(plan, side_by_side, sum(len(search.all_rows(t)) for t in chosen.terms))
    small.plan = plan._replace(start=settled(small, search.plan.augmented.model.between_rows))
    return preferences(small, fitted_again(small, search, chosen))


def preferences(search: Search, at: Trial) -> dict[str, Preference]:
    """Compare held and linear inputs in one model, input by input, then all at once.

    Args:
        search: with terms that ask.
        at: the model, fitted with the shares in `search.plan.start`.
    """
    names = asked_inputs(search)
    rows = {t: search.rows[t][0] for t in names}
    said = {t: bool(search.plan.start[rows[t]] > 0.5) for t in names}
    best, evidence, alone = dict(said), at.optimum.log_evidence, {}
    sets = [[t] for t in names] + ([[*names]] if len(names) > 1 else [])
    while sets:
        fits = search.fitter([_flipped(search, at, [rows[t] for t in own], best, rows) for own in sets])
        gains = [float(np.nan_to_num(f.log_evidence - evidence, nan=-np.inf)) for f in fits]
        for own, gain in zip(sets, gains, strict=True):
            if len(own) == 1:
                alone[own[0]] = (not best[own[0]], gain)
        first = int(np.argmax(gains))
        # to leave what is usual, or what was chosen, takes the evidence of an effect
        if gains[first] <= ACCEPT:
            break
        best |= {t: not best[t] for t in sets[first]}
        evidence += gains[first]
        sets = [own for own in sets if not set(own) & set(sets[first])]
    found = {}
    for t, name in names.items():
        other, gain = alone[t]
        found[name] = Preference(LINEAR if best[t] else HELD, gain if other == best[t] else -gain)
    return found


def _flipped(
    search: Search, at: Trial, flipped: Sequence[int], best: dict[int, bool], rows: dict[int, int]
) -> Hypothesis:
    z = search.loud(at.optimum.z)
    for t, linear in best.items():
        z[rows[t]] = float(linear != (rows[t] in flipped))
    return Hypothesis(z, search.free(at.terms), search.ones)


def settled(search: Search, words: Mapping[str, str]) -> np.ndarray:
    """Return `plan.start` with the shares that follow from words: held or linear, by input."""
    start = search.plan.start.copy()
    for t, name in asked_inputs(search).items():
        start[search.rows[t][0]] = float(words[name] == LINEAR)
    return start


def in_words(found: dict[str, Preference]) -> str:
    """Return what was found in a line."""
    return "; ".join(
        f"{name} {p.word} between rows, by {p.gain:.1f} nats" if p.gain > ACCEPT
        else f"{name} {p.word} between rows: the data do not tell ({p.gain:+.1f} nats)"
        for name, p in found.items()
    )  # fmt: skip


def words_of(found: dict[str, Preference]) -> dict[str, str]:
    """Return the words alone."""
    return {name: p.word for name, p in found.items()}


def sentence_of(found: dict[str, Preference]) -> str:
    """Return what a verdict says of linear inputs; nothing where all are held, as is usual."""
    linear = [f"{name} goes straight from a row to the next (by {p.gain:.0f} nats, against held between rows)"
              for name, p in found.items() if p.word == LINEAR]  # fmt: skip
    return f" The input {' and '.join(linear)}." if linear else ""
