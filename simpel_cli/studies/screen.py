"""What a study shows while it runs. Studies call it; `reporting.fit.SCREEN` is the one for people."""

from collections.abc import Callable
from typing import NamedTuple


class Screen(NamedTuple):
    """Functions that a fit and an evaluation call.

    Args:
        describe: (terminal, study, fitted, checked prior or None), before training.
        describe_evaluation: (terminal, directory of the fit, step, study of the fit, study that is judged), before judging.
        publish: (terminal, study of the fit, fitted, study that is judged, judged, manifest), at the end: prints the results,
            draws the figures, writes the report.
    """

    describe: Callable[..., None]
    describe_evaluation: Callable[..., None]
    publish: Callable[..., None]
