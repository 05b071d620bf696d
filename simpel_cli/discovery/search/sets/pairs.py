"""Effects that pay only together.

Of a drag v|v| - a v a search by single effects sees little: each of the two looks like a part of the other, and neither earns
its place alone. So pairs are judged as sets: by what a score test promises for both at once, and the best of them are fitted.
"""

from itertools import combinations

import numpy as np

from simpel_cli.discovery.search.trials import PROMISING, Search, Trial, asked
from simpel_cli.filtering.likelihood.fit import Hypothesis

MOST = 30  # effects, by what they promise alone, of which all pairs are tried
FITTED = 4  # pairs


def together(search: Search, before: Trial) -> Trial | None:
    """Return a model with the two effects more that earn most together, or nothing where none of the fitted ones earns enough.

    Args:
        search: over sets of effects.
        before: a model to which no single effect could be added.
    """
    candidates = [t for t in search.candidates(before.terms) if not search.terms[t].depends_on]
    starts = search.starts(before, candidates)
    alone: dict[int, tuple[float, int]] = {}  # term -> what its best start promises, and where that stands
    for i, ((t, _), score) in enumerate(zip(starts, search.promises(before, starts), strict=True)):
        if score.switched_off and score.gain >= alone.get(t, (0.0, i))[0]:
            alone[t] = score.gain, i
    most = sorted(alone, key=lambda t: -alone[t][0])[:MOST]
    pairs = [pair for pair in combinations(most, 2) if search.fits((*before.terms, *pair))]
    sets = [(alone[a][1], alone[b][1]) for a, b in pairs]
    scores = search.promises(before, starts, sets)
    gains = [score.gain if np.isfinite(score.gain) else 0.0 for score in scores]
    # beside what one of them promises: a pair is more than its better half
    beside = [gain - max(alone[t][0] for t in pair) for gain, pair in zip(gains, pairs, strict=True)]
    going = [k for k in sorted(range(len(pairs)), key=lambda k: -gains[k]) if beside[k] > PROMISING][:FITTED]
    hypotheses = []
    for k in going:
        z = search.loud(before.optimum.z)
        for t, i in zip(pairs[k], sets[k], strict=True):
            rows = search.all_rows(t)
            z[rows] = starts[i][1].z[rows]
        hypotheses.append(Hypothesis(z, search.free((*before.terms, *pairs[k])), search.ones))
    search.tried += len(going)
    fits = search.fitter(hypotheses)
    trials = [search.best((*before.terms, *pairs[k]), [fit]) for k, fit in zip(going, fits, strict=True)]
    best = max(trials, key=lambda t: t.optimum.log_evidence, default=None)
    needed = sum(asked(len(before.terms) + k) for k in (1, 2))
    return best if best is not None and best.optimum.log_evidence - before.optimum.log_evidence > needed else None
