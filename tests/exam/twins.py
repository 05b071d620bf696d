"""Effects that no data of a rig can tell apart, since its parameters or another effect's take up the difference."""

from itertools import permutations

_LEVEL: dict[str, tuple[frozenset[str], ...]] = {
    "pendulum": (
        frozenset({"constant_load@omega", "input_offset@u"}),
        frozenset({"gravity_tilt@omega", "sensor_bias@phi"}),
    ),
    "cart": (
        frozenset({"constant_load@v", "input_offset@u", "sensor_bias@s"}),
        frozenset({"sensor_scale@s", "sensor_scale@v"}),
    ),
    "tanks": (frozenset({"constant_inflow@h_1", "input_offset@u"}),),
    "thermal": (
        frozenset({"constant_inflow@T_1", "input_offset@u"}),
        frozenset({"constant_inflow@T_2", "sensor_bias@T_2", "sensor_scale@T_2"}),
    ),
    "car": (
        frozenset({"constant_load@v", "input_offset@throttle"}),
        frozenset({"coulomb_friction@v", "rolling_resistance@v"}),
    ),
}
_ONE_SENSOR: dict[str, tuple[frozenset[str], ...]] = {
    "pendulum": (frozenset({"input_delay@u", "sensor_delay@phi"}),),
    "cart": (frozenset({"input_delay@u", "sensor_delay@s"}),),
    "tanks": (frozenset({"input_delay@u", "sensor_delay@h_2"}),),
    "thermal": (
        frozenset(
            {"constant_inflow@T_1", "input_offset@u", "constant_inflow@T_2", "sensor_bias@T_2", "sensor_scale@T_2"}
        ),
        frozenset({"input_delay@u", "sensor_delay@T_2"}),
    ),
}
_HOLDS = {  # an effect -> another that its own parameters make up for, where both are there
    "pendulum": {"asymmetric_friction@omega": "constant_load@omega"},
    "cart": {"asymmetric_friction@v": "constant_load@v"},
    "car": {"asymmetric_friction@v": "constant_load@v"},
}
_ONE_SENSOR_HOLDS = {"thermal": {"crowding@T_1": "input_offset@u"}}
_ONE_SENSOR_ABSORBED = {"thermal": {"thermal_coupling@T_1"}}  # two poles and a gain: as many as the rig has parameters


def twins(system: str, key: str, *, position_only: bool) -> list[str]:
    """Return `name@place` of what no data of this system can tell from `key`.

    A constant force is an offset of the motor (its gain is a parameter); a spring at rest elsewhere is a sensor's bias;
    an angle sensor's bias is a tilt; two temperatures with free exchange rates take up every constant; where one sensor
    reports everything, it is late as much as the input is; with one speed, dry friction is rolling resistance. A linear cart
    whose mass, spring and friction are free may be measured in any unit of length: a speed's scale is a position's.
    """
    groups = _LEVEL[system] + (_ONE_SENSOR.get(system, ()) if position_only else ())
    return sorted({other for group in groups if key in group for other in group} - {key})


def apart(system: str, keys: tuple[str, ...], *, position_only: bool) -> bool:
    """Whether data can show each of several planted effects `name@place` beside the others.

    Not so for twins, nor for an effect that holds the other or a twin of it: friction that differs between the directions is
    Coulomb's and a constant load. Where only the end of a linear chain is measured, its parameters take in more.
    """
    holds = _HOLDS.get(system, {}) | (_ONE_SENSOR_HOLDS.get(system, {}) if position_only else {})
    if position_only and len(keys) > 1 and _ONE_SENSOR_ABSORBED.get(system, set()) & set(keys):
        return False

    def made_up(key: str) -> set[str]:
        held = {holds[key]} if key in holds else set()
        return held.union(*(twins(system, k, position_only=position_only) for k in (key, *held)))

    return not any(b in made_up(a) for a, b in permutations(keys, 2))
