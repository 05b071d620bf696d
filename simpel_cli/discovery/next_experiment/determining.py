"""The episode that determines a combination of parameters which the data leave open.

Two models stand for the combination: the chosen one with a parameter of it held on either side, one standard deviation of its
prior away, and everything else refitted. They explain the data alike, for that is what open means. The episode that
distinguishes them as two causes (see `design`) determines the combination; where none does, no input would: the equations
leave it open, or what is measured does.

Reference: Raue et al. (2009), Structural and practical identifiability analysis by exploiting the profile likelihood.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.discovery.next_experiment.design import HOPELESS, Class, designed
from simpel_cli.discovery.search.trials import NEARLY, Search, Trial
from simpel_cli.discovery.verdict.determined import Open
from simpel_cli.filtering.likelihood.fit import Hypothesis

FILE = "determining_experiment{}.csv"
MOST = 2  # combinations, the least known first
HALVINGS = 5  # of the distance, until both models explain the data as the chosen one does
ALIKE = 0.3  # nats of log posterior
LEAST = 0.05  # of a range: nearer models are one


def determining_experiments(
    search: Search, chosen: Trial, opens: Sequence[Open], directory: Path
) -> list[dict[str, Any]]:
    """Design an experiment for each combination, write it as CSV and return what the verdict says of it.

    Args:
        search: that was run.
        chosen: model of it.
        opens: combinations that the data leave open.
        directory: of the run.
    """
    found = []
    for k, one in enumerate(opens[:MOST]):
        ends, what = ends_of(search, chosen, one), one.words.partition(":")[0]
        if ends is None:
            text = f"No two models that differ in {what} were found to explain these data alike."
            found.append(
                {"combination": one.words, "file": None, "expected_log_likelihood_ratio": 0.0, "description": text}
            )
            continue
        file = directory / FILE.format(f"_{k + 1}" if k else "")
        plan = designed(search, ends, file)
        if plan["file"] and plan["expected_log_likelihood_ratio"] < HOPELESS:
            first, second = ends.names
            file.unlink()  # an episode like all others
            plan["file"] = None
            plan["description"] = (
                f"No admissible input determines {what}: models with {first} and with {second} predict the same measurements. "
                "Measure something else, or declare one of the parameters."
            )
        found.append({"combination": one.words, **plan})
    return found


def ends_of(search: Search, chosen: Trial, one: Open) -> Class | None:
    """Return two models that explain the data as the chosen one does, on either side of it; None: there are none."""
    plan, optimum = search.plan, chosen.optimum
    names = [q.name for q in plan.augmented.params]
    row = names.index(max(one.move, key=lambda name: abs(one.move[name])))
    sd = float(np.asarray(plan.coordinates.sd_of_prior())[row])
    far = sd if np.isfinite(sd) else 1 / np.sqrt(12)
    free = tuple(i for i in optimum.free if i != row)
    # along such a combination a fit creeps: the chosen model may be a little short of its optimum
    again = search.fitter([Hypothesis(search.loud(optimum.z), optimum.free, search.ones)])
    best = min(o.loss for o in (optimum, *again) if np.isfinite(o.loss))
    for halving in range(HALVINGS + 1):
        at = [float(np.clip(optimum.z[row] + side * far / 2**halving, NEARLY, 1 - NEARLY)) for side in (-1, 1)]
        if at[1] - at[0] < LEAST:
            return None
        starts = []
        for value in at:
            z = search.loud(optimum.z)
            z[row] = value
            starts.append(Hypothesis(z, free, search.ones))
        fits = search.fitter(starts)
        best = min([best, *(fit.loss for fit in fits if np.isfinite(fit.loss))])
        if all(fit.loss < best + ALIKE for fit in fits):
            values = [plan.coordinates.value(row, value) for value in at]
            digits = next(n for n in range(3, 18) if f"{values[0]:.{n}g}" != f"{values[1]:.{n}g}")
            labels = [f"{names[row]}={value:.{digits}g}" for value in values]
            return Class(tuple(Trial(chosen.terms, fit) for fit in fits), tuple(labels), ((0, 1), (1, 0)))
    return None
