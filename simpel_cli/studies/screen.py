"""The output of a study while it runs; `reporting.fit.SCREEN` prints to the terminal."""

from collections.abc import Callable
from typing import NamedTuple


class Screen(NamedTuple):
    """Functions that a fit and an evaluation call.

    Args:
        describe: (terminal, study, fitted, checked prior or None), before training.
        describe_evaluation: (terminal, directory of the fit, step, study of the fit, study that is tested), before the test.
        publish: (terminal, study of the fit, fitted, study that is tested, results, manifest), at the end: prints the results,
            draws the figures, writes the report.
    """

    describe: Callable[..., None]
    describe_evaluation: Callable[..., None]
    publish: Callable[..., None]
