"""Which compiled programs a process keeps in memory.

XLA keeps about 3 kB of every instruction of a program, which comes to 50 to 300 MiB for a filter with dozens of effects. A
search that asks about ranges, noise and hidden states makes dozens of programs and goes back to few. So those that were not
used for longest are dropped, but for the last few; one that is called again is read from the cache on disk, which takes a
second or two. Sizes are what making a program left behind in the process, about; where that is not told (not on Linux), and
of programs of a GPU, nothing is dropped.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from weakref import WeakMethod

MOST = 600.0  # MiB of programs
LEAST = 6  # programs, which a search goes back to in turn
STATM = Path("/proc/self/statm")


class Resident:
    """Programs in memory, the one that was used last at the end; one that nobody else holds is none.

    Args:
        most: MiB of them.
        least: programs that stay, however large they are.
    """

    def __init__(self, most: float = MOST, least: int = LEAST) -> None:
        self._most, self._least = most, least
        self._size: OrderedDict[Hashable, tuple[float, WeakMethod[Callable[[Hashable], None]]]] = OrderedDict()
        self._lock = threading.Lock()

    def used(self, name: Hashable) -> None:
        """Note that a program is called."""
        with self._lock:
            if name in self._size:
                self._size.move_to_end(name)

    def add(self, name: Hashable, size: float, drop: Callable[[Hashable], None]) -> int:
        """Note a program that was made, and drop others where there are too many; returns how many.

        Args:
            name: of the program.
            size: MiB.
            drop: method of what holds it, which lets go of the program of a name.
        """
        with self._lock:
            for gone in [other for other, (_, held) in self._size.items() if held() is None]:
                del self._size[gone]
            self._size[name] = (max(size, 0.0), WeakMethod(drop))
            dropped = []
            while len(self._size) > self._least and sum(mib for mib, _ in self._size.values()) > self._most:
                other, (_, held) = self._size.popitem(last=False)
                dropped.append((other, held()))
        for other, let_go in dropped:
            if let_go is not None:
                let_go(other)
        return len(dropped)


def resident_mib() -> float:
    """Return the memory of this process, MiB; 0 where the system does not tell."""
    try:
        pages = int(STATM.read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
