"""Harm with both models calibrated for their use."""

import numpy as np
from test_pairs import CUBIC, LINEAR, carts
from test_ranges import cart, searched

from simpel_cli.discovery.search.gate.harm import growing_for
from simpel_cli.filtering.errors_ahead import Assessor


def test_what_grows_is_told_on_parts_that_had_no_part() -> None:
    search = searched(carts(-0.09, 0.0125), (LINEAR, CUBIC), cart())
    assessor = Assessor(search.plan, 10)
    base = search.base()
    both = search.part(base, tuple(t for t, term in enumerate(search.terms) if term.effect in ("linear", "cubic")))
    assert growing_for(search, assessor, base, base, "free_run") == ()
    assert growing_for(search, assessor, both, base, "free_run") == ()
    grown = growing_for(search, assessor, base, both, "free_run")
    assert grown
    assert "v in free run" in grown
    windows = search.plan.windows
    search.plan = search.plan._replace(windows=windows._replace(episode=np.zeros_like(windows.episode)))
    assert growing_for(search, assessor, both, base, "free_run") is None  # one episode tells nothing
