"""A search within a time: what is worth most comes first, and what there is no time for is said."""

import re
import time
from collections.abc import Callable

SECONDS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}


def seconds_of(given: str | float | int | None) -> float | None:
    """Return a time in seconds: 60, `60s`, `2min`; None: as long as it takes.

    Raises:
        ValueError: it is no time.
    """
    if given is None or isinstance(given, float | int):
        seconds = None if given is None else float(given)
    else:
        found = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*(s|min|h|)\s*", given)
        if found is None:
            raise ValueError(given)
        seconds = float(found[1]) * SECONDS[found[2]]
    if seconds is not None and not seconds > 0:
        raise ValueError(given)
    return seconds


class Budget:
    """How long a search may take.

    Args:
        seconds: from now on; None: as long as it takes.
        clock: seconds.
    """

    def __init__(self, seconds: float | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock, self.began, self.seconds = clock, clock(), seconds
        self.left_out: list[str] = []

    @property
    def spent(self) -> float:
        """Time since the search began, s."""
        return self.clock() - self.began

    def over(self, what: str) -> bool:
        """Whether there is no time left for a part of the search, which is then left out."""
        if self.seconds is None or self.spent < self.seconds:
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    @property
    def sentence(self) -> str:
        """What a verdict says of it."""
        return f" Left out for lack of time (discovery.budget): {'; '.join(self.left_out)}." if self.left_out else ""
