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
        ends = ends_of(search, chosen, one)
        if ends is None:
            continue
        plan = designed(search, ends, directory / FILE.format(f"_{k + 1}" if k else ""))
        if plan["expected_log_likelihood_ratio"] < HOPELESS:
            first, second = ends.names
            plan["description"] = (
                f"No admissible input determines {one.words.partition(':')[0]}: models with {first} and with {second} predict "
                "the same measurements. Measure something else, or declare one of the parameters."
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
        if all(fit.loss < optimum.loss + ALIKE for fit in fits):
            labels = [f"{names[row]}={plan.coordinates.value(row, value):.3g}" for value in at]
            return Class(tuple(Trial(chosen.terms, fit) for fit in fits), tuple(labels), ((0, 1), (1, 0)))
    return None
