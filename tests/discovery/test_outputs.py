"""Outputs that are no states have no range: what is compared with ranges leaves them out."""

import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.errors import DataError
from simpel_cli.filtering.measurements.cleaning import refuse_far
from simulators.model import Declared


def test_values_far_outside_are_those_of_states_and_inputs() -> None:
    states = {"x": {"unit": "m", "range": [0, 1]}}
    model = Declared("s", 1, states=states, dynamics={"x": "0"}, outputs={"y": "x"}).model()
    rows = np.linspace(0, 1, 20)
    episode = Episode("0", rows, rows[:, None], np.zeros((20, 0)), 1e6 * rows[:, None])
    refuse_far(Recording((episode,), (), ("y",), {}, (), (), ()), model)
    far = episode._replace(states=1e6 * rows[:, None])
    with pytest.raises(DataError, match=r"data: x reaches 1e\+06 m"):
        refuse_far(Recording((far,), (), ("y",), {}, (), (), ()), model)
