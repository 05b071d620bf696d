"""The calibrated simulator, before any effect: which terms get a place, and which single values do not count."""

from collections.abc import Callable, Sequence

import numpy as np

from simpel_cli.discovery.likelihood.fit import Fitter
from simpel_cli.discovery.likelihood.latent_force import Forces
from simpel_cli.discovery.measurements.cleaning import Cleaned
from simpel_cli.discovery.measurements.windows import Windows
from simpel_cli.discovery.search.errors_ahead import Assessor
from simpel_cli.discovery.search.initial_states import begun, moved
from simpel_cli.discovery.search.outliers import gated, without_new
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.setup import Key, Setup, key_of, test_windows
from simpel_cli.discovery.search.shortlist import MOST_PARAMETERS, shortlist
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.runs.console import Terminal
from simulators.effects import Term

MOST_CALIBRATIONS = 3  # with fewer outliers the noise is known better, and shows more of them


def shortlisted(
    attach: Callable[..., Setup], terms: Sequence[Term], options: Discovery, terminal: Terminal
) -> frozenset[Key] | None:
    """Say which terms get a place in the program; None: all of them."""
    unknowns = sum(len(t.parameters) for t in terms)
    if unknowns <= MOST_PARAMETERS:
        return None
    terminal.line(
        f"{len(terms)} terms with {unknowns} unknowns: calibrating the simulator alone, to choose", "screening"
    )
    plan = attach(kept=frozenset())
    width = len(plan.augmented.model.params) + plan.coordinates.sizes[1] + plan.coordinates.sizes[2] + 1
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=options.lanes, width=width)
    base = Search(plan, fitter).base()
    forces = Forces(plan.rule, plan.coordinates, plan.augmented.model.dt)
    z = base.optimum.z
    force = forces(z, Assessor(plan, options.horizon)(z, plan.windows).track, plan.windows)
    kept = shortlist(plan, z, force, forces.inputs(z, plan.windows), terms)
    left = sum(len(t.parameters) for t in terms if key_of(t) in kept)
    terminal.line(f"{len(kept)} terms with {left} unknowns are worth a fit", "screening")
    return kept


def calibrated(
    plan: Setup, fitter: Fitter, assessor: Assessor, clean: Cleaned, terminal: Terminal
) -> tuple[Search, Trial, Windows, Cleaned]:
    """Calibrate the simulator, and again as long as values stand out or hidden states turn out to begin elsewhere."""
    recording, names = clean.recording, plan.augmented.measured
    raw = {"train": plan.windows, "test": test_windows(plan, recording.test, recording.outputs)}
    if plan.spare is not None:
        raw["spare"] = plan.spare
    cut = {split: begun(assessor, plan.start, windows) for split, windows in raw.items()}
    report = lambda text: terminal.line(text, "search")  # noqa: E731
    for _ in range(MOST_CALIBRATIONS):
        search = Search(plan._replace(windows=cut["train"], spare=cut.get("spare")), fitter.on(cut["train"]), report)
        base = search.base()
        z = base.optimum.z
        # where hidden states begin was guessed with parameters from the middle of their ranges
        again = {split: begun(assessor, z, raw[split]._replace(ok=windows.ok)) for split, windows in cut.items()}
        after = {split: gated(assessor, z, windows) for split, windows in again.items()}
        clean, after = without_new(clean, cut, after, names)
        settled = np.array_equal(after["train"].ok, cut["train"].ok) and not moved(cut["train"], after["train"])
        cut = after  # settled or not: values that stand out may be in test episodes alone
        if settled:
            break
    search.plan = search.plan._replace(spare=cut.get("spare"))
    report("calibrated")
    return search, base, cut["test"], clean
