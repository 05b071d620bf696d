"""Whether an effect does harm over whole episodes, which a search sees in short windows only.

A search cuts long episodes into windows, and every window begins with a state of its own. An effect that only makes up for
where a window begins, as one with a slow hidden state, helps in every window, held out or not, and goes astray in a free run of
the whole. So the free runs of the training episodes, from what their first rows tell, are looked at with and without it. Both
models are fitted to the same rows, and the larger one has more freedom: an error that surely grows all the same is harm.
"""

from functools import partial

import numpy as np

from simpel_cli.discovery.search.gate.held_out import AHEAD, Gate, growing
from simpel_cli.discovery.search.sets.selection import Selection, refused
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.independent_parts import independent_parts
from simpel_cli.filtering.initial_states import begun
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.runs.console import Terminal


def harmless_in_long_runs(
    search: Search, assessor: Assessor, selection: Selection, judged: list[Gate], windows: Windows, terminal: Terminal
) -> tuple[Selection, list[Gate]]:
    """Return the selection without effects with which free runs of whole training episodes surely grow, the worst first.

    Args:
        search: over sets of effects.
        assessor: of errors ahead.
        selection: what was accepted.
        judged: its gates.
        windows: training episodes, each as long as it is; no longer than those of the search: nothing new is in them.
        terminal: takes lines.
    """
    if windows.y.shape[1] <= search.plan.windows.y.shape[1]:
        return selection, judged
    while selection.chosen.terms:
        chosen = selection.chosen
        parts = [search.part(chosen, tuple(t for t in chosen.terms if t != gone)) for gone in chosen.terms]
        question = "long runs", chosen.terms, *(trial.optimum.z.tobytes() for trial in (chosen, *parts))
        grows = search.once(question, partial(_growing, assessor, chosen, parts, windows))
        gone = max(range(len(grows)), key=lambda i: grows[i][0])
        times, which = grows[gone]
        if not which:
            break
        label = search.terms[chosen.terms[gone]].label
        terminal.line(
            f"{label}: over whole episodes the error of {which[0]} grows {times:.3g} times: not accepted", "gate"
        )
        search.banned.add(chosen.terms[gone])
        selection = refused(search, selection, gone)
        judged = [gate for i, gate in enumerate(judged) if i != gone] if selection.chosen.terms else []
    return selection, judged


def _growing(
    assessor: Assessor, whole: Trial, parts: list[Trial], windows: Windows
) -> list[tuple[float, tuple[str, ...]]]:
    """Return, for every effect, how often the error is as large with it as without, where it surely grows, and which it is."""
    first = assessor.first_of(windows)
    starts = [begun(assessor, trial.optimum.z, windows, first) for trial in (whole, *parts)]
    with_all, *others = (
        assessor.free_runs(trial.optimum.z[None], start)[0]
        for trial, start in zip((whole, *parts), starts, strict=True)
    )
    free, found = AHEAD["free"], []
    for errors in others:
        cut = independent_parts(errors, with_all, windows.episode)
        which = growing({free: cut.before}, {free: cut.after}, assessor.plan.augmented.measured, cut.parts)
        ratio = np.sqrt(np.nansum(with_all**2, axis=(0, 1)) / np.maximum(np.nansum(errors**2, axis=(0, 1)), 1e-300))
        found.append((float(ratio.max()) if which else 0.0, which))
    return found
