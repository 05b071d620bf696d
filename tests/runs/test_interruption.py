"""Ctrl-C is not lost, wherever it comes."""

import signal
import time

import pytest

from simpel_cli.runs.interruption import never_lost


class Interrupting:
    """Ctrl-C comes while it is destroyed, where Python drops whatever is raised."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


def test_ctrl_c_inside_a_destructor_is_raised_once_more() -> None:
    def work() -> None:
        with never_lost():
            Interrupting()
            time.sleep(20)

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        work()
    assert time.monotonic() - began < 10


def test_what_else_a_destructor_raises_is_shown_as_ever(capsys: pytest.CaptureFixture[str]) -> None:
    import sys

    class Failing:
        def __del__(self) -> None:
            raise ValueError("no")

    before, sys.unraisablehook = sys.unraisablehook, sys.__unraisablehook__
    try:
        with never_lost():
            Failing()
    finally:
        sys.unraisablehook = before
    assert "ValueError: no" in capsys.readouterr().err
