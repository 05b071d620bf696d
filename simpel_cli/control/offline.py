"""A policy learned in the posterior of a fit, and tested in the true simulator: the work of `simpel rl-offline`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.config.compose import Job
from simpel_cli.control.agents.rollout import Episodes
from simpel_cli.control.assignment import Assignment, assignment, refuse_outputs, remarks
from simpel_cli.control.planning import plan
from simpel_cli.control.saved_policies import done_steps, of_seed, save_policies
from simpel_cli.control.settings import CONTROL_GROUPS
from simpel_cli.control.training import TrainedPolicies, judge_of, train
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.files import write_table
from simpel_cli.runs.interruption import interruption, stop_if
from simpel_cli.runs.manifest import Manifest
from simpel_cli.runs.metrics import MetricStream
from simpel_cli.runs.settings import configure, stream
from simpel_cli.runs.tensorboard import Scalars
from simpel_cli.studies.declared import Declared, declare, resolved
from simpel_cli.studies.fit import Learned, learned
from simpel_cli.studies.new_run import kept_run, new_run
from simpel_cli.studies.open import open_study
from simpel_cli.studies.screen import Screen

# terminal, configuration, posterior, assignment, policies, episodes in the true simulator or None, directory
Publish = Callable[[Terminal, dict[str, Any], Learned, Assignment, TrainedPolicies, Episodes | None, Path], None]


def rl_offline(job: Job, screen: Screen, publish: Publish) -> None:
    """Run in a new directory.

    Args:
        job: of the verb.
        screen: what the fit shows.
        publish: prints the result, draws the figures and writes the report.
    """
    with new_run("rl-offline", resolved(job), job.directory) as (declared, manifest):
        _run(declared, job.directory, job.data_folder, manifest, screen, publish)


def resume(directory: Path, screen: Screen, publish: Publish) -> None:
    """Go on with an interrupted run, bit for bit as if it had not been interrupted."""
    record, config, settings = kept_run("rl-offline", directory)
    left = [directory / "report.html", directory / "metrics.parquet"]
    left += [] if config.get("planner") else [directory / "policy" / "policy.safetensors"]
    if record.get("status") == "done" and all(path.exists() for path in left):
        Terminal(settings.quiet).line(f"{directory} is complete; nothing to do.")
        return
    with Manifest(directory, "rl-offline", settings) as manifest:
        _run(declare(config, settings), directory, directory, manifest, screen, publish)


def _run(
    declared: Declared, directory: Path, data_folder: Path, manifest: Manifest, screen: Screen, publish: Publish
) -> None:
    configure(declared.settings)
    asked = assignment(declared)  # errors of the task are reported before the fit
    study = open_study(declared.without(*CONTROL_GROUPS), data_folder)
    refuse_outputs(study.system.encoding)
    with interruption() as interrupted:
        model = learned(study, directory / "posterior", screen)
        stop_if(interrupted)
    manifest.add_inputs(study.recording.files)
    manifest.facts["device"] = str(study.device)
    terminal = Terminal(study.settings.quiet, directory / "run.log")
    terminal.line()
    terminal.line(_task_line(asked), "task")
    for remark in remarks(asked):
        terminal.line(remark, "warning", style="yellow")
    constants = study.constants | {
        "run": directory.name, "command": "rl-offline", "n_train": model.fitted.n_train
    }  # fmt: skip
    since = done_steps(directory)
    scalars = Scalars(directory, since) if study.settings.tensorboard else None
    with MetricStream(directory, constants, resume_at=since, scalars=scalars) as metrics:
        if asked.planner is None:
            trained = train(model, asked, terminal, metrics, directory)
            judged = _in_truth(model, asked, trained)
        else:
            trained, judged = plan(model, asked)
        manifest.facts |= {
            "compile_seconds": round(trained.compile_seconds, 3), "policy_seconds": round(trained.seconds, 3),
            "n_train": constants["n_train"],
        }  # fmt: skip
        if judged is not None:
            _write_episodes(model, asked, judged, directory)
        metrics.add(_rows(study.settings.all_seeds, asked, trained, judged))
        metrics.close()
    if trained.policies is not None:
        save_policies(directory, model, asked, trained)
    publish(terminal, declared.config, model, asked, trained, judged, directory)


def _task_line(asked: Assignment) -> str:
    where = (
        f"tested in the simulator {asked.truth_name}"
        if asked.truth is not None
        else "not tested in a true simulator (sim@truth=NAME names one)"
    )
    return f"{asked.task.horizon} steps   {_learner(asked)}, sampling {asked.control.sampling}   {where}"


def _learner(asked: Assignment) -> str:
    if asked.planner is not None:
        return f"plans of {asked.planner.ahead} steps"
    return f"{asked.policy.policies} policies of {asked.policy.steps} steps each"


def _in_truth(model: Learned, asked: Assignment, trained: TrainedPolicies) -> Episodes | None:
    """Test the policies in the true simulator."""
    if asked.truth is None or trained.policies is None:
        return None
    return judge_of(asked, len(model.study.system.encoding.inputs))(trained.policies, stream(0, "judge in the truth"))


def _write_episodes(model: Learned, asked: Assignment, found: Episodes, directory: Path) -> None:
    """Write every transition in the true simulator."""
    encoding = model.study.system.encoding
    runs, steps, number = found.reward.shape
    states = np.asarray(encoding.decode(found.encoded))[:, 1:]
    low, high = np.array(asked.goal.low), np.array(asked.goal.high)
    commands = low + (high - low) * (np.asarray(found.action) + 1) / 2
    shape = (runs, steps, number)
    columns: dict[str, Any] = {
        "seed": np.broadcast_to(np.array(model.study.settings.all_seeds)[:, None, None], shape).ravel(),
        "episode": np.broadcast_to(np.arange(number)[None, None], shape).ravel(),
        "step": np.broadcast_to(np.arange(1, steps + 1)[None, :, None], shape).ravel(),
    }
    columns |= {q.name: states[..., i].ravel() for i, q in enumerate(encoding.states)}
    columns |= {q.name: commands[..., i].ravel() for i, q in enumerate(encoding.inputs)}
    columns |= {"reward": np.asarray(found.reward).ravel(), "good": np.asarray(found.good).ravel()}
    columns |= {"counts": np.asarray(found.lived).ravel()}
    units = {q.name: q.unit for q in (*encoding.states, *encoding.inputs)}
    write_table(directory / "episodes.parquet", columns, units)


def _rows(
    seeds: list[int], asked: Assignment, trained: TrainedPolicies, judged: Episodes | None
) -> list[dict[str, Any]]:
    rows = []
    for i, seed in enumerate(seeds):
        steps = asked.policy.steps if asked.planner is None else 0
        base = {"seed": seed, "step": steps, "split": "test", "output": "", "unit": "1"}
        rows.append(base | {"metric": "return_in_model", "value": float(trained.model_returns[i])})
        rows.append(base | {"metric": "broken_in_model", "value": float(trained.broken[i])})
        if judged is not None:
            own = of_seed(judged, i)
            rows.append(base | {"metric": "return_in_truth", "value": float(np.mean(own.returns))})
            if asked.task.success:
                rows.append(base | {"metric": "success", "value": float(np.mean(own.succeeded(asked.task.settled)))})
    return rows
