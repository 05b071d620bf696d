"""What goes on in a search, in one line for whoever waits: how many fits of a step have ended, and the time.

How many steps there will be nobody knows beforehand: with a budget the time that is left is known, without one it is not, and
none is guessed.
"""

from simpel_cli.discovery.search.budget import Budget


class Watch:
    """The line.

    Args:
        budget: whose clock it reads.
    """

    def __init__(self, budget: Budget) -> None:
        self.budget = budget
        self.fits = 0, 0

    def __call__(self, ended: int, fits: int) -> None:
        """Take note of how many fits of a step have ended, of how many."""
        self.fits = ended, fits

    def __str__(self) -> str:
        spent = self.budget.spent
        left = "" if self.budget.seconds is None else f" · {_minutes(max(self.budget.seconds - spent, 0.0))} left"
        ended, fits = self.fits  # at once: another thread draws
        step = f"{ended} of {fits} fits · " if fits else ""
        return f"{'':<10}{step}{_minutes(spent)} so far{left}"


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d} min"
