"""The groups of a configuration, and the class that a group's YAML declares where it names none with `_target_`."""

import importlib

# group -> its obvious class; None: YAML names one of several with `_target_`
CLASSES: dict[str, str | None] = {
    "run": "simpel_cli.runs.settings.Settings",
    "sim": "simulators.model.Declared",
    "data": "simpel_cli.data.config.Measurements",
    "prior": None,
    "score": None,
    "method": None,
    "evaluation": "simpel_cli.evaluation.settings.Evaluation",
    "simulation": "simulators.worlds.simulate.Simulate",
    "effect": "simulators.effects.Expression",
    "discovery": "simpel_cli.discovery.search.settings.Discovery",
    "reward": "simpel_cli.control.task.Task",
    "control": "simpel_cli.control.settings.Control",
    "policy": "simpel_cli.control.agents.sac.SAC",
    "planner": "simpel_cli.control.agents.planner.ICEM",
    "online": "simpel_cli.control.online_settings.Online",
    "truth": "simulators.model.Declared",
    "mujoco": "simulators.worlds.mujoco_world.MujocoWorld",
}
OPTIONAL = (
    "evaluation",
    "effect",
    "discovery",
    "reward",
    "control",
    "planner",
    "online",
    "truth",
    "mujoco",
)  # may be null
SIMULATORS = ("sim", "truth", "mujoco")  # groups whose class has a `model()`: equations, or a world that is queried
# what a class of the group must have, whatever it is called
ROLES = dict.fromkeys(SIMULATORS, "model") | {
    "prior": "uses_simulator",
    "score": "gap_draws",
    "method": "bind",
    "policy": "bind",
    "planner": "bind",
    "reward": "bind",
}
PLAIN_KEYS = ("choices", "run_dir", "out", "close", "report", "world")  # of a configuration, beside its groups


def obvious_class(path: str) -> type | None:
    """Return the class of a node without `_target_`, by its place; None: there is none.

    Args:
        path: of a group (`sim`), of an entry of `effect` (`effect.stiction`), or of a simulator's base (`sim.base`).
    """
    group, *below = path.split(".")
    entry = group == "effect" and len(below) == 1
    base = group in SIMULATORS and set(below) == {"base"}
    name = CLASSES.get(group) if not below or entry or base else None
    if name is None:
        return None
    module, _, attribute = name.rpartition(".")
    found: type = getattr(importlib.import_module(module), attribute)
    return found
