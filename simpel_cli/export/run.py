"""What a run leaves for a rig: the simulator for CasADi and as C, the posterior for numpy; neither needs simpel.

export/simulator.yaml        the `sim:` node, as `simpel` reads it
export/simulator.json        names, units, ranges and values of x, u, p and of what comes out
export/simulator.casadi      casadi.Function.load: (x, u, p) -> (next, y), one transition
export/simulator.c, .h       the same in C, without dependencies
export/posterior.json, posterior.safetensors, predictor.py      networks, see `simpel_cli.export.predictor`
"""

import json
from pathlib import Path
from typing import Any

from simpel_cli.config.resolved import load, of_run
from simpel_cli.errors import ConfigError
from simpel_cli.export.posterior import write_posterior
from simpel_cli.export.simulator import write_simulator
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, typed
from simpel_cli.runs.manifest import read_manifest
from simpel_cli.runs.settings import Settings
from simpel_cli.studies.declared import Declared, declare
from simulators.model import Model

VERBS = {"fit": ".", "discover": ".", "rl-offline": "posterior"}


def export(run: Path, out: Path | None = None, seed: int | None = None) -> None:
    """Write the files.

    Args:
        run: directory of a fit, a discovery or a policy.
        out: folder; None: `export` in the run's own.
        seed: of several that a run has fitted; None: the first.

    Raises:
        ConfigError: not a finished run, or none of that seed.
    """
    record = read_manifest(run)
    verb = str(record.get("command"))
    if verb not in VERBS:
        raise ConfigError(
            f"{run}: made by `simpel {verb}`; export takes the directory of {', '.join(VERBS)}. Every round of an online run "
            "has one, rounds/NNN/posterior."
        )
    if record.get("status") != "done":
        raise ConfigError(
            f"{run}: {record.get('status')}, not done. Go on with it first: simpel {verb} --resume {typed(run)}"
        )
    folder = run / VERBS[verb]
    declared = declare(of_run(folder), only=("sim", "data", "method"))
    into = make_directory(out if out is not None else run / "export", "--out")
    terminal = Terminal(quiet=False)
    declared, values, groups, meaning = _as_found(run, declared, verb)
    if isinstance(declared.source, Model):
        write_simulator(into, declared.source, declared.config["sim"], values, groups)
        terminal.line(f"{into / 'simulator.casadi'}, .c, .h, .json, .yaml ({meaning})", "simulator")
    else:
        terminal.line("a world without equations: there is nothing to write for CasADi and C", "simulator")
    if verb != "discover":
        write_posterior(into, folder, declared, _index(declared.settings, seed))
        terminal.line(f"{into / 'posterior.safetensors'}, .json, predictor.py (numpy only)", "posterior")


def _as_found(
    run: Path, declared: Declared, verb: str
) -> tuple[Declared, dict[str, float], dict[str, dict[str, Any]], str]:
    """Return the configuration with the simulator that is written, values of its parameters, also by group, and what it is."""
    if verb != "discover":
        return declared, {}, {}, "as declared: its parameters are uncertain, values are the middle of their ranges"
    try:
        verdict = json.loads((run / "verdict.json").read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{run / 'verdict.json'}: not readable ({error}).") from error
    values = {name: own["after"]["value"] for name, own in (verdict.get("parameters") or {}).items()}
    for effect in verdict.get("effects") or []:
        values |= {name: own["value"] for name, own in (effect.get("parameters") or {}).items()}
    groups = {
        entry["parameter"]: {
            "per": entry["per"],
            "values": {name: own["value"] for name, own in entry["values"].items()},
        }
        for entry in verdict.get("groups") or []
    }
    differ = "".join(
        f"; {name} has a value for every {own['per']}, here what they have in common" for name, own in groups.items()
    )
    written = verdict.get("corrected_sim")
    if not written:
        said = f"verdict `{verdict.get('verdict')}`: nothing was added; parameters as calibrated{differ}"
        return declared, values, groups, said
    path = run / "conf" / "sim" / Path(written).name
    return declared.changed(sim=load(path)), values, groups, f"corrected; parameters as identified{differ}"


def _index(settings: Settings, seed: int | None) -> int:
    if seed is None:
        return 0
    if seed not in settings.all_seeds:
        raise ConfigError(f"--seed: got {seed}; the run has {', '.join(map(str, settings.all_seeds))}.")
    return settings.all_seeds.index(seed)
