"""The law of the noise, chosen for the training rows of a simulator's problem."""

import jax
import numpy as np
import pytest

from simpel_cli.errors import ConfigError
from simpel_cli.inference import scales
from simpel_cli.inference.assemble import Assembled, assemble
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Training
from simpel_cli.inference.system import normaliser_of, system_of
from simpel_cli.priors.function_prior import SimulatorPrior
from simpel_cli.reporting.run_table import law_in_words
from simpel_cli.scores.gaussian import Gaussian
from simulators.model import Declared

KEY, SIGMA, OFF = jax.random.key(0), 0.004, 0.4
SYSTEM = system_of(
    Declared(
        "decay", dt=0.1, states={"x": {"unit": "m", "range": [-1, 1]}}, inputs={"u": {"unit": "N", "range": [-2, 2]}},
        parameters={"a": {"unit": "1/s", "range": [0.5, 1.5]}}, dynamics={"x": "-a*x + u"},
    ).model(),
    (), 0,
)  # fmt: skip


def assembled(
    rows: int, law: str, *, freedom: float | None = 2.5, learn: bool = True, seeds: int = 1, kept: str | None = None
) -> Assembled:
    """Rows of the simulator with noise; the last one is far off."""
    random = np.random.default_rng(1)
    x = random.uniform([-1, -2], [1, 2], (rows, 2))
    noise = random.normal(size=(rows, 1)) if freedom is None else random.standard_t(freedom, (rows, 1))
    decay = np.exp(-0.1)
    y = x[:, :1] * (decay - 1) + x[:, 1:] * (1 - decay) + SIGMA * noise
    y[-1:] += OFF if freedom is not None else 0.0
    return assemble(
        SYSTEM, normaliser_of(SYSTEM, KEY), SimulatorPrior(), Gaussian(), [Training(x, y)] * seeds, {"x": SIGMA}, {},
        noise=NoiseModel(learn=learn), pool=16, keys=list(jax.random.split(KEY, seeds)), precision="float32", law=law,
        kept_law=kept,
    )  # fmt: skip


def words(done: Assembled, law: str, *, learn: bool = True) -> str:
    return law_in_words(done, law, ["x"], learned=learn)


def test_the_data_choose_the_law_and_the_run_says_so() -> None:
    heavy, light = assembled(80, "auto"), assembled(80, "auto", freedom=None)
    assert heavy.problems.tail is not None
    assert light.problems.tail is None
    assert "Student's t, ahead by" in words(heavy, "auto")
    assert words(light, "auto").startswith("Gaussian: Student's t is")
    assert words(assembled(10, "auto"), "auto").startswith("Gaussian: too few rows")


@pytest.mark.parametrize("freedom", [2.5, None], ids=["heavy", "light"])
def test_what_a_run_began_with_is_not_decided_again(freedom: float | None) -> None:
    """Nor does it change a number: the other law's arrays are those of a run that began with it."""
    for law in ("gaussian", "student_t"):
        kept = assembled(80, "auto", freedom=freedom, kept=law).problems
        begun = assembled(80, law, freedom=freedom).problems
        assert (kept.tail is None) == (begun.tail is None) == (law == "gaussian")
        jax.tree.map(np.testing.assert_array_equal, kept, begun)


def test_what_is_asked_for_is_taken() -> None:
    done = assembled(80, "gaussian")
    assert done.problems.tail is None
    assert words(done, "gaussian") == "Gaussian, as data.noise.law says"
    few = assembled(8, "student_t", freedom=None)
    assert few.problems.tail is not None
    assert "as data.noise.law says" in words(few, "student_t")


def test_a_fixed_noise_is_gaussian() -> None:
    with pytest.raises(ConfigError, match=r"data.noise.law: student_t, but .* method.noise.learn=false"):
        assembled(40, "student_t", learn=False)
    done = assembled(40, "auto", learn=False)
    assert words(done, "auto", learn=False) == "Gaussian, fixed (method.noise.learn=false)"


def test_rows_that_were_not_looked_at_have_weights_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """More rows than are looked at together: each that is far off counts for little, wherever it stands."""
    monkeypatch.setattr(scales, "SCALE_POINTS", 50)
    done = assembled(180, "student_t", seeds=2)
    weights = np.asarray(done.problems.weights)[:, :180, 0]
    assert weights.shape == (2, 180)
    assert np.all(weights[:, -1] < 0.05)
    assert np.all(np.abs(weights - 1) > 1e-9)  # none was left as it began


def test_scale_and_degrees_of_freedom_are_those_that_were_planted() -> None:
    """Of the noise with the white model error of the prior, which is a fifth of it here."""
    problems = assembled(400, "student_t").problems
    scale = float(problems.noise_init[0, 0] * problems.normaliser.y_std[0, 0])
    assert abs(scale / SIGMA - 1) < 0.2
    assert abs(float(problems.tail[0, 0]) - 1 / 2.5) < 0.1
