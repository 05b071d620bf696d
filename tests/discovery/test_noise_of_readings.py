"""Readings whose noise goes with the row, in the filter: they count by it, and are not taken for heavy tails."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_heavy_tailed_readings import DT, NOISE, errors, fitted, model

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.dynamics.transition import encoding_of
from simpel_cli.filtering.setup import whole_windows as windows_to_test
from simpel_cli.inference.noise_scale import noise_scale_of

ROWS, FORMULA = 120, "0.15 + u**2"


def recording(seed: int, nu: float | None = None) -> Recording:
    """Five episodes of dv/dt = B u - A v; the noise of v goes with u."""
    random = np.random.default_rng(seed)
    episodes = []
    for k in range(5):
        u = np.repeat(random.normal(size=ROWS // 5), 5)
        x, states = np.array([0.0, random.normal()]), []
        for now in u:
            states.append(x)
            for _ in range(20):
                x = x + DT / 20 * np.array([x[1], 1.3 * now - 0.7 * x[1]])
        e = random.normal(size=(ROWS, 2))
        if nu is not None:
            e[:, 1] = random.standard_t(nu, ROWS)
        e[:, 1] *= 0.15 + u**2
        time = np.arange(ROWS) * DT
        episodes.append(Episode(f"{k}", time, np.array(states) + NOISE * e, u[:, None], np.zeros((ROWS, 0))))
    return Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), {"s": NOISE, "v": NOISE}, (), (), ())


def counted(data: Recording) -> Recording:
    scale = noise_scale_of({"v": FORMULA}, encoding_of(model()))
    assert scale is not None
    return scale.counted(data)


def test_readings_count_by_their_noise() -> None:
    """More nats by N (log rms(s) - mean log s), as in closed form; without, it looks like heavy tails."""
    data = recording(0)
    plan, found = fitted(counted(data))
    assert found.degrees_of_freedom == {}
    _, alike = fitted(data, weighed=False)
    s = 0.15 + np.concatenate([e.inputs[:, 0] for e in data.train]) ** 2
    gain = len(s) * (np.log(np.sqrt(np.mean(s**2))) - np.mean(np.log(s)))
    assert gain > 100
    assert found.base.optimum.log_evidence - alike.base.optimum.log_evidence == pytest.approx(gain, rel=0.15)
    r = plan.coordinates.physical(jnp.asarray(found.base.optimum.z))[1].r
    np.testing.assert_allclose(r[1], NOISE * np.sqrt(np.mean(s**2)), rtol=0.1)  # of a typical row
    off, sd = errors(plan, found)
    assert (np.abs(off) < 3.5 * sd).all()
    held = windows_to_test(plan, counted(data).test, ())
    own = 0.15 + data.test[0].inputs[:, 0] ** 2
    np.testing.assert_allclose(held.ok[0, :, 1], np.mean(s**2) / own**2, rtol=1e-9)
    assert (held.ok[..., 0] == 1).all()
    _, fooled = fitted(data)
    assert "v" in fooled.degrees_of_freedom


def test_tails_beside_a_scale() -> None:
    """A value's weight is that of its scale times that of its tail."""
    data = counted(recording(1, 3.0))
    _, found = fitted(data)
    assert list(found.degrees_of_freedom) == ["v"]
    assert 2 < found.degrees_of_freedom["v"] < 7
    windows = found.search.plan.windows
    weight = np.concatenate([e.weight[:, 1] for e in data.train if e.weight is not None])
    tail = windows.ok[..., 1].ravel() / weight
    nu = found.degrees_of_freedom["v"]
    assert np.mean(tail > 0) > 0.99
    assert tail.max() <= (nu + 1) / nu * (1 + 1e-9)
    assert np.median(tail) == pytest.approx(1.15, abs=0.15)  # most lie near, and count a little more than one


def test_a_lone_value_is_judged_by_its_own_noise() -> None:
    """Fifteen times the noise of a quiet row is less than two of a typical one."""
    data = recording(2)
    u = data.train[0].inputs[:, 0]
    quiet = 20 + int(np.argmin(np.abs(u[20:-20])))
    states = data.train[0].states.copy()
    states[quiet, 1] += 15 * NOISE * (0.15 + u[quiet] ** 2)
    _, found = fitted(
        counted(data._replace(train=(data.train[0]._replace(states=states), *data.train[1:]))), weighed=False
    )
    assert [(p.name, p.split, p.episode, p.row) for p in found.clean.left_out] == [("v", "train", 0, quiet)]
