"""The exam's own formulas of missing physics: (v, s, t, knobs, x, u) -> what is added to the rate of v.
Those of the whole rate: (rate, knobs, x) -> what stands in its place.

v is the state acted on, s its position or the other state, t the time in the episode, x and u all states and inputs.
Dry friction is a ramp, a stop is a stiff spring: nothing is smoothed for an optimiser's sake.
"""

import numpy as np


def ramp(v: np.ndarray, width: float) -> np.ndarray:
    """Sign of a speed, linear below `width`."""
    return np.clip(v / width, -1.0, 1.0)


def beyond(value: np.ndarray, limit: float) -> np.ndarray:
    return value - np.clip(value, -limit, limit)


def viscous(v, s, t, k, x, u):
    return -k["b"] * v


def coulomb(v, s, t, k, x, u):
    return -k["tau_c"] * ramp(v, k["_width"])


def stribeck(v, s, t, k, x, u):
    return -(k["tau_c"] + k["tau_s"] * np.exp(-((v / k["v_s"]) ** 2))) * ramp(v, k["_width"])


def asymmetric(v, s, t, k, x, u):
    side = ramp(v, k["_width"])
    return np.where(v > 0, -k["tau_p"] * side, -k["tau_n"] * side)


def quadratic(v, s, t, k, x, u):
    return -k["c"] * v * np.abs(v)


def constant(v, s, t, k, x, u):
    return np.full_like(v, k["c"])


def spring(v, s, t, k, x, u):
    return -k["k"] * s


def cubic(v, s, t, k, x, u):
    return -k["k_3"] * s**3


def stop(v, s, t, k, x, u):
    return -k["k"] * beyond(s, k["s_max"])


def cogging(v, s, t, k, x, u):
    return k["a"] * np.sin(k["n"] * s) + k["b"] * np.cos(k["n"] * s)


def tilt(v, s, t, k, x, u):
    return k["a"] * np.cos(s)


def leak(v, s, t, k, x, u):
    return -k["k"] * v


def outflow(v, s, t, k, x, u):
    return -k["k"] * np.maximum(v, 0.0) ** k["n"]


def overflow(v, s, t, k, x, u):
    return -k["k"] * np.maximum(v - k["x_max"], 0.0)


def exchange(v, s, t, k, x, u):
    return k["k"] * (k["x_a"] - v)


def crowding(v, s, t, k, x, u):
    return -k["k"] * v**2


def coupling(v, s, t, k, x, u):
    return k["k"] * (s - v)


def swing(v, s, t, k, x, u):
    return np.full_like(v, k["_force"] * np.sin(2 * np.pi * t / k["_period"] + k["_phase"]))


def inertia(v, s, t, k, x, u):
    # it scales the model's whole rate, which no formula of these arguments can; `record.plant` does so itself
    raise AssertionError("added inertia is no term: record.plant scales the rate")


def rolling(v, s, t, k, x, u):
    return -k["c"] * ramp(v, k["_width"])


def grip(rate, k, x):
    """Tyres hold up to a limit and slide beyond it."""
    return np.clip(rate, -k["_most"], k["_most"])


def understeer(rate, k, x):
    """Yaw rate of a car whose steering angle for a radius grows with the square of speed; x[3] is the speed."""
    return rate / (1 + k["K"] * x[..., 3] ** 2)
