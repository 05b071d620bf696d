"""How far beyond its range a late input is taken for a line."""

import pytest

from simulators.model import Declared
from simulators.overshoot import reach


def tank(inflow: str, **more: dict[str, object]) -> Declared:
    inputs = {"u": {"unit": "V", "range": [0, 6]}, **more}
    states, parameters = {"h": {"unit": "m", "range": [0, 1]}}, {"k": {"unit": "1", "range": [0, 1]}}
    return Declared(
        "tank", dt=1.0, states=states, inputs=inputs, parameters=parameters, dynamics={"h": f"k*{inflow} - h"}
    )


@pytest.mark.parametrize(
    ("inflow", "expected"),
    [
        ("u", (-2, 8)), ("u*u*h", (-2, 8)), ("sqrt(u)", (0, 8)), ("sqrt(max(u, 0))", (0, 8)), ("log(7 - u)", (-2, 6)),
        ("1/(u + 1)", (0, 8)), ("min(max(u, 0), 6)", (0, 6)), ("u*sqrt(h - 0.5)", (-2, 8)),
    ],
)  # fmt: skip
def test_an_input_goes_beyond_its_range_where_the_simulator_goes_on_there(
    inflow: str, expected: tuple[float, float]
) -> None:
    assert reach(tank(inflow).model()) == (expected,)


def test_each_input_has_its_own() -> None:
    assert reach(tank("sqrt(u)*w", w={"unit": "1", "range": [-3, 3]}).model()) == ((0, 8), (-5, 5))
