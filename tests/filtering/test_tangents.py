"""Derivatives of what sensors read, in every parameter, beside differences of the filter: late sensors and inputs, many states.

A filter that is deaf learns nothing from what it reads, so that its innovations are a simulation's: no gain is held, and the
derivative is that of the integrator. Several points at once, each with parameters of its own.
"""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import linear_plant
import numpy as np
import pytest

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.filtering.likelihood import pushes
from simpel_cli.filtering.likelihood.track import Noise
from simpel_cli.filtering.setup import setup
from simulators.effects import Expression
from simulators.model import Declared
from simulators.overshoot import reach

DT, ROWS, POINTS, STEP = 0.2, 16, 3, 1e-6
# of the largest: k2 and k3 of a Runge-Kutta step share a state; where a sensor is late, the slope of the rates is held, too,
# and the third order's rest, which counts where inputs are late beside it
EXACT, LATE, REST = 0.005, 0.03, 0.12
ANY = {"unit": "1", "range": [-3, 3]}
UNKNOWN = {"a": {"unit": "1", "range": [0.2, 1.2]}, "b": {"unit": "1", "range": [0.8, 1.8]}}
PENDULUM: dict[str, Any] = {
    "states": {"s": ANY, "v": ANY}, "inputs": {"u": ANY}, "parameters": UNKNOWN,
    "dynamics": {"s": "v", "v": "b*u - a*v*sqrt(0.1 + v*v) - a*b*sin(s)"},
}  # fmt: skip
CHAIN: dict[str, Any] = {
    "states": dict.fromkeys("wxyz", ANY), "inputs": {"u": ANY}, "parameters": UNKNOWN,
    "dynamics": {"w": "u - w - a*z*y", "x": "y", "y": "-b*sin(x) - a*y + z", "z": "w - z"},
}  # fmt: skip
FREE: dict[str, Any] = PENDULUM | {"inputs": {}, "dynamics": {"s": "v", "v": "-a*v*sqrt(0.1 + v*v) - a*b*sin(s)"}}
LINEAR: dict[str, Any] = PENDULUM | {"inputs": {"u": ANY | {"between_rows": "linear"}}}


def late(kind: str, on: str) -> Expression:
    return Expression(kind, acts_on=on, operator=kind, parameters={"t": {"range": [0, 0.2], "unit": "s"}})


def recording(states: list[str], uneven: bool, driven: bool = True) -> Recording:
    random = np.random.default_rng(3)
    episodes = []
    for k in range(5):
        time = np.arange(ROWS) * DT + uneven * 0.3 * DT * random.uniform(-1, 1, ROWS)
        early = np.zeros((ROWS, len(states)))
        early[1:, -1] = random.uniform(0, 0.9, ROWS - 1) * np.diff(time)
        read = 0.3 + 0.05 * np.cumsum(random.normal(size=(ROWS, len(states))), axis=0)
        inputs = random.normal(size=(ROWS, 1))[:, : int(driven)]
        episodes.append(Episode(f"{k}", time, read, inputs, np.zeros((ROWS, 0)), late=early if uneven else None))
    noise = dict.fromkeys(states, 0.1)
    return Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), noise, (), (Check("c", True, ""),), ())


SENSORS = [late("sensor_delay", "v"), late("sensor_lag", "s")]
INPUTS = [late("delay", "u"), late("lag", "u")]


@pytest.mark.parametrize(
    ("system", "effects", "uneven", "within"),
    [
        (PENDULUM, [], False, EXACT), (PENDULUM, SENSORS, False, LATE), (PENDULUM, INPUTS, True, EXACT),
        (PENDULUM, [*SENSORS, *INPUTS], True, REST), (LINEAR, [*SENSORS, *INPUTS], False, REST),
        (CHAIN, [late("sensor_delay", "x"), late("sensor_lag", "w"), *INPUTS], False, REST),
        (CHAIN, [late("sensor_delay", "x"), *INPUTS], True, EXACT),
        (FREE, [], False, EXACT), (FREE, SENSORS, False, LATE), (FREE, SENSORS, True, LATE),
    ],
)  # fmt: skip
def test_derivatives_of_readings_are_those_of_differences(
    system: dict[str, Any], effects: list[Expression], uneven: bool, within: float
) -> None:
    measured = recording(list(system["states"]), uneven, bool(system["inputs"]))
    plan = setup(Declared("any", dt=DT, **system).model(), measured, (), effects, 2)
    y, ok, u, start, spread = (jnp.moveaxis(a[:POINTS], 0, -1) for a in plan.windows.arrays)
    n_p, points = plan.coordinates.sizes[0], y.shape[-1]
    own = [i for i, q in enumerate(plan.augmented.params) if not q.name.startswith(("unnamed", "size_of"))]
    p = np.repeat(plan.augmented.neutral[:, None], points, axis=1)
    random = np.random.default_rng(1)
    for i in own:  # away from where an effect begins
        q = plan.augmented.params[i]
        p[i] = q.low + random.uniform(0.3, 0.6, points) * (q.high - q.low)
    deaf = Noise(jnp.full((len(y[0]), points), 1e6), jnp.zeros((len(start), points)))
    spread = jnp.full_like(spread, 1e-9)

    @jax.jit
    def read(p: jax.Array) -> jax.Array:
        track: jax.Array = plan.rule.track(p, deaf, y, ok, u, start, spread)[0].innovation
        return track

    @jax.jit
    def slopes(p: jax.Array) -> jax.Array:
        track, held = plan.rule.track(p, deaf, y, ok, u, start, spread)
        rows = jnp.broadcast_to(jnp.array([*own, n_p])[:, None], (len(own) + 1, points))
        ways, pushes = plan.rule.pushes(p, rows, track, held, u)
        louder = jax.tree.map(lambda a: jnp.zeros((1, *a.shape)), deaf)
        found: jax.Array = plan.rule.slopes(p, deaf, louder, track, held, ok, ways, pushes)[0]
        return found

    found = np.asarray(slopes(jnp.asarray(p)))
    assert not found[0].any()  # no level of noise moves
    assert not found[-1].any()  # padding
    for k, i in enumerate(own):
        unit = np.zeros_like(p)
        unit[i] = STEP
        difference = np.asarray(read(jnp.asarray(p + unit)) - read(jnp.asarray(p - unit))) / (2 * STEP)
        assert np.abs(difference).max() > 1e-3  # it is seen
        np.testing.assert_allclose(found[k + 1], difference, atol=within * np.abs(difference).max())


def test_filters_that_are_cut_at_different_ends_are_not_the_same() -> None:
    """Where a root is defined beyond the range of an input depends on the ranges of the others."""
    names = set()
    for low, high in ((3.5, 5.0), (16.0, 18.0)):
        parameters = {"k": {"unit": "1", "range": [low, high]}}
        model = Declared(
            "root", dt=DT, **PENDULUM | {"parameters": parameters, "dynamics": {"s": "v", "v": "sqrt(k + u)"}}
        )
        names.add((reach(model.model()), setup(model.model(), recording(["s", "v"], False), (), INPUTS, 2).rule.name))
    assert len({ends for ends, _ in names}) == 2
    assert len({name for _, name in names}) == 2


@pytest.mark.parametrize("lanes", [None, 2])
def test_a_table_of_all_slopes_gives_what_branches_give(lanes: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU, where a branch waits for the host."""
    plan = setup(linear_plant.model(), linear_plant.recording(), (), [linear_plant.LOAD], 2)
    y, ok, u, start, spread = (jnp.moveaxis(a[:4], 0, -1) for a in plan.windows.arrays)
    n_p, points = plan.coordinates.sizes[0], y.shape[-1]
    p = jnp.repeat(jnp.asarray(plan.augmented.neutral)[:, None], points, axis=1)
    noise = Noise(jnp.full((len(y[0]), points), 0.1), jnp.full((len(start), points), 0.1))
    rows = jnp.arange(n_p + 1) if lanes is None else jnp.stack([jnp.arange(n_p + 1), jnp.arange(n_p + 1)[::-1]], axis=1)
    track, held = plan.rule.track(p, noise, y, ok, u, start, spread)
    on_cpu = plan.rule.pushes(p, rows, track, held, u)
    monkeypatch.setattr(pushes, "current_device", lambda: SimpleNamespace(platform="gpu"))
    on_gpu = plan.rule.pushes(p, rows, track, held, u)
    assert float(jnp.abs(on_cpu[1].state).max()) > 0
    for a, b in zip(jax.tree.leaves(on_cpu), jax.tree.leaves(on_gpu), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
