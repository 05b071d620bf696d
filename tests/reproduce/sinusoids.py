"""The paper's figure of sinusoids: what five methods make of two points of a sinusoid with a trend.

    python -m tests.reproduce.sinusoids --out runs/reproduce/sinusoids

Settings of the paper and its published code: 3 x 64, 20 particles, batch 4, learning rate 1e-3, weight decay 1e-3, likelihood
standard deviation 0.05 of the normalised output, fixed; five seeds where it has one.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.inference.protocols import Method, ScoreEstimator
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.methods.greybox import GreyBox
from simpel_cli.methods.svgd import SVGD
from simpel_cli.methods.sysid import SysID
from simpel_cli.priors.function_prior import GPPrior, SimulatorPrior
from simpel_cli.reporting.figures.canvas import BLACK, COLOURS, new_figure, save
from simpel_cli.scores.gaussian import Gaussian
from simpel_cli.scores.kde import KDE
from simpel_cli.scores.nu_method import NuMethod
from tests.reproduce.static import DRAWS, EXACT, Fitted, Task, Told, draws, fit, folder, publish, spread, task

A, W, C = 1.4979174, 2.173156, 1.6382928  # truth
X = (-4.7293234, 3.071438)
GRID = np.linspace(-5, 5, 200)
COMMON: dict[str, Any] = {"learning_rate": 1e-3, "final_learning_rate": 1.0, "batch": 4, "noise": EXACT}
SIMULATOR = SimulatorPrior(gap=None, draws=DRAWS)
GP = GPPrior(lengthscale=0.2, scale=1.0)

TITLES = {
    "rmse": "RMSE on the grid",
    "std": "spread of particles",
    "inside": "inside 2 spreads",
    "at_data": "off at the data",
}


def truth(x: np.ndarray) -> np.ndarray:
    """Return the function."""
    return A * np.sin(W * x) + C * x


def panels(share: float) -> dict[str, tuple[SimulatorPrior | GPPrior, ScoreEstimator, Method]]:
    """Return prior, score and rule of every method; share: of the published steps."""
    few, many = round(10_000 * share), round(20_000 * share)
    fsvgd = FSVGD(steps=few, fresh_points=8, bandwidth=0.5, **COMMON)
    return {
        "SVGD": (GP, Gaussian(), SVGD(steps=few, weight_std=0.5, bias_std=10.0, bandwidth=10.0, **COMMON)),
        "FSVGD": (GP, Gaussian(), fsvgd),
        "GreyBox": (SIMULATOR, Gaussian(), GreyBox(SysID(noise=EXACT), fsvgd, GP)),
        "SimPEL, Gaussian": (SIMULATOR, Gaussian(), FSVGD(steps=many, fresh_points=8, bandwidth=1.0, **COMMON)),
        "SimPEL, nu-method": (SIMULATOR, NuMethod(), FSVGD(steps=many, fresh_points=16, bandwidth=1.0, **COMMON)),
        "SimPEL, KDE": (SIMULATOR, KDE(), FSVGD(steps=many, fresh_points=16, bandwidth=1.0, **COMMON)),
    }


def figures(found: Fitted) -> dict[str, list[float]]:
    """Return what is claimed as numbers, per seed."""
    mean, std = found.particles.mean(axis=1), found.particles.std(axis=1)
    wanted = truth(GRID)
    at_data = np.stack([np.abs(GRID - x).argmin() for x in X])
    return {
        "rmse": np.sqrt(np.mean((mean - wanted) ** 2, axis=1)).tolist(),
        "std": std.mean(axis=1).tolist(),
        "inside": np.mean(np.abs(mean - wanted) <= 2 * std, axis=1).tolist(),
        "at_data": np.abs(mean - wanted)[:, at_data].max(axis=1).tolist(),
    }


def draw(path: Path, given: Task, found: dict[str, Fitted]) -> None:
    """Draw prior and posteriors of the first seed."""
    figure, axes = new_figure(1 + len(found), columns=4)
    axes[0].plot(GRID, draws(given, 10).T, color=COLOURS[5], linewidth=0.8)
    axes[0].set_title("prior: 10 draws of the simulator", fontsize=9)
    for axis, (name, one) in zip(axes[1:], found.items(), strict=True):
        particles = one.particles[0]
        mean, std = particles.mean(axis=0), particles.std(axis=0)
        axis.plot(GRID, particles.T, color=COLOURS[5], linewidth=0.5, alpha=0.7)
        axis.fill_between(GRID, mean - 2 * std, mean + 2 * std, color=COLOURS[0], alpha=0.2, linewidth=0)
        axis.plot(GRID, mean, color=COLOURS[0])
        axis.set_title(f"{name}: RMSE {spread(figures(one)['rmse'], 2)}", fontsize=9)
    for axis in axes:
        axis.plot(GRID, truth(GRID), color=BLACK, linewidth=1.2, linestyle="--")
        axis.plot(X, truth(np.array(X)), "o", color=COLOURS[1], markersize=5)
        axis.set_ylim(-14, 14)
        axis.set_xlabel("x")
        axis.set_ylabel("f")
    figure.suptitle(
        "Particles (thin), mean and two standard deviations between them; truth dashed, two training points", fontsize=9
    )
    save(figure, path)


def claims(told: Told) -> dict[str, bool]:
    """Check the paper's claims one by one."""
    middle = {name: {k: float(np.median(v)) for k, v in row.items()} for name, row in told.items()}
    own = [n for n in middle if n in ("SimPEL, Gaussian", "SimPEL, nu-method")]
    others = [n for n in middle if not n.startswith("SimPEL")]
    return {
        "SVGD misses even the data (more than 0.5 off at a training point)": middle["SVGD"]["at_data"] > 0.5,
        "FSVGD is right at the data (within 0.5) and wide elsewhere (five times SimPEL's spread)": middle["FSVGD"][
            "at_data"
        ]
        < 0.5
        and middle["FSVGD"]["std"] > 5 * middle[own[0]]["std"],
        "GreyBox has the right mean (RMSE within twice SimPEL's) and is wider than SimPEL": middle["GreyBox"]["rmse"]
        < 2 * max(middle[n]["rmse"] for n in own)
        and middle["GreyBox"]["std"] > max(middle[n]["std"] for n in own),
        "SimPEL, both estimators: the lowest RMSE": max(middle[n]["rmse"] for n in own)
        < min(middle[n]["rmse"] for n in others),
        "SimPEL, both estimators: the narrowest": max(middle[n]["std"] for n in own)
        < min(middle[n]["std"] for n in others),
        "SimPEL, both estimators: truth inside two standard deviations on 90 % of the grid": min(
            middle[n]["inside"] for n in own
        )
        >= 0.9,
    }


def main() -> None:
    """Fit, draw and judge."""
    parser = argparse.ArgumentParser(prog="tests.reproduce.sinusoids", description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--steps", type=float, default=1.0, help="share of the published number of steps")
    options = parser.parse_args()
    out = folder(options.out, "sinusoids")
    given = task("sinusoid", 5.0, 8.0, X, truth(np.array(X)), GRID)
    found: dict[str, Fitted] = {}
    for name, (prior, score, rule) in panels(options.steps).items():
        found[name] = fit(given, prior, score, rule)
        print(f"{name}: {found[name].seconds:.0f} s", flush=True)
    told = {name: figures(one) for name, one in found.items()}
    draw(out / "sinusoids.png", given, found)
    publish(out, "sinusoids", told, found, TITLES, claims(told), note="y spans about 24")


if __name__ == "__main__":
    main()
