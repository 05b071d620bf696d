"""The held-out gate: an effect must help on episodes that had no part in the choice of its parameters.

On a real rig, evidence alone named a friction with +79 nats while the held-out fit got worse: the gate is mandatory.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessment, Assessor, gain_interval, reduction_interval
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.measurements.windows import LEAST_EPISODES, Windows

AHEAD = {"one_step": "one row ahead", "ahead": "some rows ahead", "free": "in free run"}  # of an `Assessment`, in words
FEW = 10  # windows of a record: fewer cannot tell, and blocks of rows are held out
LEAST_BLOCKS = 20
LEAST_OF_BLOCK = 8  # rows
ORDINARY = 0.9  # of the blocks: larger gains and losses than these have are odd
MOST_FOLDS = 5
AMPLE = 2.0  # times the rows that a search looked at: so many that it left out
LEAST_PARTS = 8  # of which an error that falls can pass an effect
TOLERATED = {"one_step": 0.1, "ahead": 0.02, "free": 0.02}  # of an error: so much it may grow
SURE = 0.025  # chance that an error which does not grow is said to, over all channels and horizons together
RUNAWAY = 1e4  # nats that a window costs a model that ran away in it

Fits = Callable[[Sequence[Hypothesis]], Sequence[Optimum]]
Loud = Callable[[np.ndarray], np.ndarray]  # a start -> one with loud noise
Errors = Mapping[str, np.ndarray]  # by horizon, in words: (W, T, ny)


class Gate(NamedTuple):
    """Gain in held-out log-likelihood of one model over another.

    Args:
        gain: nats, summed over all held-out parts; of blocks, an odd one counts no more than the largest others.
        low, high: 95 % interval, by resampling episodes (or windows, where there are few episodes).
        unit: what was held out at a time.
        harm: whether an error grows: of any channel, at any horizon, certainly and by more than `TOLERATED`. A model that
            predicts the next row better and all others worse has learnt to follow. One row ahead the likelihood judges, too;
            there a model that follows what it cannot explain has small errors, and may lose some of that.
        passed: whether there is no harm, and the lower end is positive or, where the gain is what evidence would have to be,
            an error further ahead than one row certainly falls by more than `TOLERATED`, in `LEAST_PARTS` or more. What acts
            seldom, as an overflow does, gains much in few parts.
        grows: which errors grow, in words.
        falls: which errors further ahead fall so.
        leans: which errors further ahead than one row are more likely than not to grow by more than is tolerated.
    """

    gain: float
    low: float
    high: float
    unit: str
    harm: bool
    passed: bool
    grows: tuple[str, ...] = ()
    falls: tuple[str, ...] = ()
    leans: tuple[str, ...] = ()


def gates(search: Search, assessor: Assessor, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
    """Return what a model gains over others that lack a part of it, on episodes that they were not fitted to.

    All are refitted on all but a fold of the training episodes and score that fold, for every fold. Of a few long episodes
    windows are held out, and those that the search left out as well: no parameter has to be fitted again. Where these are
    `AMPLE`, they are enough.
    A model that is nearly right and very sure of it loses hundreds of nats on one odd episode. So the levels of the
    noise, which all models have, are fitted to the fold itself (not of a short record, whose blocks lie between others);
    parameters and effects are not.
    """
    trials = (whole, *parts)
    windows = search.plan.windows
    measured = search.plan.augmented.measured
    unit = "episode" if len(np.unique(windows.episode)) >= LEAST_EPISODES else "window"
    few = unit == "window" and search.plan.spare is None and len(windows.episode) < FEW
    blocks = _blocks(windows) if few else ()
    if len(blocks) > 1:
        likelihood, errors, named = _of_blocks(search, assessor, trials, np.array(blocks))
        runs = np.array([np.argwhere(block)[0, 0] for block in blocks])  # errors of a free run last over its blocks
        return [
            _judged(_tempered(likelihood[0] - likelihood[k]), errors[k], errors[0], measured, named, "block", runs)
            for k in range(1, len(trials))
        ]
    groups = windows.episode if unit == "episode" else np.arange(len(windows.episode))
    order = np.random.default_rng(0).permutation(np.unique(groups))
    # a single window cannot be held out: there is nothing else to fit to
    spare = search.plan.spare if unit == "window" else None
    enough = spare is not None and (spare.ok > 0).sum() >= AMPLE * (windows.ok > 0).sum()
    alone = enough or len(order) == 1
    folds = [] if alone else [np.isin(groups, p) for p in np.array_split(order, min(MOST_FOLDS, len(order)))]
    hypotheses = [Hypothesis(t.optimum.z, t.optimum.free, 1.0 - out) for out in folds for t in trials]
    found = _refitted(search.loud, search.fitter, hypotheses)
    # how loud the noise is says nothing about the effect: all models fit it anew on what was held out. What a group is that
    # was held out as a whole, only its own rows can tell, at the price that its population asks
    unseen = [_unseen(search, h.free, windows, h.weight > 0) for h in hypotheses]
    found = search.fitter(
        [
            # a group that begins at the common value is far off: with quiet noise its fit would creep
            Hypothesis(search.loud(o.z) if new else o.z, search.noise + tuple(new), 1 - hypothesis.weight)
            for o, hypothesis, new in zip(found, hypotheses, unseen, strict=True)
        ]
    )
    prices = [_prices(search, o, new, windows) for o, new in zip(found, unseen, strict=True)]
    scored = [
        (windows, out, groups[out], found[i * len(trials) : (i + 1) * len(trials)], prices[i * len(trials) :])
        for i, out in enumerate(folds)
    ]
    if spare is not None:
        of_noise = search.fitter.of_noise()
        for names, part, out in _batches(spare, len(groups)):
            fits = of_noise.on(part)([Hypothesis(t.optimum.z, search.noise, out.astype(float)) for t in trials])
            scored.append((part, out, len(groups) + names, fits, [np.zeros(len(out))] * len(trials)))
    if not scored:
        return [Gate(0.0, 0.0, 0.0, unit, harm=False, passed=False) for _ in parts]
    named = np.concatenate([names for _, _, names, _, _ in scored])
    likelihood, errors = [], []
    for k in range(len(trials)):
        found_by = [(assessor(fits[k].z, part), part, out, price[k]) for part, out, _, fits, price in scored]
        likelihood.append(np.concatenate([(_likelihood(a, part) - price)[out] for a, part, out, price in found_by]))
        errors.append({
            words: np.concatenate([getattr(a, name)[out] for a, _, out, _ in found_by]) for name, words in AHEAD.items()
        })  # fmt: skip
    return [
        _judged(likelihood[0] - likelihood[k], errors[k], errors[0], measured, named, unit)
        for k in range(1, len(trials))
    ]


def _refitted(loud: Loud, fitter: Fits, hypotheses: Sequence[Hypothesis]) -> list[Optimum]:
    """Fit models to a part of the rows, each from where it stands on all of them and from there with loud noise.

    Without some rows another optimum may be the best by a hundred nats: which one a fit comes to must not hang on where its
    first step happens to lead.
    """
    begun = [hypothesis._replace(z=loud(hypothesis.z)) for hypothesis in hypotheses]
    other = [i for i, (a, b) in enumerate(zip(hypotheses, begun, strict=True)) if not np.array_equal(a.z, b.z)]
    found = fitter([*hypotheses, *(begun[i] for i in other)])
    best = [*found[: len(hypotheses)]]
    for i, optimum in zip(other, found[len(hypotheses) :], strict=True):
        best[i] = max(best[i], optimum, key=lambda o: o.log_evidence)
    return best


def _of_blocks(
    search: Search, assessor: Assessor, trials: Sequence[Trial], blocks: np.ndarray
) -> tuple[list[np.ndarray], list[Errors], np.ndarray]:
    """Return log-likelihoods (B,) and errors of every trial on blocks of rows that it was not fitted to, and their numbers.

    A fit that lacks a quarter of a short record may lack the only step of an input. So blocks are held out that lie between
    others; the filter runs through them without looking, and predicts them with what it learnt elsewhere.

    Reference: Racine (2000), Consistent cross-validatory model-selection for dependent data (blocks).
    """
    windows = search.plan.windows
    fold = np.random.default_rng(0).permutation(len(blocks)) % MOST_FOLDS
    likelihood: list[np.ndarray] = [np.zeros(len(blocks)) for _ in trials]
    shape = len(blocks), *windows.y.shape[1:]
    errors: list[Errors] = [{words: np.full(shape, np.nan) for words in AHEAD.values()} for _ in trials]
    for k in range(MOST_FOLDS):
        out = blocks[fold == k].any(axis=0)
        fitter = search.fitter.on(windows._replace(ok=np.where(out[..., None], 0.0, windows.ok)))
        fits = _refitted(search.loud, fitter, [Hypothesis(t.optimum.z, t.optimum.free, search.ones) for t in trials])
        for i, fitted in enumerate(fits):
            found = assessor(fitted.z, windows)
            scores = score(found, windows)
            for b in np.flatnonzero(fold == k):
                w, rows = np.argwhere(blocks[b])[0, 0], blocks[b].any(axis=0)
                likelihood[i][b] = scores[w, rows].sum()
                for name, words in AHEAD.items():
                    errors[i][words][b, rows] = getattr(found, name)[w, rows]
    return likelihood, errors, np.arange(len(blocks))


def _tempered(gains: np.ndarray) -> np.ndarray:
    """Return gains of blocks, none of which counts more than what one in ten reaches.

    A model that is nearly right and very sure of it loses hundreds of nats on one odd block, such as one at rest. Of errors
    nothing is taken away: one that grows there is harm.
    """
    most = float(np.quantile(np.abs(gains), ORDINARY))
    return np.clip(gains, -most, most)


def _blocks(windows: Windows) -> list[np.ndarray]:
    """Cut windows into about `LEAST_BLOCKS` blocks of at least `LEAST_OF_BLOCK` rows each, (W, T) each."""
    count, rows = windows.ok.shape[:2]
    found = []
    for w in range(count):
        there = np.flatnonzero((windows.ok[w] > 0).any(axis=1))
        most = max(1, min(-(-LEAST_BLOCKS // count), len(there) // LEAST_OF_BLOCK))
        for part in np.array_split(there, most) if len(there) else []:
            block = np.zeros((count, rows), bool)
            block[w, part[0] : part[-1] + 1] = True
            found.append(block)
    return found


def score(found: Assessment, windows: Windows) -> np.ndarray:
    """Log-likelihood of every row, (W, T), far down where the model ran away."""
    ok = windows.ok > 0
    e, s = found.track.innovation, found.variance
    lost = (~np.isfinite(e) & ok).any(axis=2)
    terms = np.where(ok & np.isfinite(e), np.log(s) + e**2 / s, 0.0)
    return np.where(lost, -RUNAWAY, -0.5 * terms.sum(axis=2))


def _unseen(search: Search, free: Sequence[int], windows: Windows, kept: np.ndarray) -> dict[int, np.ndarray]:
    """Return which of the free unknowns are of groups without a window that is kept, with the windows of these groups."""
    found = {}
    for row, slot in search.slot_of.items():
        own = windows.u[:, -1, slot] == 1
        if row in free and own.any() and not (own & kept).any():
            found[row] = own
    return found


def _prices(search: Search, found: Optimum, unseen: Mapping[int, np.ndarray], windows: Windows) -> np.ndarray:
    """Return what windows of unseen groups pay for what they say of their group, nats (W,).

    log p(y_g) = log p(y_g | delta_g) - delta_g^2/2 + log(sd of delta_g), by Laplace.
    """
    price = np.zeros(len(windows.episode))
    coordinates = search.plan.coordinates
    for row, own in unseen.items():
        k, span = found.free.index(row), coordinates.high[row] - coordinates.low[row]
        at = coordinates.value(row, float(found.z[row]))
        log_sd = 0.5 * np.log(max(float(found.covariance[k, k]) * span**2, 1e-12))
        price[own] += (0.5 * at**2 - min(log_sd, 0.0)) / own.sum()
    return price


def _likelihood(found: Assessment, windows: Windows) -> np.ndarray:
    """Log-likelihood of every window, (W,); far down where the model ran away."""
    lost = (~np.isfinite(found.track.innovation) & (windows.ok > 0)).any(axis=(1, 2))
    return np.where(lost, -RUNAWAY, found.log_likelihood)


def _batches(windows: Windows, size: int) -> Iterator[tuple[np.ndarray, Windows, np.ndarray]]:
    """Cut windows into batches of one size, which share a program: names of those that count, the batch, which do."""
    count = len(windows.episode)
    for begin in range(0, count, size):
        rows = np.arange(begin, begin + size)
        counts = rows < count
        yield rows[counts], Windows(*(a[rows % count] for a in windows)), counts


def _judged(
    gains: np.ndarray,
    before: Errors,
    after: Errors,
    measured: Sequence[str],
    groups: np.ndarray,
    unit: str,
    runs: np.ndarray | None = None,
) -> Gate:
    """Judge gains (W,) and errors without and with an effect; groups: (W,), and of free runs `runs` where it is given."""
    per_group = np.array([gains[groups == name].sum() for name in np.unique(groups)])
    low, high = gain_interval(per_group, np.random.default_rng(1))
    of = dict.fromkeys(before, groups) | ({} if runs is None else {AHEAD["free"]: runs})
    grows = growing(before, after, measured, of)
    # of a few parts resampling says little: it may pass nothing
    further = [w for w in before if w != AHEAD["one_step"] and len(np.unique(of[w])) >= LEAST_PARTS]
    falls = growing({words: after[words] for words in further}, before, measured, of)
    total = float(gains.sum())
    helps = bool(low > 0) or (total > ACCEPT and bool(falls))
    ahead = [words for words in before if words != AHEAD["one_step"]]
    leans = growing({w: before[w] for w in ahead}, after, measured, of, sure=0.5)
    return Gate(total, low, high, unit, bool(grows), helps and not grows, grows, falls, leans)


def errors_of(found: Assessment) -> Errors:
    """Return the errors of a model by horizon."""
    return {words: getattr(found, name) for name, words in AHEAD.items()}


def growing(
    before: Errors, after: Errors, measured: Sequence[str], groups: np.ndarray | Mapping[str, np.ndarray],
    sure: float | None = None,
) -> tuple[str, ...]:  # fmt: skip
    """Return which errors grow by more than is tolerated, certainly: of what, and how far ahead.

    Args:
        before: errors of every measured channel without an effect, at every horizon.
        after: with it.
        measured: names of the channels, ny.
        groups: of which part each window is, (W,) or per channel (W, ny); or these by horizon.
        sure: chance that an error which does not grow is said to; None: `SURE` over all channels and horizons together.
    """
    of = groups if isinstance(groups, Mapping) else dict.fromkeys(before, groups)
    random = np.random.default_rng(1)
    found: dict[str, bool] = {}
    told = sum(int(np.isfinite(e).any(axis=(0, 1)).sum()) for e in before.values())
    most = {AHEAD[name]: 1 / (1 + tolerated) for name, tolerated in TOLERATED.items()}
    for words, error in before.items():
        level = 1 - 2 * (SURE / max(told, 1) if sure is None else sure)
        best = reduction_interval(error, after[words], of[words], random, level=level)[1]
        found |= {f"{name} {words}": value < most[words] for name, value in zip(measured, best, strict=False)}
    return tuple(words for words, grows in found.items() if grows)
