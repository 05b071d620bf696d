"""What these data say of the simulator's parameters and what they do not: combinations that can change and nobody would see.

With effects and noise refitted the parameters have the information

    S = F_pp - F_pe F_ee^-1 F_ep

in units of their ranges. Along an eigenvector of S below that of the ranges themselves, 12, the data add nothing to what was
declared. Of parameters with one sign the direction is one of their logarithms: where it has the components c_i, every p_i can
be multiplied by f^c_i for any f. Of two of them p_1^c_2 p_2^-c_1 is determined: of mass and spring it may be the ratio alone.

Reference: Cox and Hinkley (1974), Theoretical statistics, 9.3; Raue et al. (2009), Structural and practical identifiability.
"""

from typing import Any, NamedTuple

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.likelihood.steps import LEAST_CURVATURE
from simulators.groups import MEMBER, SPREAD

PART = 0.2  # of the largest component: smaller ones do not take part
WHOLE = 0.1  # by which an exponent may differ from a whole number


class Open(NamedTuple):
    """One combination that these data leave open.

    Args:
        move: parameter -> what it changes by, together with the others: in logarithms, or in its range where `logarithmic` is
            false; the largest is 1.
        logarithmic: whether all of them have one sign.
        information: of the data along it, in units of that of the ranges; below 1.
        alone: whether no other such combination has any of its parameters.
    """

    move: dict[str, float]
    logarithmic: bool
    information: float
    alone: bool = True

    @property
    def words(self) -> str:
        """What is not determined, and what of it is."""
        names = list(self.move)
        if len(names) == 1:
            return names[0]
        ways = [f"{n} {'up' if v > 0 else 'down'}" for n, v in self.move.items()]
        moves = f"{' with '.join(ways)}"
        if not self.logarithmic or len(names) != 2 or not self.alone:
            return moves
        first, second = self.move.values()
        least = min(abs(first), abs(second))
        between = "/" if first * second > 0 else "*"
        told = f"{names[0]}{_power(second / least)}{between}{names[1]}{_power(first / least)}"
        return f"{moves}: only {told} is determined"


def left_open(search: Search, chosen: Trial) -> list[Open]:
    """Return the combinations of the simulator's parameters that these data leave open, the least known first."""
    plan, optimum = search.plan, chosen.optimum
    params = plan.augmented.model.params
    rows = [i for i in optimum.free if i < len(params) and params[i].role not in (SPREAD, MEMBER)]
    if not rows or not np.isfinite(optimum.fisher).all():
        return []
    at = [optimum.free.index(i) for i in rows]
    others = [k for k in range(len(optimum.free)) if k not in at]
    # the curvature of a prior is what was declared, and no word of the data
    sd = np.asarray(plan.coordinates.sd_of_prior())[list(optimum.free)]
    fisher = optimum.fisher - np.diag(np.where(np.isfinite(sd), 1 / sd**2, 0.0))
    held = np.where(np.isfinite(sd[others]), 1 / sd[others] ** 2, LEAST_CURVATURE)
    between = fisher[np.ix_(others, others)] + np.diag(held)
    cross = fisher[np.ix_(at, others)]
    own = fisher[np.ix_(at, at)] - cross @ np.linalg.solve(between, cross.T)
    known = np.where(np.isfinite(sd[at]), 1 / sd[at] ** 2, LEAST_CURVATURE)
    scale = 1 / np.sqrt(known)
    values, vectors = np.linalg.eigh((own + own.T) / 2 * np.outer(scale, scale))
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= 1:
            break
        found.append(_open(plan, optimum.z, rows, vector * scale, float(max(value, 0.0))))
    return [one._replace(alone=not any(set(one.move) & set(o.move) for o in found if o is not one)) for one in found]


def sentence_of(found: list[dict[str, Any]]) -> str:
    """Return what a verdict says of parameters that its data leave open."""
    return f" These data do not determine {'; nor '.join(f['words'] for f in found)}." if found else ""


def _open(plan: Any, z: np.ndarray, rows: list[int], direction: np.ndarray, information: float) -> Open:
    coordinates, names = plan.coordinates, [q.name for q in plan.augmented.params]
    parts = {i: float(d) for i, d in zip(rows, direction, strict=True) if abs(d) > PART * np.abs(direction).max()}
    values = {i: coordinates.value(i, float(z[i])) for i in parts}
    spans = {i: coordinates.high[i] - coordinates.low[i] for i in parts}
    one_sign = all(coordinates.log[i] or _signed(plan.augmented.params[i]) for i in parts)
    move = {
        i: d * (spans[i] if coordinates.log[i] else spans[i] / values[i]) if one_sign else d for i, d in parts.items()
    }
    largest = max(move.values(), key=abs)
    return Open({names[i]: v / largest for i, v in move.items()}, one_sign, information)


def _signed(q: Any) -> bool:
    return bool(q.low > 0 or q.high < 0)


def _power(exponent: float) -> str:
    """Write an exponent; one that is nearly whole is taken for whole."""
    size, whole = abs(exponent), round(abs(exponent))
    size = whole if abs(size - whole) < WHOLE else size
    return "" if size == 1 else f"^{size:.2g}"
