"""What the terminal says of the prior before training."""

from simpel_cli.inference.prior_predictive import OutputCheck, PriorCheck
from simpel_cli.runs.console import Terminal


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
