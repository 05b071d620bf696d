"""`simpel fit`: fit Bayesian neural networks to measured transitions under a functional prior, judge and report."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from simpel_cli.config.launch import Job
from simpel_cli.config.resolved import dump, of_run
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.inference import loop
from simpel_cli.reporting.fit import describe, publish
from simpel_cli.reporting.run_table import run_table
from simpel_cli.runs.checkpoint import keep, restored
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, refuse_occupied, typed
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.manifest import Manifest, read_manifest, refuse_changed_config, sha256
from simpel_cli.runs.metrics import MetricStream
from simpel_cli.runs.tensorboard import Scalars
from simpel_cli.studies.judgement import Judged, judge
from simpel_cli.studies.prior_check import prior_check
from simpel_cli.studies.study import STRETCH, Fitted, Study, open_study, posteriors, prepare, resolved, settings_of

LOG_EVERY = 50  # steps per row of the metric table
DRAWN = ("normaliser", "gap_scale", "noise_init", "noise_floor")  # of a problem: drawn or chosen, not measured


class Learned(NamedTuple):
    """What a fit came to: the state of every seed's posterior (leaves (seeds, ...)), and what it is bound to."""

    study: Study
    fitted: Fitted
    state: Any


def fit(job: Job) -> None:
    """Run a new fit in its run directory."""
    settings = settings_of(job.config)
    directory = make_directory(job.directory)
    refuse_occupied(directory)
    config = resolved(job)
    write_text(directory / "config.yaml", dump(config))
    with Manifest(directory, "fit", settings) as manifest:
        _run(config, directory, job.data_folder, manifest, resume=False)


def resume(directory: Path) -> None:
    """Go on with an interrupted fit, bit for bit as if it had not been interrupted."""
    record = read_manifest(directory)
    if record["command"] != "fit":
        raise ConfigError(f"{directory}: made by `simpel {record['command']}`; only a fit can be resumed.")
    refuse_changed_config(directory, record)
    config = of_run(directory)
    if record.get("status") == "done":
        Terminal(settings_of(config).quiet).line(f"{directory} is complete; nothing to do.")
        return
    inputs = record.get("inputs_sha256") or {}
    with Manifest(directory, "fit", settings_of(config), inputs=dict(inputs)) as manifest:
        _run(config, directory, directory, manifest, resume=True)


def learned(config: dict[str, Any], directory: Path, data_folder: Path, *, shown: bool = True) -> Learned:
    """Return the posterior of a fit in a directory of its own: what is complete is read, what is not is gone on with.

    Args:
        config: resolved, of `simpel fit`.
        directory: of the fit.
        data_folder: of the data YAML.
        shown: whether the terminal says what `simpel fit` says; `run.log` does in any case.
    """
    begun = (directory / "manifest.json").exists()
    record = read_manifest(directory) if begun else {}
    inputs = record.get("inputs_sha256") or {}
    if record.get("status") == "done":
        study = open_study(config, directory)
        refuse_changed_inputs(record, study.recording.files)
        _, state, fitted = checkpointed_state(directory, prepare(study))
        return Learned(study, fitted, state)
    make_directory(directory)
    write_text(directory / "config.yaml", dump(config))
    with Manifest(directory, "fit", settings_of(config), inputs=dict(inputs)) as manifest:
        return _run(config, directory, data_folder, manifest, resume=begun, shown=shown)


def _run(
    config: dict[str, Any], directory: Path, data_folder: Path, manifest: Manifest, *, resume: bool, shown: bool = True
) -> Learned:
    study = open_study(config, data_folder)
    if resume:
        refuse_changed_inputs({"inputs_sha256": manifest.inputs}, study.recording.files)
    manifest.add_inputs(study.recording.files)
    manifest.facts["device"] = str(study.device)
    terminal = Terminal(study.settings.quiet or not shown, directory / "run.log")
    fitted = prepare(study)
    checked = prior_check(study, fitted)
    describe(terminal, study, fitted, checked)
    if checked is not None:
        write_table(directory / "prior_predictive.parquet", checked.table)
    start, state, fitted = _restored(directory, fitted) if resume else (0, None, fitted)
    program = loop.compiled(fitted.bind, fitted.assembled.problems, fitted.keys, STRETCH)
    constants = study.constants | {"run": directory.name, "command": "fit", "n_train": len(fitted.training[0][0])}
    began = time.perf_counter()
    since = start if resume else None
    scalars = Scalars(directory, since) if study.settings.tensorboard else None
    with MetricStream(directory, constants, resume_at=since, scalars=scalars) as metrics:
        state = _train(study, fitted, program, terminal, metrics, directory, state, start)
        manifest.facts |= {
            "compile_seconds": round(program.compile_seconds, 3),
            "train_seconds": round(time.perf_counter() - began, 3),
            "n_train": len(fitted.training[0][0]),
        }
        if not study.recording.test:
            metrics.close()
            terminal.line(
                f"nothing was kept to judge on; simpel evaluate {typed(directory)} data=NAME judges on other measurements"
            )
            return Learned(study, fitted, state)
        found = posteriors(study, fitted, state)
        judged: Judged = judge(study, found, fitted.target_std, directory, study.method.steps)
        metrics.add(judged.rows)
        metrics.close()
    table = run_table(study, fitted, judged, manifest)
    publish(terminal, study, judged, directory, dump(config), "fit", table)
    return Learned(study, fitted, state)


def refuse_changed_inputs(record: dict[str, Any], files: tuple[Path, ...]) -> None:
    """Compare the measurements with what a run's manifest says that it was trained on.

    Raises:
        DataError: a file is another one now, so that the run cannot be repeated or gone on with.
    """
    known = record.get("inputs_sha256") or {}
    for file in files:
        if known.get(str(file), digest := sha256(file)) != digest:
            raise DataError(
                f"{file} has changed since the run was started (its SHA-256 differs). Restore it, or fit again."
            )


def _train(
    study: Study,
    fitted: Fitted,
    program: loop.Program,
    terminal: Terminal,
    metrics: MetricStream,
    directory: Path,
    state: Any,
    start: int,
) -> Any:
    encoding, steps = study.system.encoding, study.method.steps
    y_std = np.asarray(fitted.normaliser.y_std)
    compile_note = f"compile {program.compile_seconds:.1f} s"
    with terminal.progress("fit", steps, start) as update:
        for stretch in loop.train(program, steps, state=state, start=start):
            state = stretch.state
            # rows first: a kill in between leaves rows beyond the checkpoint, which resume cuts off and makes again
            metrics.add(_training_rows(study, stretch, encoding, y_std))
            keep(directory, _kept(fitted, state), {"step": stretch.step, "command": "fit"})
            loss = float(stretch.info.loss[:, -LOG_EVERY:].mean())
            noise = " ".join(f"{v:.2g}" for v in stretch.info.noise_std[:, -1].mean(axis=0) * y_std)
            update(stretch.step, f"loss {loss:.3g}  noise {noise}  {compile_note}")
    return state


def _training_rows(study: Study, stretch: loop.Stretch, encoding: Any, y_std: np.ndarray) -> list[dict[str, Any]]:
    """Means over every `LOG_EVERY` steps of what the steps reported."""
    rows = []
    length = stretch.info.loss.shape[1]
    for begin in range(0, length, LOG_EVERY):
        part = jax.tree.map(lambda a, b=begin: a[:, b : b + LOG_EVERY].mean(axis=1), stretch.info)
        step = stretch.step - length + min(begin + LOG_EVERY, length)
        for i, seed in enumerate(study.settings.all_seeds):
            base = {"seed": seed, "step": step, "split": "train"}
            rows.append(base | {"metric": "loss", "unit": "nat", "value": float(part.loss[i])})
            rows.append(base | {"metric": "mean_kernel", "unit": "1", "value": float(part.mean_kernel[i])})
            for name, unit, value in zip(encoding.y_names, encoding.y_units, part.noise_std[i] * y_std, strict=True):
                rows.append(base | {"metric": "noise_std", "output": name, "unit": unit, "value": float(value)})
    return rows


def _kept(fitted: Fitted, state: Any) -> dict[str, Any]:
    """Return what a checkpoint holds: the state, and of the problem what was drawn or chosen rather than measured.

    Another version of JAX may draw another normaliser; networks that were trained in one are worth nothing in another.
    """
    problems = fitted.assembled.problems
    return {"state": state, "problem": {name: getattr(problems, name) for name in DRAWN}}


def _restored(directory: Path, fitted: Fitted) -> tuple[int, Any, Fitted]:
    """Read the checkpoint, if there is one."""
    if not (directory / "checkpoint" / "state.safetensors").exists():
        return 0, None, fitted  # stopped before the first checkpoint: the run starts over, with the same result
    return checkpointed_state(directory, fitted)


def checkpointed_state(directory: Path, fitted: Fitted) -> tuple[int, Any, Fitted]:
    """Return the step and the state of a run's checkpoint, and the problem in the units that it was trained in.

    Raises:
        ConfigError: no checkpoint, a damaged one, or one of another configuration.
    """
    shape = _kept(fitted, loop.state_shape(fitted.bind, fitted.assembled.problems, fitted.keys))
    kept, facts = restored(directory, shape)
    assembled = fitted.assembled._replace(problems=fitted.assembled.problems._replace(**kept["problem"]))
    return int(facts["step"]), kept["state"], fitted._replace(assembled=assembled)
