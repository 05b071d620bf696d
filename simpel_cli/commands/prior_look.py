"""What a fit says of its prior before it trains: whether the simulator with its ranges can explain the training data."""

import jax
import numpy as np

from simpel_cli.commands.study import Fitted, Study
from simpel_cli.inference.prior_predictive import OutputCheck, PriorCheck, check_prior
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.settings import stream


def look_at_prior(study: Study, fitted: Fitted) -> PriorCheck | None:
    """Compare the training targets of the first seed with draws of the prior; None where there is nothing to compare."""
    if not study.prior.uses_simulator or len(fitted.training[0][0]) == 0:
        return None
    problem = jax.tree.map(lambda a: np.asarray(a[0]), fitted.assembled.problems)
    x, y = fitted.training[0]
    gap_scale = None if study.prior.gap is None else problem.gap_scale
    return check_prior(
        study.system, fitted.assembled.setting, fitted.normaliser, x, y, study.recording.noise_std, gap_scale,
        stream(0, "prior_predictive"), problem.bank,
    )  # fmt: skip


def describe_prior(terminal: Terminal, checked: PriorCheck) -> None:
    """Say which targets the prior cannot explain, and what to do."""
    lost = [o for o in checked.outputs if not o.explained]
    by_gap = [o for o in checked.outputs if o.explained and not o.by_simulator]
    if not lost and not by_gap:
        furthest = max(o.distance for o in checked.outputs)
        terminal.line(f"explains the training data (at most {furthest:.2g} times as far off as its own draws)", "prior")
        return
    if by_gap:
        terminal.line(f"the simulator alone does not explain {_listed(by_gap)}; with the gap GP it does", "prior")
    if lost:
        gap = "" if lost[0].p_with_gap is not None else "give it a gap GP (method=simpel), "
        terminal.line(f"does not explain {_listed(lost)}", "prior", style="yellow")
        terminal.line(f"widen sim.parameters, {gap}or look for what it lacks: simpel discover", "", style="yellow")


def _listed(outputs: list[OutputCheck]) -> str:
    words = []
    for o in outputs:
        beyond = f", {o.outside} of {o.rows} targets beyond all of them" if o.outside else ""
        words.append(f"{o.name} ({o.distance:.2g} times as far off as its own draws{beyond})")
    return ", ".join(words)
