"""Stopping between two pieces of work: Ctrl-C and SIGTERM become an event, which no library's callback can lose."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from simpel_cli.errors import Interrupted

_going_on = threading.local()  # `event`: of the thread's outermost interruption


@contextmanager
def interruption(given: threading.Event | None = None) -> Iterator[threading.Event]:
    """Give an event that Ctrl-C or SIGTERM sets; a second Ctrl-C acts at once. Within another, gives that one's event.

    Args:
        given: an event that somebody else sets, for a thread that gets no signals.
    """
    if getattr(_going_on, "event", None) is not None:
        yield _going_on.event
        return
    event = _going_on.event = given or threading.Event()
    try:
        with _heeding_signals(event):
            yield event
    finally:
        _going_on.event = None


@contextmanager
def _heeding_signals(event: threading.Event) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(number: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    before = {s: signal.signal(s, note) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def stop_if(interrupted: threading.Event) -> None:
    """Stop between two pieces of work, of which each keeps what it came to.

    Raises:
        Interrupted: Ctrl-C or SIGTERM came meanwhile.
    """
    if interrupted.is_set():
        raise Interrupted("stopped; what is complete is kept.")
