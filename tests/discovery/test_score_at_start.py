"""What a term promises that has no size which could be switched off: a delay of rows, a level at which a signal ends."""

from typing import Any

import numpy as np
import pytest
from test_ranges import cart, measured, searched

from simpel_cli.filtering.likelihood.fit import Hypothesis
from simulators.effects import Expression

LATE = Expression(
    "late", acts_on="input", operator="delay",
    parameters={"d": {"range": [0, "8*dt"], "unit": "s", "starts": ["2*dt", "5*dt"]}},
)  # fmt: skip
ENDS = Expression(
    "ends", acts_on="input", term="min(max(u, -limit), limit)",
    parameters={"limit": {"range": ["0.1*U", "U"], "unit": "U", "neutral": "2*U", "starts": ["0.8*U", "0.5*U"]}},
)  # fmt: skip
ROWS = 3


def late(rows: int) -> Any:
    """Carts whose input acts some rows after it is recorded, with five times the usual noise."""
    recording = measured(1.3)

    def moved(episode: Any) -> Any:
        u = np.concatenate([episode.inputs[rows:], np.repeat(episode.inputs[-1:], rows, axis=0)])
        random = np.random.default_rng(int(episode.name))
        return episode._replace(inputs=u, states=episode.states + 0.02 * random.normal(size=episode.states.shape))

    train, test = (tuple(moved(e) for e in part) for part in (recording.train, recording.test))
    return recording._replace(train=train, test=test, noise_std={"s": 0.02, "v": 0.02})


@pytest.fixture(scope="module")
def search() -> Any:
    return searched(late(ROWS), (LATE, ENDS), cart(0.5, 2.0))


def test_a_delay_promises_about_what_its_fit_gains(search: Any) -> None:
    base = search.base()
    starts = search.starts(base, range(len(search.terms)))
    scores = search.promises(base, starts)
    fits = search.fitter([hypothesis for _, hypothesis in starts])
    gains = [base.optimum.loss - o.loss for o in fits]
    told = [(s, g) for (t, _), s, g in zip(starts, scores, gains, strict=True) if search.terms[t].effect == "late"]
    most = max(gains)
    assert most == pytest.approx(max(g for _, g in told))
    assert most > 50
    ours = [s for (t, _), s in zip(starts, scores, strict=True) if search.terms[t].effect in ("late", "ends")]
    assert not any(score.switched_off for score in ours)
    assert all(score.sure < most + 1 for score, _ in told)  # what is reached where it begins, a fit reaches
    assert 0.3 * most < max(score.gain for score, _ in told) < 3 * most
    # what the data do not ask for promises less
    other = [s for (t, _), s in zip(starts, scores, strict=True) if search.terms[t].effect == "ends"]
    assert max(s.sure for s in other) < max(s.sure for s, _ in told)


def test_what_is_reached_at_a_start_is_the_loss_there_with_the_noise_of_the_model_without_it(search: Any) -> None:
    base = search.base()
    (term, hypothesis), *_ = search.starts(base, [0])
    z = base.optimum.z.copy()
    z[search.rows[term]] = hypothesis.z[search.rows[term]]
    (there,) = search.fitter([Hypothesis(z, search.free((term,)), search.ones)], 1)
    (score, *_) = search.promises(base, search.starts(base, [0]))
    assert score.sure == pytest.approx(base.optimum.loss - there.loss, abs=0.01)
    assert score.gain == pytest.approx(score.sure + 2 * there.step, rel=0.02)


def test_a_start_that_is_far_off_tells_nothing(search: Any) -> None:
    base = search.base()
    z = base.optimum.z.copy()
    quiet = z.copy()
    quiet[list(search.noise)] = 0.0  # beside so little noise every start is far off
    before = base._replace(optimum=base.optimum._replace(z=quiet))
    (score, *_) = search.promises(before, search.starts(before, [0]))
    assert score.gain == np.inf
    assert score.sure == -np.inf
