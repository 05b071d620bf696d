"""What a late sensor shows ahead: errors of the right model are noise at every horizon, also where the motion is fast."""

import numpy as np
import pytest
from test_found_sensors import TAU, carts
from test_ranges import searched

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.filtering.errors_ahead import Assessor, rmse
from simulators.effects import Expression
from simulators.model import Declared

NOISE = (0.005, 0.01)


@pytest.mark.parametrize("horizon", [1, 3, 10])
def test_a_lag_is_seen_in_what_is_predicted_further_ahead(horizon: int) -> None:
    rows = carts("lag")
    episodes = [
        Episode(str(e), own["t"].to_numpy(), own[["s", "v"]].to_numpy(), own[["u"]].to_numpy(), np.zeros((len(own), 0)))
        for e, own in rows.groupby("episode")
    ]
    data = Recording(
        tuple(episodes[:4]),
        tuple(episodes[4:6]),
        (),
        dict(zip("sv", NOISE, strict=True)),
        (),
        (Check("c", True, ""),),
        (),
    )
    model = Declared(
        name="cart", dt=0.05, states={"s": {"unit": "m", "range": [-5, 5]}, "v": {"unit": "m/s", "range": [-5, 5]}},
        inputs={"u": {"unit": "V", "range": [-3, 3]}}, parameters={"b": {"unit": "m/s^2/V", "range": [0.6, 2.0]}},
        dynamics={"s": "v", "v": "b*u"},
    ).model()  # fmt: skip
    lag = Expression(
        "lag",
        acts_on="v",
        operator="sensor_lag",
        parameters={"tau": {"range": [0, 0.2], "unit": "s", "starts": [0.02]}},
    )
    search = searched(data, (lag,), model)
    base = search.base()
    (term,) = (t for t, one in enumerate(search.terms) if one.effect == "lag")
    whole = search.part(base, (term,))
    (row,) = search.rows[term]
    assert search.plan.coordinates.value(row, float(whole.optimum.z[row])) == pytest.approx(TAU, rel=0.15)
    assessor = Assessor(search.plan, horizon)
    before, after = (assessor(t.optimum.z, search.plan.windows) for t in (base, whole))
    for name in ("ahead", "free"):
        v = rmse(getattr(after, name))[1]
        assert v < 1.5 * NOISE[1], name
        assert v < 0.3 * rmse(getattr(before, name))[1], name
