"""Run directories of searches that never ran: verdict, tables and nodes for reports and figures."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.runs.files import write_table

SIM: dict[str, Any] = {
    "_target_": "simulators.model.Declared",
    "name": "rotor",
    "dt": 0.05,
    "states": {"omega": {"unit": "rad/s", "range": [-5, 5]}},
    "inputs": {"u": {"unit": "V", "range": [-2, 2]}},
    "parameters": {"k": {"unit": "1/s", "range": [0, 2]}},
    "dynamics": {"omega": "u - k*omega"},
}
CORRECTED = SIM | {
    "name": "rotor_with_coulomb_friction",
    "dynamics": {"omega": "u - k*omega + (-tau_c*tanh(omega/w))"},
}
CONFIG = {"sim": SIM, "choices": {"experiment": "rotor", "sim": "rotor", "data": "bench"}}
ERRORS = {h: {"omega": v} for h, v in (("one_step", 0.05), ("horizon", 0.4), ("free_run", 0.9))}
AFTER = {h: {"omega": v} for h, v in (("one_step", 0.03), ("horizon", 0.04), ("free_run", 0.06))}
EFFECT: dict[str, Any] = {
    "name": "coulomb_friction", "acts_on": "omega", "meaning": "dry friction, the same at every speed",
    "class": ["coulomb_friction"], "class_acts_on": {"coulomb_friction": "omega"}, "same_as": [], "same_as_two": [],
    "class_members": [{"name": "coulomb_friction", "acts_on": "omega", "same": True}],
    "log_evidence_gain": 193.04, "share_of_residual": 0.98,
    "held_out_gain": {"gain": 31.0, "low": 24.0, "high": 38.0, "unit": "episode", "passed": True},
    "parameters": {"tau_c": {"value": 0.41, "low": 0.4, "high": 0.42, "unit": "rad/s^2"}},
}  # fmt: skip
REMAINDER = {
    "acts_on": "omega", "depends_on": ["omega", "u"], "rms": 0.31, "unit": "rad/s^2", "log_evidence_gain": 44.0,
    "description": "something acts on d(omega)/dt",
}  # fmt: skip
NEXT: dict[str, Any] = {
    "file": "next_experiment.csv", "start": {"omega": 0.0}, "kind": "ramps", "seconds": 3.0,
    "units": {"omega": "rad/s", "u": "V"}, "expected_log_likelihood_ratio": 13.7,
    "pairs": [
        {"true": "coulomb_friction", "against": "viscous_friction", "expected_log_likelihood_ratio": 13.7},
        {"true": "viscous_friction", "against": "coulomb_friction", "expected_log_likelihood_ratio": 15.2},
    ],
    "description": "Run the 3 s ramps of next_experiment.csv from omega = 0 rad/s: expected 14 nats.",
}  # fmt: skip


def verdict(kind: str) -> dict[str, Any]:
    """A verdict of each kind."""
    effects = [EFFECT] if kind in ("effect", "ambiguous") else []
    if kind == "ambiguous":
        names = ["coulomb_friction", "viscous_friction"]
        rival: dict[str, Any] = {"class": names, "class_acts_on": dict.fromkeys(names, "omega")}
        rival["class_members"] = [{"name": n, "acts_on": "omega", "same": n == names[0]} for n in names]
        effects = [EFFECT | rival]
    return {
        "verdict": kind,
        "summary": f"One sentence about a verdict of the kind {kind}, with 0.41 rad/s^2.",
        "effects": effects,
        "remainder": REMAINDER if kind == "unexplained" else None,
        "parameters": {},
        "error": {
            "split": "test", "episodes": 2, "horizon_steps": 20,
            "before": ERRORS | {"log_likelihood_per_step": 1.25},
            "after": (AFTER | {"log_likelihood_per_step": 2.5}) if effects else ERRORS | {"log_likelihood_per_step": 1.25},
        },
        "noise_floor": {"omega": 0.029},
        "process_noise": {"before": 0.31, "after": 0.01 if effects else 0.31},
        "gate": [],
        "not_found": [
            {"name": "quadratic_drag", "acts_on": "omega", "parameter": "c", "smallest_detectable": 0.0213,
             "unit": "1/rad", "log_evidence_gain": -3.0},
            {"name": "end_stop", "acts_on": "omega", "parameter": "k", "smallest_detectable": 1e-6, "unit": "1/s^2",
             "log_evidence_gain": -96595.0},
        ],
        "data_checks": [{"check": "stale", "ok": False, "detail": "omega repeats itself in rows 3 to 5"}],
        "next_experiment": NEXT if kind == "ambiguous" else None,
        "corrected_sim": "conf/sim/rotor_with_coulomb_friction.yaml" if effects else None,
        "corrected_sim_lacks": [],
        "candidates_tried": 21,
        "seconds": 8.4,
    }  # fmt: skip


def directory(folder: Path, kind: str) -> Path:
    """Everything that a report reads, as a search leaves it."""
    found = verdict(kind)
    (folder / "verdict.json").write_text(json.dumps(found))
    both = bool(found["effects"])
    if both:
        path = folder / found["corrected_sim"]
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(CORRECTED))  # JSON is YAML
    residuals(folder, both)
    curves(folder, both)
    runs(folder, both)
    tables(folder, both)
    if found["next_experiment"]:
        following(folder)
    return folder


def following(folder: Path) -> None:
    t = np.arange(60) * 0.05
    rows = [f"{a},{np.sin(a)},{np.sin(a - 0.5)},{np.sin(a - 0.4)}\n" for a in t]
    head = "time,u,omega_if_coulomb_friction,omega_if_viscous_friction\n"
    (folder / "next_experiment.csv").write_text(f"# {NEXT['description']}\n{head}{''.join(rows)}")


def residuals(folder: Path, both: bool) -> None:
    random = np.random.default_rng(0)
    n = 300
    parts = []
    for model in ("before", "without", "after") if both else ("before",):
        omega, u = random.uniform(-4, 4, n), random.uniform(-2, 2, n)
        effect = -0.41 * np.tanh(omega / 0.05) * both
        force = 0.2 * random.normal(size=n) + (0 if model == "after" else -0.41 * np.tanh(omega / 0.05))
        parts.append(
            {
                "model": [model] * n, "split": ["train"] * n, "episode": ["a"] * n, "row": np.arange(n),
                "time": 0.05 * np.arange(n), "acts_on": ["omega"] * n, "unit": ["rad/s^2"] * n, "force": force,
                "std": np.full(n, 0.2), "effect": effect, "omega": omega, "u": u,
            }
        )  # fmt: skip
    write_table(
        folder / "residuals.parquet",
        {name: np.concatenate([p[name] for p in parts]) for name in parts[0]},
        {"time": "s", "omega": "rad/s", "u": "V"},
    )


def curves(folder: Path, both: bool) -> None:
    value = np.linspace(-4, 4, 101) if both else np.zeros(0)
    text = {"effect": "coulomb_friction", "on": "omega", "argument": "omega", "acts_on": "omega", "unit": "rad/s^2"}
    write_table(
        folder / "effect_curves.parquet",
        {k: np.full(len(value), v) for k, v in text.items()} | {"value": value, "force": -0.41 * np.tanh(value / 0.05)},
    )


def runs(folder: Path, both: bool) -> None:
    random = np.random.default_rng(1)
    t = np.arange(60) * 0.05
    free, innovation = [], []
    for episode, error in (("a", 0.1), ("b", 0.3), ("c", 0.2)):
        true = 3 * np.sin(t)
        free.append(
            {
                "episode": [episode] * 60, "row": np.arange(60), "time": t, "output": ["omega"] * 60,
                "unit": ["rad/s"] * 60, "measured": true + 0.03 * random.normal(size=60),
                "before": true + (3 * error * t if both else 0.1 * error * t), "after": true + 0.1 * error * t,
                "free": np.arange(60) >= 5,
            }
        )  # fmt: skip
        for model in ("before", "after"):
            e = random.normal(size=60)
            e = np.convolve(e, [1, 0.9, 0.7], mode="same") if model == "before" and both else e
            e[:5] = np.nan
            innovation.append(
                {
                    "model": [model] * 60, "split": ["test"] * 60, "episode": [episode] * 60, "row": np.arange(60),
                    "time": t, "output": ["omega"] * 60, "innovation": 0.03 * e, "std": np.full(60, 0.03),
                }
            )  # fmt: skip
    for name, parts in (("trajectories", free), ("innovations", innovation)):
        joined = {k: np.concatenate([np.asarray(p[k]) for p in parts]) for k in parts[0]}
        write_table(folder / f"{name}.parquet", joined, {"time": "s"})


def tables(folder: Path, both: bool) -> None:
    horizons = list(ERRORS)
    before = np.array([ERRORS[h]["omega"] for h in horizons])
    after = np.array([AFTER[h]["omega"] for h in horizons]) if both else before
    columns: dict[str, Any] = {"horizon": horizons, "output": ["omega"] * 3, "unit": ["rad/s"] * 3}
    columns["noise_floor"] = np.full(3, 0.029)
    for name, value in (("before", before), ("after", after), ("reduction", before / after)):
        columns |= {name: value, f"{name}_low": 0.9 * value, f"{name}_high": 1.1 * value}
    write_table(folder / "errors.parquet", columns)
    names = [("k", "", "1/s", "before", 0.0, 2.0, 0.9, 0.6, 1.2), ("k", "", "1/s", "after", 0.0, 2.0, 0.5, 0.45, 0.55)]
    if both:
        names.append(("tau_c", "coulomb_friction on omega", "rad/s^2", "after", 0.0, 5.0, 0.41, 0.40, 0.42))
    keys = ("parameter", "effect", "unit", "model", "range_low", "range_high", "value", "low", "high")
    write_table(folder / "parameters.parquet", {k: [row[i] for row in names] for i, k in enumerate(keys)})
    gains = [("coulomb_friction", "", 1738.0), ("stribeck_friction", "", 1736.1), ("unnamed", "omega", 1500.0)]
    gains += [("viscous_friction", "", 90.0), ("quadratic_drag", "", 3.3), ("input_delay", "", -2.0)]
    gains += [("end_stop", "", -96595.0), ("cogging", "", -np.inf)]
    steps = [(1, *g, both and g[0] == "coulomb_friction") for g in (gains if both else gains[4:])]
    steps += [(2, n, d, g, False) for n, d, g in gains[4:]] if both else []
    write_table(
        folder / "candidates.parquet",
        {
            "step": [s for s, *_ in steps], "effect": [e for _, e, *_ in steps], "acts_on": ["omega"] * len(steps),
            "depends_on": [d for _, _, d, *_ in steps], "log_evidence_gain": [g for *_, g, _ in steps],
            "accepted": [a for *_, a in steps], "asked": [4.5 if s == 1 else 6.8 for s, *_ in steps],
        },
    )  # fmt: skip
    write_table(
        folder / "coverage.parquet",
        {
            "quantity": ["omega", "u"], "unit": ["rad/s", "V"], "low": [-2.0, -2.0], "high": [2.5, 2.0],
            "range_low": [-5.0, -2.0], "range_high": [5.0, 2.0], "periodic": [False, False],
        },
    )  # fmt: skip
