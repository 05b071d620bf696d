"""What stands behind a short episode in a window that is as long as the longest one."""

import numpy as np

from simpel_cli.data.recording import Episode
from simpel_cli.filtering.measurements.windows import windows_of


def test_inputs_go_on_as_a_parabola_for_two_rows_within_what_they_were() -> None:
    def of(u: np.ndarray) -> Episode:
        n = len(u)
        return Episode("e", 0.1 * np.arange(n), np.zeros((n, 1)), u[:, None], np.zeros((n, 0)))

    bowl, rising = (np.arange(10.0) - 7) ** 2, np.arange(10.0)
    given = windows_of(
        [of(np.zeros(14)), of(bowl), of(rising)], ["x"], ["x"], [], np.zeros(1), np.ones(1), lead=1, dt=0.1
    )
    np.testing.assert_allclose(given.u[1, 11:, 0], [9, 16, 16, 16])  # a smooth input reads two rows ahead
    np.testing.assert_allclose(given.u[2, 11:, 0], 9)  # no further than it ever was
