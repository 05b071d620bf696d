"""A posterior rebuilt from configuration and checkpoint, and tested: on its own test split, or on other measurements."""

from pathlib import Path
from typing import Any

from simpel_cli.config.compose import Job
from simpel_cli.config.resolved import of_run
from simpel_cli.data import Check
from simpel_cli.data.summary import held_out_summary
from simpel_cli.errors import ConfigError, DataError, did_you_mean
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.manifest import read_manifest, sha256
from simpel_cli.runs.metrics import write_metrics
from simpel_cli.studies.declared import Declared, resolved
from simpel_cli.studies.fit import refuse_changed_inputs
from simpel_cli.studies.judgement import judge
from simpel_cli.studies.new_run import new_run
from simpel_cli.studies.open import Study, open_study
from simpel_cli.studies.prepare import posteriors, prepare
from simpel_cli.studies.screen import Screen
from simpel_cli.studies.training import checkpointed_state, law_kept

CARDS = (".yaml",)  # describe columns; one may lie beside several files
OWN_SETTINGS = ("quiet", "device", "cache")  # of the group `run`; the others belong to the fit


def evaluate(job: Job, screen: Screen) -> None:
    """Test the run `run_dir` on its own test split, or on all of the measurements that `data=` names.

    Of a file that the run was trained on, only its own test split is used. Training data, seeds and method are the
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
            f"data.{key}: evaluate keeps the run's own data; for another data.{key} fit again. To test on other "
            f"measurements, name them: data=NAME. (evaluate takes data=NAME and its keys, evaluation.horizon, {settings})"
        )
    directory, beside = job.directory, {"judged_on": own["data"]} if own.get("data") else {}
    with new_run("evaluate", config, directory, beside=beside) as (declared, manifest):
        study = open_study(declared, run)
        refuse_changed_inputs(record.get("inputs_sha256") or {}, study.recording.files, config)
        step, state, fitted = checkpointed_state(run, prepare(study, law_kept(run)))
        judged_on = _new_measurements(study, own, job, record) if own.get("data") else study
        if fitted.scale is not None:
            fitted.scale.refuse_wrong(judged_on.recording)
        manifest.add_inputs(judged_on.recording.files)
        manifest.facts |= {"run": str(run), "step": step, "device": str(study.device)}
        terminal = Terminal(study.settings.quiet, directory / "run.log")
        screen.describe_evaluation(terminal, run, step, study, judged_on)
        judged = judge(judged_on, posteriors(study, fitted, state, judged_on), fitted.target_std, directory, step)
        constants = judged_on.constants | {"run": directory.name, "command": "evaluate", "n_train": fitted.n_train}
        write_metrics(directory / "metrics.parquet", judged.rows, constants)
        screen.publish(terminal, study, fitted, judged_on, judged, manifest)


def _new_measurements(study: Study, own: dict[str, Any], job: Job, record: dict[str, Any]) -> Study:
    """Return the study with other measurements, all of them to be tested on; the run's own where the file is its own.

    Raises:
        ConfigError: other quantities were measured.
    """
    # the past inputs of the fit, where the new data do not say otherwise
    data = {"stack_actions": study.measurements.stack_actions} | own["data"]
    for key in ("between_rows", "latency"):  # as the rig was, where the new data do not say otherwise
        data[key] = dict(getattr(study.measurements, key)) | (data.get(key) or {})
    scale = (data.get("noise") or {}).get("scale")
    if scale and scale != study.measurements.noise_scale:
        raise ConfigError(
            f"data.noise.scale: {scale}, but the run was fitted with {dict(study.measurements.noise_scale) or 'none'}, and is "
            "judged with its own noise. Leave it out, or fit again."
        )
    choices = study.choices | {"data": own["choices"].get("data", "")}
    declared = study.declared._replace(config=study.declared.config | {"choices": choices})
    other = _opened_whole(declared, data, job.data_folder, study.recording.groups)
    linear = study.system.encoding.linear
    for i, q in enumerate(study.system.encoding.inputs):
        ways = [i in linear, i in other.system.encoding.linear]
        if ways[0] != ways[1]:
            was, is_ = ("that move" if way else "that are held" for way in ways)
            raise ConfigError(
                f"data.between_rows.{q.name}: inputs {is_}, but the run was fitted to inputs {was} between rows. "
                f"Give {'linear or smooth' if ways[0] else 'held'}."
            )
    if other.system.encoding != study.system.encoding:
        raise ConfigError("data: these data have other measured quantities than the run was fitted to.")
    recording = other.recording
    known = (record.get("inputs_sha256") or {}).values()
    if any(sha256(file) in known for file in recording.files if file.suffix not in CARDS):
        return study  # another split of the run's own file would test the model on its training data
    recording = recording._replace(train=(), test=(*recording.train, *recording.test))
    said = f"all rows are test data ({held_out_summary(recording)}): the fit was not trained on this file"
    checks = tuple(Check("split", True, said) if check.name == "split" else check for check in recording.checks)
    return other._replace(recording=recording._replace(checks=checks))


def _opened_whole(declared: Declared, data: dict[str, Any], folder: Path, groups: dict[str, tuple[str, ...]]) -> Study:
    """Read measurements whose split does not matter; a file of one episode can be split within it only."""
    whole = data | {"n_train": None, "n_episodes": None}
    try:
        return open_study(declared.changed(data=whole | {"split": {"by": "episode"}}), folder, groups=groups)
    except DataError:
        return open_study(
            declared.changed(data=whole | {"split": {"by": "time", "test_fraction": 0.5}}), folder, groups=groups
        )
