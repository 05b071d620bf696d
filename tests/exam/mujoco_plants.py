"""The same rigs in MuJoCo, where the planted physics is MuJoCo's: friction loss, damping, armature, springs, lags.

Its joint limits are left out: they replace the acceleration instead of adding to it, which is another effect than a soft stop.

Mechanisms and their numbers: MuJoCo documentation, chapter Computation (passive forces, actuation model).
"""

from collections.abc import Callable, Mapping

import mujoco
import numpy as np

STEPS = 25  # of MuJoCo per row

PENDULUM = """
<mujoco><option timestep="{h}" integrator="RK4" gravity="0 0 -9.81"/>
<worldbody><body><joint name="j" type="hinge" axis="0 1 0" {joint}/>
<body pos="0 0 {l}"><inertial pos="0 0 0" mass="{m}" diaginertia="1e-9 1e-9 1e-9"/></body></body></worldbody>
<actuator><general joint="j" gear="{gain}" {actuator}/></actuator></mujoco>
"""
CART = """
<mujoco><option timestep="{h}" integrator="RK4" gravity="0 0 0"/>
<worldbody><body><joint name="j" type="slide" axis="1 0 0" stiffness="{K}" damping="{b}" {joint}/>
<inertial pos="0 0 0" mass="{M}" diaginertia="1 1 1"/></body></worldbody>
<actuator><general joint="j" gear="{gain}" {actuator}/></actuator></mujoco>
"""
WORLDS = {
    "pendulum": ("coulomb_friction", "viscous_friction", "added_inertia", "linear_stiffness", "input_lag"),
    "cart": ("coulomb_friction", "input_lag"),
}


def can(system: str, effect: str) -> bool:
    """Whether MuJoCo has the rig, and a mechanism of its own for this effect (empty for none)."""
    return system in WORLDS and (not effect or effect in WORLDS[system])


def world(
    system: str, parameters: Mapping[str, float], effect: str, knobs: Mapping[str, float], dt: float
) -> mujoco.MjModel:
    """Compile the rig with one mechanism; knobs are accelerations and are turned into forces.

    Args:
        system: pendulum or cart.
        parameters: true ones of the rig.
        effect: of WORLDS; empty for none.
        knobs: of the effect, as `planted` has them.
        dt: s, distance of the rows.
    """
    p = dict(parameters)
    mass = p["m"] * p["l"] ** 2 if system == "pendulum" else p["M"]
    joint = {
        "coulomb_friction": lambda k: f'frictionloss="{k["tau_c"] * mass}"',
        "viscous_friction": lambda k: f'damping="{k["b"] * mass}"',
        "added_inertia": lambda k: f'armature="{k["alpha"] * mass}"',
        "linear_stiffness": lambda k: f'stiffness="{k["k"] * mass}"',
    }
    lag = f'dyntype="filter" dynprm="{knobs["tau"]}"' if effect == "input_lag" else ""
    text = (PENDULUM if system == "pendulum" else CART).format(
        h=dt / STEPS, joint=joint[effect](knobs) if effect in joint else "", actuator=lag,
        gain=p["C_m"] if system == "pendulum" else p["K_m"], **p,
    )  # fmt: skip
    return mujoco.MjModel.from_xml_string(text.replace("<mujoco>", '<mujoco><compiler angle="radian"/>'))


def simulate(
    model: mujoco.MjModel,
    start: np.ndarray,
    commands: np.ndarray,
    controller: Callable[[np.ndarray, int], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Run every episode; a lagging actuator starts at its first command, as the exam's own lags do.

    Args:
        model: of `world`.
        start: (B, 2) first states.
        commands: (B, rows, 1).
        controller: (x (B, 2), row) -> (B, 1), in place of the commands.

    Returns:
        states (B, rows, 2) and commands (B, rows, 1).
    """
    commands = np.array(commands, float)
    states = np.empty((*commands.shape[:2], 2))
    data = mujoco.MjData(model)
    for episode, first in enumerate(start):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = first[0], first[1]
        for row in range(commands.shape[1]):
            states[episode, row] = data.qpos[0], data.qvel[0]
            if controller is not None:
                commands[episode, row] = controller(states[episode : episode + 1, row], row)[0]
            if row == 0 and model.na:
                data.act[:] = commands[episode, 0, 0]
            data.ctrl[:] = commands[episode, row]
            mujoco.mj_step(model, data, STEPS)
    return states, commands
