"""The published reference's own arrays (SIMPEL_SHARED/reference) as learning problems of this project.

Simulators: pendulum_published; rc_car, the kinematic bicycle, with the action three steps old as its input, as the arrays
have it. Gap GP l = 10 raw, N = 1028, L = 20, 3 x 64, 24 + 16 points, the reference's number of steps.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Array, Key
from omegaconf import OmegaConf

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir, recordings_dir
from simpel_cli.inference.assemble import Assembled, assemble
from simpel_cli.inference.protocols import Method, Normaliser, Training
from simpel_cli.inference.system import normaliser_of, system_of
from simpel_cli.priors.function_prior import GapGP, GPPrior, SimulatorPrior
from simpel_cli.runs.settings import stream

STEPS = {20: 5000, 50: 5000, 320: 7000, 400: 8000}  # of the reference, per training size
SIMULATORS = {"pendulum": "pendulum_published", "rc_car": "rc_car"}
# of the measurements per output component; of the car, that which the reference simulates
NOISE = {
    "pendulum": {"phi": 0.02, "omega": 0.02},
    "rc_car": {"x": 1.1e-3, "y": 1.1e-3, "theta": 1.8e-3, "vx": 8.2e-3, "vy": 8.2e-3, "omega": 3.7e-2},
}
METHODS = (
    "simpel", "simpel_only_sim", "pathwise", "map", "repulsive", "fsvgd", "ensemble", "svgd", "greybox", "sysid", "gp",
)  # fmt: skip
SCORES = ("gaussian", "kde", "ssge", "nu_method")


class Case(NamedTuple):
    """A learning problem, ready to be compiled.

    Args:
        rule: with the reference's number of steps.
        assembled: problem arrays of every seed.
        normaliser: of the system.
        keys: one per seed.
        arrays: of the reference.
    """

    rule: Method
    assembled: Assembled
    normaliser: Normaliser
    keys: Key[Array, " seeds"]
    arrays: dict[str, np.ndarray]

    @property
    def bind(self) -> Any:
        """Problem -> rule."""
        return partial(self.rule.bind, self.assembled.setting)


def folder() -> Path:
    """Return where the arrays lie."""
    return recordings_dir() / "reference"


def sets() -> list[str]:
    """Return the names of all sets that have scores."""
    return sorted(p.stem for p in folder().glob("*_n*_s*.npz"))


def node(group: str, name: str) -> dict[str, Any]:
    """Return a YAML of conf/ without its defaults."""
    given = OmegaConf.load(conf_dir() / group / f"{name}.yaml")
    resolved = cast("dict[str, Any]", OmegaConf.to_container(given, resolve=True))
    return {k: v for k, v in resolved.items() if k != "defaults"}


def prior_of(method: str, scale: str | float, draws: int, lengthscale: str | float | None) -> SimulatorPrior | GPPrior:
    """Return the prior that the method's YAML chooses; lengthscale of the gap: auto, None, or a number in data units."""
    chosen = yaml.safe_load((conf_dir() / "method" / f"{method}.yaml").read_text())["defaults"][0]
    (name,) = chosen.values()
    if name == "gp":
        return build(node("prior", "gp"), "prior")
    gap = GapGP(lengthscale=lengthscale, lengthscale_units="raw", scale=scale) if name == "simulator" else None
    return SimulatorPrior(gap=gap, draws=draws)


def rule_of(method: str, steps: int, fields: dict[str, Any], kind: str) -> Method:
    """Return the method of its YAML; those that train networks take the given number of steps.

    On the car FSVGD and GreyBox have the published bandwidth, 10, with which they do better than with 2.
    """
    given = node("method", method)
    if kind == "rc_car" and method in ("fsvgd", "greybox"):
        given.get("residual", given)["bandwidth"] = 10.0
    if "residual" in given:
        given["residual"] |= {"steps": steps}
    elif "network" in given:
        given |= {"steps": steps}
    return build(given | fields, "method")


def case(
    name: str,
    method: str = "simpel",
    score: str = "gaussian",
    *,
    seeds: int = 1,
    scale: str | float = "auto",
    lengthscale: str | float | None = 10.0,
    draws: int = 1028,
    rows: int | None = None,
    fields: dict[str, Any] | None = None,
    law: str = "auto",
) -> Case:
    """Return the problem of one set.

    Args:
        name: of the set, e.g. pendulum_n20_s0.
        method, score: names of their YAML.
        seeds: number of them.
        scale: kappa of the gap: declared, auto or a number.
        lengthscale: of the gap: auto, None (2 sqrt(dx), normalised) or a number in data units; the published one by default.
        draws: N of the simulator.
        rows: training rows, drawn with repeats from those of the set (to time other sizes); None: as they are.
        fields: of the method.
        law: of the noise: gaussian, student_t or auto.
    """
    arrays = dict(np.load(folder() / f"{name}.npz"))
    kind, size = name.rsplit("_n", 1)
    system = system_of(build(node("sim", SIMULATORS[kind]), "sim").model(), (), 0)
    normaliser = normaliser_of(system, stream(0, "normaliser"))
    rule = rule_of(method, STEPS[int(size.split("_")[0])], fields or {}, kind)
    x, y = (np.asarray(arrays[k], float) for k in ("x_train", "y_train_diff"))
    if rows is not None:
        chosen = np.random.default_rng(0).integers(0, len(x), rows)
        x, y = x[chosen], y[chosen]
    assembled = assemble(
        system, normaliser, prior_of(method, scale, draws, lengthscale), build(node("score", score), "score"),
        [Training(x, y)] * seeds, NOISE[kind], NOISE[kind] if kind == "pendulum" else {}, noise=rule.noise, pool=rule.pool,
        keys=[stream(s, "prior") for s in range(seeds)], precision="float32", law=law,
    )  # fmt: skip
    return Case(rule, assembled, normaliser, jnp.stack([stream(s, "train") for s in range(seeds)]), arrays)
