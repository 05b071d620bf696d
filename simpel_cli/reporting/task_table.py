"""The report's table of a control task."""

from typing import Any

from simpel_cli.control.assignment import Assignment


def task_table(asked: Assignment) -> dict[str, Any]:
    """Return the report's table of the task."""
    task, source = asked.task, asked.source
    begins = {q.name: task.initial.get(q.name, 0.0) for q in source.states}
    rows = [
        ("reward per step", task.reward),
        *((f"... {name}", str(text)) for name, text in task.names.items()),
        ("horizon", f"{task.horizon} steps of {source.dt:.4g} s"),
        ("initial state", ", ".join(f"{name} {value}" for name, value in begins.items())),
        ("commands", ", ".join(
            f"{q.name} {low:g} to {high:g} {q.unit}".rstrip()
            for q, low, high in zip(asked.encoding.inputs, asked.goal.low, asked.goal.high, strict=True)
        )),
    ]  # fmt: skip
    if task.success:
        rows.append(("success", f"{task.success} in each of the last {task.settled} steps"))
    if task.stop:
        rows.append(("episode ends if", task.stop))
    return {"title": "Task", "head": (), "rows": rows, "text": True}
