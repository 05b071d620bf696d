"""The calibrated simulator, before any effect: which terms get a place, and which single values do not count."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.between_rows import Preference, in_words, preferences, saying, settled, words_of
from simpel_cli.discovery.search.heavy_tails import heavy_tails, weighed
from simpel_cli.discovery.search.outliers import gated, without_new
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.shortlist import MOST_PARAMETERS, shortlist
from simpel_cli.discovery.search.smaller import carried, small_search
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.initial_states import begun, moved
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.likelihood.latent_force import Forces
from simpel_cli.filtering.measurements.cleaning import Cleaned
from simpel_cli.filtering.measurements.windows import LONGEST_TEST, Windows
from simpel_cli.filtering.setup import Key, Setup, key_of, questions, whole_windows
from simpel_cli.filtering.tracks import Tracks
from simpel_cli.runs.console import Terminal
from simulators.effects import Term
from simulators.model import Model

MOST_CALIBRATIONS = 3  # with fewer outliers the noise is known better, and shows more of them


class Prepared(NamedTuple):
    """What is settled before the whole program is compiled.

    Args:
        plan: with the terms that get a place in it: all of them, or those worth a fit.
        kept: them; None: all.
        between_rows: input -> what it does between rows, where neither simulator nor data say.
    """

    plan: Setup
    kept: frozenset[Key] | None
    between_rows: dict[str, Preference]


def prepared(
    attach: Callable[..., Setup], model: Model, terms: Sequence[Term], options: Discovery, terminal: Terminal,
    known: frozenset[Key] = frozenset(),
) -> Prepared:  # fmt: skip
    """Calibrate the simulator alone, where that tells what the whole program needs: what inputs do, which terms to try.

    Args:
        attach: (model, kept, extra) -> the setup of a program with these terms alone, or with all.
        model: the simulator.
        terms: all of them.
        options: of the search.
        terminal: takes lines that say what goes on.
        known: terms that an earlier search had a place for, in other ranges or steps (see `shortlist`).
    """
    unknowns = sum(len(t.parameters) for t in terms)
    unsaid, many = questions(model), unknowns > MOST_PARAMETERS
    if not unsaid and not many:
        return Prepared(attach(model), None, {})
    if many:
        terminal.line(
            f"{len(terms)} terms with {unknowns} unknowns: calibrating the simulator alone, to choose", "screening"
        )
    plan = attach(model, kept=frozenset(), extra=unsaid)
    plan = plan._replace(windows=begun(Tracks(plan), plan.start, plan.windows))
    search = small_search(plan, options.lanes, 1)
    base = search.base()
    found = preferences(search, base)
    start = settled(search, words_of(found))
    if not np.array_equal(start, plan.start):  # nothing is judged beside the wrong inputs
        plan = plan._replace(start=start)
        search = Search(plan, search.fitter)
        base = search.base()
    z, kept = base.optimum.z, None
    if found:
        terminal.line(in_words(found), "inputs")
    if many:
        forces = Forces(plan.rule, plan.coordinates, model.dt)
        force = forces(z, Assessor(plan, options.horizon)(z, plan.windows).track, plan.windows)
        kept = shortlist(plan, z, force, forces.inputs(z, plan.windows), terms, known)
        left = sum(len(t.parameters) for t in terms if key_of(t) in kept)
        terminal.line(f"{len(kept)} terms with {left} unknowns are worth a fit", "screening")
    whole = attach(saying(model, found), kept=kept)
    return Prepared(whole._replace(optimum=carried(plan, z, whole)), kept, found)


class Calibrated(NamedTuple):
    """The simulator before any effect.

    Args:
        search: in the windows that count.
        base: its fit.
        test: held-out windows.
        clean: the measurements, without what stands out.
        degrees_of_freedom: measured channel -> nu, of those whose noise has heavy tails.
    """

    search: Search
    base: Trial
    test: Windows
    clean: Cleaned
    degrees_of_freedom: dict[str, float] = {}  # noqa: RUF012


def calibrated(plan: Setup, fitter: Fitter, assessor: Assessor, clean: Cleaned, terminal: Terminal) -> Calibrated:
    """Calibrate the simulator, and again as long as values stand out or hidden states turn out to begin elsewhere.

    Args:
        plan: setup with every term.
        fitter: of its program.
        assessor: of errors ahead.
        clean: measurements.
        terminal: takes lines that say what goes on.
    """
    recording, names = clean.recording, plan.augmented.measured
    raw = {"train": plan.windows, "test": whole_windows(plan, recording.test, recording.outputs, LONGEST_TEST)}
    if plan.spare is not None:
        raw["spare"] = plan.spare
    # what a free run of the test may begin with is what its first rows tell
    seen = {"test": assessor.first_of(raw["test"])}
    cut = {split: begun(assessor, plan.start, windows, seen.get(split)) for split, windows in raw.items()}
    report = lambda text: terminal.line(text, "search")  # noqa: E731
    for _ in range(MOST_CALIBRATIONS):
        search = Search(plan._replace(windows=cut["train"], spare=cut.get("spare")), fitter.on(cut["train"]), report)
        base = search.base()
        z = base.optimum.z
        # where hidden states begin was guessed with parameters from the middle of their ranges
        again = {
            split: begun(assessor, z, raw[split]._replace(ok=windows.ok), seen.get(split))
            for split, windows in cut.items()
        }
        after = {split: gated(assessor, z, windows) for split, windows in again.items()}
        clean, after = without_new(clean, cut, after, names)
        same = np.array_equal(after["train"].ok, cut["train"].ok) and not moved(cut["train"], after["train"])
        cut = after  # the same or not: values that stand out may be in test episodes alone
        if same:
            break
    search.plan = search.plan._replace(spare=cut.get("spare"))
    report("calibrated")
    return Calibrated(search, base, cut["test"], clean)


def with_heavy_tails(found: Calibrated, assessor: Assessor, z: np.ndarray, terminal: Terminal) -> Calibrated | None:
    """Return the calibration with values that count by their weights, where a model's noise has heavy tails; else None.

    Args:
        found: in which every value counts alike.
        assessor: of errors ahead.
        z: unit coordinates of the model that was chosen. What a simulator lacks looks like heavy tails, too: they are judged
            beside the effects that were found.
        terminal: takes a line.
    """
    plan, names = found.search.plan, found.search.plan.augmented.measured
    tail = heavy_tails(assessor, z, plan.windows)
    if tail is None:
        return None
    nu = {name: float(1 / t) for name, t in zip(names, tail, strict=True) if t > 0}
    heavy = ", ".join(f"{name} {value:.3g}" for name, value in nu.items())
    terminal.line(f"Student's t, degrees of freedom: {heavy}; values that lie far off count less", "noise")
    given = {"train": plan.windows, "test": found.test} | ({"spare": plan.spare} if plan.spare is not None else {})
    cut = {part: weighed(assessor, z, windows, tail) for part, windows in given.items()}
    plan = plan._replace(windows=cut["train"], spare=cut.get("spare"))
    search = Search(plan, found.search.fitter.on(cut["train"]), found.search.report)
    return found._replace(search=search, base=search.base(), test=cut["test"], degrees_of_freedom=nu)
