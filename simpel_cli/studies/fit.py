"""A fit as a whole: opened, its prior checked, trained, tested, reported; or resumed where it was stopped."""

import time
from pathlib import Path
from typing import Any, NamedTuple

from simpel_cli.config.compose import Job
from simpel_cli.config.resolved import dump
from simpel_cli.errors import DataError
from simpel_cli.inference import loop
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, typed
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.manifest import Manifest, read_manifest, sha256
from simpel_cli.runs.metrics import MetricStream
from simpel_cli.runs.tensorboard import Scalars
from simpel_cli.studies.declared import declare, resolved
from simpel_cli.studies.judgement import judge
from simpel_cli.studies.new_run import kept_run, new_run, read_into
from simpel_cli.studies.open import Study, open_study
from simpel_cli.studies.prepare import STRETCH, Fitted, posteriors, prepare
from simpel_cli.studies.prior_check import prior_check
from simpel_cli.studies.screen import Screen
from simpel_cli.studies.training import checkpointed_state, has_checkpoint, law_kept, train


class Learned(NamedTuple):
    """The result of a fit: the state of every seed's posterior (leaves (seeds, ...)), and what it is bound to."""

    study: Study
    fitted: Fitted
    state: Any


def fit(job: Job, screen: Screen) -> None:
    """Run a new fit in its run directory."""
    with new_run("fit", resolved(job), job.directory) as (declared, manifest):
        _run(open_study(declared, job.data_folder), manifest, screen, resume=False)


def resume(directory: Path, screen: Screen) -> None:
    """Resume an interrupted fit, bit for bit as if it had not been interrupted."""
    record, config, settings = kept_run("fit", directory)
    if record.get("status") == "done":
        Terminal(settings.quiet).line(f"{directory} is complete; nothing to do.")
        return
    inputs = record.get("inputs_sha256") or {}
    with Manifest(directory, "fit", settings, inputs=dict(inputs)) as manifest:
        _run(open_study(declare(config, settings), directory), manifest, screen, resume=True)


def learned(study: Study, directory: Path, screen: Screen, *, shown: bool = True) -> Learned:
    """Return the posterior of a fit in a directory of its own: a complete one is read, an interrupted one is resumed.

    Args:
        study: what is fitted.
        directory: of the fit.
        screen: what is shown.
        shown: whether the terminal says what `simpel fit` says; `run.log` does in any case.
    """
    begun = (directory / "manifest.json").exists()
    record = read_manifest(directory) if begun else {}
    inputs = record.get("inputs_sha256") or {}
    if record.get("status") == "done":
        refuse_changed_inputs(inputs, study.recording.files, study.declared.config)
        _, state, fitted = checkpointed_state(directory, prepare(study, law_kept(directory)))
        return Learned(study, fitted, state)
    make_directory(directory)
    write_text(directory / "config.yaml", dump(study.declared.config))
    with Manifest(directory, "fit", study.settings, inputs=dict(inputs)) as manifest:
        return _run(study, manifest, screen, resume=begun, shown=shown)


def _run(study: Study, manifest: Manifest, screen: Screen, *, resume: bool, shown: bool = True) -> Learned:
    directory = manifest.directory
    if resume:
        refuse_changed_inputs(manifest.inputs, study.recording.files, study.declared.config)
    manifest.add_inputs(study.recording.files)
    manifest.facts["device"] = str(study.device)
    terminal = Terminal(study.settings.quiet or not shown, directory / "run.log")
    fitted = prepare(study, law_kept(directory) if resume else None)
    checked = prior_check(study, fitted)
    screen.describe(terminal, study, fitted, checked)
    if checked is not None:
        write_table(directory / "prior_predictive.parquet", checked.table)
    start, state, fitted = _restored(directory, fitted) if resume else (0, None, fitted)
    program = loop.compiled(fitted.bind, fitted.assembled.problems, fitted.keys, STRETCH)
    constants = study.constants | {"run": directory.name, "command": "fit", "n_train": fitted.n_train}
    began = time.perf_counter()
    since = start if resume else None
    scalars = Scalars(directory, since) if study.settings.tensorboard else None
    with MetricStream(directory, constants, resume_at=since, scalars=scalars) as metrics:
        state = train(study, fitted, program, terminal, metrics, directory, state, start)
        manifest.facts |= {
            "compile_seconds": round(program.compile_seconds, 3),
            "train_seconds": round(time.perf_counter() - began, 3),
            "n_train": fitted.n_train,
        }
        if not study.recording.test:
            metrics.close()
            terminal.line(
                f"there are no test data; simpel evaluate {typed(directory)} data=NAME tests on other measurements"
            )
            return Learned(study, fitted, state)
        judged = judge(study, posteriors(study, fitted, state), fitted.target_std, directory, study.method.steps)
        metrics.add(judged.rows)
        metrics.close()
    screen.publish(terminal, study, fitted, study, judged, manifest)
    return Learned(study, fitted, state)


def refuse_changed_inputs(inputs: dict[str, str], files: tuple[Path, ...], config: dict[str, Any]) -> None:
    """Compare the measurements with what a run's manifest says that it was trained on; tables are in its configuration.

    Args:
        inputs: the files of the run and their SHA-256.
        files: of the measurements, as they are found today.
        config: resolved.

    Raises:
        DataError: a file is another one now, or there are more or fewer of them (of a pattern in `data.path`), so that the run
            cannot be repeated or gone on with.
    """
    tables = read_into(config)
    known = {name: digest for name, digest in inputs.items() if name not in tables}
    new = [file for file in files if str(file) not in known and file.suffix != ".yaml"]
    gone = [name for name in known if not Path(name).exists()]
    if (new or gone) and any(
        str(file) in known for file in files
    ):  # none is known where all were moved to another folder
        what = f"{new[0]} is new" if new else f"{gone[0]} is gone"
        raise DataError(f"{what} since the run was started. Have the same files in data.path again, or fit again.")
    for file in files:
        if known.get(str(file), digest := sha256(file)) != digest:
            raise DataError(
                f"{file} has changed since the run was started (its SHA-256 differs). Restore it, or fit again."
            )


def _restored(directory: Path, fitted: Fitted) -> tuple[int, Any, Fitted]:
    """Read the checkpoint, if there is one."""
    if not has_checkpoint(directory):
        return 0, None, fitted  # stopped before the first checkpoint: the run starts over, with the same result
    return checkpointed_state(directory, fitted)
