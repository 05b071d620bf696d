"""A model that follows its sensors is fitted once more as one that trusts its equations."""

from typing import Any

import numpy as np
from test_pairs import CUBIC, LINEAR, carts
from test_ranges import cart, searched

from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.two_optima import other_optima, trusting


def test_the_right_model_that_follows_a_sensor_finds_the_other_optimum() -> None:
    """Begun where a wrong model had ended, with a sensor without noise, it comes to the same as from its own start."""
    search: Any = searched(carts(-0.09, 0.0125), (LINEAR, CUBIC), cart())
    both = tuple(t for t, term in enumerate(search.terms) if term.effect in ("linear", "cubic"))
    whole = search.part(search.base(), both)
    n_p, n_r, n_q = search.plan.coordinates.sizes
    lost = whole.optimum.z.copy()
    lost[n_p : n_p + n_r], lost[n_p + n_r : n_p + n_r + n_q] = 0.0, 0.6
    (worse,) = search.fitter([Hypothesis(lost, whole.optimum.free, search.ones)], 0)
    stuck = worse._replace(z=lost, loss=whole.optimum.loss + 80, log_evidence=whole.optimum.log_evidence - 80)
    least = whole.optimum.log_evidence - 200
    (found,) = other_optima(search.plan, search.fitter, [stuck], least)
    assert found.log_evidence > whole.optimum.log_evidence - 1
    # what does not follow a sensor, or gains little beside the best, is left as it is
    assert other_optima(search.plan, search.fitter, [whole.optimum], least) == [whole.optimum]
    little = stuck._replace(log_evidence=least + 20)
    assert other_optima(search.plan, search.fitter, [whole.optimum, little], least)[1] is little
    start = trusting(search.plan, lost)
    assert np.all(start[n_p + n_r : n_p + n_r + n_q] <= 0.1)
    np.testing.assert_array_equal(start[n_p : n_p + n_r], search.plan.start[n_p : n_p + n_r])
    # the simulator alone is compared with nothing, and begins again, too
    (alone,) = other_optima(search.plan, search.fitter, [stuck], -np.inf)
    assert alone.log_evidence == found.log_evidence
    # one that was left on the way is no better fit, whatever its evidence seems to be there
    lost_on_the_way = [found._replace(left=True, log_evidence=found.log_evidence + 1e3)]
    assert other_optima(search.plan, lambda _, hopes: lost_on_the_way if _ else [], [stuck], least) == [stuck]
