"""Which of the effects that a search has chosen are accepted on held-out episodes."""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from simpel_cli.discovery.search.again import Earlier, path_in, stages_in
from simpel_cli.discovery.search.gate.few_places import in_few_places
from simpel_cli.discovery.search.gate.harm import growing_for
from simpel_cli.discovery.search.gate.held_out import Gate, gates, score
from simpel_cli.discovery.search.gate.long_runs import gone_astray
from simpel_cli.discovery.search.near import far
from simpel_cli.discovery.search.sets.forward import condensed, further, selected, widely
from simpel_cli.discovery.search.sets.rivals import rivalled
from simpel_cli.discovery.search.sets.selection import Selection, cut, refused
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.discovery.search.unexplained.interactions import in_words, interaction
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.search.uses import ONE_STEP
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import Setup
from simpel_cli.runs.console import Terminal

STRONG = (
    20.0  # nats of evidence: an effect that earns so much may be uncertain on few held-out parts, if the set is not
)
CARRIED = 0.25  # of that evidence, which held-out parts have to bear out
MOST_SEARCHES = 3  # each goes on without the effects that did harm in those before

Answer = TypeVar("Answer")


def proposed(
    search: Search, assessor: Assessor, base: Trial, options: Discovery, begun: tuple[Trial, ...] = (), *,
    earlier: Earlier | None = None,
) -> Selection:  # fmt: skip
    """Search by evidence; where errors ahead stay far above the noise, effects begin anywhere in their ranges, too.

    Args:
        search: over sets of effects.
        assessor: of errors ahead.
        base: the calibrated simulator.
        options: of the search.
        begun: as of `selected`.
        earlier: a search that this one is made after, which has tried other beginnings.
    """
    if earlier is not None and (path := path_in(search, base, earlier)):
        found = selected(search, base, 0, path, settled=earlier.settled)
        return found._replace(stages=(*stages_in(search, earlier, path), *found.stages)) if earlier.settled else found
    selection = selected(search, base, options.beginnings, begun)
    return widely(search, selection) if far(search, assessor, selection.chosen) else selection


def judgement(
    search: Search, assessor: Assessor, selection: Selection, terminal: Terminal, use: str | float = ONE_STEP,
    ask: Callable[[Selection, bool], Answer | None] = lambda *_: None,
) -> tuple[Selection, list[Gate]] | Answer:  # fmt: skip
    """Judge what is proposed, and go on without an effect that does harm: another one may be what it stood for.

    Args:
        search: over sets of effects.
        assessor: of errors ahead.
        selection: what is proposed.
        terminal: takes lines.
        use: what the model will be calibrated for in the end.
        ask: whether something else has to be known first. Asked of whatever is judged, before that, and of what is left, if
            something was refused: it may have made up for a range, or have hidden heavy tails. Before another effect is looked
            for in its place it is asked without tails (False): what that effect explains looks like tails.

    Returns:
        what is left with its gates, all of which have been judged; or the first answer.
    """
    search_on = MOST_SEARCHES
    while True:
        if (answer := ask(selection, True)) is not None:
            return answer
        before, selection = selection.chosen.terms, condensed(search, selection)
        if selection.chosen.terms != before and (answer := ask(selection, True)) is not None:
            return answer
        proposal = selection.chosen.terms
        selection, found, harmful = gated_selection(search, assessor, selection, terminal, use)
        search_on -= 1
        if harmful and search_on and not search.budget.over("what an effect that did harm stood for"):
            if selection.chosen.terms != proposal and (answer := ask(selection, False)) is not None:
                return answer
            left, selection = selection, further(search, selection)
            if selection.chosen.terms != left.chosen.terms:
                continue
        answer = ask(selection, True) if selection.chosen.terms != proposal else None
        return (selection, found) if answer is None else answer


def accepted(
    search: Search, assessor: Assessor, selection: Selection, found: list[Gate], terminal: Terminal,
    use: str | float = ONE_STEP,
) -> tuple[Selection, list[Gate]]:  # fmt: skip
    """Name the rivals of what was judged.

    Where one does better, or a function without a name makes an effect superfluous, the others are judged again.

    Args:
        search: over sets of effects.
        assessor: of errors ahead.
        selection: what is left of what was proposed.
        found: its gates.
        terminal: takes lines.
        use: as of `judgement`.
    """
    while True:
        named = rivalled(search, selection)
        if named.chosen.terms == selection.chosen.terms:
            return named, found
        after, gates_after, _ = gated_selection(search, assessor, named, terminal, use)
        refused = {*named.chosen.terms} - {*selection.chosen.terms} - {*after.chosen.terms}
        if refused:  # what would have taken the place of another: that was accepted, and stays
            search.banned |= refused
            continue
        selection, found = after, gates_after
        if selection.chosen.terms == named.chosen.terms:
            return selection, found


def harmless(
    search: Search, assessor: Assessor, selection: Selection, found: list[Gate], runs: Windows, terminal: Terminal,
    use: str | float = ONE_STEP,
) -> tuple[Selection, list[Gate]]:  # fmt: skip
    """Return what is left without effects with which free runs of training rows surely grow, the worst first.

    Args:
        search: over sets of effects.
        assessor: of errors ahead.
        selection: what was accepted.
        found: its gates.
        runs: windows of training rows, long ones.
        terminal: takes lines.
        use: as of `judgement`.
    """
    while (astray := gone_astray(search, assessor, selection.chosen, runs, use)) is not None:
        gone = selection.chosen.terms[astray.place]
        label, times = search.terms[gone].label, f"{astray.times:.3g} times"
        terminal.line(f"{label}: the error of long free runs of {astray.channel} grows {times}: not accepted", "gate")
        search.banned.add(gone)
        selection, found, _ = gated_selection(search, assessor, refused(search, selection, astray.place), terminal, use)
    return selection, found


def gated_selection(
    search: Search, assessor: Assessor, selection: Selection, terminal: Terminal, use: str | float = ONE_STEP
) -> tuple[Selection, list[Gate], list[int]]:
    """Judge on held-out episodes what every effect adds to the others; of those that fail one goes at a time.

    Effects that are of use only together, as a delay and a slip, are judged together so. Of those that do harm the one goes
    that gains least on held-out episodes, and the others are judged without it: the harm may be its own. Of two that can stand
    for each other, neither of which gains for certain, the one with less evidence goes. Few held-out parts cannot tell of every
    member of a set whether it helps: one of strong evidence, of which they bear out a part, stays where the set surely helps,
    unless its evidence comes from a few places of the recording, or an error is more likely than not to grow. One that helps
    for certain, but by less than an effect has to earn, goes where it gains in a few places: one outlier is enough for that.
    And where others fall with one that was not certain, and gains in more places, they stay together if together they
    surely help beside what is left: an overflow may do harm without the outflow that belongs to it.
    Where a use is named, harm is what is left of it with both models calibrated for that.

    Returns:
        what is left of the selection, its gates, and the terms with which an error grows.
    """
    harmful: list[int] = []
    whole: tuple[Selection, list[Gate]] | None = None
    while selection.chosen.terms:
        chosen = selection.chosen
        parts = [search.part(chosen, tuple(t for t in chosen.terms if t != gone)) for gone in chosen.terms]
        question = "judged", chosen.terms, *(trial.optimum.z.tobytes() for trial in (chosen, *parts))
        judged = [*search.once(question, partial(gates, search, assessor, chosen, parts))]
        for i, (part, found) in enumerate(zip(parts, judged, strict=True)):
            if found.harm and found.low > 0 and use != ONE_STEP and not search.budget.over("harm for the use"):
                asked = "harm", use, chosen.terms, part.terms, chosen.optimum.z.tobytes(), part.optimum.z.tobytes()
                grows = search.once(asked, partial(growing_for, search, assessor, chosen, part, use))
                harmless = grows is not None and not grows
                judged[i] = found._replace(harm=not harmless, passed=harmless, grows=() if harmless else found.grows)
            # of one episode in which it gains, resampling finds one that surely does
            narrow = judged[i].passed and 0 < judged[i].low < ACCEPT
            if narrow and _of_outliers(search, assessor, chosen, part):
                judged[i] = judged[i]._replace(passed=False)
        failed = [i for i, found in enumerate(judged) if not found.passed]
        earned = {i: selection.gains[i] for i in failed if not judged[i].harm and selection.gains[i] > STRONG}
        acts = {i for i in earned if len(parts) > 1 and not _of_outliers(search, assessor, chosen, parts[i])}
        helps = {i for i in acts if not judged[i].leans and judged[i].gain > CARRIED * earned[i]}
        if failed and helps.issuperset(failed):
            (beside_none,) = gates(search, assessor, chosen, [selection.base])
            failed = [] if beside_none.passed else failed
        strong = all(i in acts and judged[i].gain > 0 for i in failed)
        if whole is None and not harmful and failed and strong:
            whole = selection, judged
        harm = [i for i in failed if judged[i].harm]
        gone = min(harm or failed, key=lambda i: judged[i].gain if harm else selection.gains[i], default=None)
        for i, (term, found) in enumerate(zip(chosen.terms, judged, strict=True)):
            _report_gate(search.terms[term].label, found, terminal, out=i == gone)
        if gone is None:
            break
        if judged[gone].harm:
            harmful.append(chosen.terms[gone])
            search.banned.add(chosen.terms[gone])  # nor is it another name for what stays
        selection = refused(search, selection, gone)
    if whole is not None and len(selection.chosen.terms) < len(whole[0].chosen.terms) - 1:
        (together,) = gates(search, assessor, whole[0].chosen, [selection.chosen])
        _report_gate("all of these together", together, terminal, out=not together.passed)
        if together.passed:
            search.banned -= set(harmful)
            return *whole, []
    return selection, judged if selection.chosen.terms else [], harmful


def _of_outliers(search: Search, assessor: Assessor, chosen: Trial, part: Trial) -> bool:
    """Whether a model gains over another in a few places alone of the rows that both were fitted to.

    Both with the noise of the first: that of the other makes up for an outlier, so that every row would gain a little.
    """
    z = part.optimum.z.copy()
    z[list(search.noise)] = chosen.optimum.z[list(search.noise)]
    same = Trial(part.terms, part.optimum._replace(z=z))
    return in_few_places(_by_row(search, assessor, chosen) - _by_row(search, assessor, same), STRONG)


def _by_row(search: Search, assessor: Assessor, trial: Trial) -> np.ndarray:
    """Return the log-likelihood of every row that a model was fitted to, (W, T)."""
    windows = search.plan.windows
    asked = "by row", trial.terms, trial.optimum.z.tobytes()
    return search.once(asked, lambda: score(assessor(trial.optimum.z, windows), windows))


def with_interactions(
    levels: NoiseProfile,
    alone: NoiseProfile,
    selection: Selection,
    judged: list[Gate],
    attach: Callable[..., Setup],
    options: Discovery,
    terminal: Terminal,
) -> tuple[Selection, list[Gate]]:
    """Look once more whether what is left is a function of two arguments, or a parameter that depends on one."""
    known = selection.remainder[1] if selection.remainder else 0.0
    report = lambda text: terminal.line(text, "search")  # noqa: E731
    found = interaction(levels, alone, attach, options.lanes, report, known)
    if found is None:
        return selection, judged
    _report_gate(
        f"{in_words(found.term)} +{found.gain:.0f}",
        found.gate,
        terminal,
        out=not found.gate.passed,
    )
    if not found.gate.passed:
        return selection, judged
    gone = [levels.search.terms[t].label for i, t in enumerate(selection.chosen.terms) if i not in found.kept]
    if gone:
        report(f"beside it {' and '.join(gone)} is not needed")
        selection = cut(levels.search, selection, found.kept)
        judged = [judged[i] for i in found.kept]
    return selection._replace(remainder=(found.term, found.gain)), judged


def _report_gate(what: str, judged: Gate, terminal: Terminal, *, out: bool) -> None:
    instead = f", the error of {judged.falls[0]} falls" if judged.falls and judged.low <= 0 else ""
    why = instead if judged.passed else f", the error of {judged.grows[0]} grows" if judged.grows else ", not certain"
    terminal.line(
        f"{what}: held-out gain {judged.gain:.0f} ({judged.low:.0f}..{judged.high:.0f}) nats"
        f" by {judged.unit}{why}{': not accepted' if out else ''}",
        "gate",
    )
