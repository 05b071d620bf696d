"""Large models: which terms get a place in the compiled program.

A compile grows with the number of unknown sizes: a car has several hundred. So the simulator is calibrated alone, and what
its smoothed latent force w leaves is regressed on what every term would add to the rates at the smoothed states:

    w_i = sum_k d(rate_i)/d(p_k) dp_k + a delta_i,    weight sqrt(dt)/q_i,    gain = 1/2 of what a takes off the squares

with the known parameters taken out of both sides first (Frisch and Waugh 1933). Delays, lags and sensors change no rate
and keep their place.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from simpel_cli.filtering.likelihood.augmented import Augmented, augment
from simpel_cli.filtering.likelihood.latent_force import Force
from simpel_cli.filtering.setup import Key, Setup, key_of
from simulators.effects import Term
from simulators.effects.term import OPERATORS, SENSOR

MOST_PARAMETERS = 160  # of a program with every term
NAMED, UNNAMED = 60, 24  # unknowns of named effects and of functions that are kept by their gain
HALF = 0.5  # of the places: what gains so much decides whether others will do
ROWS = 1000  # looked at
NUDGE = 1e-4  # of the range of a known parameter


def shortlist(
    plan: Setup,
    z: np.ndarray,
    force: Force,
    inputs: np.ndarray,
    terms: Sequence[Term],
    known: frozenset[Key] = frozenset(),
) -> frozenset[Key]:
    """Return the terms that are worth compiling: those that have a place already, where the better half is among them.

    Args:
        plan: of the simulator alone.
        z: its optimum.
        force: its latent force on the training windows.
        inputs: (W, T, nu) as they arrive.
        terms: all of them.
        known: terms that have a place in a program that is compiled.
    """
    gains = dict(zip(map(key_of, terms), _gains(plan, z, force, inputs, terms), strict=True))
    known = known & frozenset(gains)
    return known if known and _by_gain(gains, terms, HALF) <= known else _by_gain(gains, terms)


def _by_gain(gains: Mapping[Key, float], terms: Sequence[Term], share: float = 1.0) -> frozenset[Key]:
    """Return the terms that gain most, as far as a share of the places goes, and those of which the rates tell nothing."""
    kept = {key for key, gain in gains.items() if gain == np.inf}
    for named, places in ((True, NAMED), (False, UNNAMED)):
        capacity = share * places
        ranked = sorted((t for t in terms if bool(t.depends_on) is not named), key=lambda t: -gains[key_of(t)])
        for term in ranked:
            if key_of(term) not in kept and len(term.parameters) <= capacity:
                kept.add(key_of(term))
                capacity -= len(term.parameters)
    return frozenset(kept)


def _gains(plan: Setup, z: np.ndarray, force: Force, inputs: np.ndarray, terms: Sequence[Term]) -> list[float]:
    """Gain of every term, nats; inf where the rates cannot tell."""
    model, coordinates = plan.augmented.model, plan.coordinates
    augmented = augment(model, terms, plan.augmented.measured)
    n_p, n_r, _ = coordinates.sizes
    driven = list(coordinates.driven)
    q = np.array([coordinates.value(n_p + n_r + k, float(z[n_p + n_r + k])) for k in range(len(driven))])
    rows = np.isfinite(force.force[..., driven]).all(axis=-1) & (plan.windows.ok[:, :-1].max(axis=-1) > 0)
    chosen = np.argwhere(rows)
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, min(ROWS, len(chosen))).astype(int))]
    w, t = chosen[:, 0], chosen[:, 1]
    x, u = force.state[w, t].T, inputs[w, t].T
    weight = np.sqrt(model.dt) / q
    at = augmented.neutral.copy()
    at[: len(model.params)] = [coordinates.value(i, float(z[i])) for i in range(len(model.params))]

    everywhere = augmented.function.map("everywhere", "serial", x.shape[1], [2], [])  # one p for all points

    def rates(p: np.ndarray) -> np.ndarray:
        found = np.asarray(everywhere(x, u, p)[0])[driven]
        return np.nan_to_num((found * weight[:, None]).ravel(), posinf=0.0, neginf=0.0)

    still = rates(at)
    known = []
    for i, parameter in enumerate(model.params):
        p = at.copy()
        p[i] += NUDGE * (parameter.high - parameter.low)
        known.append((rates(p) - still) / NUDGE)
    basis = np.linalg.qr(np.array(known).T)[0] if known else np.zeros((len(still), 0))
    wanted = (force.force[w, t][:, driven] * weight).T.ravel()
    wanted = wanted - basis @ (basis.T @ wanted)
    found = []
    for term in terms:
        if term.groupings or term.kind in (*OPERATORS, SENSOR):
            found.append(np.inf)
            continue
        best = 0.0
        for columns in _columns(augmented, term, at, rates, still):
            columns = columns - basis @ (basis.T @ columns)
            explained = columns @ np.linalg.lstsq(columns, wanted, rcond=1e-10)[0]
            best = max(best, 0.5 * float(explained @ explained))
        found.append(best)
    return found


def _columns(augmented: Augmented, term: Term, at: np.ndarray, rates: Any, still: np.ndarray) -> Iterator[np.ndarray]:
    """Yield what a term adds to the rates, (rows, n): at each of its starts, or of a linear function for every weight."""
    place = augmented.rows(term)
    if term.depends_on:
        columns = []
        for row, parameter in zip(place, term.parameters, strict=True):
            p = at.copy()
            p[row] = parameter.high
            columns.append(rates(p) - still)
        yield np.array(columns).T
        return
    for s in range(max(len(parameter.starts) for parameter in term.parameters)):
        p = at.copy()
        p[place] = [parameter.starts[min(s, len(parameter.starts) - 1)] for parameter in term.parameters]
        yield (rates(p) - still)[:, None]
