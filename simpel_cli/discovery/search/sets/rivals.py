"""Which names do as well as the chosen ones, which do better, and which a function without a name makes superfluous."""

from collections.abc import Sequence

from simpel_cli.discovery.search.sets.selection import Selection, asked_for, nameless, weeded
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial, asked
from simpel_cli.filtering.likelihood.fit import Hypothesis

CERTAINLY = 10.0  # nats by which a name has to do better than another to take its place: with less they are a class
MOST = 0.9  # of what a function without a name explains: a formula that explains so much of it stays


def rivalled(search: Search, found: Selection) -> Selection:
    """Take out, one at a time, the effects that a function without a name makes superfluous; name the rivals of the rest.

    A name that does better in the place of another takes it: what explained most when an effect was added need not be what
    explains most beside those that came later.
    """
    every = found.chosen.terms
    without: Sequence[Trial] = [search.part(found.chosen, tuple(t for t in every if t != gone)) for gone in every]
    instead = found.instead
    left = {search.terms.index(found.remainder[0]): found.remainder[1]} if found.remainder else {}
    while True:
        chosen, classes = found.chosen, list[tuple[Trial, ...]]()
        superfluous: dict[int, int] = {}
        swapped: Trial | None = None
        for i, rest in enumerate(without):
            rivals = search.rivals(chosen, rest)
            classes.append(tuple(t for t in rivals if not nameless(search, t)))
            best = max(classes[-1], key=lambda t: t.optimum.log_evidence, default=chosen)
            if best.optimum.log_evidence > (swapped or chosen).optimum.log_evidence + (0 if swapped else CERTAINLY):
                swapped = best
            beaten = next((t for t in rivals if nameless(search, t)), None)
            if instead is not None and chosen.terms[i] not in instead.terms:
                beaten = instead
            whole = None if beaten is None else _beside(search, chosen, i, beaten, rest)
            if whole is not None:
                left[whole.terms[-1]] = whole.optimum.log_evidence - chosen.optimum.log_evidence
            elif beaten is not None:
                superfluous[i] = beaten.terms[-1]
        if swapped is not None:
            new, (old,) = search.terms[swapped.terms[-1]], set(chosen.terms) - set(swapped.terms)
            more = swapped.optimum.log_evidence - chosen.optimum.log_evidence
            search.report(f"{new.label} in place of {search.terms[old].label} +{more:.0f}")
            found, without = weeded(search, found._replace(chosen=swapped), range(len(chosen.terms)))
            left, instead = asked_for(search, found.chosen, left), None
            continue
        if not superfluous:
            break
        gone = min(superfluous, key=lambda i: found.gains[i])
        found, without = weeded(search, found, [i for i in range(len(chosen.terms)) if i != gone])
        left, instead = asked_for(search, found.chosen, {superfluous[gone], *left}), None
    most = max(left, key=lambda t: left[t], default=None)
    remainder = None if most is None or left[most] <= ACCEPT else (search.terms[most], float(left[most]))
    return found._replace(classes=tuple(classes), remainder=remainder, instead=None)


def _beside(search: Search, chosen: Trial, i: int, rival: Trial, without: Trial) -> Trial | None:
    """Return the chosen model and a function without a name, unless that makes effect i superfluous.

    A real friction is no formula: some function does better, and a formula may still be most of it: where it earns beside the
    function, or `MOST` of what the function earns in its place. Where the program has no room for both, the formula stays.
    """
    function, own = rival.terms[-1], chosen.terms[i]
    what, depends_on = search.terms[own].label, " and ".join(search.terms[function].depends_on)
    if not search.fits((*chosen.terms, function)):
        search.report(f"{what}: a function of {depends_on} does better; no room for both (discovery.room)")
        return rival
    terms = (*chosen.terms, function)
    starts = []
    for z, new, other in ((chosen.optimum.z, function, rival), (rival.optimum.z, own, chosen)):
        z = search.loud(z)
        rows = search.all_rows(new)
        z[rows] = other.optimum.z[rows]
        starts.append(Hypothesis(z, search.free(terms), search.ones))
    whole = search.best(terms, search.fitter(starts))
    rest = (*(t for t in chosen.terms if t != own), function)
    part = search.best(rest, search.fitter(search.less(whole, rest)))
    earned = whole.optimum.log_evidence - part.optimum.log_evidence
    own_gain, its_gain = (t.optimum.log_evidence - without.optimum.log_evidence for t in (chosen, rival))
    stays = earned >= asked(len(chosen.terms)) or own_gain >= MOST * its_gain
    search.report(
        f"{what} +{own_gain:.0f}: a function of {depends_on} does better, +{its_gain:.0f}"
        f"{f'; beside it +{earned:.0f}' if stays else ''}"
    )
    return whole if stays else None
