"""`simpel rl-offline`: learn a policy in the posterior of a fit, judge it in the true world."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.commands.control import (
    Assignment,
    Flown,
    assignment,
    judge_of,
    plan,
    refuse_outputs,
    remarks,
    task_table,
    train,
)
from simpel_cli.commands.fit import Learned, learned
from simpel_cli.config.launch import Job
from simpel_cli.config.resolved import dump, of_run
from simpel_cli.control.agents.rollout import Episodes
from simpel_cli.control.plants.policy_files import contract, save_policy
from simpel_cli.errors import ConfigError
from simpel_cli.reporting.figures.canvas import with_interval
from simpel_cli.reporting.figures.control import draw_control
from simpel_cli.reporting.html import figure, write_report
from simpel_cli.runs.arrays import load_checkpoint
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, refuse_occupied, typed
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.interruption import interruption, stop_if
from simpel_cli.runs.manifest import Manifest, read_manifest, refuse_changed_config
from simpel_cli.runs.metrics import MetricStream
from simpel_cli.runs.settings import configure, stream
from simpel_cli.runs.tensorboard import Scalars
from simpel_cli.studies.study import open_study, resolved, settings_of

OWN = (
    "policy",
    "planner",
    "reward",
    "truth",
    "mujoco",
    "control",
    "online",
    "world",
)  # groups that a fit does not have


def rl_offline(job: Job) -> None:
    """Run in a new directory."""
    directory = make_directory(job.directory)
    refuse_occupied(directory)
    config = resolved(job)
    write_text(directory / "config.yaml", dump(config))
    with Manifest(directory, "rl-offline", settings_of(config)) as manifest:
        _run(config, directory, job.data_folder, manifest)


def resume(directory: Path) -> None:
    """Go on with an interrupted run, bit for bit as if it had not been interrupted."""
    record = read_manifest(directory)
    if record["command"] != "rl-offline":
        raise ConfigError(f"{directory}: made by `simpel {record['command']}`, not by rl-offline.")
    refuse_changed_config(directory, record)
    config = of_run(directory)
    left = [directory / "report.html", directory / "metrics.parquet"]
    left += [] if config.get("planner") else [directory / "policy" / "policy.safetensors"]
    if record.get("status") == "done" and all(path.exists() for path in left):
        Terminal(settings_of(config).quiet).line(f"{directory} is complete; nothing to do.")
        return
    with Manifest(directory, "rl-offline", settings_of(config)) as manifest:
        _run(config, directory, directory, manifest)


def _run(config: dict[str, Any], directory: Path, data_folder: Path, manifest: Manifest) -> None:
    settings = settings_of(config)
    configure(settings)
    asked = assignment(config, settings)  # what is wrong with the task is said before the fit
    fit = {key: value for key, value in config.items() if key not in OWN}
    refuse_outputs(open_study(fit, data_folder).system.encoding)
    with interruption() as interrupted:
        model = learned(fit, directory / "posterior", data_folder)
        stop_if(interrupted)
    study = model.study
    manifest.add_inputs(study.recording.files)
    manifest.facts["device"] = str(study.device)
    terminal = Terminal(study.settings.quiet, directory / "run.log")
    terminal.line()
    terminal.line(_task_line(asked), "task")
    for remark in remarks(asked):
        terminal.line(remark, "look", style="yellow")
    constants = study.constants | {
        "run": directory.name, "command": "rl-offline", "n_train": len(model.fitted.training[0][0])
    }  # fmt: skip
    since = done_steps(directory)
    scalars = Scalars(directory, since) if study.settings.tensorboard else None
    with MetricStream(directory, constants, resume_at=since, scalars=scalars) as metrics:
        if asked.planner is None:
            flown = train(model, asked, terminal, metrics, directory)
            judged = _in_truth(model, asked, flown)
        else:
            flown, judged = plan(model, asked)
        manifest.facts |= {
            "compile_seconds": round(flown.compile_seconds, 3), "policy_seconds": round(flown.seconds, 3),
            "n_train": constants["n_train"],
        }  # fmt: skip
        if judged is not None:
            _write_episodes(model, asked, judged, directory)
        metrics.add(_rows(study.settings.all_seeds, asked, flown, judged))
        metrics.close()
    if flown.policies is not None:
        saved_policies(directory, model, asked, flown)
    _publish(config, terminal, model, asked, flown, judged, directory)


def saved_policies(directory: Path, model: Learned, asked: Assignment, flown: Flown) -> None:
    """Write the policies of every seed; that of the seed with the largest return in the model as `policy`."""
    study = model.study
    facts = contract(study.system.encoding, asked.goal, asked.memory, study.system.source.dt)
    best = int(np.argmax(flown.model_returns))
    for i, seed in enumerate(study.settings.all_seeds):
        folder = directory / "policy" if i == best else directory / f"policy_seed_{seed}"
        save_policy(folder, _of_run(flown.policies, i), facts)


def done_steps(directory: Path) -> int | None:
    """Return the steps of the world at the checkpoint, if there is one."""
    if not (directory / "checkpoint" / "state.safetensors").exists():
        return None
    try:
        return int(load_checkpoint(directory / "checkpoint")[1]["world_steps"])
    except ConfigError as error:
        raise ConfigError(
            f"{error} Or delete {directory / 'checkpoint'}, and the policy alone is trained anew on --resume."
        ) from error


def _of_run(tree: Any, i: int) -> Any:
    import jax

    return jax.tree.map(lambda a: a[i], tree)


def _task_line(asked: Assignment) -> str:
    where = (
        f"judged in the simulator {asked.truth_name}"
        if asked.truth is not None
        else "no true world to judge in (truth: a simulator)"
    )
    return f"{asked.task.horizon} steps   {_learner(asked)}, sampling {asked.control.sampling}   {where}"


def _learner(asked: Assignment) -> str:
    if asked.planner is not None:
        return f"plans of {asked.planner.ahead} steps"
    return f"{asked.policy.policies} policies of {asked.policy.steps} steps each"


def _in_truth(model: Learned, asked: Assignment, flown: Flown) -> Episodes | None:
    """Judge the policies in the true world."""
    if asked.truth is None or flown.policies is None:
        return None
    return judge_of(asked, len(model.study.system.encoding.inputs))(flown.policies, stream(0, "judge in the truth"))


def _write_episodes(model: Learned, asked: Assignment, found: Episodes, directory: Path) -> None:
    """Write every transition in the true world."""
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


def _rows(seeds: list[int], asked: Assignment, flown: Flown, judged: Episodes | None) -> list[dict[str, Any]]:
    rows = []
    for i, seed in enumerate(seeds):
        steps = asked.policy.steps if asked.planner is None else 0
        base = {"seed": seed, "step": steps, "split": "test", "output": "", "unit": "1"}
        rows.append(base | {"metric": "return_in_model", "value": float(flown.model_returns[i])})
        rows.append(base | {"metric": "broken_in_model", "value": float(flown.broken[i])})
        if judged is not None:
            own = _of_run(judged, i)
            rows.append(base | {"metric": "return_in_truth", "value": float(np.mean(own.returns))})
            if asked.task.success:
                rows.append(base | {"metric": "success", "value": float(np.mean(own.succeeded(asked.task.settled)))})
    return rows


def _publish(
    config: dict[str, Any],
    terminal: Terminal,
    model: Learned,
    asked: Assignment,
    flown: Flown,
    judged: Episodes | None,
    directory: Path,
) -> None:
    """Print the result, draw the figures, write the report, and say what to type next."""
    study = model.study
    seeds = study.settings.all_seeds
    head = ("seed", "return in the model", "return in the truth", "nine in ten episodes", "succeeded")
    rows = []
    for i, seed in enumerate(seeds):
        cells = [str(seed), f"{flown.model_returns[i]:.4g}"]
        if judged is not None:
            own = _of_run(judged, i)
            returns = np.asarray(own.returns, float)
            mean = float(returns.mean())
            half = 1.96 * float(returns.std(ddof=1)) / len(returns) ** 0.5 if len(returns) > 1 else math.nan
            ends = np.quantile(returns, [0.05, 0.95])
            cells += [
                with_interval(mean, mean - half, mean + half),
                f"{ends[0]:.4g} to {ends[1]:.4g}",
                f"{100 * float(np.mean(own.succeeded(asked.task.settled))):.0f} %" if asked.task.success else "-",
            ]
        else:
            cells += ["-", "-", "-"]
        rows.append(tuple(cells))
    terminal.line()
    for row in rows:
        terminal.line(
            f"seed {row[0]}: return in the model {row[1]}, in the truth {row[2]}, succeeded {row[4]}", "judged"
        )
    for seed, share in zip(seeds, flown.broken, strict=True):
        if share:
            terminal.line(f"seed {seed}: {100 * share:.0f} % of the roll-outs in the model diverged", "diverged")
    images = draw_control(directory) if study.settings.figures else []
    runner = typed(directory / "policy" / "run_policy.py")
    run = f"python {runner} < states.jsonl          # a JSON object per line; no JAX needed"
    commands = [
        *([run] if flown.policies is not None else []),
        f"simpel evaluate {typed(directory / 'posterior')}          # the model that the policy was learned in",
    ]
    note = (
        f"{asked.control.episodes} episodes of {asked.task.horizon} steps in the simulator {asked.truth_name}; intervals over "
        "episodes."
        if judged is not None
        else "There is no true world to judge in: name one with sim@truth=, or try the policy on the rig."
    )
    report = write_report(
        directory / "report.html",
        title=f"simpel rl-offline · {study.settings.name} · {study.choices.get('method', '')}",
        lead=f"{len(model.fitted.training[0][0])} transitions of {study.recording.files[0].name}, "
        + (
            f"{asked.policy.policies} policies per seed, of which the best in the model is kept."
            if asked.planner is None
            else f"planned {asked.planner.ahead} steps ahead in the model; no policy is learned."
        ),
        sections=[
            {"title": "Returns", "head": head, "rows": rows, "note": note},
            task_table(asked),
            *(figure(path, f"control/{path.stem}") for path in images),
        ],
        commands=commands,
        config=dump(config),
    )
    terminal.line(str(report), "report")
    terminal.next(commands)
