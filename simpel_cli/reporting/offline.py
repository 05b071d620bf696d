"""The terminal's screen and the report of `rl-offline`."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.config.resolved import dump
from simpel_cli.control.agents.rollout import Episodes
from simpel_cli.control.assignment import Assignment
from simpel_cli.control.saved_policies import of_seed
from simpel_cli.control.training import TrainedPolicies
from simpel_cli.reporting.figures.canvas import with_interval
from simpel_cli.reporting.figures.control import draw_control
from simpel_cli.reporting.html import figure, write_report
from simpel_cli.reporting.task_table import task_table
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import typed
from simpel_cli.studies.fit import Learned


def publish(
    terminal: Terminal,
    config: dict[str, Any],
    model: Learned,
    asked: Assignment,
    trained: TrainedPolicies,
    judged: Episodes | None,
    directory: Path,
) -> None:
    """Print the result, draw the figures, write the report, and print the next commands."""
    study = model.study
    seeds = study.settings.all_seeds
    head = ("seed", "return in the model", "return in the true simulator", "90 % of the episodes", "success")
    rows = []
    for i, seed in enumerate(seeds):
        cells = [str(seed), f"{trained.model_returns[i]:.4g}"]
        if judged is not None:
            own = of_seed(judged, i)
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
            f"seed {row[0]}: return in the model {row[1]}, in the true simulator {row[2]}, success {row[4]}", "tested"
        )
    for seed, share in zip(seeds, trained.broken, strict=True):
        if share:
            terminal.line(f"seed {seed}: {100 * share:.0f} % of the roll-outs in the model diverged", "diverged")
    images = draw_control(directory) if study.settings.figures else []
    runner = typed(directory / "policy" / "run_policy.py")
    run = f"python {runner} < states.jsonl          # a JSON object per line; no JAX needed"
    commands = [
        *([run] if trained.policies is not None else []),
        f"simpel evaluate {typed(directory / 'posterior')}          # the model that the policy was learned in",
    ]
    note = (
        f"{asked.control.episodes} test episodes of {asked.task.horizon} steps in the simulator {asked.truth_name}; 95 % "
        "intervals over episodes."
        if judged is not None
        else "Not tested in a true simulator: name one with sim@truth=, or test the policy on the rig."
    )
    report = write_report(
        directory / "report.html",
        title=f"simpel rl-offline · {study.settings.name} · {study.choices.get('method', '')}",
        lead=f"{model.fitted.n_train} transitions of {study.recording.files[0].name}, "
        + (
            f"{asked.policy.policies} policies per seed; the best in the model is kept."
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
