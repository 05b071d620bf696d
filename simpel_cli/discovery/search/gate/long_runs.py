"""Whether an effect does harm in free runs that are longer than the windows of a search.

A search cuts long episodes into windows, and every window begins with a state of its own. An effect that only makes up for
where a window begins, as one with a slow hidden state, helps in every window, held out or not, and goes astray in a long run.
So free runs of the training episodes, from what their first rows tell, are looked at with and without it. An error that surely
grows, in rows that both models were fitted to, is harm. Where the use is a free run, it has to grow with both models calibrated
for that, too: parameters that predict the next row best need not simulate best (`harm.py`). Where it is some seconds, which
windows hold, it is not asked: of a position that is added up over minutes a free run tells little.
"""

from functools import partial
from typing import NamedTuple

from simpel_cli.discovery.search.gate.growth import growth
from simpel_cli.discovery.search.gate.held_out import AHEAD
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.uses import FREE_RUN, ONE_STEP, calibrated_for
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.initial_states import begun
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.tracks import Tracks


class Astray(NamedTuple):
    """An effect with which a free run goes astray.

    Args:
        place: of it, among the terms of the model.
        channel: whose error grows most.
        times: how often it is as large as without the effect.
    """

    place: int
    channel: str
    times: float


def gone_astray(
    search: Search, assessor: Assessor, chosen: Trial, windows: Windows, use: str | float = ONE_STEP
) -> Astray | None:
    """Return the effect with which a free run of training rows surely grows most; None: there is none.

    Args:
        search: that the model comes from.
        assessor: of its program.
        chosen: the model.
        windows: of training rows; no longer than those of the search: nothing new is in them.
        use: what the model will be calibrated for.
    """
    if windows.y.shape[1] <= search.plan.windows.y.shape[1] or not isinstance(use, str):
        return None
    found = []
    for i, gone in enumerate(chosen.terms):
        part = search.part(chosen, tuple(t for t in chosen.terms if t != gone))
        question = "long runs", use, chosen.terms, gone, chosen.optimum.z.tobytes(), part.optimum.z.tobytes()
        grows = search.once(question, partial(_grows, search, assessor, chosen, part, windows, use))
        found += [] if grows is None else [Astray(i, *grows)]
    return max(found, key=lambda astray: astray.times, default=None)


def _grows(
    search: Search, assessor: Assessor, whole: Trial, part: Trial, windows: Windows, use: str | float
) -> tuple[str, float] | None:
    """Return the channel whose error grows most for certain from a part to the whole, and how often it is as large."""
    found = _growing(assessor, whole, part, windows)
    if found is None or use == ONE_STEP:
        return found
    whole, part = (calibrated_for(search, assessor, trial, windows, FREE_RUN) for trial in (whole, part))
    return _growing(assessor, whole, part, windows)


def _growing(assessor: Assessor, whole: Trial, part: Trial, windows: Windows) -> tuple[str, float] | None:
    first, tracks, free = assessor.first_of(windows), Tracks(assessor.plan), AHEAD["free"]
    without, with_it = (
        assessor.free_runs(t.optimum.z[None], begun(tracks, t.optimum.z, windows, first))[0] for t in (part, whole)
    )
    grown = growth({free: without}, {free: with_it}, assessor.plan.augmented.measured, windows.episode)
    return max(((g.channel, g.times) for g in grown), key=lambda item: item[1], default=None)
