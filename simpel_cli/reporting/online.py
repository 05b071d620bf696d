"""The report of `rl-online`."""

from simpel_cli.config.resolved import dump
from simpel_cli.control.rounds import OnlineRun, episode_facts
from simpel_cli.reporting.figures.control import draw_online
from simpel_cli.reporting.html import figure, write_report
from simpel_cli.reporting.task_table import task_table
from simpel_cli.runs.directory import typed


def publish(run: OnlineRun) -> None:
    """Draw the figures, write the report, and print the next commands."""
    directory, last = run.directory, run.online.episodes - 1
    head = (
        "episode",
        "return",
        "return in the model",
        "success",
        "steps",
        "NLL before training on it",
        "fit, s",
        "policy, s",
    )
    rows = []
    for number in range(run.online.episodes):
        f = episode_facts(run, number)
        rows.append((
            str(number), f"{f['return']:.4g}", f"{f['return_in_model']:.4g}",
            ("yes" if f["success"] else "no") if run.asked.task.success else "-", f"{f['steps']:.0f}",
            f"{f['nll_before']:.3g}", f"{f['fit_seconds']:.0f}", f"{f['policy_seconds']:.0f}",
        ))  # fmt: skip
    images = draw_online(directory) if run.settings.figures else []
    commands = [
        f"python {typed(directory / 'policy' / 'run_policy.py')} < states.jsonl          # the last policy; no JAX needed",
        f"simpel rl-online --resume {typed(directory)} online.episodes={2 * run.online.episodes}          # more episodes",
        f"simpel evaluate {typed(run.folder(last) / 'posterior')} data=NAME          # tests the last model on your own file",
    ]
    report = write_report(
        directory / "report.html",
        title=f"simpel rl-online · {run.settings.name} · {run.declared.choices.get('method', '')}",
        lead=f"{run.online.episodes} episodes of {run.asked.task.horizon} steps in {run.world}. The policy of "
        "the first episode was learned in the prior, without data.",
        sections=[
            {"title": "Episodes", "head": head, "rows": rows},
            task_table(run.asked),
            *(figure(path, f"control/{path.stem}") for path in images),
        ],
        commands=commands,
        config=dump(run.declared.config),
    )
    run.terminal.line(str(report), "report")
    run.terminal.next(commands)
