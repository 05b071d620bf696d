"""JSON Schema (draft 2020-12) of what a type hint says too little about: the sections of a simulator's YAML."""

from collections.abc import Iterable
from typing import Any

from simulators.definitions import COVARIATE, INTERMEDIATE, KNOWN, UNCERTAIN
from simulators.quantity import BETWEEN_ROWS, GIVEN, LIMITS, PRIORS, ROLES, VARIABLE
from simulators.readings import KEYS as READING
from simulators.sensors import KEYS as SENSOR
from simulators.tables import DEGREES
from simulators.tables import KEYS as TABLE

Schema = dict[str, Any]

NUMBER: Schema = {"type": ["number", "string"], "description": "A number; text is read as arithmetic, e.g. 2*pi."}
TERM: Schema = {"type": ["number", "string"], "description": "An expression, e.g. -k*x, or a number."}
NUMBER_OR_NAME: Schema = {"type": ["number", "string"], "description": "A number, or the name of a parameter."}


def pair(entry: Schema, description: str) -> Schema:
    """Return the schema of a list of two."""
    return {"type": "array", "items": entry, "minItems": 2, "maxItems": 2, "description": description}


ENDS: Schema = {"type": ["number", "string", "null"]}
PROPERTIES: dict[str, Schema] = {
    "unit": {"type": "string", "description": 'Unit, a text; "1" for a number without one.'},
    "range": pair(NUMBER, "[low, high]: where the model is asked; of a parameter: its prior."),
    "periodic": {"type": "boolean", "description": "An angle in rad, of which sine and cosine are learned."},
    "limits": pair(ENDS, "[low, high] to which the state is put back after each Runge-Kutta step; null: no limit."),
    "role": {"enum": list(ROLES), "description": "What the state is, which says which effects can act on it."},
    "delay": NUMBER_OR_NAME | {"description": "How late the input acts, s, or the parameter that says so."},
    "lag": NUMBER_OR_NAME | {"description": "Time constant of a first-order lag, s, or the parameter that says so."},
    "between_rows": {"enum": list(BETWEEN_ROWS), "description": "What the input does from one row to the next."},
    "per": {"type": "string", "description": "Column that names the groups from one to another of which it differs."},
    "spread": pair(
        NUMBER, "[low, high] of how far groups differ, one sd; of the logarithm where the range has one sign."
    ),
    "groups": {
        "type": "object",
        "additionalProperties": pair(
            NUMBER, "[low, high] of its value: +-2 sd, of the logarithm where it has one sign."
        ),
        "description": "What is known of groups: name -> value there. Of the others only what the population says.",
    },
    "column": {"type": "string", "description": "Column of the measurements that knows the parameter in every row."},
    "prior": {"enum": list(PRIORS), "description": "Law of an uncertain parameter; normal: the range is +-2 sd."},
    "value": TERM
    | {"description": "Of a parameter: the known number. Of an input or a sensor: the expression in its place."},
    "expression": TERM,
    "scale": NUMBER_OR_NAME | {"description": "Factor of the reading."},
    "bias": NUMBER_OR_NAME | {"description": "Added to the reading."},
    "saturates": pair(ENDS, "[low, high] of the sensor's reading; null: no end."),
    "inputs": {
        "type": "array",
        "items": {"type": "string"},
        "minItems": 1,
        "maxItems": 2,
        "description": "One or two names of the model, in the order of the axes.",
    },
    "method": {"enum": list(DEGREES), "description": "How values between the nodes are found."},
    "file": {"type": "string", "description": "CSV: a header line, the inputs' columns in order, then the value."},
    "axes": {
        "type": "array",
        "items": {"type": "array", "items": NUMBER, "minItems": 2},
        "minItems": 1,
        "maxItems": 2,
        "description": "Increasing nodes of each input.",
    },
    "values": {
        "type": "array",
        "minItems": 2,
        "description": "Values at the nodes; of two inputs a list for each row.",
    },
    "read_from": {"type": "object", "description": "Where simpel read the numbers; it writes this itself."},
    "joint": {"type": "string", "description": "Joint of the XML."},
    "of": {"enum": ["position", "velocity"], "description": "Which coordinate of the joint."},
    "actuator": {"type": "string", "description": "Actuator of the XML."},
    "element": {"type": "string", "description": "Kind and name of an element of the XML, e.g. `joint hinge`."},
    "field": {"type": "string", "description": "Attribute of that element in mujoco.MjSpec."},
    "index": {"type": "integer", "minimum": 0, "description": "Which number of the field."},
}


def keys(allowed: Iterable[str], required: tuple[str, ...] = ()) -> Schema:
    """Return the schema of a mapping of these keys."""
    properties = {key: PROPERTIES[key] for key in allowed}
    node: Schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return node | ({"required": list(required)} if required else {})


def named(entry: Schema, description: str = "") -> Schema:
    """Return the schema of a mapping of names that a user chooses."""
    return {"type": "object", "additionalProperties": entry} | ({"description": description} if description else {})


def either(*options: Schema) -> Schema:
    """Return the schema of what fits one of these."""
    return {"anyOf": list(options)}


_OUTPUT = keys(SENSOR, ("expression",))
_OUTPUT["properties"]["delay"] = NUMBER | {"description": "How old a reading is when it is recorded, s."}
_READING = keys(READING)
_READING["properties"]["delay"] = NUMBER_OR_NAME | {"description": "How late its sensor shows it, s, or a parameter."}
_PARAMETER = {"required": ["range"]}, {"required": ["value"]}
PARAMETER = either(TERM, keys(dict.fromkeys((*UNCERTAIN, *KNOWN, *COVARIATE))) | {"anyOf": list(_PARAMETER)})
GAP = named(NUMBER)
SECTIONS: dict[str, Schema] = {
    "dt": NUMBER,
    "states": named(keys((*VARIABLE, *LIMITS), ("range",))),
    "inputs": named(keys((*VARIABLE, *GIVEN), ("range",))),
    "parameters": named(PARAMETER),
    "intermediates": named(either(TERM, keys(INTERMEDIATE, ("expression",)))),
    "tables": named(keys(TABLE, ("inputs",))),
    "dynamics": named(TERM),
    "outputs": named(either(TERM, _OUTPUT)),
    "sensors": named(_READING),
    "gap": GAP,
}
