"""An effect written as an expression: every effect of the catalogue, and a user's own, is one YAML file of this form."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from simulators.effects.names import names_in, renamed, value_in
from simulators.effects.stores import check_states, stores_at
from simulators.effects.structure import drives, structure
from simulators.effects.term import INPUT, NAMED, RATE, SENSOR, EffectParameter, Term
from simulators.effects.units import per, unit_in
from simulators.effects.vehicle import PARTS, Vehicle, vehicle
from simulators.groups import Grouping, grouping
from simulators.model import Model, ModelError
from simulators.quantity import Quantity

PLANAR = "planar"  # a vehicle in the plane: a term per part of it
SUPPLY = "supply"  # all inputs of one unit, which share a supply
ROLES = ("velocity", "angle_velocity", "first_order", "input", SUPPLY, "measured", "measured_angle", PLANAR)
ZERO = {"K": "0", "degC": "(-273.15)"}  # absolute, in a unit
KIND_OF_ROLE = {"velocity": RATE, "angle_velocity": RATE, "first_order": RATE, "input": INPUT}


class Scales(NamedTuple):
    """How large things are in the measurements: what the ranges of effects are stated in.

    Args:
        size: quantity -> largest magnitude (a periodic state: pi).
        rate: state -> typical magnitude of its rate, per second.
        dt: distance of the rows, s.
    """

    size: dict[str, float]
    rate: dict[str, float]
    dt: float


@dataclass(frozen=True)
class Expression:
    """An effect as a term in the names of the model.

    Args:
        name: of the effect.
        meaning: one physical sentence.
        acts_on: where: roles (velocity, angle_velocity, first_order, input, supply, measured, measured_angle, planar) or names
            of states, inputs and measured quantities.
        term: what is added to the rate of a state, or what stands in place of an input or a measured quantity. Roles can
            be used for names: `v` the velocity acted on, `s` its position, `x` the first-order state, `other` another
            state of the same unit, `around` an input of the same unit, `drive` an input that pushes the velocity from
            standstill, `given` any input, `u` the input, `y` the measured quantity, `rate` the model's own rate, `zero` the
            absolute zero in the unit of a temperature, `load` of a `supply` the mean magnitude of its inputs. For `planar` a
            mapping {long: ..., lat: ..., yaw: ..., heading: ...}: what is added to the accelerations along, across and about
            the vehicle, and to the rate of a heading without inertia, each where the model has it; names are `long`, `lat`,
            `yaw`, `heading` and the model's own `rate_long`, `rate_lat`, `rate_yaw` in these axes.
        operator: in place of `term`: delay, lag, backlash, rate_limit, sensor_delay or sensor_lag, on the signal that it acts
            on, with one parameter.
        kind: rate, input or sensor, where `acts_on` names quantities; found from the model if left out.
        parameters: name -> {range: [low, high], unit, neutral: 0, starts: [...]}. Numbers, or expressions of the scales A
            (typical rate), V, S, X, U, Y (largest magnitude of v, s, x, u, y) and dt. Units likewise: `A/V`. For planar:
            A, V of the vehicle's speed, W, Q of its yaw rate (largest magnitude, typical rate).
        states: states that it brings along, which nothing measures: name -> {rate, unit, range: [low, high], begins}. `rate`
            is theirs, in the names of the term; they begin at the first value of the quantity `begins`, or at 0. A search tries
            such an effect where what it leaves has a memory.
        per: column of the measurements that names groups, from one to another of which its strength differs: the parameters
            that are 0 where it is switched off (all, where there are none) have a common value and one per group.
        same_as: effects that no data can tell from this one.
        units: unit or units of the quantities that it can act on; empty: any.
        generalises: effects that it becomes when some of its parameters are neutral.
        dissipative: it never adds energy (tested).
        mutual: what it adds to the rate of `x` it takes from that of `other`: one term per pair of states, in which `x` is the
            one that the simulator names first.
        passes: the share, a number or an expression of parameters, of what its term takes from `x` that `other` gains: one term
            per pair of states and direction.
        widened: unique name of a parameter at a place -> its range there, where a search found that stated too narrow.
    """

    name: str
    meaning: str = ""
    acts_on: Any = ()
    term: str | Mapping[str, str] = ""
    operator: str = ""
    kind: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    units: str | tuple[str, ...] = ()
    same_as: tuple[str, ...] = ()
    generalises: tuple[str, ...] = ()
    dissipative: bool = False
    mutual: bool = False
    passes: str = ""
    per: str = ""
    states: Mapping[str, Any] = field(default_factory=dict)
    widened: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = f"effect.{self.name}"
        if not self.places:
            raise ModelError(f"{where}.acts_on: empty; name a role ({', '.join(ROLES)}) or quantities of the simulator")
        if bool(self.term) == bool(self.operator):
            raise ModelError(f"{where}: give either `term` or `operator` ({', '.join(NAMED)})")
        if self.operator and (self.operator not in NAMED or len(self.parameters) != 1):
            raise ModelError(
                f"{where}.operator: {self.operator!r} with {len(self.parameters)} parameters; allowed are "
                f"{', '.join(NAMED)} with one parameter"
            )
        parts = list(self.term) if isinstance(self.term, Mapping) else []
        if bool(parts) != (PLANAR in self.places) or not set(parts) <= set(PARTS) or (parts and len(self.places) > 1):
            raise ModelError(
                f"{where}.term: a term per part goes with `acts_on: {PLANAR}` alone; write {{long: ...}}; parts: "
                f"{', '.join(PARTS)}"
            )
        if self.units and parts:
            raise ModelError(f"{where}.units: not with `acts_on: {PLANAR}`, whose parts are accelerations and a rate")
        if (
            isinstance(self.term, str)
            and self.term
            and len(both := names_in(self.term) & {"other", "around", "drive", "given"}) > 1
        ):
            raise ModelError(
                f"{where}.term: {self.term!r} has both `{'` and `'.join(sorted(both, reverse=True))}`; one effect is an "
                "exchange with one"
            )
        if self.passes and (self.mutual or not isinstance(self.term, str) or "other" in names_in(self.term or "0")):
            raise ModelError(f"{where}.passes: goes with a `term` of `x` alone that is not `mutual`")
        if self.mutual and not (isinstance(self.term, str) and self.term and "other" in names_in(self.term)):
            raise ModelError(f"{where}.mutual: its term has no `other`, from whose rate it could be taken")
        if not isinstance(self.per, str) or not (self.per.isidentifier() or not self.per):
            raise ModelError(f"{where}.per: {self.per!r} is not the name of a column (letters, digits, underscores)")
        if self.per and self.operator:
            raise ModelError(f"{where}.per: a {self.operator} is the same for all groups; leave `per` out")
        plain = bool(self.term) and not (parts or self.mutual or self.passes or self.per)
        check_states(where, self.states, self.parameters, plain=plain)
        for name, node in self.parameters.items():
            if not (
                isinstance(node, Mapping) and isinstance(node.get("range"), list | tuple) and len(node["range"]) == 2
            ):
                raise ModelError(
                    f"{where}.parameters.{name}: {node!r} has no range; write {{range: [low, high], unit: ...}}"
                )

    @property
    def places(self) -> tuple[str, ...]:
        """Roles or names, as given."""
        return (self.acts_on,) if isinstance(self.acts_on, str) else tuple(self.acts_on)

    def attach(self, model: Model, scales: Scales, measured: tuple[str, ...]) -> list[Term]:
        """Return a term for every place of the model where the effect can act; none where the model has no such place.

        Args:
            model: the simulator.
            scales: magnitudes of its quantities in the measurements.
            measured: names of the measured states and outputs.

        Raises:
            ModelError: a place or a name in the term that the model does not have.
        """
        if isinstance(self.term, Mapping):
            car = vehicle(model)
            return self._on_vehicle(self.term, car, model, scales) if car else []
        if "drive" in names_in(self.term or "0") and (car := vehicle(model)):  # along its heading, wherever that points
            along, pushed = {"long": renamed(self.term, {"v": "long"})}, drives(model)
            motors = dict.fromkeys(motor for state in car.parts["long"] for motor in pushed[state])
            return [t for motor in motors for t in self._on_vehicle(along, car, model, scales, motor)]
        roles = structure(model)
        units = {q.name: q.unit for q in (*model.states, *model.inputs, *model.outputs)}
        periodic = {q.name for q in model.states if q.periodic}
        angles = periodic | {n for n, u in units.items() if u == "rad"}
        members = {
            "velocity": tuple(roles.velocity),
            "angle_velocity": tuple(v for v, s in roles.velocity.items() if s in angles),
            "first_order": roles.first_order,
            "input": tuple(q.name for q in model.inputs if q.name not in model.covariates),
            "measured": measured,
            "measured_angle": tuple(n for n in measured if n in angles),
        }
        allowed = (self.units,) if self.units and isinstance(self.units, str) else tuple(self.units)
        terms: list[Term] = []
        for place in self.places:
            if place not in (*members, SUPPLY) and place not in units:
                raise ModelError(
                    f"effect.{self.name}.acts_on: {place!r} is no role and no quantity of {model.name}; roles: "
                    f"{', '.join(ROLES)}; quantities: {', '.join(units)}"
                )
            if place == SUPPLY:
                terms += self._on_supply(self.term, model, scales, units)
                continue
            for name in members.get(place, (place,)):
                if allowed and units[name] not in allowed:
                    continue
                terms += self._at(name, self.term, model, scales, roles.velocity.get(name), units, place)
        return list({t.acts_on: t for t in terms[::-1]}.values())[::-1] if self.mutual else terms  # once per pair

    def _at(
        self,
        name: str,
        term: str,
        model: Model,
        scales: Scales,
        position: str | None,
        units: dict[str, str],
        place: str,
    ) -> list[Term]:
        states, zero = [q.name for q in model.states], ZERO.get(units[name])
        kind = self.operator or self.kind or KIND_OF_ROLE.get(place) or _kind(name, model, place)
        names = set().union(*map(names_in, [*([term] if term else []), *(s["rate"] for s in self.states.values())]))
        if (
            ("s" in names and position is None and "s" not in units)
            or ("S" in str(self.parameters) and position is None)
            or ("zero" in names and zero is None)
        ):
            return []
        periodic = {q.name for q in model.states if q.periodic}
        role = "other" if self.passes else next((r for r in ("other", "around", "drive", "given") if r in names), "")
        among = {"other": states, "around": [q.name for q in model.inputs]}.get(role, [])
        others = [n for n in among if n != name and units[n] == units[name]] if role else [""]
        if role == "drive":
            others = [*drives(model).get(name, ())]
        if role == "given":
            others = [q.name for q in model.inputs if q.name not in model.covariates]
        if self.passes:
            others = [n for n in others if n in structure(model).first_order]
        if self.mutual:
            if name not in states:
                raise ModelError(
                    f"effect.{self.name}.acts_on: {name!r} is no state; a mutual effect is between two states"
                )
            dynamic = structure(model).dynamic  # nothing is taken from what a speed says of its position
            others = [n for n in others if n in dynamic]
        own = {"v": name, "x": name, "u": name, "y": name, "zero": zero} | ({"s": position} if position else {})
        size = scales.size
        values = {
            "A": scales.rate.get(name, 1.0),
            "V": size[name], "X": size[name], "U": size[name], "Y": size[name],
            "S": size[position] if position else 1.0,
            "dt": scales.dt,
        }  # fmt: skip
        unit = units[name]
        unit_of = {"A": per(unit, "s"), "V": unit, "X": unit, "U": unit, "Y": unit, "S": units.get(position or "", "")}
        if position in periodic:
            values["S"] = 3.141592653589793
        found = []
        for other in others:
            if role in ("drive", "given"):
                values["U"], unit_of["U"] = size[other], units[other]
            prefix = f"{self.name}_{name}" + (f"_{other}" if other else "")
            parameters = self._parameters(prefix, values, unit_of)
            swap = own | {role: other} | {k.label: k.name for k in parameters}
            swap |= {label: f"{prefix}_{label}" for label in self.states}
            text = renamed(term, {k: v for k, v in swap.items() if v is not None}) if term else ""
            if self.mutual:
                first, second = sorted((name, other), key=states.index)
                if first != name:  # the same term, whichever of the two was named
                    parameters = self._parameters(f"{self.name}_{first}_{second}", values, unit_of)
                    text = renamed(term, {"x": first, role: second} | {k.label: k.name for k in parameters})
                both = ((first, text), (second, f"-({text})"))
                found.append(self._term(f"{first}, {second}", kind, "", parameters, model, both))
            elif self.passes:
                share = renamed(self.passes, {k.label: k.name for k in parameters})
                both = ((name, text), (other, f"-({share})*({text})"))
                found.append(self._term(f"{name}, {other}", kind, "", parameters, model, both))
            else:
                there = {k: v for k, v in swap.items() if v is not None}
                stores = stores_at(f"effect.{self.name}", self.states, there, values, unit_of)
                found.append(self._term(name, kind, text, parameters, model)._replace(stores=stores))
        return found

    def _on_supply(self, term: str, model: Model, scales: Scales, units: dict[str, str]) -> list[Term]:
        """Return one term on all inputs of one unit, of every unit that several have; a vehicle's steering is no load."""
        motors = None if vehicle(model) is None else {motor for of in drives(model).values() for motor in of}
        sharing: dict[str, list[str]] = {}
        for q in model.inputs:
            if q.name in model.covariates or (self.units and q.unit not in self.units):
                continue
            if motors is None or q.name in motors:
                sharing.setdefault(q.unit, []).append(q.name)
        found = []
        for unit, names in sharing.items():
            if len(names) < 2:
                continue
            values, unit_of = {"U": max(scales.size[n] for n in names), "dt": scales.dt}, {"U": unit}
            parameters = self._parameters("_".join([self.name, *names]), values, unit_of)
            swap = {"load": "((" + " + ".join(f"abs({n})" for n in names) + f")/{len(names)})"}
            swap |= {k.label: k.name for k in parameters}
            several = tuple((n, renamed(term, swap | {"u": n})) for n in names)
            found.append(self._term(", ".join(names), INPUT, "", parameters, model, several))
        return found

    def _on_vehicle(
        self, parts: Mapping[str, str], car: Vehicle, model: Model, scales: Scales, drive: str = ""
    ) -> list[Term]:
        """Return one term on the rates of all states that the parts act on."""
        own = {part: text for part, text in parts.items() if part in car.parts}
        if not own:
            return []
        speeds, turn = list(car.parts["long"]), (car.parts.get("yaw") or car.parts["heading"])
        values = {
            "A": max(scales.rate[s] for s in speeds),
            "V": max(scales.size[s] for s in speeds),
            "W": max((scales.size if "yaw" in car.parts else scales.rate)[s] for s in turn),
            "dt": scales.dt,
        }
        unit_of = {"A": "m/s^2", "V": "m/s", "W": "rad/s"}
        if "yaw" in car.parts:
            values["Q"], unit_of["Q"] = max(scales.rate[s] for s in turn), "rad/s^2"
        if drive:
            values["U"] = scales.size[drive]
            unit_of["U"] = next(q.unit for q in model.inputs if q.name == drive)
        states = [q.name for q in model.states if any(q.name in car.parts[part] for part in own)]
        used = set().union(*(names_in(text) for text in own.values()))
        parameters = self._parameters(
            "_".join([self.name, *states, *([drive] if drive else [])]), values, unit_of, used
        )
        swap = car.names | {"drive": drive} | {k.label: k.name for k in parameters}
        sums: dict[str, list[str]] = {state: [] for state in states}
        for part, text in own.items():
            for state, factor in car.parts[part].items():
                push = f"({renamed(text, swap)})"
                sums[state].append(push if factor == "1" else f"{factor}*{push}")
        several = tuple((state, " + ".join(terms)) for state, terms in sums.items())
        return [self._term(", ".join(states), RATE, "", parameters, model, several)]

    def _parameters(
        self, prefix: str, values: Mapping[str, float], unit_of: Mapping[str, str], used: set[str] | None = None
    ) -> tuple[EffectParameter, ...]:
        """Return the parameters, or those that are used, in the scales of a place."""
        parameters = []
        for label, node in self.parameters.items():
            if used is not None and label not in used:
                continue
            low, high = (value_in(v, values, f"effect.{self.name}.parameters.{label}.range") for v in node["range"])
            low, high = self.widened.get(f"{prefix}_{label}", (low, high))
            null = value_in(node.get("neutral", 0), values, f"effect.{self.name}.parameters.{label}.neutral")
            given = node.get("starts") or [0.1 * high + 0.9 * max(low, 0.0)]
            starts = tuple(value_in(v, values, f"effect.{self.name}.parameters.{label}.starts") for v in given)
            parameters.append(
                EffectParameter(
                    f"{prefix}_{label}",
                    label,
                    unit_in(node.get("unit", ""), unit_of),
                    low,
                    high,
                    null,
                    starts,
                    node.get("prior", "uniform"),
                )
            )
        return tuple(parameters)

    def _term(
        self,
        name: str,
        kind: str,
        text: str,
        parameters: tuple[EffectParameter, ...],
        model: Model,
        several: tuple[tuple[str, str], ...] = (),
    ) -> Term:
        return Term(
            self.name, name, kind, text, parameters, self.meaning, tuple(self.same_as), tuple(self.generalises),
            self.dissipative,
            several=several,
            groupings=self._groupings(parameters, model),
        )  # fmt: skip

    def _groupings(self, parameters: tuple[EffectParameter, ...], model: Model) -> tuple[Grouping, ...]:
        """Return how its strengths differ from group to group."""
        if not self.per:
            return ()
        if self.per not in model.groups:
            raise ModelError(f"effect.{self.name}.per: the groups of {self.per!r} are not known to {model.name}")
        return tuple(differing(k, self.per, model.groups[self.per]) for k in strengths(parameters))


def strengths(parameters: tuple[EffectParameter, ...]) -> tuple[EffectParameter, ...]:
    """Return the parameters that are 0 where an effect is switched off; all of them, where there are none."""
    return tuple(k for k in parameters if k.neutral == 0) or parameters


def differing(parameter: EffectParameter, by: str, names: tuple[str, ...]) -> Grouping:
    """Return how a parameter of an effect differs between the groups of a column."""
    return grouping(Quantity(parameter.name, parameter.unit, parameter.low, parameter.high), by, names)


def _kind(name: str, model: Model, place: str) -> str:
    if place in ("measured", "measured_angle"):
        return SENSOR
    if any(q.name == name for q in model.inputs):
        return INPUT
    return RATE if any(q.name == name for q in model.states) else SENSOR
