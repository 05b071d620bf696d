"""The `discovery:` group."""

from dataclasses import dataclass

from simpel_cli.discovery.search.budget import seconds_of
from simpel_cli.discovery.search.sets.forward import BEGINNINGS
from simpel_cli.discovery.search.uses import FREE_RUN, ONE_STEP
from simpel_cli.errors import ConfigError, check_at_least_one
from simpel_cli.filtering.errors_ahead import FIRST

PAIR = 11  # unknowns of a function of two arguments beside an effect


@dataclass(frozen=True)
class Discovery:
    """How the search runs.

    Args:
        horizon: how far ahead errors are judged, in rows.
        first_rows: rows of an episode from which the state is estimated that its free run begins with; errors of the free run
            are those of the rows behind.
        substeps: Runge-Kutta steps per row in the filter; null = as many as the noise asks for, 8 at most.
        lanes: fits that run side by side in the compiled program, at most; fewer where there are many windows.
        room: unknowns of effects that a hypothesis can have at once; time grows with it.
        rows: training rows that a search looks at, evenly spaced windows of a longer record; errors are of all test rows.
        pairs: whether a named effect has to beat functions of two arguments, too; a search then takes about twice as long.
            Without it, they are looked for in what is left at the end.
        beginnings: first effects that are tried beside the one that explains most, where one effect is not enough.
        for_: what the model is for: `free_run`, how many seconds ahead (0.5), or `one_step`. The last calibration, of the
            simulator and of the corrected one, is for it; null: one_step.
        simulations: whether a second search takes every episode for one simulation, whose remainder has a memory; what it
            finds is chosen where it is worth more. It takes as long again, and may take what differs from group to group for
            effects. Null: where the model is for `free_run`, no column names groups, and what was found leaves a fifth of the
            mean square error of a free run, of any quantity.
        determine: whether an experiment is designed that determines what the data leave open of the simulator's parameters.
        budget: how long the search may take, s (60, `60s`, `2min`): what is worth most comes first, and the verdict says what
            was left out. What has begun is ended, and the report comes on top. Null: as long as it takes.
    """

    horizon: int = 20
    first_rows: int = FIRST
    substeps: int | None = None
    lanes: int = 4
    room: int = 9
    rows: int = 3000
    pairs: bool = False
    beginnings: int = BEGINNINGS
    for_: str | float | None = None
    simulations: bool | None = None
    determine: bool = False
    budget: str | float | None = None

    def __post_init__(self) -> None:
        if self.pairs and self.room < PAIR:
            raise ConfigError(
                f"discovery.room: got {self.room}; discovery.pairs needs {PAIR}: a function of two has 9."
            )
        check_at_least_one("discovery", self, ("horizon", "first_rows", "lanes", "room", "rows"))
        if isinstance(self.for_, str) and self.for_ not in (ONE_STEP, FREE_RUN):
            raise ConfigError(
                f"discovery.for: got {self.for_!r}; allowed are {FREE_RUN}, {ONE_STEP}, or how many seconds ahead, e.g. 0.5."
            )
        if isinstance(self.for_, float) and not self.for_ > 0:
            raise ConfigError(f"discovery.for: got {self.for_}; seconds ahead must be above 0.")
        try:
            seconds_of(self.budget)
        except ValueError:
            raise ConfigError(
                f"discovery.budget: got {self.budget!r}; give a time above 0, in seconds or as 60s, 2min, 1h."
            ) from None
        if self.beginnings < 0:
            raise ConfigError(f"discovery.beginnings: got {self.beginnings}; it must be at least 0.")
        if self.substeps is not None and self.substeps < 1:
            raise ConfigError(f"discovery.substeps: got {self.substeps}; it must be at least 1.")
