"""Stopping: between two pieces of work Ctrl-C and SIGTERM become an event; elsewhere Ctrl-C raises, and is not lost."""

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from simpel_cli.errors import Interrupted

_going_on = threading.local()  # `event`: of the thread's outermost interruption


@contextmanager
def never_lost() -> Iterator[None]:
    """Raise Ctrl-C once more where it came inside a destructor or a callback of the garbage collector.

    Python drops what is raised there, and prints a traceback. JAX has such a callback: one Ctrl-C in eight was lost to it.
    """
    before, main = sys.unraisablehook, threading.main_thread().ident or 0

    def once_more() -> None:
        time.sleep(0.01)  # s; by then the callback has returned
        signal.pthread_kill(main, signal.SIGINT)  # a real signal: it ends a blocking call, too

    def hook(dropped: Any) -> None:
        if dropped.exc_type is KeyboardInterrupt:
            _thread.start_new_thread(once_more, ())  # takes no lock, which the interrupted code may hold
        else:
            before(dropped)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


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
