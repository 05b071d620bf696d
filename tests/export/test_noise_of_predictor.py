"""The exported predictor's noise where it goes with the row: numpy says what the posterior does."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.export.predictor import Predictor, value_of
from simpel_cli.inference.noise_scale import noise_scale_of
from simulators.model import Quantity

ENCODING = Encoding(
    (Quantity("phi", "rad", -np.pi, np.pi, periodic=True), Quantity("w", "rad/s", -4.0, 4.0)),
    (Quantity("u", "V", -1.0, 1.0), Quantity("f", "N", -1.0, 1.0)),
    (Quantity("q", "", np.nan, np.nan),),
    stack=1,
    linear=(1,),
)
SHAPES = {
    "phi": "0.1 + abs(sin(phi))*max(u, 0.2, f)",
    "w": "where(0 < w <= 2, 1 + w**2, 2.5) + exp(-f)/pi",
    "q": "sqrt(0.3 + q**2) - -min(0.1, 0.2)*(w != 3)",
}


def test_the_noise_of_a_row_is_that_of_the_posterior(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    facts = {
        "states": [{"name": q.name, "unit": q.unit, "angle": q.periodic} for q in ENCODING.states],
        "inputs": [{"name": q.name, "unit": q.unit} for q in ENCODING.inputs],
        "outputs": [{"name": "q", "unit": ""}], "past_inputs": 1, "next_inputs": ["f"], "negative_slope": 0.01,
        "noise_scale": SHAPES,
    }  # fmt: skip
    (tmp_path / "posterior.json").write_text(json.dumps(facts))
    dx, dy = ENCODING.dim_x, ENCODING.dim_y
    scale, std = noise_scale_of(SHAPES, ENCODING), rng.uniform(0.1, 1, dy)
    typical = rng.uniform(0.5, 2, dy)
    arrays = {
        "x_mean": np.zeros(dx), "x_std": np.ones(dx), "y_mean": np.zeros(dy), "y_std": np.ones(dy), "noise_std": std,
        "noise_rms": typical, "kernel_0": 0.3 * rng.normal(size=(3, dx, dy)), "bias_0": rng.normal(size=(3, dy)),
    }  # fmt: skip
    save_file(arrays, tmp_path / "posterior.safetensors")
    predictor = Predictor(tmp_path)
    assert scale is not None
    for _ in range(5):
        states, inputs = rng.uniform(-3, 3, (1, 2)), rng.uniform(-1, 1, (1, 5))
        x = ENCODING.to_x(states, inputs)
        expected = scale.relative(x, predictor.targets(x).mean(axis=0), typical)[0]
        np.testing.assert_allclose(predictor.relative_noise(states, inputs), expected, rtol=1e-9)
        now = {"u": inputs[0, 2], "f": inputs[0, 3]}
        past, later = [{"u": inputs[0, 0], "f": inputs[0, 1]}], {"f": inputs[0, 4]}
        found = predictor.step({"phi": states[0, 0], "w": states[0, 1]}, now, past, later)
        spread = found.members.var(axis=0)
        assert found.std["w"] == pytest.approx(np.hypot(np.sqrt(spread[1]), std[2] * expected[2]), rel=1e-9)
        assert found.std["q"] == pytest.approx(np.hypot(np.sqrt(spread[2]), std[3] * expected[3]), rel=1e-9)


@pytest.mark.parametrize("text", ["().__class__", "open('x')", "[1][0]", "(lambda: 1)()"])
def test_a_file_that_somebody_changed_runs_nothing(text: str) -> None:
    with pytest.raises((ValueError, KeyError)):
        value_of(ast.parse(text, mode="eval").body, {"x": 1.0})
