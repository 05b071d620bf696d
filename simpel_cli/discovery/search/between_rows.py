"""Whether an input is held from a row to the next, goes there straight or in a curve, where neither simulator nor data say.

All are the same program: an unknown place on the way from held over linear to smooth, which no fit moves. It is the first
hypothesis of all: half a row's shift of an input looks like a delay, a lag or a spring. And it is asked again of the model that
was chosen, since a missing effect may look like that shift. It takes every stage of every step an input of its own: it is asked
in a small program, and the whole one takes the answer as said.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.smaller import fitted_again, small_search
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.discovery.search.trials import asked as asked_for
from simpel_cli.dynamics.between_rows import WAY
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.setup import Setup, key_of, questions
from simulators.effects.term import BETWEEN_ROWS, DELAY, LAG, SENSOR_DELAY, SENSOR_LAG
from simulators.model import Model
from simulators.quantity import HELD, LINEAR, SMOOTH

MOVES = {LINEAR: "goes straight from a row to the next", SMOOTH: "is a smooth curve from row to row"}
LATE = (DELAY, LAG, SENSOR_DELAY, SENSOR_LAG)
AGAINST = {LINEAR: "held or smooth", SMOOTH: "held or linear"}


class Preference(NamedTuple):
    """What the data say of one input.

    Args:
        word: held, linear or smooth.
        gain: nats of evidence by which it is ahead of the next best; negative where another was ahead, but by too little to
            leave the usual assumption for it.
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
    """Compare held, linear and smooth inputs beside the effects that were chosen.

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
    """Compare held, linear and smooth inputs in one model, input by input, then all at once.

    What makes a signal late may be there for the half of a row by which a wrong way is off: each way may do without it.

    Args:
        search: with terms that ask.
        at: the model, fitted with the ways in `search.plan.start`.
    """
    late = [t for t in at.terms if search.terms[t].kind in LATE]
    gone = [(one,) for one in late] + ([tuple(late)] if len(late) > 1 else [])
    models = [at.terms, *(tuple(t for t in at.terms if t not in those) for those in gone)]
    price = [sum(asked_for(k + 1) for k in range(len(terms))) for terms in models]

    def worth(fits: Sequence[Optimum]) -> float:
        return max(float(np.nan_to_num(o.log_evidence, nan=-np.inf)) - p for o, p in zip(fits, price, strict=True))

    names = asked_inputs(search)
    rows = {t: search.rows[t][0] for t in names}
    best = {t: min(WAY, key=lambda word: abs(WAY[word] - search.plan.start[rows[t]])) for t in names}
    asked = [(t,) for t in names] + ([tuple(names)] if len(names) > 1 else [])
    usual = search.fitter([_said(search, at, {}, rows, terms) for terms in models[1:]]) if late else []
    evidence = {tuple(best.values()): worth([at.optimum, *usual])}
    choices = [LINEAR, HELD] if search.plan.clocked else [*WAY]  # a curve goes by whole rows
    while True:
        others = [best | dict.fromkeys(own, word) for own in asked for word in choices]
        said = [words for words in others if tuple(words.values()) not in evidence]
        begun = [_said(search, at, words, rows, terms) for words in said for terms in models]
        fits = search.fitter(begun) if begun else []
        for i, words in enumerate(said):
            evidence[tuple(words.values())] = worth(fits[i * len(models) : (i + 1) * len(models)])
        after = _better(best, others, evidence)
        if after == best:
            break
        best = after
    alone = {t: {word: evidence[tuple((best | {t: word}).values())] for word in choices} for t in names}
    return {names[t]: Preference(best[t], _ahead(alone[t], best[t])) for t in names}


Words = dict[int, str]


def _better(best: Words, others: Sequence[Words], evidence: Mapping[tuple[str, ...], float]) -> Words:
    """Return the words to take in place of the best so far, or these.

    To leave what is usual, or what was chosen, takes the evidence of an effect; so does a curve over a straight line.
    """
    worth = lambda words: evidence[tuple(words.values())]  # noqa: E731
    first = max(others, key=worth, default=best)
    if worth(first) <= worth(best) + ACCEPT:
        return best
    straight = {t: LINEAR if word == SMOOTH and best[t] != SMOOTH else word for t, word in first.items()}
    simpler = tuple(straight.values()) in evidence and worth(best) + ACCEPT < worth(straight)
    return straight if simpler and worth(first) <= worth(straight) + ACCEPT else first


def _ahead(compared: Mapping[str, float], word: str) -> float:
    """Return by how much a word is ahead of the next best."""
    return compared[word] - max(gain for other, gain in compared.items() if other != word)


def _said(
    search: Search, at: Trial, words: Mapping[int, str], rows: Mapping[int, int], terms: tuple[int, ...]
) -> Hypothesis:
    z = search.off(search.loud(at.optimum.z), [t for t in at.terms if t not in terms])
    for t, word in words.items():
        z[rows[t]] = WAY[word]
    return Hypothesis(z, search.free(terms), search.ones)


def settled(search: Search, words: Mapping[str, str]) -> np.ndarray:
    """Return `plan.start` with the ways that follow from words: held, linear or smooth, by input."""
    start = search.plan.start.copy()
    for t, name in asked_inputs(search).items():
        start[search.rows[t][0]] = WAY[words[name]]
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
    """Return what a verdict says of inputs that move between rows; nothing where all are held, as is usual."""
    moving = [f"{name} {MOVES[p.word]} (by {p.gain:.0f} nats, against {AGAINST[p.word]} between rows)"
              for name, p in found.items() if p.word in MOVES]  # fmt: skip
    return f" The input {' and '.join(moving)}." if moving else ""
