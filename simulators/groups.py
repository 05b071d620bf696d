"""A parameter that differs from group to group, such as the drag of each ball: values about a common one, a learned spread.

    c_g = c + s delta_g,    or, where the range of c has one sign,    c_g = c exp(s delta_g),    delta_g ~ N(0, 1)

c and the spread s are parameters of the population, delta_g of a group. Which group a row is of, is an input per group that is
1 there and 0 elsewhere. The last of them is of a group that was never seen: no data tell of its delta, so that what is
predicted for it is the population, with its spread. Parameters of a simulator and of an effect differ in the same way.
A group of which the value itself is known, from other measurements, is no member of that population: its value is a parameter.

Reference: Gelman and Hill (2007), Data analysis using regression and multilevel/hierarchical models, ch. 12 (partial pooling).
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import casadi

from simulators.expression import Symbol
from simulators.model import Model, ModelError, column
from simulators.quantity import Quantity

UNSEEN = "another"  # the group of rows whose group was not trained on
DELTA = (-2.0, 2.0)  # +-2 standard deviations
SPREAD, MEMBER = "spread", "member"  # roles of parameters: of the population, of one group
OF_ZERO = (
    1.5  # largest spread, of the logarithm, of a range that begins at 0: a factor of 20 at two standard deviations
)


class Grouping(NamedTuple):
    """How one parameter differs from group to group.

    Args:
        parameter: its name.
        by: column that names the groups.
        ratio: whether a group has a factor, else something that is added.
        spread: s, a parameter of the population.
        members: delta of every group of which nothing is known; the last is of one that was never seen.
        slots: inputs that say which group a row is of, in the same order.
        names: of these groups, as the column has them, without that one.
        known: value of every group of which it is known.
        known_slots: inputs of these, in the same order.
    """

    parameter: str
    by: str
    ratio: bool
    spread: Quantity
    members: tuple[Quantity, ...]
    slots: tuple[str, ...]
    names: tuple[str, ...]
    known: tuple[Quantity, ...] = ()
    known_slots: tuple[str, ...] = ()

    @property
    def own(self) -> tuple[Quantity, ...]:
        """The parameters that the groups need beside the common one: the spread first."""
        return (self.spread, *self.members, *self.known)

    def value(self, known: Mapping[str, Symbol]) -> Symbol:
        """Return the parameter of the group that a row is of, from what all names stand for."""
        off = known[self.spread.name] * casadi.sum1(
            casadi.vertcat(*(known[slot] * known[q.name] for slot, q in zip(self.slots, self.members, strict=True)))
        )
        common = known[self.parameter]
        value = common * casadi.exp(off) if self.ratio else common + off
        for slot, q in zip(self.known_slots, self.known, strict=True):
            value = value + known[slot] * (known[q.name] - value)
        return value


def grouping(
    q: Quantity,
    by: str,
    names: tuple[str, ...],
    spread: tuple[float, float] | None = None,
    known: Mapping[str, tuple[float, float]] | None = None,
) -> Grouping:
    """Return how a parameter differs between groups.

    Args:
        q: the parameter.
        by: column of the groups.
        names: of the groups.
        spread: range of the spread; None: from 0 to half of the range of the parameter.
        known: group -> range of its value, +-2 standard deviations, of the logarithm where it is positive; None: of none.
    """
    ratio = is_factor(q)
    low, high = spread or (0.0, largest_spread(q))
    given = known or {}
    # a column may have a group that is called as that one
    every = list(zip((*names, None), words((*names, UNSEEN)), slot_names(by, names), strict=True))
    others = [(name, word, slot) for name, word, slot in every if name not in given]
    own_value = [(given[name], word, slot) for name, word, slot in every if name is not None and name in given]
    members = tuple(Quantity(f"{q.name}_of_{word}", "1", *DELTA, prior="normal", role=MEMBER) for _, word, _ in others)
    own = Quantity(f"{q.name}_spread", "1" if ratio else q.unit, low, high, role=SPREAD)
    values = tuple(
        Quantity(f"{q.name}_of_{word}", q.unit, *ends, prior="lognormal" if ratio and ends[0] > 0 else "normal")
        for ends, word, _ in own_value
    )
    return Grouping(
        q.name, by, ratio, own, members, tuple(slot for *_, slot in others), tuple(name for name, *_ in others if name),
        values, tuple(slot for *_, slot in own_value),
    )  # fmt: skip


def groupings(model: Model, groups: Mapping[str, tuple[str, ...]]) -> list[Grouping]:
    """Return how the parameters of a simulator differ that do, in their order; groups: column -> names."""
    return [
        grouping(q, by, groups[by], model.spreads.get(q.name), model.known_groups.get(q.name))
        for q in model.params
        for by in [model.per.get(q.name)]
        if by is not None
    ]


def grouped(model: Model, groups: dict[str, tuple[str, ...]]) -> Model:
    """Return the model in which every parameter that differs `per` group does so.

    Args:
        model: with `per`: parameter -> column of the groups.
        groups: column -> names of its groups; of columns that no parameter names there are the inputs alone.

    Raises:
        ModelError: a parameter that cannot differ, or a name that is taken.

    """
    if not groups:
        return model
    for name in model.per:
        refuse_late(model, name, f"sim.parameters.{name}.per")
    slots = [name for by, names in groups.items() for name in slot_names(by, names)]
    inputs = [Quantity(name, "1", 0.0, 1.0) for name in slots]
    taken = {q.name for q in (*model.states, *model.inputs, *model.params, *model.outputs)} | model.fixed.keys()
    every = groupings(model, groups)
    own = [q for each in every for q in each.own]
    for q in (*inputs, *own):
        if q.name in taken:
            raise ModelError(f"sim: the name {q.name} is needed for groups, but it is taken; choose another name")
    nu, n = len(model.inputs), len(model.params)

    def of_group(u: Symbol, p: Symbol) -> Symbol:
        """Return the parameters of the group that a row is of."""
        known = {q.name: p[i] for i, q in enumerate((*model.params, *own))}
        known |= {name: u[nu + j] for j, name in enumerate(slots)}
        values = {each.parameter: each.value(known) for each in every}
        return column(model.symbol, [values.get(q.name, p[i]) for i, q in enumerate(model.params[:n])])

    by_slot = {name: by for by, names in groups.items() for name in slot_names(by, names)}
    return replace(
        model,
        inputs=(*model.inputs, *inputs),
        params=(*model.params, *own),
        rhs=lambda x, u, p: model.rhs(x, u[:nu], of_group(u, p)),
        output=lambda x, u, p: model.output(x, u[:nu], of_group(u, p)),
        covariates=model.covariates | by_slot,
        coordinates=None,
        groups=groups,
        base=model,
    )


def refuse_late(model: Model, parameter: str, key: str) -> None:
    """Refuse a parameter that a delay or a lag depends on.

    Raises:
        ModelError: `key` says that it differs from group to group.

    """
    late = {
        "inputs": {"delay": model.delay, "lag": model.lag},
        "sensors": {"delay": model.sensor_delay, "lag": model.sensor_lag},
    }
    for section, what, times in ((section, *item) for section, kinds in late.items() for item in kinds.items()):
        for name, value in times.items():
            if value == parameter:
                raise ModelError(
                    f"{key}: sim.{section}.{name}.{what} depends on it, and a {what} is the same for all groups; leave "
                    "`per` out"
                )


def spreads_of(params: Sequence[Quantity]) -> dict[int, list[int]]:
    """Return the rows of the spreads, and of what the groups are, without the group that was never seen."""
    found: dict[int, list[int]] = {}
    for i, q in enumerate(params):
        if q.role == SPREAD:
            after = [k for k in range(i + 1, len(params)) if params[k].role != MEMBER]
            rows = list(range(i + 1, min(after, default=len(params)) - 1))
            found |= {i: rows} if rows else {}  # the data tell nothing of the spread of groups that are all known
    return found


def slots_of(model: Model) -> tuple[tuple[int, ...], ...]:
    """Return the rows of the inputs that say which group a row is of, column by column."""
    first, found = len(model.inputs) - sum(len(names) + 1 for names in model.groups.values()), []
    for names in model.groups.values():
        found.append(tuple(range(first, first + len(names) + 1)))
        first += len(names) + 1
    return tuple(found)


def slot_names(by: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the inputs that say which group a row is of; the last is of one that was never seen."""
    return tuple(f"{by}_is_{word}" for word in words((*names, UNSEEN)))


def words(names: tuple[str, ...]) -> list[str]:
    """Return a word for every name that an expression can hold, no two alike."""
    found: list[str] = []
    for name in names:
        word = re.sub(r"\W+", "_", name).strip("_").replace("__", "_") or "group"
        found.append(word if word not in found else f"{word}_{len(found)}")
    return found


def is_factor(q: Quantity) -> bool:
    """Whether groups differ by a factor, as where the parameter has one sign; else by something that is added."""
    return q.low >= 0 or q.high <= 0


def largest_spread(q: Quantity) -> float:
    """Return half of the range, so that two standard deviations reach over all of it and more; of a factor, its logarithm."""
    if not is_factor(q):
        return (q.high - q.low) / 2
    ends = sorted((abs(q.low), abs(q.high)))
    return math.log(ends[1] / ends[0]) / 2 if ends[0] > 0 else OF_ZERO
