"""The report's table of a run: data used, learned noise and scales, software, time."""

import platform
from collections.abc import Sequence
from typing import Any

import numpy as np

from simpel_cli.inference.assemble import Assembled
from simpel_cli.priors.function_prior import GapGP
from simpel_cli.runs.manifest import Manifest, versions
from simpel_cli.studies.judgement import Judged
from simpel_cli.studies.open import Study
from simpel_cli.studies.prepare import Fitted

PHASES = (("compilation", "compile_seconds"), ("training", "train_seconds"))


def run_table(study: Study, fitted: Fitted, judged: Judged, manifest: Manifest) -> dict[str, Any]:
    """Return the table of a fit, or of an evaluation and the fit that it tests.

    Args:
        study: what was fitted.
        fitted: its problems, as they were trained.
        judged: has the learned noise.
        manifest: of the verb that runs; `facts` may hold the seconds of compilation and training.
    """
    used, seeds = fitted.n_train, study.settings.all_seeds
    software = {"python": platform.python_version()} | versions()
    rows = [
        ("method", _method(study)),
        ("training", f"{used} of {fitted.available} {'transitions' if study.system.source.states else 'rows'}"),
        ("seeds", ", ".join(map(str, seeds))),
        ("gap scale kappa", _kappa(study, fitted)),
        ("gap lengthscales", lengthscales(study, fitted)),
        ("distinct particles", _distinct(study, judged.distinct)),
        ("learned noise", _per_output(study, judged.noise_std)),
        ("law of the noise", law_of_noise(study, fitted)),
        ("device", f"{manifest.facts.get('device', study.device)}, {study.settings.precision}"),
        ("time", _time(manifest)),
        ("software", ", ".join(f"{name} {version}" for name, version in software.items() if version)),
    ]
    return {"title": "Run", "head": (), "rows": rows, "text": True}


def _method(study: Study) -> str:
    return f"{named_method(study)}, {study.method.particles} particles, {study.method.steps} steps"


def named_method(study: Study) -> str:
    """Return the method's name, with that of the score where it estimates one."""
    method, score = study.choices.get("method", ""), study.choices.get("score", "")
    return f"{method} ({score} score)" if study.method.uses_score else method


def _kappa(study: Study, fitted: Fitted) -> str:
    if study.prior.gap is None:
        return "no gap GP"
    scale = np.asarray(fitted.assembled.problems.gap_scale, dtype=float)
    return _per_output(study, scale * fitted.target_std)


def lengthscales(study: Study, fitted: Fitted) -> str:
    """Return the lengthscales of the gap of a fit."""
    relevance, encoding = fitted.assembled.problems.gap_relevance, study.system.encoding
    each = None if relevance is None else 1 / np.asarray(relevance, dtype=float)
    return lengthscales_in_words(study.prior.gap, each, encoding.y_names, encoding.dim_x)


def lengthscales_in_words(gap: GapGP | None, chosen: np.ndarray | None, names: Sequence[str], dim_x: int) -> str:
    """Return the lengthscales of the gap, in standard deviations of an input over the domain.

    Args:
        gap: as declared.
        chosen: of every seed, output and input; None: what was declared holds.
        names: of the outputs.
        dim_x: number of inputs.
    """
    if gap is None:
        return "no gap GP"
    if chosen is None:
        if gap.lengthscale is None:
            return f"{2 * dim_x**0.5:.3g}"
        return f"{gap.lengthscale:.3g}" + (" in data units" if gap.lengthscale_units == "raw" else "")
    low, high = chosen.min(axis=(0, 2)), chosen.max(axis=(0, 2))
    if np.allclose(low.min(), high.max()):
        return f"{low[0]:.3g}"
    shown = zip(names, (f"{a:.2g}" for a in low), (f"{b:.2g}" for b in high), strict=True)
    return ", ".join(f"{name} {a}" + ("" if a == b else f" to {b}") for name, a, b in shown)


def law_of_noise(study: Study, fitted: Fitted) -> str:
    """Return the law of the noise of a fit, and what it was chosen by."""
    names = study.system.encoding.y_names
    law = law_in_words(fitted.assembled, study.measurements.law, names, learned=study.method.noise.learn)
    if fitted.scale is None:
        return law
    shapes = ", ".join(f"{name} as {formula}" for name, formula in fitted.scale.formulas.items())
    return f"{law}; its scale goes with the row, of {shapes}, and is given for a typical one"


def law_in_words(assembled: Assembled, asked: str, names: Sequence[str], *, learned: bool) -> str:
    """Return the law of the noise, and what it was chosen by.

    Args:
        assembled: problems with the law.
        asked: data.noise.law.
        names: of the targets.
        learned: whether the noise is learned.
    """
    problems, gain = assembled.problems, assembled.heavy_tails
    if problems.tail is None:
        if asked == "gaussian":
            return "Gaussian, as data.noise.law says"
        if not learned:
            return "Gaussian, fixed (method.noise.learn=false)"
        if np.isnan(gain):
            return "Gaussian: too few rows to learn another law from (data.noise.law)"
        ahead = f"ahead by {gain:.1f} nats only" if gain > 0 else f"behind by {-gain:.1f} nats"
        return f"Gaussian: Student's t is {ahead} in leave-one-out log score"
    said = "as data.noise.law says" if asked != "auto" else f"ahead by {gain:.1f} nats of leave-one-out log score"
    freedom = (1 / np.asarray(problems.tail, dtype=float)).mean(axis=0)
    degrees = ", ".join(f"{name} {value:.2g}" for name, value in zip(names, freedom, strict=True))
    return f"Student's t, {said}; degrees of freedom: {degrees}"


def _distinct(study: Study, numbers: list[float]) -> str:
    low, high = f"{min(numbers):.3g}", f"{max(numbers):.3g}"
    return f"{low if low == high else f'{low}..{high}'} of {study.method.particles} at the scale of the noise"


def _per_output(study: Study, values: np.ndarray) -> str:
    """Values (seeds, dy) with their units; a range where seeds differ."""
    encoding = study.system.encoding
    shown = []
    for name, unit, column in zip(encoding.y_names, encoding.y_units, np.asarray(values).T, strict=True):
        low, high = f"{column.min():.3g}", f"{column.max():.3g}"
        number = low if low == high else f"{low}..{high}"
        shown.append(f"{name} {number}" + ("" if unit in ("1", "") else f" {unit}"))
    return ", ".join(shown)


def _time(manifest: Manifest) -> str:
    facts = manifest.facts
    parts = [f"{what} {facts[key]:.1f} s" for what, key in PHASES if key in facts]
    return ", ".join([*parts, f"{manifest.wall_seconds:.1f} s in total until this report"])
