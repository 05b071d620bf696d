"""What a verdict says of parameters that differ from group to group: the common value, the spread, a value per group."""

from typing import Any, NamedTuple

import numpy as np

from simpel_cli.discovery.search.by_group.spreads import known
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simulators.groups import Grouping, groupings

DRAWS = 4000  # of the posterior, for the interval of a value per group
Z90 = 1.6448536269514722


class Differing(NamedTuple):
    """A parameter that differs in a fit.

    Args:
        how: it does.
        label: of the parameter, as its simulator or its effect calls it.
        effect: whose it is; empty: the simulator's own.
        place: where the effect acts.
        row: of the common value.
        spread: row.
        members: rows of what the groups are, those that were trained on.
    """

    how: Grouping
    label: str
    effect: str
    place: str
    row: int
    spread: int
    members: tuple[int, ...]

    @property
    def key(self) -> str:
        """The key that says so."""
        return f"effect.{self.effect}.per" if self.effect else f"sim.parameters.{self.label}.per"


def differing(search: Search, trial: Trial) -> list[Differing]:
    """Return the parameters that differ in a fit: the simulator's own, then those of its effects."""
    augmented = search.plan.augmented
    names = [q.name for q in augmented.params]
    model = augmented.model
    of_simulator = groupings(model.base, model.groups) if model.base else []
    found = [(how, how.parameter, "", "") for how in of_simulator if how.names]
    for t in trial.terms:
        term = search.terms[t]
        labels = {k.name: k.label for k in term.parameters}
        found += [(g, labels[g.parameter], term.effect, term.acts_on) for g in term.groupings]
    return [
        Differing(
            how, label, effect, place, names.index(how.parameter), names.index(how.spread.name),
            tuple(names.index(q.name) for q in how.members[:-1]),
        )
        for how, label, effect, place in found
    ]  # fmt: skip


def spread_of(search: Search, trial: Trial, one: Differing, z: float = Z90) -> dict[str, float]:
    """Return the spread with its interval; z: half width in standard deviations of its logarithm."""
    value = search.plan.coordinates.value(one.spread, float(trial.optimum.z[one.spread]))
    sd = known(search.plan.coordinates, trial.optimum, one.members).sd
    return {"value": value, "low": value * float(np.exp(-z * sd)), "high": value * float(np.exp(z * sd))}


def values_of(search: Search, trial: Trial, one: Differing, share: float = 0.9) -> dict[str, dict[str, float]]:
    """Return the value of every group with its interval, by name, from draws of the posterior as a Gaussian.

    Args:
        search: that was run.
        trial: the fit.
        one: the parameter.
        share: of the draws that lie in the interval.
    """
    coordinates, optimum = search.plan.coordinates, trial.optimum
    spread = coordinates.value(one.spread, float(optimum.z[one.spread]))
    found = {}
    for name, member in zip(one.how.names, one.members, strict=True):
        rows = [one.row, member]
        k = [optimum.free.index(row) for row in rows]
        at, apart = optimum.centre[k], np.linalg.cholesky(optimum.covariance[np.ix_(k, k)] + 1e-15 * np.eye(2))
        white = np.random.default_rng(0).standard_normal((DRAWS, 2))
        drawn = np.clip(np.vstack([at, at + white @ apart.T]), 0, 1)
        common, delta = (np.array([coordinates.value(row, v) for v in drawn[:, j]]) for j, row in enumerate(rows))
        values = common * np.exp(spread * delta) if one.how.ratio else common + spread * delta
        low, high = np.quantile(values[1:], [(1 - share) / 2, (1 + share) / 2])
        found[name] = {"value": float(values[0]), "low": float(low), "high": float(high)}
    return found


def gain_of(search: Search, trial: Trial, one: Differing) -> float:
    """Return the evidence that is lost where all groups have the common value, nats."""
    z = search.loud(trial.optimum.z)
    z[one.spread] = 0.0
    z[list(one.members)] = 0.5
    free = tuple(i for i in trial.optimum.free if i not in one.members)
    (alike,) = search.fitter([Hypothesis(z, free, search.ones)])
    return float(trial.optimum.log_evidence - alike.log_evidence)


def groups_of(search: Search, trial: Trial, common: dict[int, dict[str, float]]) -> list[dict[str, Any]]:
    """Return the key `groups` of `verdict.json`: an entry per parameter that differs.

    Args:
        search: that was run.
        trial: the model that it ended with.
        common: row of a parameter -> common value with its interval.
    """
    return [
        {
            "parameter": one.label, "effect": one.effect or None, "acts_on": one.place or None, "per": one.how.by,
            "key": one.key, "unit": one.how.spread.unit if not one.how.ratio else search.plan.augmented.params[one.row].unit,
            "log_evidence_gain": gain_of(search, trial, one), "common": common[one.row],
            "spread": spread_of(search, trial, one) | {"of": "logarithm" if one.how.ratio else "value"},
            "values": values_of(search, trial, one),
        }
        for one in differing(search, trial)
    ]  # fmt: skip


def sentence_of(groups: list[dict[str, Any]]) -> str:
    """Return what a verdict says of parameters that differ; nothing where none does."""
    return "".join(
        f" {e['parameter']}{' of ' + e['effect'].replace('_', ' ') if e['effect'] else ''} differs from {e['per']} to "
        f"{e['per']} (by {e['log_evidence_gain']:.0f} nats), from {least['value']:.3g} ({lowest}) to {most['value']:.3g} "
        f"({highest}){' ' + e['unit'] if e['unit'] not in ('', '1') else ''}."
        for e in groups
        for lowest, least in [min(e["values"].items(), key=lambda v: v[1]["value"])]
        for highest, most in [max(e["values"].items(), key=lambda v: v[1]["value"])]
    )
