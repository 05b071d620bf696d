"""`simpel evaluate RUN_DIR [data=...]`: rebuild a posterior from configuration and checkpoint, judge it."""

from pathlib import Path
from typing import Any

from simpel_cli.commands.fit import checkpointed_state, refuse_changed_inputs
from simpel_cli.config.launch import Job
from simpel_cli.config.resolved import dump, of_run
from simpel_cli.data import Check
from simpel_cli.errors import ConfigError, DataError, did_you_mean
from simpel_cli.reporting.data_summary import test_summary
from simpel_cli.reporting.fit import describe_data, publish
from simpel_cli.reporting.run_table import run_table
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, refuse_occupied
from simpel_cli.runs.files import write_text
from simpel_cli.runs.manifest import Manifest, read_manifest, sha256
from simpel_cli.runs.metrics import write_metrics
from simpel_cli.studies.judgement import judge
from simpel_cli.studies.study import Study, open_study, posteriors, prepare, resolved, settings_of

CARDS = (".yaml",)  # describe columns; one may lie beside several files
OWN_SETTINGS = ("quiet", "device", "cache")  # of the group `run`; the others belong to the fit


def evaluate(job: Job) -> None:
    """Judge the run `run_dir` on its own test split, or on all of the measurements that `data=` names.

    Of a file that the run was trained on, only its own test split is judged. Training data, seeds and method are the
    run's; `data=`, `evaluation=` and `run.quiet` may differ.
    """
    run = Path(job.config["run_dir"])
    record = read_manifest(run)
    if record["command"] != "fit":
        raise ConfigError(f"{run}: made by `simpel {record['command']}`; evaluate takes the directory of a fit.")
    trained = of_run(run)
    own = resolved(job)
    config = trained | {name: (trained.get(name) or {}) | (own.get(name) or {}) for name in ("run", "evaluation")}
    settings = ", ".join(f"run.{k}" for k in OWN_SETTINGS)
    for key in own.get("run") or {}:
        if key not in OWN_SETTINGS:
            raise ConfigError(
                f"run.{key}: evaluate keeps the run's own value; it takes {settings}."
                + did_you_mean(key, list(OWN_SETTINGS))
            )
    if own.get("data") and not own["choices"].get("data"):
        key = next(iter(own["data"]))
        raise ConfigError(
            f"data.{key}: evaluate keeps the run's own data; for another data.{key} fit again. To judge on other "
            f"measurements, name them: data=NAME. (evaluate takes data=NAME and its keys, evaluation.horizon, {settings})"
        )
    directory = make_directory(job.directory)
    refuse_occupied(directory)
    write_text(directory / "config.yaml", dump(config | ({"judged_on": own["data"]} if own.get("data") else {})))
    with Manifest(directory, "evaluate", settings_of(config)) as manifest:
        study = open_study(config, run)
        refuse_changed_inputs(record, study.recording.files)
        fitted = prepare(study)
        step, state, fitted = checkpointed_state(run, fitted)
        judged_on = _new_measurements(study, config, own, job, record) if own.get("data") else study
        manifest.add_inputs(judged_on.recording.files)
        manifest.facts |= {"run": str(run), "step": step, "device": str(study.device)}
        terminal = Terminal(study.settings.quiet, directory / "run.log")
        terminal.line(f"simpel evaluate · {run} · step {step}", style="bold")
        judged_rows = test_summary(judged_on.recording)
        what = (
            f"the test split of the fit, {judged_rows}"
            if judged_on is study
            else f"all of it, {judged_rows}, new to the fit"
        )
        describe_data(terminal, judged_on.recording, what)
        judged = judge(judged_on, posteriors(study, fitted, state), fitted.target_std, directory, step)
        constants = judged_on.constants | {"run": directory.name, "command": "evaluate"}
        write_metrics(directory / "metrics.parquet", judged.rows, constants | {"n_train": len(fitted.training[0][0])})
        table = run_table(study, fitted, judged, manifest)
        publish(terminal, judged_on, judged, directory, dump(config), "evaluate", table, run)


def _new_measurements(
    study: Study, config: dict[str, Any], own: dict[str, Any], job: Job, record: dict[str, Any]
) -> Study:
    """Return the study with other measurements, all of them to be tested on; the run's own where the file is its own.

    Raises:
        ConfigError: other quantities were measured.
    """
    choices = config["choices"] | {"data": own["choices"].get("data", "")}
    # the past inputs of the fit, where the new data do not say otherwise
    data = {"stack_actions": config["data"].get("stack_actions") or 0} | own["data"]
    other = _opened_whole(config | {"choices": choices}, data, job.data_folder)
    if other.system.encoding != study.system.encoding:
        raise ConfigError("data: the run was fitted to other measured quantities than these data have.")
    recording = other.recording
    known = (record.get("inputs_sha256") or {}).values()
    if any(sha256(file) in known for file in recording.files if file.suffix not in CARDS):
        return study  # another split of the run's own file would judge the model on what it was trained on
    recording = recording._replace(train=(), test=(*recording.train, *recording.test))
    said = f"everything is judged ({test_summary(recording)}): the fit was not trained on this file"
    checks = tuple(Check("split", True, said) if check.name == "split" else check for check in recording.checks)
    return other._replace(recording=recording._replace(checks=checks))


def _opened_whole(config: dict[str, Any], data: dict[str, Any], folder: Path) -> Study:
    """Read measurements whose split does not matter; a file of one episode can be split within it only."""
    whole = data | {"n_train": None, "n_episodes": None}
    try:
        return open_study(config | {"data": whole | {"split": {"by": "episode"}}}, folder)
    except DataError:
        return open_study(config | {"data": whole | {"split": {"by": "time", "test_fraction": 0.5}}}, folder)
