"""A search that is made once more, in other ranges or with other noise, begins with what the last one chose, too."""

from typing import NamedTuple

from simpel_cli.discovery.search.smaller import carried
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import key_of


class Earlier(NamedTuple):
    """What an earlier search has chosen."""

    search: Search
    chosen: Trial


def path_in(search: Search, base: Trial, earlier: Earlier) -> tuple[Trial, ...]:
    """Return fits from the calibrated simulator to the effects that an earlier search has chosen, as far as they are here.

    Args:
        search: in which they are fitted.
        base: its calibrated simulator.
        earlier: what was chosen there.
    """
    place = {key_of(term): t for t, term in enumerate(search.terms)}
    keys = [key_of(earlier.search.terms[t]) for t in earlier.chosen.terms]
    terms = tuple(place[key] for key in keys if key in place and place[key] not in search.banned)
    if not terms or not search.fits(terms):
        return ()
    z = search.loud(carried(earlier.search.plan, earlier.chosen.optimum.z, search.plan))
    sets = [terms[: k + 1] for k in range(len(terms))]
    starts = [Hypothesis(search.off(z, terms[k + 1 :]), search.free(here), search.ones) for k, here in enumerate(sets)]
    fits = search.fitter(starts)
    return (base, *(search.best(here, [fit]) for here, fit in zip(sets, fits, strict=True)))
