"""Parameters that differ: between groups of episodes (each ball its own drag), with a known covariate."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from simulators.expression import did_you_mean
from simulators.model import ModelError, Quantity
from simulators.quantity import check_spelling, check_word, refuse_unknown
from simulators.worlds.streams import Streams

LAWS = ("normal", "lognormal")


@dataclass(frozen=True)
class Spread:
    """How a parameter varies between groups, around the truth that they have in common.

    Args:
        std: normal: standard deviation, in the unit of the parameter. lognormal: of its logarithm, so about relative.
        law: `normal` or `lognormal`.

    """

    std: float
    law: str = "normal"


@dataclass(frozen=True)
class Group:
    """Episodes that share parameters; they are dealt to the groups in turn.

    Args:
        count: number of groups.
        parameters: parameter -> how it varies between groups.

    """

    count: int
    parameters: dict[str, Spread] = field(default_factory=dict)


@dataclass(frozen=True)
class Covariate:
    """A known number that differs between episodes, with a column of its own: the value of a parameter.

    Args:
        parameter: what it is the value of.
        range: lowest and highest value, uniform in between, in the unit of the parameter.
        per: drawn for every group of this name; empty: for every episode.

    """

    parameter: str
    range: tuple[float, ...]
    per: str = ""


class Dealt(NamedTuple):
    """Parameters of every episode (of layouts without episodes: of every row).

    Args:
        params: (n, dp).
        columns: name -> one value per episode: the group's name, or the covariate.
        by_group: name -> group -> parameter -> its true value.

    """

    params: np.ndarray
    columns: dict[str, np.ndarray]
    by_group: dict[str, dict[str, dict[str, float]]]


@dataclass(frozen=True)
class Groups:
    """What differs between episodes; the fields are those of `Simulate`.

    Args:
        groups: column -> groups.
        covariates: column -> covariate.

    """

    groups: Mapping[str, Group] = field(default_factory=dict)
    covariates: Mapping[str, Covariate] = field(default_factory=dict)

    def check(self, params: Iterable[Quantity], taken: Iterable[str], given: Iterable[str], n: int) -> None:
        """Refuse what is not allowed.

        Args:
            params: of the source.
            taken: names of other columns.
            given: parameters whose value `truth` gives.
            n: number of episodes.

        """
        names, columns = [q.name for q in params], set(taken)
        used: dict[str, str] = {}
        for column, path in [
            *((each, f"simulation.groups.{each}") for each in self.groups),
            *((each, f"simulation.covariates.{each}") for each in self.covariates),
        ]:
            check_spelling(path, column)
            if column in columns:
                raise ModelError(f"{path}: there is a column `{column}` already; choose another name")
            columns.add(column)
        for column, group in self.groups.items():
            path = f"simulation.groups.{column}"
            if not 1 <= group.count <= n:
                raise ModelError(f"{path}.count: {group.count} groups of {n} episodes; give 1 to {n}, or more episodes")
            for name, spread in group.parameters.items():
                where = f"{path}.parameters.{name}"
                _use(where, name, names, used)
                check_word(f"{where}.law", spread.law, LAWS)
                if not 0 <= spread.std < math.inf:
                    raise ModelError(f"{where}.std: {spread.std:g} is no standard deviation; give 0 or more")
        used |= dict.fromkeys(given, "simulation.truth")  # what groups vary may be given; a covariate would replace it
        for column, covariate in self.covariates.items():
            path, ends = f"simulation.covariates.{column}", covariate.range
            _use(f"{path}.parameter", covariate.parameter, names, used)
            if len(ends) != 2 or not all(map(math.isfinite, ends)) or not ends[0] <= ends[1]:
                raise ModelError(f"{path}.range: {list(ends)} is no range; write [low, high] with low <= high")
            if covariate.per and covariate.per not in self.groups:
                refuse_unknown(f"{path}.per", f"{covariate.per!r} is no group", covariate.per, self.groups)

    def deal(self, params: tuple[Quantity, ...], truth: np.ndarray, n: int, streams: Streams) -> Dealt:
        """Give every episode its groups, covariates and parameters.

        Args:
            params: of the source.
            truth: (dp,) what the groups have in common.
            n: number of episodes.
            streams: the randomness.

        """
        names = [q.name for q in params]
        values, columns = np.tile(truth, (n, 1)), {}
        by_group: dict[str, dict[str, dict[str, float]]] = {}
        members, slower = {}, 1
        for column, group in self.groups.items():  # the first changes fastest, so that all combinations come
            members[column] = np.arange(n) // slower % group.count
            slower *= group.count
            called = [f"{column}_{i}" for i in range(group.count)]
            columns[column] = np.array(called)[members[column]]
            by_group[column] = {each: {} for each in called}
            for name, spread in group.parameters.items():
                common = truth[names.index(name)]
                unit = np.array([streams.of(f"group.{column}.{name}", i).normal() for i in range(group.count)])
                away = spread.std * unit
                own = common + away if spread.law == "normal" else common * np.exp(away)
                values[:, names.index(name)] = own[members[column]]
                for each, value in zip(called, own, strict=True):
                    by_group[column][each][name] = float(value)
        for column, covariate in self.covariates.items():
            which = members[covariate.per] if covariate.per else np.arange(n)
            low, high = covariate.range
            drawn = [streams.of(f"covariate.{column}", i).uniform(low, high) for i in range(which.max() + 1)]
            columns[column] = np.array(drawn)[which]
            values[:, names.index(covariate.parameter)] = columns[column]
        return Dealt(values, columns, by_group)

    def planted(self, *, hide_truth: bool) -> dict[str, Any]:
        """Return what the card says about groups and covariates; the spreads are a truth."""
        card: dict[str, Any] = {}
        if self.groups:
            card["groups"] = {
                column: {"count": group.count}
                | (
                    {}
                    if hide_truth
                    else {"parameters": {p: {"law": s.law, "std": s.std} for p, s in group.parameters.items()}}
                )
                for column, group in self.groups.items()
            }
        if self.covariates:
            card["covariates"] = {
                column: {"parameter": c.parameter, "range": list(c.range)} | ({"per": c.per} if c.per else {})
                for column, c in self.covariates.items()
            }
        return card


def _use(path: str, name: str, names: list[str], used: dict[str, str]) -> None:
    """Refuse a parameter that the source does not have, or that is varied elsewhere; note where it is."""
    if name not in names:
        known, hint = ", ".join(names) or "none", did_you_mean(name, names)
        raise ModelError(
            f"{path}: {name!r} is no uncertain parameter; known: {known}.{hint} A parameter of one value needs a range in "
            "sim to vary"
        )
    if name in used:
        raise ModelError(f"{path}: {name} has its value from {used[name]} already; leave one out")
    used[name] = path
