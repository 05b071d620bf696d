"""Effects that these data cannot detect, whatever their size: neither found nor ruled out.

At an effect's start points, with everything else that moves refitted, its first parameter has the information

    S = F_kk - F_kb F_bb^-1 F_bk

in units of the parameter's range. Below that of the range itself, 12, the data add nothing to what was known before.

Reference: Cox and Hinkley (1974), Theoretical statistics, 9.3 (information on one parameter among several).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from simpel_cli.data.recording import Episode
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.likelihood.steps import LEAST_CURVATURE

FAULTS = ("kinematics", "stale")  # checks of the data that can hide or feign an effect
SHOWN = 6  # names in a sentence
SURPRISING = 1.5  # times the standard deviation that the model predicts, on test episodes


def undetectable(search: Search, chosen: Trial, episodes: Sequence[Episode]) -> list[dict[str, str]]:
    """Return the effects that these data do not test, and why: name, acts_on, reason.

    Args:
        search: that was run.
        chosen: the model that it ended with.
        episodes: that it was run on.
    """
    here = set(chosen.terms)
    asked = [t for t in search.candidates(chosen.terms) if not search.terms[t].depends_on and t not in here]
    starts = [
        (t, hypothesis) for t in asked for hypothesis in search.hypotheses((*chosen.terms, t), t, chosen.optimum.z)
    ]
    seen = set()
    for (t, hypothesis), optimum in zip(
        starts, search.fitter([hypothesis for _, hypothesis in starts], 1), strict=True
    ):
        if _information(optimum.fisher, hypothesis.free.index(search.rows[t][0])) >= LEAST_CURVATURE:
            seen.add(t)
    still = _still(search, episodes)
    return [
        {
            "name": search.terms[t].effect, "acts_on": search.terms[t].acts_on,
            "reason": f"{search.terms[t].acts_on} never changes" if search.terms[t].acts_on in still
            else "its size has no visible influence on these data",
        }
        for t in asked if t not in seen
    ]  # fmt: skip


def in_words(entries: Sequence[dict[str, str]]) -> list[str]:
    """Return what was not tested as a few words each, long lists cut."""
    named = [f"{e['name'].replace('_', ' ')} on {e['acts_on']} ({e['reason']})" for e in entries[:SHOWN]]
    return [*named, f"{len(entries) - SHOWN} more effects"] if len(entries) > SHOWN else named


def caveats(found: dict[str, Any]) -> str:
    """Return the caveats of a verdict: effects not tested, faults of the data, test errors larger than predicted."""
    text = ""
    if found["verdict"] in ("none", "unexplained"):
        names = in_words(found["not_tested"])
        text += f" Not tested by these data: {', '.join(names)}." if names else ""
        faults = [c["check"] for c in found["data_checks"] if not c["ok"] and c["check"] in FAULTS]
        text += f" Correct these faults of the data first: {', '.join(faults)}." if faults else ""
    name, most = max(found["error"]["surprise"].items(), key=lambda entry: np.nan_to_num(entry[1]))
    if most > SURPRISING:
        text += (
            f" On the test episodes the errors one step ahead in {name} are {most:.2g} times as large as the model predicts: "
            "the test episodes may reach states that the training episodes do not cover."
        )
    return text


def _information(fisher: np.ndarray, k: int) -> float:
    if not np.isfinite(fisher).all():
        return np.inf
    others = [i for i in range(len(fisher)) if i != k]
    base = fisher[np.ix_(others, others)] + LEAST_CURVATURE * np.eye(len(others))
    cross = fisher[others, k]
    return float(fisher[k, k] - cross @ np.linalg.solve(base, cross))


def _still(search: Search, episodes: Sequence[Episode]) -> set[str]:
    inputs = np.concatenate([e.inputs for e in episodes])
    return {q.name for j, q in enumerate(search.plan.augmented.model.inputs) if np.ptp(inputs[:, j]) == 0}
