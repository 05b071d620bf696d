"""Effects that no data of a rig can tell apart, since its parameters take up the difference."""

_LEVEL: dict[str, tuple[frozenset[str], ...]] = {
    "pendulum": (
        frozenset({"constant_load@omega", "input_offset@u"}),
        frozenset({"gravity_tilt@omega", "sensor_bias@phi"}),
    ),
    "cart": (frozenset({"constant_load@v", "input_offset@u", "sensor_bias@s"}),),
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


def twins(system: str, key: str, *, position_only: bool) -> list[str]:
    """Return `name@place` of what no data of this system can tell from `key`.

    A constant force is an offset of the motor (its gain is a parameter); a spring at rest elsewhere is a sensor's bias;
    an angle sensor's bias is a tilt; two temperatures with free exchange rates take up every constant; where one sensor
    reports everything, it is late as much as the input is; with one speed, dry friction is rolling resistance.
    """
    groups = _LEVEL[system] + (_ONE_SENSOR.get(system, ()) if position_only else ())
    return sorted({other for group in groups if key in group for other in group} - {key})
