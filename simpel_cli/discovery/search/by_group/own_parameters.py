"""Whether parameters of the simulator differ from group to group, where columns of the data name groups.

It is asked of the simulator alone before any effect, since one value for all groups leaves what looks like effects, and again
beside the effects that were chosen, since a missing effect may look like parameters that differ. All parameters differ in one
small program per column, and none does until a hypothesis says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from simpel_cli.discovery.search.by_group.grouping import Grouping, Question, judged
from simpel_cli.discovery.search.by_group.spreads import respread
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.smaller import carried, small_search
from simpel_cli.discovery.search.trials import SPREADS, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.initial_states import begun
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import Setup
from simpel_cli.filtering.tracks import Tracks
from simulators.groups import SPREAD, grouped, is_factor, largest_spread, spreads_of
from simulators.model import Model, ModelError

MOST_AT_ONCE = 3  # parameters that differ by one column: what the program has room for
WIDE = 0.35  # spread of the logarithm that is asked at least: a factor of two at two standard deviations

Attach = Callable[..., Setup]  # (model, kept, extra) -> the setup of a program with these terms alone


def with_own(model: Model, per: Mapping[str, str]) -> Model:
    """Return the simulator whose parameters differ from group to group as it says itself, and these as well.

    A range says where the common value is. Groups may differ by more than that where nobody said that they differ at all.

    Args:
        model: of measurements with groups.
        per: parameter -> column of the groups.
    """
    base = model.base
    assert base is not None
    narrow = [q for q in base.params if q.name in per and q.name not in base.per and q.name not in base.spreads]
    wide = {q.name: (0.0, WIDE) for q in narrow if is_factor(q) and largest_spread(q) < WIDE}
    between, late = model.between_rows, model.latency
    per, spreads = {**base.per, **per}, {**base.spreads, **wide}
    return grouped(replace(base, per=per, spreads=spreads, between_rows=between, latency=late), model.groups)


def said_of_groups(model: Model, per: Mapping[str, str], groups: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what the YAML of a simulator says of its parameters that differ: parameter -> `per`, and `spread` if it is wide.

    Args:
        model: as it was declared.
        per: parameter -> column of the groups.
        groups: as in `verdict.json`.
    """
    found: dict[str, Any] = {name: {"per": by} for name, by in per.items()}
    usual = {q.name: largest_spread(q) for q in (model.base or model).params}
    for one in groups:
        name, most = one["parameter"], one["spread"]["high"]
        if name in found and not one["effect"] and most > usual.get(name, most):
            found[name]["spread"] = [0.0, float(f"{most:.3g}")]
    return found


def own_parameters(
    attach: Attach, model: Model, options: Discovery, beside: tuple[Search, Trial] | None = None
) -> list[Grouping]:
    """Return what it is worth that each parameter of the simulator differs, by each column of groups.

    What pays stays when the next is asked; of several columns the one that explains most comes first.

    Args:
        attach: binds the measurements.
        model: of measurements with groups, as it was declared.
        options: of the search.
        beside: a search and the effects that it chose; None: the simulator alone.
    """
    names = [q.name for q in (model.base.params if model.base else ()) if _can_differ(model, q.name)]
    left, taken, found = list(model.groups), dict[str, str](), dict[tuple[str, str], Grouping]()
    while left and names:
        asked = {by: _asked(attach, with_own(model, taken | dict.fromkeys(names, by)), by, names, options, beside)
                 for by in left}  # fmt: skip
        best = max(left, key=lambda by: sum(g.gain for g in asked[by] if g.pays))
        found |= {(g.parameter, by): g._replace(pays=g.pays and by == best) for by in left for g in asked[by]}
        pays = {g.parameter: best for g in asked[best] if g.pays}
        if not pays:
            break
        taken |= pays
        names = [name for name in names if name not in pays]
        left.remove(best)
    return list(found.values())


def _can_differ(model: Model, name: str) -> bool:
    """Whether a parameter has one value so far, no delay depends on it, and what its groups need to be called is free."""
    try:
        return name not in model.per and all(with_own(model, {name: by}) for by in model.groups)
    except ModelError:
        return False


def per_of(found: list[Grouping]) -> dict[str, str]:
    """Return the parameters of the simulator for which it pays, with the column of their groups."""
    return {g.parameter: g.per for g in found if g.parameter and g.pays}


def spreads_in(search: Search, per: Mapping[str, str]) -> list[int]:
    """Return the spreads of parameters of the simulator that differ."""
    rows = {q.name: i for i, q in enumerate(search.plan.augmented.params)}
    return [rows[f"{name}_{SPREAD}"] for name in per]


def in_common(search: Search, trial: Trial, spreads: Sequence[int]) -> Trial:
    """Return the fit of a model in which what has these spreads has one value for all groups."""
    members = {i for row in spreads for i in search.spreads[row]}
    again = search.plan.start.copy()
    own = [row for t in trial.terms for row in search.all_rows(t)]
    again[own] = trial.optimum.z[own]
    starts = [search.loud(trial.optimum.z), again]
    for z in starts:
        z[[*spreads]], z[[*members]] = 0.0, 0.5
    free = tuple(i for i in trial.optimum.free if i not in members)
    found = search.fitter([Hypothesis(z, free, search.ones) for z in starts])
    return Trial(trial.terms, max(found, key=lambda o: o.log_evidence))


def declared_in(sim: dict[str, Any]) -> set[str]:
    """Return the parameters with a range that a `sim:` node declares, or that on which it is built."""
    own = {name for name, node in (sim.get("parameters") or {}).items() if isinstance(node, dict)}
    return own | (declared_in(sim["base"]) if isinstance(sim.get("base"), dict) else set())


def written(sim: dict[str, Any], said: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the `sim:` node with more said of its parameters; one that is built on another says it where they are declared.

    Args:
        sim: the node.
        said: parameter -> keys and values.
    """
    own = sim.get("parameters") or {}
    here = {name: own[name] | dict(keys) for name, keys in said.items() if isinstance(own.get(name), dict)}
    node = sim | ({"parameters": own | here} if here else {})
    deeper = {name: keys for name, keys in said.items() if name not in here}
    return node | ({"base": written(sim["base"], deeper)} if deeper and isinstance(sim.get("base"), dict) else {})


def _asked(
    attach: Attach,
    model: Model,
    by: str,
    names: Sequence[str],
    options: Discovery,
    beside: tuple[Search, Trial] | None,
) -> list[Grouping]:
    """Ask in one program of the parameters that differ by one column."""
    own = [beside[0].terms[t] for t in beside[1].terms] if beside else []
    plan = attach(model, kept=frozenset(), extra=own)
    rows = {q.name: i for i, q in enumerate(model.params)}
    spreads = {name: rows[f"{name}_{SPREAD}"] for name in names}
    of_groups = spreads_of(model.params)
    start = plan.start.copy() if beside is None else carried(beside[0].plan, beside[1].optimum.z, plan)
    for row in spreads.values():
        start[row] = 0.0
        start[of_groups[row]] = 0.5  # in the middle of the population
    windows = begun(Tracks(plan), start, plan.windows) if beside is None else beside[0].plan.windows
    most, groups = min(len(names), MOST_AT_ONCE), len(model.groups[by])
    room = sum(len(t.parameters) + sum(len(g.own) for g in t.groupings) for t in own) + most * groups
    still = sum(1 + len(of_groups[row]) for row in spreads.values())  # unknowns that no fit moves, or few at once
    small = small_search(
        plan._replace(start=start, windows=windows), options.lanes, room - still, alike=tuple(spreads.values())
    )
    terms = tuple(range(len(own)))
    if beside is None:
        alike = small.base()
    else:
        alike = small.best(terms, small.fitter([Hypothesis(start, small.free(terms), small.ones)]))

    def question(name: str) -> Question:
        def trials(at: Trial) -> tuple[Trial, list[Trial]]:
            return _differing(small, at, spreads[name]), [at]

        return Question(Grouping("", by, 0.0, None, pays=False, parameter=name), trials)

    return judged(
        small,
        Assessor(small.plan, options.horizon, options.first_rows),
        alike,
        [question(name) for name in names],
        most,
    )


def _differing(small: Search, at: Trial, spread: int) -> Trial:
    """Return the model in which one more parameter differs."""
    members = small.spreads[spread]
    free = (*at.optimum.free, *members)
    z = small.loud(at.optimum.z)
    starts = [respread(small.plan.coordinates, z, {spread: level}, {spread: members}) for level in SPREADS]
    found = small.fitter([Hypothesis(start, free, small.ones) for start in starts])
    return Trial(at.terms, max(found, key=lambda o: o.log_evidence))
