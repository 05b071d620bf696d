"""`simpel discover`: find what the simulator lacks, name it, add it, and say how much that helps."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from simpel_cli.config.launch import Job
from simpel_cli.config.nodes import build
from simpel_cli.config.resolved import dump
from simpel_cli.discovery.likelihood.fit import Fitter
from simpel_cli.discovery.likelihood.latent_force import Forces
from simpel_cli.discovery.measurements.cleaning import Cleaned, cleaned, outlier_check
from simpel_cli.discovery.measurements.windows import Windows
from simpel_cli.discovery.next_experiment.design import next_experiment
from simpel_cli.discovery.search.disturbances import swing
from simpel_cli.discovery.search.errors_ahead import Assessor
from simpel_cli.discovery.search.gate import Gate, gates
from simpel_cli.discovery.search.initial_states import begun, moved
from simpel_cli.discovery.search.interactions import interaction
from simpel_cli.discovery.search.noise_profile import Levels
from simpel_cli.discovery.search.outliers import gated, without_new
from simpel_cli.discovery.search.selection import Selection, cut, further, refused, select
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.setup import Key, Setup, key_of, setup, terms_of, test_windows
from simpel_cli.discovery.search.shortlist import MOST_KNOBS, shortlist
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.verdict.corrected import corrected
from simpel_cli.discovery.verdict.evidence import exhibits
from simpel_cli.discovery.verdict.remainder import remainder_of
from simpel_cli.discovery.verdict.undetectable import caveats, unseen
from simpel_cli.discovery.verdict.verdict import AMBIGUOUS, steps_of, verdict_of
from simpel_cli.errors import ConfigError, Inconclusive
from simpel_cli.reporting.discover import publish
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, refuse_occupied
from simpel_cli.runs.files import strict, write_table, write_text
from simpel_cli.runs.manifest import Manifest
from simpel_cli.studies.close_loop import close, memory_of
from simpel_cli.studies.study import open_study, refuse_untested, resolved, settings_of
from simulators.effects import Expression, Term
from simulators.model import Model

MOST_SEARCHES = 3  # each goes on without the effects that did harm in those before
MOST_CALIBRATIONS = 3  # with fewer outliers the noise is known better, and shows more of them


def discover(job: Job, *, strict: bool = False) -> None:
    """Run a search in its run directory.

    Raises:
        Inconclusive: `strict` and another verdict than `effect`.
    """
    settings = settings_of(job.config)
    directory = make_directory(job.directory)
    refuse_occupied(directory)
    config = resolved(job) | {"run": {**(job.config.get("run") or {}), "precision": "float64"}}
    write_text(directory / "config.yaml", dump(config))
    with Manifest(directory, "discover", settings) as manifest, jax.enable_x64(True):
        found = _run(config, directory, job.data_folder, manifest)
    if strict and found["verdict"] != "effect":
        raise Inconclusive(f"verdict {found['verdict']}: {found['summary']}")


def effects_of(node: Mapping[str, Any] | None, plugins: tuple[str, ...]) -> list[Expression]:
    """Build the catalogue that a configuration names."""
    if not node:
        raise ConfigError(
            "effect: none chosen; use effect=[all], or name some, e.g. effect=[coulomb_friction,input_delay]."
        )
    return [build(dict(entry), f"effect.{name}", plugins) for name, entry in node.items()]


def _run(config: dict[str, Any], directory: Path, data_folder: Path, manifest: Manifest) -> dict[str, Any]:
    began = time.perf_counter()
    study = open_study(config, data_folder, whole=False)
    refuse_untested(study.recording)
    manifest.add_inputs(study.recording.files)
    model = study.system.source
    if not isinstance(model, Model):
        raise ConfigError(
            "sim: discover needs a simulator in symbols, since effects are terms of it; a world has none."
        )
    terminal = Terminal(study.settings.quiet, directory / "run.log")
    options: Discovery = build(config.get("discovery") or {}, "discovery", default=Discovery)
    effects = effects_of(config.get("effect"), study.settings.plugins)
    terminal.line(f"simpel discover · {model.name} · {len(effects)} effects · {study.device}", style="bold")
    declared_noise = tuple(study.measurements.noise_std)
    clean = cleaned(study.recording, model, declared_noise)
    recording = clean.recording
    bad = [c for c in recording.checks if not c.ok]
    terminal.line("; ".join(f"{c.name}: {c.detail}" for c in bad) if bad else f"{len(recording.checks)} ok", "data")
    attach = partial(
        setup, model, recording, declared_noise, effects, options.substeps, pairs=options.pairs, most_rows=options.rows
    )
    rows = sum(len(e.time) for e in recording.train)
    if rows > options.rows:
        terminal.line(f"searching in about {options.rows} of {rows} training rows (discovery.rows)", "data")
    kept = _kept(attach, terms_of(model, recording, effects, pairs=options.pairs), options, terminal)
    plan = attach(kept=kept)
    width = len(model.params) + plan.coordinates.sizes[1] + plan.coordinates.sizes[2] + options.room
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, lanes=options.lanes, width=width)
    assessor = Assessor(plan, options.horizon)
    search, base, windows, clean = _calibrated(plan, fitter, assessor, clean, terminal)
    outliers = outlier_check(clean, plan.augmented.measured)
    terminal.line(outliers.detail, "outliers")
    recording = recording._replace(checks=(*recording.checks, outliers))
    selection, judged = _selected(search, assessor, base, options, terminal)
    levels = Levels(search, assessor, selection.chosen)
    selection, judged = _of_two(levels, selection, judged, attach, options, terminal)
    swinging = None if selection.remainder else swing(levels)
    if swinging is not None:
        terminal.line(f"a force on {swinging.acts_on} {swinging.how} +{swinging.gain:.0f}", "search")
    before, after = (assessor(t.optimum.z, windows) for t in (selection.base, selection.chosen))
    found = verdict_of(
        search,
        selection,
        judged,
        before,
        after,
        remainder_of(search, selection, swinging, assessor(selection.chosen.optimum.z, search.plan.windows)),
        windows,
        recording.checks,
        options.horizon,
        time.perf_counter() - began,
    )
    found["steps"] = steps_of(search, selection, assessor, windows)
    found["not_tested"] = unseen(search, selection.chosen, recording.train)
    unknown = {(e["name"], e["acts_on"]) for e in found["not_tested"]}
    found["not_found"] = [e for e in found["not_found"] if (e["name"], e["acts_on"]) not in unknown]
    found["summary"] += caveats(found)
    if found["verdict"] == AMBIGUOUS:
        terminal.line("which experiment tells them apart", "search")
        found["next_experiment"] = next_experiment(search, selection, directory)
    if found["effects"]:
        name, node, left_out = corrected(config["sim"], model, search, selection.chosen)
        path = directory / "conf" / "sim" / f"{name}.yaml"
        data = (
            directory / "conf" / "data" / f"{config['choices'].get('data')}.yaml"
        )  # the user's own lies in another folder
        for file, content in ((path, f"# {found['summary']}\n" + dump(node)), (data, dump(config["data"]))):
            file.parent.mkdir(parents=True)
            write_text(file, content)
        found |= {
            "corrected_sim": str(path.relative_to(directory)),
            "corrected_sim_lacks": left_out,
            "stack_actions": memory_of(node),
        }
        if config.get("close", True) and len(left_out) < len(found["effects"]):
            found["as_prior"] = close(config, node, directory, data_folder, terminal)
    write_text(directory / "verdict.json", json.dumps(strict(found), indent=1, allow_nan=False))
    shown = exhibits(search, selection, assessor, recording, windows, before, after)
    for name, table in shown.items():
        write_table(directory / f"{name}.parquet", table.columns, table.units)
    publish(terminal, found, directory, config)
    return found


def _kept(
    attach: Callable[..., Setup], terms: Sequence[Term], options: Discovery, terminal: Terminal
) -> frozenset[Key] | None:
    """Say which terms get a place in the program; None: all of them."""
    unknowns = sum(len(t.knobs) for t in terms)
    if unknowns <= MOST_KNOBS:
        return None
    terminal.line(
        f"{len(terms)} terms with {unknowns} unknowns: calibrating the simulator alone, to choose", "screening"
    )
    plan = attach(kept=frozenset())
    width = len(plan.augmented.model.params) + plan.coordinates.sizes[1] + plan.coordinates.sizes[2] + 1
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, lanes=options.lanes, width=width)
    base = Search(plan, fitter).base()
    forces = Forces(plan.rule, plan.coordinates, plan.augmented.model.dt)
    z = base.optimum.z
    force = forces(z, Assessor(plan, options.horizon)(z, plan.windows).track, plan.windows)
    kept = shortlist(plan, z, force, forces.inputs(z, plan.windows), terms)
    left = sum(len(t.knobs) for t in terms if key_of(t) in kept)
    terminal.line(f"{len(kept)} terms with {left} unknowns are worth a fit", "screening")
    return kept


def _calibrated(
    plan: Setup, fitter: Fitter, assessor: Assessor, clean: Cleaned, terminal: Terminal
) -> tuple[Search, Trial, Windows, Cleaned]:
    """Calibrate the simulator, and again as long as values stand out or hidden states turn out to begin elsewhere."""
    recording, names = clean.recording, plan.augmented.measured
    raw = {"train": plan.windows, "test": test_windows(plan, recording.test, recording.outputs)}
    if plan.spare is not None:
        raw["spare"] = plan.spare
    cut = {split: begun(assessor, plan.start, windows) for split, windows in raw.items()}
    told = lambda text: terminal.line(text, "search")  # noqa: E731
    for _ in range(MOST_CALIBRATIONS):
        search = Search(plan._replace(windows=cut["train"], spare=cut.get("spare")), fitter.on(cut["train"]), told)
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
    told("calibrated")
    return search, base, cut["test"], clean


def _selected(
    search: Search, assessor: Assessor, base: Trial, options: Discovery, terminal: Terminal
) -> tuple[Selection, list[Gate]]:
    """Search, and go on without an effect that does harm: another one may be what it stood for."""
    selection = select(search, base, options.beginnings)
    for attempt in range(MOST_SEARCHES):
        selection, judged, harmful = _gated(search, assessor, selection, terminal)
        if not harmful or attempt == MOST_SEARCHES - 1:  # what is returned has been judged
            break
        left, selection = selection, further(search, selection)
        if selection.chosen.terms == left.chosen.terms:
            break
    return selection, judged


def _gated(
    search: Search, assessor: Assessor, selection: Selection, terminal: Terminal
) -> tuple[Selection, list[Gate], list[int]]:
    """Judge on held-out episodes what every effect adds to the others; of those that fail one goes at a time.

    Effects that are of use only together, as a delay and a slip, are judged together so. Of two that can stand for each other
    the one with less evidence goes, and the other is judged without it.

    Returns:
        what is left of the selection, its gates, and the terms with which the errors ahead grow.
    """
    harmful: list[int] = []
    while selection.chosen.terms:
        chosen = selection.chosen
        parts = [search.part(chosen, tuple(t for t in chosen.terms if t != gone)) for gone in chosen.terms]
        judged = gates(search, assessor, chosen, parts)
        failed = [i for i, found in enumerate(judged) if not found.passed]
        gone = min(failed, key=lambda i: (not judged[i].harm, selection.gains[i]), default=None)
        for i, (term, found) in enumerate(zip(chosen.terms, judged, strict=True)):
            _told(search.terms[term].label, found, terminal, out=i == gone)
        if gone is None:
            return selection, judged, harmful
        if judged[gone].harm:
            harmful.append(chosen.terms[gone])
            search.banned.add(chosen.terms[gone])  # nor is it another name for what stays
        selection = refused(search, selection, gone)
    return selection, [], harmful


def _of_two(
    levels: Levels,
    selection: Selection,
    judged: list[Gate],
    attach: Callable[..., Setup],
    options: Discovery,
    terminal: Terminal,
) -> tuple[Selection, list[Gate]]:
    """Look once more whether what is left is a function of two arguments."""
    known = selection.remainder[1] if selection.remainder else 0.0
    told = lambda text: terminal.line(text, "search")  # noqa: E731
    found = interaction(levels, attach, options.lanes, told, known)
    if found is None:
        return selection, judged
    _told(
        f"function of {' and '.join(found.term.depends_on)} +{found.gain:.0f}",
        found.gate,
        terminal,
        out=not found.gate.passed,
    )
    if not found.gate.passed:
        return selection, judged
    gone = [levels.search.terms[t].label for i, t in enumerate(selection.chosen.terms) if i not in found.kept]
    if gone:
        told(f"beside it {' and '.join(gone)} is not needed")
        selection = cut(levels.search, selection, found.kept)
        judged = [judged[i] for i in found.kept]
    return selection._replace(remainder=(found.term, found.gain)), judged


def _told(what: str, judged: Gate, terminal: Terminal, *, out: bool) -> None:
    why = "" if judged.passed else ", the errors ahead grow" if judged.harm else ", not certain"
    terminal.line(
        f"{what}: held-out gain {judged.gain:.0f} ({judged.low:.0f}..{judged.high:.0f}) nats"
        f" by {judged.unit}{why}{': not accepted' if out else ''}",
        "gate",
    )
