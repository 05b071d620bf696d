"""MuJoCo as a world, declared: which joints, actuators and fields of an XML are states, inputs and parameters."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import mujoco
import numpy as np

from simulators.expression import did_you_mean
from simulators.model import Declared, ModelError
from simulators.sections import GAP, NUMBER, keys, named
from simulators.worlds.compiled_world import CompiledWorld, Setting, commands_on_their_way

FOLDER = Path(__file__).parent
LISTS = {
    "body": "bodies",
    "joint": "joints",
    "geom": "geoms",
    "site": "sites",
    "tendon": "tendons",
    "actuator": "actuators",
}
# keys of a quantity that say where it is in the XML, needed and optional ones, and those that a model has as well
PLACES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "states": (("joint", "of"), ()),
    "inputs": (("actuator",), ("delay",)),
    "parameters": (("element", "field"), ("index",)),
}
MEANING = {
    "states": ("unit", "range", "periodic"),
    "inputs": ("unit", "range"),
    "parameters": ("unit", "range", "prior", "value"),
}


@dataclass(frozen=True)
class MujocoWorld:
    """A MuJoCo world as a YAML file declares it; the fields are the YAML keys.

    Zero and sign of an angle are matters of the XML: attributes `ref` and `axis` of the joint. The answers are those of
    the integrator and time step that the XML names; RK4 is the most accurate without contacts.

    Args:
        name: letters, digits and single underscores.
        dt: duration of one transition, s; a whole number of MuJoCo's time steps.
        xml: MuJoCo XML: a path, or the bare name of a file that comes with simpel.
        timestep: MuJoCo's time step, s; null = as in the XML.
        threads: threads that share the queries; the results do not depend on it.
        states: name: {unit, range, periodic, joint: <name>, of: position|velocity}; every joint needs both, since a
            query must fix the whole state of the world.
        inputs: name: {unit, range, actuator: <name>, delay}; other actuators are at zero. A `delay`, s, a whole number
            of MuJoCo's time steps, makes the commands late; those on their way are states, <input>_1 the newest.
        parameters: name: {unit, range, prior, element, field, index}, or `value` for `range`: known. `element` is a
            kind and a name, e.g. `joint hinge`, or `option`; `field` is an attribute of that element in mujoco.MjSpec,
            mostly named as in the XML; `index` counts from 0 in a field of several numbers.
        gap: state: expected error of one transition, in its unit.

    """

    name: str
    dt: float
    xml: str
    timestep: float | None = None
    threads: int = 1
    states: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    gap: dict[str, Any] = field(default_factory=dict)

    sections: ClassVar[dict[str, Any]] = {"dt": NUMBER, "gap": GAP} | {  # JSON schemas of fields
        section: named(keys((*MEANING[section], *needed, *optional), needed))
        for section, (needed, optional) in PLACES.items()
    }

    def model(self) -> CompiledWorld:
        """Check everything and build the world.

        Raises:
            ModelError: names the key, what it holds, what is allowed and the cure.

        """
        nodes = {section: self._without_places(section) for section in PLACES}
        spec = self._read()
        delays = {name: _delay(f"sim.inputs.{name}.delay", node, spec) for name, node in self.inputs.items()}
        for name, delay in delays.items():
            for i in range(commands_on_their_way(delay, round(self.dt / spec.option.timestep))):
                past = f"{name}_{i + 1}"
                if past in nodes["states"]:
                    raise ModelError(f"sim.states.{past}: so is a command on its way called; choose another name")
                nodes["states"][past] = nodes["inputs"][name]
        # units, ranges, priors, names and gap obey the rules of a model: let it read them
        quantities = Declared(
            self.name,
            self.dt,
            states=nodes["states"],
            inputs=nodes["inputs"],
            parameters=nodes["parameters"],
            dynamics=dict.fromkeys(nodes["states"], "0"),
            gap=self.gap,
        ).model()
        if not isinstance(self.threads, int) or self.threads < 1:
            raise ModelError(f"sim.threads: {self.threads!r} is not allowed; give a whole number, at least 1")
        settings = {name: _place(spec, f"sim.parameters.{name}", node) for name, node in self.parameters.items()}
        for name, value in quantities.fixed.items():
            settings[name].write(value)
        world = CompiledWorld(
            name=quantities.name,
            dt=quantities.dt,
            states=quantities.states,
            inputs=quantities.inputs,
            params=quantities.params,
            outputs=(),
            gap=quantities.gap,
            spec=spec,
            settings=tuple(settings[quantity.name] for quantity in quantities.params),
            state_columns=self._state_columns(spec),
            controls=self._controls(spec),
            delays=tuple(delays.values()),
            threads=self.threads,
        )
        for name, setting in settings.items():
            ends = {quantity.name: (quantity.low, quantity.high) for quantity in quantities.params}
            world.check_effect(name, setting, ends.get(name))
        return world

    def _without_places(self, section: str) -> dict[str, Any]:
        """Check the keys that say where a quantity is in the XML, and return the nodes without them."""
        nodes, (needed, optional), meaning = getattr(self, section), PLACES[section], MEANING[section]
        example = ", ".join(f"{key}: ..." for key in (*meaning[:2], *needed))
        if not isinstance(nodes, Mapping):
            raise ModelError(f"sim.{section}: {nodes!r} is not a mapping; write `name: {{{example}}}`")
        rest = {}
        for name, node in nodes.items():
            path = f"sim.{section}.{name}"
            if not isinstance(node, Mapping):
                raise ModelError(f"{path}: {node!r} is not a mapping; write {{{example}}}")
            for key in node:
                allowed = [*meaning, *needed, *optional]
                if key not in allowed:
                    hint = did_you_mean(str(key), allowed)
                    raise ModelError(f"{path}.{key}: unknown key; allowed: {', '.join(allowed)}.{hint}")
            for key in needed:
                if not isinstance(node.get(key), str):
                    raise ModelError(f"{path}.{key}: {node.get(key)!r} is no name; write {{{example}}}")
            rest[name] = {key: value for key, value in node.items() if key in meaning}
        return rest

    def _read(self) -> mujoco.MjSpec:
        own = sorted(file.name for file in FOLDER.glob("*.xml"))
        path = FOLDER / self.xml if self.xml in own else Path(self.xml).expanduser()
        if not path.is_file():
            raise ModelError(
                f"sim.xml: no file {path} in {Path.cwd()}; give a path to a MuJoCo XML, or one that comes with simpel: "
                f"{', '.join(own)}.{did_you_mean(self.xml, own)}"
            )
        try:
            spec = mujoco.MjSpec.from_file(str(path))
            if self.timestep is not None:
                spec.option.timestep = self.timestep
            model = spec.compile()
        except ValueError as error:
            raise ModelError(f"sim.xml: MuJoCo refuses {path}: {error}") from error
        if model.opt.timestep <= 0:
            raise ModelError(
                f"sim.timestep: {model.opt.timestep:g} s is not positive; give MuJoCo's time step in seconds"
            )
        steps = self.dt / model.opt.timestep
        if round(steps) < 1 or abs(steps / round(steps) - 1) > 1e-9:
            raise ModelError(
                f"sim.dt: {self.dt:g} s is no whole number of MuJoCo's time steps of {model.opt.timestep:g} s; "
                "change it, or set sim.timestep"
            )
        return spec

    def _state_columns(self, spec: mujoco.MjSpec) -> tuple[int, ...]:
        """Return where each declared state stands in MuJoCo's state [time, positions, velocities]."""
        model = spec.compile()
        names = [model.joint(i).name for i in range(model.njnt)]
        scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        for name, kind in zip(names, model.jnt_type, strict=True):
            if mujoco.mjtJoint(kind) not in scalar:
                raise ModelError(
                    f"sim.xml: joint {name!r} is neither hinge nor slide; replace a ball or free joint by several"
                )
        if mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS) != 1 + 2 * model.njnt:
            raise ModelError(
                "sim.xml: an actuator or plug-in has a state of its own, which no query could fix; use actuators "
                "without dynamics, e.g. motor"
            )
        taken: dict[int, str] = {}
        for name, node in self.states.items():
            path, joint, of = f"sim.states.{name}", node["joint"], node["of"]
            if joint not in names:
                _unknown(f"{path}.joint", f"no joint {joint!r} in the XML", joint, names)
            if of not in ("position", "velocity"):
                _unknown(f"{path}.of", f"{of!r} is not allowed", of, ["position", "velocity"])
            column = 1 + names.index(joint) + (model.njnt if of == "velocity" else 0)
            if column in taken:
                raise ModelError(f"{path}: {of} of joint {joint} is already the state {taken[column]}; leave one out")
            taken[column] = name
        for column in range(1, 1 + 2 * model.njnt):
            if column not in taken:
                of, joint = ("position", "velocity")[(column - 1) // model.njnt], names[(column - 1) % model.njnt]
                raise ModelError(
                    f"sim.states: the {of} of joint {joint} is no state, but decides the future; add "
                    f"`<name>: {{unit: ..., range: [...], joint: {joint}, of: {of}}}`"
                )
        return tuple(taken)

    def _controls(self, spec: mujoco.MjSpec) -> tuple[int, ...]:
        """Return which actuator each declared input drives."""
        names = [actuator.name for actuator in spec.actuators]
        taken: dict[str, str] = {}
        for name, node in self.inputs.items():
            path, wanted = f"sim.inputs.{name}.actuator", node["actuator"]
            if wanted not in names:
                _unknown(path, f"no actuator {wanted!r} in the XML", wanted, names)
            if wanted in taken:
                raise ModelError(f"{path}: {wanted} is already driven by the input {taken[wanted]}; leave one out")
            taken[wanted] = name
        return tuple(names.index(wanted) for wanted in taken)


def _delay(path: str, node: Mapping[str, Any], spec: mujoco.MjSpec) -> int:
    """Return by how many time steps an input is late."""
    delay, timestep = node.get("delay", 0), spec.option.timestep
    if not isinstance(delay, (int, float)) or isinstance(delay, bool) or not 0 <= delay < math.inf:
        raise ModelError(f"{path}: {delay!r} is no delay; give 0 s or more")
    steps = round(delay / timestep)
    if abs(delay - steps * timestep) > 1e-9:
        raise ModelError(
            f"{path}: {delay:g} s is no whole number of MuJoCo's time steps of {timestep:g} s; "
            "change it, or set sim.timestep"
        )
    return steps


def _place(spec: mujoco.MjSpec, path: str, node: Mapping[str, Any]) -> Setting:
    """Find the number that a parameter sets."""
    kind, _, name = node["element"].partition(" ")
    if kind == "option":
        element: Any = spec.option
    else:
        if kind not in LISTS:
            _unknown(f"{path}.element", f"{kind!r} is no kind of element", kind, ["option", *LISTS])
        elements = {element.name: element for element in getattr(spec, LISTS[kind])}
        if name not in elements:
            _unknown(f"{path}.element", f"no {kind} {name!r} in the XML", name, [n for n in elements if n])
        element = elements[name]
    fields = [n for n in dir(element) if not n.startswith("_") and isinstance(getattr(element, n), (float, np.ndarray))]
    fields = [n for n in fields if n != "timestep"]  # of all queries together: `sim.timestep`
    if node["field"] not in fields:
        _unknown(f"{path}.field", f"{kind} has no number {node['field']!r}", node["field"], fields)
    value, index = getattr(element, node["field"]), node.get("index")
    if isinstance(value, float):
        if index is not None:
            raise ModelError(f"{path}.index: {node['field']} is a single number; leave it out")
    elif not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(value):
        raise ModelError(
            f"{path}.index: {node['field']} holds {len(value)} numbers, {index!r} is none of them; "
            f"give 0 to {len(value) - 1}"
        )
    return Setting(element, node["field"], index)


def _unknown(path: str, problem: str, word: str, allowed: list[str]) -> NoReturn:
    raise ModelError(f"{path}: {problem}; known: {', '.join(allowed) or 'none'}.{did_you_mean(word, allowed)}")
