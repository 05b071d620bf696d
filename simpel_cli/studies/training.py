"""Training of a study's posterior: metric rows, checkpoints, and the state that a checkpoint holds."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from simpel_cli.inference import loop
from simpel_cli.runs.arrays import load_checkpoint
from simpel_cli.runs.checkpoint import keep, restored
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.metrics import MetricStream
from simpel_cli.studies.open import Study
from simpel_cli.studies.prepare import Fitted

LOG_EVERY = 50  # steps per row of the metric table
# of a problem: drawn or chosen, not measured
DRAWN = ("normaliser", "gap_scale", "noise_init", "noise_floor", "tail", "weights", "noise_rms", "gap_relevance")


def train(
    study: Study,
    fitted: Fitted,
    program: loop.Program,
    terminal: Terminal,
    metrics: MetricStream,
    directory: Path,
    state: Any,
    start: int,
) -> Any:
    """Train from a state on (None: from the beginning), with a checkpoint and metric rows after every stretch.

    Returns:
        The state of every seed's posterior at the last step.
    """
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
    # a target at a sensor's end is what draws of the prior made of it
    names = DRAWN if problems.precision is None else (*DRAWN, "y", "precision")
    drawn = {name: getattr(problems, name) for name in names}
    return {"state": state, "problem": {name: value for name, value in drawn.items() if value is not None}}


def law_kept(directory: Path) -> str | None:
    """Return the law of the noise that a run was trained with; None: it has no checkpoint yet.

    What `data.noise.law: auto` comes to is decided once: near the threshold another machine, which rounds otherwise, might
    decide the other way, and its problem would have other arrays than the checkpoint.

    Raises:
        ConfigError: a damaged checkpoint.
    """
    if not has_checkpoint(directory):
        return None
    leaves, _ = load_checkpoint(directory / "checkpoint")
    return "student_t" if "['problem']['tail']" in leaves else "gaussian"


def has_checkpoint(directory: Path) -> bool:
    """Whether a run came as far as its first checkpoint."""
    return (directory / "checkpoint" / "state.safetensors").exists()


def checkpointed_state(directory: Path, fitted: Fitted) -> tuple[int, Any, Fitted]:
    """Return the step and the state of a run's checkpoint, and the problem in the units that it was trained in.

    Raises:
        ConfigError: no checkpoint, a damaged one, or one of another configuration.
    """
    shape = _kept(fitted, loop.state_shape(fitted.bind, fitted.assembled.problems, fitted.keys))
    kept, facts = restored(directory, shape)
    assembled = fitted.assembled._replace(problems=fitted.assembled.problems._replace(**kept["problem"]))
    return int(facts["step"]), kept["state"], fitted._replace(assembled=assembled)
