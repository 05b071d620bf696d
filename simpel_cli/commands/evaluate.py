"""`simpel evaluate RUN_DIR [data=...]`: rebuild a posterior from configuration and checkpoint, judge it."""

from pathlib import Path

from simpel_cli.commands.fit import checkpointed_state, refuse_changed_inputs
from simpel_cli.commands.judge import judge
from simpel_cli.commands.show import publish
from simpel_cli.commands.study import open_study, posteriors, prepare, resolved, settings_of
from simpel_cli.config import Job, dump, load
from simpel_cli.console import Terminal
from simpel_cli.errors import ConfigError, did_you_mean
from simpel_cli.records import write_metrics, write_text
from simpel_cli.run import Manifest, make_directory, read_manifest, refuse_occupied, sha256

OWN_SETTINGS = ("quiet", "device", "cache")  # of the group `run`; the others belong to the fit


def evaluate(job: Job) -> None:
    """Judge the run `run_dir` on its own test split, or on the measurements that `data=` names.

    Training data, seeds and method are the run's; `data=`, `evaluation=` and `run.quiet` may differ.
    """
    run = Path(job.config["run_dir"])
    record = read_manifest(run)
    if record["command"] != "fit":
        raise ConfigError(f"{run}: made by `simpel {record['command']}`; evaluate takes the directory of a fit.")
    trained = load(run / "config.yaml")
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
        judged_on = study
        if own.get("data"):
            choices = trained["choices"] | {"data": own["choices"].get("data", "")}
            judged_on = open_study(
                config | {"data": own["data"] | {"n_train": None}, "choices": choices}, job.data_folder
            )
            if judged_on.system.encoding != study.system.encoding:
                raise ConfigError("data: the run was fitted to other measured quantities than these data have.")
            if sha256(judged_on.recording.files[0]) in (record.get("inputs_sha256") or {}).values():
                # the run's own file: another split of it would judge the model on what it was trained on
                judged_on = study
        manifest.add_inputs(judged_on.recording.files)
        manifest.facts |= {"run": str(run), "step": step, "device": str(study.device)}
        terminal = Terminal(study.settings.quiet, directory / "run.log")
        terminal.line(f"simpel evaluate · {run} · step {step} · {judged_on.recording.files[0]}", style="bold")
        judged = judge(judged_on, posteriors(study, fitted, state), directory, step)
        constants = judged_on.constants | {"run": directory.name, "command": "evaluate"}
        write_metrics(directory / "metrics.parquet", judged.rows, constants | {"n_train": len(fitted.training[0][0])})
        publish(terminal, judged_on, judged, directory, dump(config), "evaluate", run)
