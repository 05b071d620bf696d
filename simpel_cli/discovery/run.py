"""A search as a whole: find what the simulator lacks, name it, add it, and say how much that helps."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from simpel_cli.config.build import build_settings
from simpel_cli.config.compose import Job
from simpel_cli.config.resolved import dump
from simpel_cli.discovery.latencies import latencies_of, with_latencies
from simpel_cli.discovery.latency import sentence_of as sentence_of_latency
from simpel_cli.discovery.next_experiment.design import next_experiment
from simpel_cli.discovery.next_experiment.determining import determining_experiments
from simpel_cli.discovery.search.between_rows import MOVES, Preference, sentence_of
from simpel_cli.discovery.search.by_group.grouping import sentence_of as of_grouping
from simpel_cli.discovery.search.by_group.own_parameters import declared_in, per_of, said_of_groups, written
from simpel_cli.discovery.search.by_group.strangers import assessed
from simpel_cli.discovery.search.heavy_tails import sentence_of as sentence_of_tails
from simpel_cli.discovery.search.sets.splitting import two_in_place
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.searched import Searched, search_of
from simpel_cli.discovery.verdict.beyond import Beyond, beyond, ranges_of
from simpel_cli.discovery.verdict.beyond import sentence_of as of_ranges
from simpel_cli.discovery.verdict.corrected import corrected
from simpel_cli.discovery.verdict.determined import left_open
from simpel_cli.discovery.verdict.determined import sentence_of as of_open
from simpel_cli.discovery.verdict.evidence import evidence_tables
from simpel_cli.discovery.verdict.groups import sentence_of as of_groups
from simpel_cli.discovery.verdict.remainder import remainder_of
from simpel_cli.discovery.verdict.undetectable import caveats, undetectable
from simpel_cli.discovery.verdict.verdict import AMBIGUOUS, steps_of, verdict_of
from simpel_cli.errors import ConfigError, Inconclusive, SimpelError
from simpel_cli.filtering.errors_ahead import Assessment
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.files import strict as strict_json
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.manifest import Manifest
from simpel_cli.studies.close_loop import close, past_inputs
from simpel_cli.studies.declared import Declared, resolved
from simpel_cli.studies.new_run import new_run
from simpel_cli.studies.open import open_study, refuse_untested
from simulators.effects import stores_of
from simulators.model import Model

IN_PYTHON = "a simulator in Python, whose YAML does not name it: make it differ there"
NOT_ALIKE = (
    "the corrected simulator has a state that nobody measures, so that scores of a fit with it are of other outputs than those "
    "without it; fit it by itself"
)
Publish = Callable[[Terminal, dict[str, Any], Path, dict[str, Any]], Any]  # terminal, verdict, directory, configuration


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
    manifest.facts["device"] = str(study.device)
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
    latencies = latencies_of(study, data_folder, terminal)
    if latencies:
        declared = with_latencies(declared, latencies)
        study = open_study(declared, data_folder, whole=False)
    searched = search_of(study, terminal)
    search, selection, assessor = searched.search, searched.selection, searched.assessor
    assert isinstance(study.system.source, Model)
    per = per_of(searched.groupings)
    before, after = (
        assessed(search, assessor, t, searched.windows, searched.for_use) for t in (selection.base, selection.chosen)
    )
    outside = beyond(study.system.source, search, selection.chosen, searched.wider)
    found = _verdict(searched, outside, before, after, began)
    found["latency"] = {name: each._asdict() for name, each in latencies.items()}
    found["summary"] += sentence_of_latency(latencies)
    if found["verdict"] == AMBIGUOUS and not search.budget.over("the next experiment"):
        terminal.line("which experiment tells them apart", "search")
        found["next_experiment"] = next_experiment(search, selection, directory)
    options: Discovery = declared.groups.get("discovery") or Discovery()
    opens = left_open(search, selection.chosen) if options.determine else []
    if opens and not search.budget.over("experiments that determine what is left open"):
        terminal.line("which experiment determines what is left open", "search")
        found["determining_experiments"] = determining_experiments(search, selection.chosen, opens, directory)
    declared = _with_moving_inputs(declared, searched.between_rows)
    if found["effects"] or per or outside:
        found |= _correct(declared, searched, outside, found, directory, data_folder, terminal)
    write_text(directory / "verdict.json", json.dumps(strict_json(found), indent=1, allow_nan=False))
    shown = evidence_tables(search, selection, assessor, searched.recording, searched.windows, before, after)
    for name, table in shown.items():
        write_table(directory / f"{name}.parquet", table.columns, table.units)
    publish(terminal, found, directory, declared.config)
    return found


def _verdict(
    searched: Searched, outside: list[Beyond], before: Assessment, after: Assessment, began: float
) -> dict[str, Any]:
    """Return what `verdict.json` holds of the search itself."""
    search, assessor, selection, gates, disturbance, windows, recording, between_rows, nu, asked, *_ = searched
    learnt = assessor(selection.chosen.optimum.z, search.plan.windows)
    left = remainder_of(search, selection, disturbance, learnt, searched.drift)
    # what simulations have chosen is not judged row by row
    places = range(0 if searched.by_simulations else len(selection.chosen.terms))
    pairs = [two_in_place(search, selection.chosen, i) for i in places]
    seconds = time.perf_counter() - began
    found = verdict_of(
        search, selection, gates, before, after, left, windows, recording.checks, assessor.horizon, seconds, pairs
    )
    found["between_rows"] = {name: p._asdict() for name, p in between_rows.items()}
    found["degrees_of_freedom"] = nu
    found["grouping"] = [g._asdict() | {"gate": g.gate and g.gate._asdict()} for g in asked]
    found["steps"] = steps_of(search, selection, assessor, windows, searched.for_use)
    found["left_out"] = search.budget.left_out
    found["drift"] = searched.drift and searched.drift._asdict()
    found["not_determined"] = [o._asdict() | {"words": o.words} for o in left_open(search, selection.chosen)]
    found["outside_ranges"] = [b._asdict() for b in outside]
    first = [f"{name} by {by}" for name, by in per_of(asked).items()]
    first += [f"{b.name} outside its range" for b in outside]
    if first:
        found["steps"][0]["added"] = first
        found["steps"].insert(0, {"added": [], "error": found["error"]["before"]})
    found["not_tested"] = undetectable(search, selection.chosen, recording.train)
    unknown = {(e["name"], e["acts_on"]) for e in found["not_tested"]}
    found["not_found"] = [e for e in found["not_found"] if (e["name"], e["acts_on"]) not in unknown]
    found["summary"] += (
        of_ranges(outside)
        + of_grouping(asked)
        + of_groups(found["groups"])
        + of_open(found["not_determined"])
        + sentence_of(between_rows)
        + sentence_of_tails(nu)
        + caveats(found)
        + search.budget.sentence
    )
    return found


def _with_moving_inputs(declared: Declared, found: dict[str, Preference]) -> Declared:
    """Return the configuration whose data say which inputs move between rows, so that whatever follows takes them so."""
    moving = {name: p.word for name, p in found.items() if p.word in MOVES}
    data = declared.config["data"]
    return (
        declared.changed(data=data | {"between_rows": (data.get("between_rows") or {}) | moving})
        if moving
        else declared
    )


def _correct(
    declared: Declared,
    searched: Searched,
    outside: list[Beyond],
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
    nowhere += [f"the range of {b.name} ({IN_PYTHON})" for b in outside if b.name not in declared_in(config["sim"])]
    changes = len(per) + len(outside)
    said = ranges_of(outside)
    own = said_of_groups(model, per, found["groups"])
    said |= {name: said.get(name, {}) | keys for name, keys in own.items()}
    if not found["effects"] and len(nowhere) == changes:
        return {"corrected_sim_lacks": nowhere}
    name, node, left_out = corrected(written(config["sim"], said), model, searched.search, searched.selection.chosen)
    path = directory / "conf" / "sim" / f"{name}.yaml"
    data = directory / "conf" / "data" / f"{declared.choices.get('data')}.yaml"  # the user's own lies elsewhere
    hidden = [s.name for s in stores_of(searched.search.terms[t] for t in searched.selection.chosen.terms)]
    hidden = [name for name in hidden if name in node.get("states", {})]
    columns = {"columns": (config["data"].get("columns") or {}) | dict.fromkeys(hidden)} if hidden else {}
    for file, content in ((path, f"# {found['summary']}\n" + dump(node)), (data, dump(config["data"] | columns))):
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
    if hidden:
        added["not_closed"] = f"{NOT_ALIKE}: simpel fit --config-dir {directory.name}/conf sim={name} data={data.stem}"
    elif config.get("close", True) and (len(nowhere) < changes or len(left_out) < len(found["effects"])):
        added |= _compared(declared, after, directory, data_folder, terminal)
    return added


def _compared(
    declared: Declared, after: Declared, directory: Path, data_folder: Path, terminal: Terminal
) -> dict[str, Any]:
    """Compare both simulators as priors; what was found stands without it: a fit needs whole rows, and can fail."""
    try:
        return {"as_prior": close(declared, after, directory, data_folder, terminal)}
    except SimpelError as error:
        terminal.line(f"no fit with the corrected simulator: {error}", "close")
        return {"not_closed": str(error)}
