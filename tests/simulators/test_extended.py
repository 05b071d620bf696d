"""A simulator with terms beside it: the rates of the base and what is added, and messages."""

from typing import Any

import numpy as np
import pytest
from systems import whole_node

from simpel_cli.config.build import build
from simpel_cli.errors import ConfigError
from simulators.model import Model, ModelError


def extended(base: str, **parts: Any) -> Model:
    node = {"_target_": "simulators.extended.Extended", "name": "more", "base": whole_node(base)} | parts
    made = build(node, "sim").model()
    assert isinstance(made, Model)
    return made


def point(model: Model, **values: float) -> list[list[float]]:
    """States, inputs and parameters, in the middle of their ranges where nothing else is given."""
    return [
        [values.get(q.name, (q.low + q.high) / 2) for q in group]
        for group in (model.states, model.inputs, model.params)
    ]


def rates(model: Model, **values: float) -> np.ndarray:
    return np.asarray(model.function()(*point(model, **values))[0]).ravel()


def test_terms_add_to_the_rates_of_the_base() -> None:
    added = {"c": {"unit": "1/s", "range": [0.2, 0.4], "prior": "normal"}, "k": 2.0}
    more = extended("pendulum", parameters=added, dynamics={"omega": "-c*omega + k*rate_omega"})
    bare = extended("pendulum")
    assert [q.name for q in more.params] == [*(q.name for q in bare.params), "c"]
    assert more.params[-1].prior == "normal"
    here = {"phi": 0.3, "omega": 2.0, "u": 1.0}
    old = rates(bare, **here)
    np.testing.assert_allclose(rates(more, **here), [old[0], 3 * old[1] - 0.3 * 2.0], rtol=1e-12)


def test_an_input_is_replaced_before_the_base_sees_it() -> None:
    more = extended("racecar", parameters={"a": 0.5}, inputs={"throttle": {"value": "a*throttle"}})
    bare = extended("racecar")
    np.testing.assert_allclose(rates(more, throttle=0.8), rates(bare, throttle=0.4), rtol=1e-12)
    assert np.abs(rates(bare, throttle=0.8) - rates(bare, throttle=0.4)).max() > 0.1


def test_commands_become_late_and_the_car_keeps_its_coordinates() -> None:
    more = extended("racecar", parameters={"d": {"unit": "s", "range": [0.1, 0.2]}}, inputs={"steer": {"delay": "d"}})
    assert more.delay == {"steer": "d"}
    assert more.coordinates is not None
    assert extended("racecar", dynamics={"omega": "-omega"}).coordinates is None


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"dynamics": {"omge": "1"}},
            r"sim\.dynamics\.omge: sim\.base has no such name; known: .*omega.* Did you mean",
        ),
        ({"inputs": {"stear": {"value": "1"}}}, r"sim\.inputs\.stear: sim\.base has no such name"),
        ({"parameters": {"m": 1.0}}, r"sim\.parameters\.m: the name is taken by sim\.base"),
        ({"parameters": {"rate_omega": 1.0}}, r"sim\.parameters\.rate_omega: the name is taken by sim\.base"),
        ({"parameters": {"sin": 1.0}}, r"sim\.parameters\.sin: sin is a function of expressions"),
        ({"inputs": {"steer": {"dely": 0.1}}}, r"sim\.inputs\.steer\.dely: unknown key; allowed: value, delay, lag"),
        ({"inputs": {"steer": "0.5*steer"}}, r"sim\.inputs\.steer: '0\.5\*steer' is not a mapping"),
        ({"name": "no name"}, r"sim\.name: 'no name' is no model name"),
        ({"dynamics": {"omega": "-q*omega"}}, r"sim\.dynamics\.omega: unknown name 'q'"),
        (
            {"inputs": {"steer": {"delay": "q"}}},
            r"sim\.inputs\.steer\.delay: 'q' is neither a number \(s\) nor a parameter",
        ),
    ],
)
def test_wrong_words(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        extended("racecar", **parts)


def test_a_world_cannot_be_extended() -> None:
    with pytest.raises((ModelError, ConfigError), match=r"sim\.base: a world shows no equations"):
        extended("pendulum_world")
