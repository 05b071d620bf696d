"""The episode that distinguishes tied causes: the one whose least expected log-likelihood ratio is the largest.

    max over admissible episodes of min over ordered pairs (i, j) of the class of min(D_ij, d_ij)    (see `discriminate`)

Admissible are inputs within their declared ranges, starts that the data cover, and states that stay within their
declared ranges under every member. Families that a person can run are tried first, then neighbours of the best.

Reference: Atkinson and Fedorov (1975), Optimal design: experiments for discriminating between several models.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from simpel_cli.discovery.next_experiment.candidates import (
    Proposal,
    neighbours,
    proposals,
    reach_of,
    rows_of,
    signal,
)
from simpel_cli.discovery.next_experiment.discrimination import Forecast, Members, forecast
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import TIE, Search, Trial
from simpel_cli.discovery.verdict.aliases import are_aliases
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.runs.files import write_text
from simulators.quantity import HIDDEN, Quantity

FILE = "next_experiment.csv"
LOUDER = (1.0, 1.5, 2.5, 5.0, 15.0, 100.0)  # factors on the process noise that a member may have
BATCH = 32  # episodes per call of the compiled program
WIDE, NEAR = 2, 3  # calls over the families, and near the best
KEPT = 4  # episodes whose neighbours are tried
MOST = 6  # members
ENOUGH = 30.0  # nats of a pair beyond which more are not rewarded
HOPELESS = 0.1  # nats: below, repeating the episode is not advised
Pair = tuple[int, int]


class Class(NamedTuple):
    """Fits that do equally well, and which of them are to be distinguished."""

    trials: tuple[Trial, ...]
    names: tuple[str, ...]
    pairs: tuple[Pair, ...]  # ordered: (true, compared with)


class Design(NamedTuple):
    """One evaluated episode.

    Args:
        proposal: what to do.
        inputs: (T, nu).
        ratio: (M, M) expected log-likelihood ratios, nats.
        mean: (M, T, ny) predicted measurements.
        least: of the ratios of all pairs.
        score: by which designs are ranked.
    """

    proposal: Proposal
    inputs: np.ndarray
    ratio: np.ndarray
    mean: np.ndarray
    least: float
    score: float


def next_experiment(search: Search, selection: Selection, directory: Path) -> dict[str, Any] | None:
    """Design the experiment, write it as CSV and return what the verdict says of it; None where nothing is tied.

    Args:
        search: that was run.
        selection: what it chose.
        directory: of the run.
    """
    tied = class_of(search, selection)
    if not tied.pairs:
        return None
    return designed(search, tied, directory / FILE)


def designed(search: Search, tied: Class, file: Path) -> dict[str, Any]:
    """Find the episode that distinguishes the members of a class, write it as CSV and return what the verdict says of it."""
    best = Designer(search, tied).best()
    if best is None:
        names = " and ".join(_words(n) for n in tied.names)
        text = f"No episode was found that distinguishes {names} and keeps all states within their declared ranges."
        nothing: dict[str, Any] = {"file": None, "start": None, "kind": None, "seconds": 0.0, "units": {}, "pairs": []}
        return nothing | {"expected_log_likelihood_ratio": 0.0, "description": text}
    found = _verdict(search, tied, best, file.name)
    write_text(file, _csv(search, tied, best, found))
    return found


def class_of(search: Search, selection: Selection) -> Class:
    """Return the members of every class of more than one distinguishable name; the chosen model is in all of them."""
    terms = search.terms
    trials, names, pairs = [selection.chosen], [], []
    for chosen, rivals in zip(selection.chosen.terms, selection.classes, strict=True):
        others: dict[str, Trial] = {}
        for trial in rivals:
            term = terms[trial.terms[-1]]
            if term.effect != terms[chosen].effect:
                others.setdefault(term.effect, trial)
        group = [(0, chosen)]
        for trial in list(others.values())[: MOST - len(trials)]:
            group.append((len(trials), trial.terms[-1]))
            trials.append(trial)
        own = [
            (i, j)
            for i, first in group
            for j, second in group
            if i != j
            and terms[first].effect not in terms[second].same_as
            and terms[second].effect not in terms[first].same_as
            and not are_aliases(search, selection.chosen, (first, trials[i]), (second, trials[j]))
        ]
        if own:
            names.append(terms[chosen].effect)
            pairs += own
    labels = ["_and_".join(names)] + [terms[t.terms[-1]].effect for t in trials[1:]]
    used = sorted({i for pair in pairs for i in pair})
    new = {old: k for k, old in enumerate(used)}
    return Class(
        tuple(trials[i] for i in used), tuple(labels[i] for i in used), tuple((new[i], new[j]) for i, j in pairs)
    )


class Designer:
    """Evaluates episodes for one class; one compiled program."""

    def __init__(self, search: Search, tied: Class) -> None:
        plan = search.plan
        self.plan, self.tied = plan, tied
        self.reach, self.rows = reach_of(plan), rows_of(plan)
        self.model = plan.augmented.model
        self.members = members_of(search, tied.trials)
        periodic = {q.name for q in self.model.states if q.periodic}
        self.wraps = np.array([name in periodic for name in plan.augmented.measured])
        self._program = jax.jit(partial(forecast, plan.rule, rows=self.rows, dt=self.model.dt))
        self.tried = 0

    def best(self) -> Design | None:
        """Search: all families, then neighbours of the best."""
        random = np.random.default_rng(0)
        wide = proposals(self.reach, len(self.model.inputs), WIDE * BATCH, random)
        designs: list[Design] = []
        for k in range(WIDE):
            designs += self(wide[k * BATCH : (k + 1) * BATCH])
        for _ in range(NEAR):
            designs = sorted(designs, key=lambda d: -d.score)[:KEPT]
            if not designs:
                return None
            designs += self(neighbours([d.proposal for d in designs], self.reach, BATCH, random))
        return max(designs, key=lambda d: d.score, default=None)

    def __call__(self, episodes: Sequence[Proposal]) -> list[Design]:
        """Evaluate at most BATCH episodes; those that are not admissible are left out."""
        self.tried += len(episodes)
        inputs = [signal(e, self.model.inputs, self.rows, self.model.dt) for e in episodes]
        for j, q in enumerate(self.model.inputs):
            if q.name in self.model.covariates:  # a payload stays what it is for an episode
                for u in inputs:
                    u[:, j] = q.middle
        padded = [*range(len(episodes)), *[0] * (BATCH - len(episodes))]
        u = np.stack([np.concatenate([np.repeat(inputs[i][:1], self.plan.lead, axis=0), inputs[i]]) for i in padded])
        start = np.stack([episodes[i].start for i in padded])
        spread = self.plan.windows.spread[0]
        given = (u, start, spread, np.zeros_like(spread), self.wraps)
        forecast: Forecast = self._program(self.members, *(jnp.asarray(a) for a in given))
        ratio, distance, mean, states, finite = (np.asarray(a) for a in forecast)
        fine = finite & self._inside(states)
        ratio = np.minimum(ratio, distance)  # a difference in the noise alone does not count
        pairs = tuple(np.array(self.tied.pairs).T)
        designs = []
        for i, episode in enumerate(episodes):
            if fine[i]:
                ratios = ratio[i][pairs]
                # if the least pair is equal, the other pairs decide
                score = ratios.min() + 0.01 * np.minimum(ratios, ENOUGH).mean()
                designs.append(Design(episode, inputs[i], ratio[i], mean[i], float(ratios.min()), float(score)))
        return designs

    def _inside(self, states: np.ndarray) -> np.ndarray:
        """Whether all states of each episode stay within their declared ranges under every member."""
        low, high = (np.array([getattr(q, end) for q in self.model.states]) for end in ("low", "high"))
        turns = np.array([q.periodic for q in self.model.states])
        slack = 1e-9 * (high - low)
        inside = (states >= low - slack) & (states <= high + slack) | turns
        return inside.all(axis=(1, 2, 3))


def members_of(search: Search, trials: Sequence[Trial]) -> Members:
    """Return fitted models with the principal directions of their parameters' posterior and louder process noise."""
    coordinates = search.plan.coordinates
    n_p, n_r, n_q = coordinates.sizes
    q_rows = np.arange(n_p + n_r, n_p + n_r + n_q)
    louder = np.zeros((len(LOUDER), len(coordinates.low)))
    louder[:, q_rows] = np.log(LOUDER)[:, None] / (coordinates.high - coordinates.low)[q_rows]
    most = max(sum(row < n_p for row in t.optimum.free) for t in trials)
    points, levels, hypotheses = [], [], []
    for trial in trials:
        z, free = trial.optimum.z, np.array(trial.optimum.free)
        own = np.flatnonzero(free < n_p)
        values, vectors = np.linalg.eigh(trial.optimum.covariance[np.ix_(own, own)])
        directions = np.zeros((most, len(z)))
        directions[: len(own), free[own]] = (vectors * np.sqrt(np.maximum(values, 0.0))).T
        # a secant over one standard deviation to each side, inside the bounds: the posterior ends there
        points.append(np.clip(np.concatenate([z[None], z + directions, z - directions]), 0.0, 1.0))
        levels.append(np.clip(z + louder, 0.0, 1.0))
        hypotheses += [Hypothesis(level, trial.optimum.free, search.ones) for level in levels[-1]]
    p = jax.vmap(jax.vmap(lambda z: coordinates.physical(z)[0]))(jnp.asarray(np.stack(points)))
    noise = jax.vmap(jax.vmap(lambda z: coordinates.physical(z)[1]))(jnp.asarray(np.stack(levels)))
    losses = np.array([o.loss for o in search.fitter(hypotheses, 1)]).reshape(len(trials), -1)
    weight = losses.min(axis=1, keepdims=True) - losses
    weight = weight - np.log(np.exp(weight).sum(axis=1, keepdims=True))
    return Members(p, noise.r[:, 0], noise.q, jnp.asarray(weight))


def _verdict(search: Search, tied: Class, best: Design, file: str) -> dict[str, Any]:
    model = search.plan.augmented.model
    start = {q.name: float(v) for q, v in _begins(search, best)}
    pairs = [
        {"true": tied.names[i], "against": tied.names[j], "expected_log_likelihood_ratio": float(best.ratio[i, j])}
        for i, j in tied.pairs
    ]
    found = {
        "file": file,
        "start": start,
        "kind": best.proposal.kind,
        "seconds": len(best.inputs) * model.dt,
        "units": {q.name: q.unit for q in (*model.states, *model.inputs, *model.outputs)},
        "expected_log_likelihood_ratio": best.least,
        "pairs": pairs,
    }
    return found | {"description": _sentence(search, tied, best, file)}


def _begins(search: Search, best: Design) -> list[tuple[Quantity, float]]:
    """Return the states that an experimenter can set, with where they begin: not those that effects bring along."""
    both = zip(search.plan.augmented.model.states, best.proposal.start, strict=True)
    return [(q, float(v)) for q, v in both if q.role != HIDDEN]


def _sentence(search: Search, tied: Class, best: Design, file: str) -> str:
    """Return what to do, for how long, and the expected gain in log evidence."""
    model = search.plan.augmented.model
    seconds = f"{len(best.inputs) * model.dt:.3g} s"
    start = ", ".join(f"{q.name} = {_short(v)} {q.unit}".removesuffix(" 1").rstrip() for q, v in _begins(search, best))
    spans = ", ".join(
        f"{q.name} within {_short(u.min())}..{_short(u.max())} {q.unit}".rstrip()
        for q, u in zip(model.inputs, best.inputs.T, strict=True)
    )
    i, j = min(tied.pairs, key=lambda pair: best.ratio[pair])
    names = f"{_words(tied.names[i])} and {_words(tied.names[j])}"
    others = " (more for any other pair)" if len(tied.names) > 2 else ""
    doing = f"the {seconds} {best.proposal.kind} of {file} from {start}" + (f" ({spans})" if spans else "")
    if best.least >= TIE:
        return f"Run {doing}. Expected gain in log evidence between {names}: {best.least:.0f} nats{others}."
    least = max(best.least, 0.0)
    advice = (
        f"repeat it {int(np.ceil(TIE / least))} times, or lower the measurement noise"
        if least > HOPELESS
        else "repeating it would not help; lower the measurement noise, widen the ranges, or measure something else"
    )
    return (
        f"No admissible experiment of {seconds} was found that distinguishes {names}. The best, {doing}, has an expected "
        f"gain in log evidence of {least:.1f} nats: {advice}."
    )


def _csv(search: Search, tied: Class, best: Design, found: dict[str, Any]) -> str:
    """Return the episode as CSV: time, inputs, and the measurements that each member predicts."""
    model, measured = search.plan.augmented.model, search.plan.augmented.measured
    units = {q.name: q.unit for q in (*model.states, *model.inputs)}
    columns: dict[str, np.ndarray] = {"time": np.round(np.arange(len(best.inputs)) * model.dt, 9)}
    columns |= {q.name: best.inputs[:, k] for k, q in enumerate(model.inputs)}
    periodic = {q.name for q in model.states if q.periodic}
    for i, name in enumerate(tied.names):
        for k, channel in enumerate(measured):
            mean = best.mean[i, :, k] + 0.0  # no -0
            columns[f"{channel}_if_{name}"] = np.unwrap(mean) if channel in periodic else mean
    start = ", ".join(f"{n} = {v!r} {units[n]}".rstrip() for n, v in found["start"].items())
    notes = [
        found["description"],
        f"start: {start}",
        "inputs are held constant until the next row; <channel>_if_<effect> is the predicted measurement without noise",
    ]
    return "".join(f"# {line}\n" for line in notes) + pd.DataFrame(columns).to_csv(index=False)


def _short(value: float) -> str:
    return f"{value + 0.0:.3g}"


def _words(name: str) -> str:
    return name.replace("_", " ")
