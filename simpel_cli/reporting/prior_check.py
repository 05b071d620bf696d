"""Terminal lines about the prior, printed before training."""

from simpel_cli.inference.prior_predictive import OutputCheck, PriorCheck
from simpel_cli.runs.console import Terminal


def describe_prior(terminal: Terminal, checked: PriorCheck) -> None:
    """Print which targets the prior does not explain, and what to do; and that draws ran away."""
    if checked.lost:
        terminal.line(
            f"the integration of {checked.lost} of {checked.draws} draws of the simulator runs away: others stand for them "
            "(raise sim.substeps, or narrow sim.parameters)",
            "prior",
        )
    lost = [o for o in checked.outputs if not o.explained]
    by_gap = [o for o in checked.outputs if o.explained and not o.by_simulator]
    if not lost and not by_gap:
        furthest = max(o.distance for o in checked.outputs)
        terminal.line(
            f"explains the training data (distance at most {furthest:.2g} times that of its own draws)", "prior"
        )
        return
    if by_gap:
        terminal.line(f"the simulator alone does not explain {_listed(by_gap)}; with the gap GP it does", "prior")
    if lost:
        gap = "" if lost[0].p_with_gap is not None else "add a gap GP (method=simpel), "
        terminal.line(f"does not explain {_listed(lost)}", "prior", style="yellow")
        terminal.line(f"widen sim.parameters, {gap}or search for missing effects: simpel discover", "", style="yellow")


def _listed(outputs: list[OutputCheck]) -> str:
    words = []
    for o in outputs:
        beyond = f", {o.outside} of {o.rows} targets outside all draws" if o.outside else ""
        words.append(f"{o.name} (distance {o.distance:.2g} times that of its own draws{beyond})")
    return ", ".join(words)
