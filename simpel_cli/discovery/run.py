"""A search as a whole: find what the simulator lacks, name it, add it, and say how much that helps."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax

from simpel_cli.config.build import build_settings
from simpel_cli.config.compose import Job
from simpel_cli.config.resolved import dump
from simpel_cli.data import Recording, read
from simpel_cli.discovery.next_experiment.design import next_experiment
from simpel_cli.discovery.search.acceptance import accepted, with_interactions
from simpel_cli.discovery.search.between_rows import (
    LINEAR,
    Preference,
    asked_beside,
    in_words,
    saying,
    sentence_of,
    words_of,
)
from simpel_cli.discovery.search.calibration import Calibrated, calibrated, prepared, with_heavy_tails
from simpel_cli.discovery.search.grouping import Grouping, confirmed, grouped_effects, groupings
from simpel_cli.discovery.search.grouping import in_words as grouping_in_words
from simpel_cli.discovery.search.grouping import sentence_of as of_grouping
from simpel_cli.discovery.search.heavy_tails import sentence_of as sentence_of_tails
from simpel_cli.discovery.search.held_out_gate import Gate
from simpel_cli.discovery.search.latency import Latency, estimated, same_readings
from simpel_cli.discovery.search.latency import in_words as in_words_of_latency
from simpel_cli.discovery.search.latency import sentence_of as sentence_of_latency
from simpel_cli.discovery.search.own_parameters import declared_in, in_common, own_parameters, per_of, with_own, written
from simpel_cli.discovery.search.selection import Selection
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.smaller import carried, fitter_of, small_search
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.disturbances import Disturbance, time_dependent_disturbance
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.verdict.corrected import corrected
from simpel_cli.discovery.verdict.evidence import evidence_tables
from simpel_cli.discovery.verdict.groups import sentence_of as of_groups
from simpel_cli.discovery.verdict.remainder import remainder_of
from simpel_cli.discovery.verdict.undetectable import caveats, undetectable
from simpel_cli.discovery.verdict.verdict import AMBIGUOUS, steps_of, verdict_of
from simpel_cli.dynamics.transition import encoding_of
from simpel_cli.errors import ConfigError, DataError, Inconclusive
from simpel_cli.filtering.errors_ahead import Assessment, Assessor
from simpel_cli.filtering.measurements.cleaning import cleaned, outlier_check, without_computed
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import MOST_GROUPED, Setup, members, setup, terms_of
from simpel_cli.inference.noise_scale import noise_scale_of
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.files import strict as strict_json
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.manifest import Manifest
from simpel_cli.studies.close_loop import close, past_inputs
from simpel_cli.studies.declared import Declared, resolved
from simpel_cli.studies.new_run import new_run
from simpel_cli.studies.open import Study, open_study, refuse_untested
from simulators.effects import Expression
from simulators.model import Model

IN_PYTHON = "a simulator in Python, whose YAML does not name it: make it differ there"
Publish = Callable[[Terminal, dict[str, Any], Path, dict[str, Any]], Any]  # terminal, verdict, directory, configuration


class Searched(NamedTuple):
    """What a search came to, before it is put into words.

    Args:
        search: its fits.
        assessor: of errors ahead.
        selection: the models before and after.
        gates: what every chosen effect adds on held-out episodes.
        disturbance: a force that goes with time alone; None: there is none.
        windows: held-out ones.
        recording: the measurements that were searched in, with what was found in them.
        between_rows: input -> what it does between rows, where neither simulator nor data say.
        degrees_of_freedom: measured channel -> nu of Student's t, of those whose noise has heavy tails.
        groupings: what it is worth that a parameter of the simulator, or an effect, differs from group to group.
    """

    search: Search
    assessor: Assessor
    selection: Selection
    gates: list[Gate]
    disturbance: Disturbance | None
    windows: Windows
    recording: Recording
    between_rows: dict[str, Preference]
    degrees_of_freedom: dict[str, float]
    groupings: list[Grouping]


def discover(job: Job, publish: Publish, *, strict: bool = False) -> None:
    """Run a search in its run directory.

    Args:
        job: of the verb.
        publish: prints the verdict and writes the report.
        strict: whether another verdict than `effect` is an error.

    Raises:
        Inconclusive: `strict` and another verdict than `effect`.
    """
    config = resolved(job)
    build_settings(config)  # a wrong key is named, also one that is replaced
    config["run"] = {**(config.get("run") or {}), "precision": "float64"}
    with new_run("discover", config, job.directory) as (declared, manifest), jax.enable_x64(True):
        found = _run(declared, job.data_folder, manifest, publish)
    if strict and found["verdict"] != "effect":
        raise Inconclusive(f"verdict {found['verdict']}: {found['summary']}")


def _run(declared: Declared, data_folder: Path, manifest: Manifest, publish: Publish) -> dict[str, Any]:
    began, directory = time.perf_counter(), manifest.directory
    study = open_study(declared, data_folder, whole=False)
    refuse_untested(study.recording)
    manifest.add_inputs(study.recording.files)
    if not isinstance(study.system.source, Model):
        raise ConfigError(
            "sim: discover needs a simulator in symbols, since effects are terms of it; a world has none."
        )
    if not declared.groups.get("effect"):
        raise ConfigError(
            "effect: none chosen; use effect=[all], or name some, e.g. effect=[coulomb_friction,input_delay]."
        )
    terminal = Terminal(study.settings.quiet, directory / "run.log")
    latencies = _latencies(study, data_folder, terminal)
    if latencies:
        declared = _with_latencies(declared, latencies)
        study = open_study(declared, data_folder, whole=False)
    searched = _with_groups(study, _search(study, terminal), terminal)
    search, selection, assessor = searched.search, searched.selection, searched.assessor
    if per := per_of(searched.groupings):  # before is the simulator as it was declared
        selection = selection._replace(base=in_common(search, selection.base, per))
        searched = searched._replace(selection=selection)
    before, after = (assessor(t.optimum.z, searched.windows) for t in (selection.base, selection.chosen))
    found = _verdict(searched, before, after, began)
    found["latency"] = {name: each._asdict() for name, each in latencies.items()}
    found["summary"] += sentence_of_latency(latencies)
    if found["verdict"] == AMBIGUOUS:
        terminal.line("which experiment tells them apart", "search")
        found["next_experiment"] = next_experiment(search, selection, directory)
    declared = _with_linear_inputs(declared, searched.between_rows)
    if found["effects"] or per:
        found |= _correct(declared, searched, found, directory, data_folder, terminal)
    write_text(directory / "verdict.json", json.dumps(strict_json(found), indent=1, allow_nan=False))
    shown = evidence_tables(search, selection, assessor, searched.recording, searched.windows, before, after)
    for name, table in shown.items():
        write_table(directory / f"{name}.parquet", table.columns, table.units)
    publish(terminal, found, directory, declared.config)
    return found


def _latencies(study: Study, data_folder: Path, terminal: Terminal) -> dict[str, Latency]:
    """Estimate the latencies that the data give by a range, with the simulator as it is."""
    model, measurements = study.system.source, study.measurements
    ranges = measurements.latency_ranges()
    if not ranges:
        return {}
    assert isinstance(model, Model)
    options: Discovery = study.declared.groups.get("discovery") or Discovery()
    names = [*(q.name for q in model.states), *study.recording.outputs]
    columns = {name: names.index(name) for name in ranges}
    longest = {name: high for name, (_, high) in ranges.items()}
    known: list[tuple[Setup, Trial]] = []  # the best calibration so far: another latency moves it little

    def evidence(at: Mapping[str, float]) -> float:
        own = replace(measurements, latency=dict(measurements.latency) | dict(at))
        recording = without_computed(read(own, model, data_folder, 0, whole=False), model)
        recording = _counted(same_readings(recording, columns, at, longest, model.dt), study)
        plan = setup(model, recording, tuple(own.noise_std), [], options.substeps, most_rows=options.rows)
        optimum = carried(known[-1][0], known[-1][1].optimum.z, plan) if known else None
        base = small_search(plan._replace(optimum=optimum), options.lanes, 1).base()
        if not known or base.optimum.log_evidence > known[-1][1].optimum.log_evidence:
            known.append((plan, base))
        return float(base.optimum.log_evidence)

    found = estimated(evidence, ranges, model.dt)
    terminal.line(in_words_of_latency(found), "latency")
    return found


def _counted(recording: Recording, study: Study, *, spikes: bool = False) -> Recording:
    """Return measurements whose values count by the scale of their noise, where `data.noise.scale` says it."""
    source, formulas = study.system.source, dict(study.measurements.noise_scale)
    computed = set(recording.derived) - set(study.recording.estimated)
    formulas = {name: formula for name, formula in formulas.items() if name not in computed}  # no channels
    measured = [*recording.outputs, *(q.name for q in source.states)]
    unmeasured = [q.name for q in source.outputs if q.name not in measured]
    scale = noise_scale_of(formulas, encoding_of(source, recording.outputs), [*study.recording.estimated, *unmeasured])
    return recording if scale is None else scale.counted(recording, spikes=spikes)


def _alike(recording: Recording) -> Recording:
    """Return measurements that all count alike."""
    train, test = (tuple(e._replace(weight=None) for e in part) for part in (recording.train, recording.test))
    return recording._replace(train=train, test=test)


def _with_latencies(declared: Declared, found: dict[str, Latency]) -> Declared:
    """Return the configuration whose data say how late each reading is, so that whatever follows takes it so."""
    data = declared.config["data"]
    said = {name: round(each.value, 12) for name, each in found.items()}
    return declared.changed(data=data | {"latency": dict(data.get("latency") or {}) | said})


def _with_groups(study: Study, searched: Searched, terminal: Terminal) -> Searched:
    """Search once more with the effects that differ from group to group, as long as that pays; return what was found last."""
    for _ in range(MOST_GROUPED):
        declared = study.declared
        effects = grouped_effects(declared.groups["effect"], searched.groupings)
        if effects == declared.groups["effect"]:
            break
        terminal.line("searching once more with it", "groups")
        study = study._replace(declared=declared._replace(groups=declared.groups | {"effect": effects}))
        again = _search(study, terminal, [g for g in searched.groupings if g.parameter])
        if not any(again.search.terms[t].groupings for t in again.selection.chosen.terms):
            said = confirmed(searched.groupings, searched.search, searched.selection.chosen)
            return searched._replace(groupings=said)
        before = confirmed(searched.groupings, again.search, again.selection.chosen)
        known = {(g.subject, g.per): g for g in (*before, *again.groupings)}
        searched = again._replace(groupings=list(known.values()))
    return searched


def _search(study: Study, terminal: Terminal, own: list[Grouping] | None = None) -> Searched:
    """Clean the measurements, calibrate the simulator, choose effects, and accept those that help on held-out episodes.

    Args:
        study: what is declared.
        terminal: takes lines.
        own: which of the simulator's parameters differ from group to group; None: that is asked.
    """
    model, groups = study.system.source, study.declared.groups
    assert isinstance(model, Model)
    options: Discovery = groups.get("discovery") or Discovery()
    effects: list[Expression] = groups["effect"]
    terminal.line(f"simpel discover · {model.name} · {len(effects)} effects · {study.device}", style="bold")
    declared_noise = tuple(study.measurements.noise_std)
    clean = cleaned(_counted(study.recording, study, spikes=True), model, declared_noise)
    # once more: what is typical is not what a lone value would make of it
    clean = clean._replace(recording=_counted(_alike(clean.recording), study))
    recording = clean.recording
    bad = [c for c in recording.checks if not c.ok]
    terminal.line("; ".join(f"{c.name}: {c.detail}" for c in bad) if bad else f"{len(recording.checks)} ok", "data")
    attach = partial(
        setup, recording=recording, declared_noise=declared_noise, effects=effects, substeps=options.substeps,
        pairs=options.pairs, most_rows=options.rows,
    )  # fmt: skip
    rows = sum(len(e.time) for e in recording.train)
    if rows > options.rows:
        terminal.line(f"searching in about {options.rows} of {rows} training rows (discovery.rows)", "data")
    declared, settled = model, own is not None
    own = own if own is not None else own_parameters(attach, declared, options)
    for one in [] if settled else own:
        terminal.line(grouping_in_words(one), "groups")
    model = with_own(declared, per_of(own)) if per_of(own) else declared
    terms = terms_of(model, recording, effects, pairs=options.pairs)
    plan, kept, between_rows = prepared(attach, model, terms, options, terminal)

    def searched_in(plan: Setup) -> tuple[Assessor, Calibrated, Selection, list[Gate]]:
        fitter = fitter_of(plan, options.lanes, options.room + members(plan))
        assessor = Assessor(plan, options.horizon)
        found = calibrated(plan, fitter, assessor, clean, terminal)
        return assessor, found, *accepted(found.search, assessor, found.base, options, terminal)

    assessor, found, selection, gates = searched_in(plan)
    said, chosen = words_of(between_rows), selection.chosen
    if said and chosen.terms:
        between_rows = asked_beside(attach, model, found.search, chosen, options.lanes)
    if words_of(between_rows) != said:
        terminal.line(f"beside these effects {in_words(between_rows)}: searching once more", "inputs")
        plan = attach(saying(model, between_rows), kept=kept)
        assessor, found, selection, gates = searched_in(plan)
    beside = (
        own
        if settled or not selection.chosen.terms
        else own_parameters(attach, saying(declared, between_rows), options, (found.search, selection.chosen))
    )
    if per_of(beside) == per_of(own):
        own = beside  # what it is worth beside the effects
    else:
        for one in beside:
            terminal.line(f"beside these effects {grouping_in_words(one)}", "groups")
        terminal.line("searching once more", "groups")
        return _search(study, terminal, beside)
    # beside what is left unexplained, no data tell whether tails are heavy
    heavy = None if selection.remainder else with_heavy_tails(found, assessor, selection.chosen.optimum.z, terminal)
    if heavy is not None:
        found = heavy
        selection, gates = accepted(found.search, assessor, found.base, options, terminal)
    search, windows = found.search, found.test
    outliers = outlier_check(found.clean, plan.augmented.measured)
    terminal.line(outliers.detail, "outliers")
    levels = NoiseProfile(search, assessor, selection.chosen)
    attach_said = partial(attach, saying(model, between_rows))
    selection, gates = with_interactions(levels, selection, gates, attach_said, options, terminal)
    disturbance = None if selection.remainder else time_dependent_disturbance(levels)
    if disturbance is not None:
        terminal.line(f"a force on {disturbance.acts_on} {disturbance.how} +{disturbance.gain:.0f}", "search")
    left = bool(selection.remainder or disturbance)
    asked = own + groupings(search, assessor, selection, left, effects, attach_said, options, terminal)
    recording = recording._replace(checks=(*recording.checks, outliers))
    return Searched(
        search, assessor, selection, gates, disturbance, windows, recording, between_rows, found.degrees_of_freedom,
        asked,
    )  # fmt: skip


def _verdict(searched: Searched, before: Assessment, after: Assessment, began: float) -> dict[str, Any]:
    """Return what `verdict.json` holds of the search itself."""
    search, assessor, selection, gates, disturbance, windows, recording, between_rows, nu, asked = searched
    left = remainder_of(search, selection, disturbance, assessor(selection.chosen.optimum.z, search.plan.windows))
    seconds = time.perf_counter() - began
    found = verdict_of(
        search, selection, gates, before, after, left, windows, recording.checks, assessor.horizon, seconds
    )
    found["between_rows"] = {name: p._asdict() for name, p in between_rows.items()}
    found["degrees_of_freedom"] = nu
    found["grouping"] = [g._asdict() | {"gate": g.gate and g.gate._asdict()} for g in asked]
    found["steps"] = steps_of(search, selection, assessor, windows)
    if per := per_of(asked):
        found["steps"][0]["added"] = [f"{name} by {by}" for name, by in per.items()]
        found["steps"].insert(0, {"added": [], "error": found["error"]["before"]})
    found["not_tested"] = undetectable(search, selection.chosen, recording.train)
    unknown = {(e["name"], e["acts_on"]) for e in found["not_tested"]}
    found["not_found"] = [e for e in found["not_found"] if (e["name"], e["acts_on"]) not in unknown]
    found["summary"] += (
        of_grouping(asked)
        + of_groups(found["groups"])
        + sentence_of(between_rows)
        + sentence_of_tails(nu)
        + caveats(found)
    )
    return found


def _with_linear_inputs(declared: Declared, found: dict[str, Preference]) -> Declared:
    """Return the configuration whose data say which inputs are linear, so that whatever follows takes them so."""
    linear = {name: p.word for name, p in found.items() if p.word == LINEAR}
    data = declared.config["data"]
    return (
        declared.changed(data=data | {"between_rows": (data.get("between_rows") or {}) | linear})
        if linear
        else declared
    )


def _correct(
    declared: Declared,
    searched: Searched,
    found: dict[str, Any],
    directory: Path,
    data_folder: Path,
    terminal: Terminal,
) -> dict[str, Any]:
    """Write the corrected simulator, and compare both as priors; returns what the verdict says of it."""
    config, model = declared.config, declared.source
    assert isinstance(model, Model)
    per = per_of(searched.groupings)
    nowhere = [f"{name} per {by} ({IN_PYTHON})" for name, by in per.items() if name not in declared_in(config["sim"])]
    if not found["effects"] and len(nowhere) == len(per):
        return {"corrected_sim_lacks": nowhere}
    name, node, left_out = corrected(written(config["sim"], per), model, searched.search, searched.selection.chosen)
    path = directory / "conf" / "sim" / f"{name}.yaml"
    data = directory / "conf" / "data" / f"{declared.choices.get('data')}.yaml"  # the user's own lies elsewhere
    for file, content in ((path, f"# {found['summary']}\n" + dump(node)), (data, dump(config["data"]))):
        file.parent.mkdir(parents=True)
        write_text(file, content)
    # groups that only the search was about are no inputs of what is fitted
    declared = declared.without("effect", "discovery")
    after = declared.changed(sim=node)
    added: dict[str, Any] = {
        "corrected_sim": str(path.relative_to(directory)),
        "corrected_sim_lacks": [*left_out, *nowhere],
        "stack_actions": past_inputs(after.source),
    }
    if config.get("close", True) and (len(nowhere) < len(per) or len(left_out) < len(found["effects"])):
        try:
            added["as_prior"] = close(declared, after, directory, data_folder, terminal)
        except DataError as error:  # a fit needs whole rows; what was found stands without it
            terminal.line(f"no fit with the corrected simulator: {error}", "close")
            added["not_closed"] = str(error)
    return added
