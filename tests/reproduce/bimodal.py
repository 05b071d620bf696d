"""The paper's figure of two modes: what four score estimators make of a prior that has two slopes where there are no data.

    python -m tests.reproduce.bimodal --out runs/reproduce/bimodal

Settings of the paper and its published code: 3 x 64, 20 particles, 20000 steps, N = 256, 16 fresh points, s = 1. The estimators
are this project's; `published` are those of the paper with its settings (kernel width 1, no Gaussian baseline, eta 0.1,
lambda 1e-4), at the same prior weight.
"""

import argparse
from pathlib import Path

import numpy as np

from simpel_cli.inference.protocols import ScoreEstimator
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.priors.function_prior import SimulatorPrior
from simpel_cli.reporting.figures.canvas import COLOURS, new_figure, save
from simpel_cli.scores.gaussian import Gaussian
from simpel_cli.scores.kde import KDE
from simpel_cli.scores.nu_method import NuMethod
from simpel_cli.scores.ssge import SSGE
from tests.reproduce.static import DRAWS, EXACT, Fitted, Task, Told, draws, fit, folder, publish, task

X = (-0.06935716, -1.3706367, -0.7339401)
SLOPE = -0.55
GRID = np.linspace(-2, 2, 200)
NEAR = 0.3  # of a mode's slope
ESTIMATORS: dict[str, ScoreEstimator] = {
    "Gaussian": Gaussian(),
    "KDE": KDE(),
    "SSGE": SSGE(),
    "nu-method": NuMethod(),
    "SSGE, published": SSGE(bandwidth=1.0, eta=0.1, baseline="none"),
    "nu-method, published": NuMethod(bandwidth=1.0, wider=1.0, weight=1e-4, baseline="none"),
}


TITLES = {
    "up": "at slope 1",
    "down": "at slope -1",
    "neither": "at neither",
    "bent": "bent on the right",
    "left_rmse": "RMSE on the left",
}


def figures(particles: np.ndarray) -> dict[str, float]:
    """Return what is claimed as numbers: particles (L, n) of one seed."""
    right = GRID > 0
    slope = np.array([np.interp(1.5, GRID, h) for h in particles]) / 1.5
    up, down = np.abs(slope - 1) < NEAR, np.abs(slope + 1) < NEAR
    x = GRID[right]
    lines = (particles[:, right] @ x / (x @ x))[:, None] * x
    wanted = SLOPE * GRID[~right]
    return {
        "up": float(up.mean()),
        "down": float(down.mean()),
        "neither": float((~up & ~down).mean()),
        "bent": float(np.sqrt(np.mean((particles[:, right] - lines) ** 2))),
        "left_rmse": float(np.sqrt(np.mean((particles[:, ~right].mean(axis=0) - wanted) ** 2))),
    }


def draw(path: Path, given: Task, found: dict[str, Fitted]) -> None:
    """Draw prior and particles of the first seed, and the regions where 80 % of all seeds' particles lie most densely."""
    figure, axes = new_figure(1 + len(found), columns=4)
    axes[0].plot(GRID, draws(given, 40).T, color=COLOURS[5], linewidth=0.6)
    axes[0].set_title("prior: 40 draws of the simulator", fontsize=9)
    levels = np.linspace(-4, 4, 161)
    for axis, (name, one) in zip(axes[1:], found.items(), strict=True):
        every = one.particles.reshape(-1, len(GRID))
        width = 0.12
        density = np.exp(-(((levels[:, None, None] - every[None]) / width) ** 2) / 2).mean(axis=1)  # (levels, grid)
        order = np.sort(density, axis=0)[::-1]
        least = order[np.argmax(np.cumsum(order, axis=0) >= 0.8 * order.sum(axis=0), axis=0), np.arange(len(GRID))]
        axis.contourf(GRID, levels, (density >= least).astype(float), levels=[0.5, 1.5], colors=[COLOURS[0]], alpha=0.2)
        axis.plot(GRID, one.particles[0].T, color=COLOURS[0], linewidth=0.7)
        up, down = (100 * np.mean([figures(p)[k] for p in one.particles]) for k in ("up", "down"))
        axis.set_title(f"{name}: {up:.0f} % up, {down:.0f} % down", fontsize=9)
    for axis in axes:
        axis.plot(X, SLOPE * np.array(X), "o", color=COLOURS[1], markersize=4)
        axis.set_ylim(-4, 4)
        axis.set_xlabel("x")
        axis.set_ylabel("f")
    figure.suptitle(
        "Particles of one seed; shaded: where 80 % of those of five seeds lie most densely; three training points",
        fontsize=9,
    )
    save(figure, path)


def claims(told: Told, found: dict[str, Fitted]) -> dict[str, bool]:
    """Check the paper's claims one by one."""

    def mean(name: str, key: str) -> float:
        return float(np.mean(told[name][key]))

    def both(name: str) -> bool:
        return min(mean(name, "up"), mean(name, "down")) >= 0.2

    return {
        "the nu-method puts a fifth of its particles or more on each mode": both("nu-method"),
        "the nu-method's particles are lines on the right (bent by less than 0.1)": mean("nu-method", "bent") < 0.1,
        "the Gaussian cannot: less than a fifth on one of the modes": not both("Gaussian"),
        "KDE and SSGE find several, but their particles are bent more than the nu-method's": both("KDE")
        and both("SSGE")
        and min(mean("KDE", "bent"), mean("SSGE", "bent")) > mean("nu-method", "bent"),
        "the nu-method takes at most four times as long a step as KDE": found["nu-method"].ms_per_step
        <= 4 * found["KDE"].ms_per_step,
    }


def main() -> None:
    """Fit, draw and judge."""
    parser = argparse.ArgumentParser(prog="tests.reproduce.bimodal", description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--only", nargs="+", choices=list(ESTIMATORS), default=list(ESTIMATORS))
    options = parser.parse_args()
    out = folder(options.out, "bimodal")
    given = task("bimodal", 2.0, 1.5, X, SLOPE * np.array(X), GRID)
    rule = FSVGD(
        steps=options.steps,
        learning_rate=1e-3,
        final_learning_rate=1.0,
        batch=4,
        fresh_points=16,
        bandwidth=1.0,
        noise=EXACT,
    )
    found: dict[str, Fitted] = {}
    for name in options.only:
        found[name] = fit(given, SimulatorPrior(gap=None, draws=DRAWS), ESTIMATORS[name], rule)
        print(f"{name}: {found[name].seconds:.0f} s", flush=True)
    of_seeds = {name: [figures(p) for p in one.particles] for name, one in found.items()}
    told = {name: {key: [seed[key] for seed in seeds] for key in TITLES} for name, seeds in of_seeds.items()}
    draw(out / "bimodal.png", given, found)
    checks = claims(told, found) if set(told) >= {"Gaussian", "KDE", "SSGE", "nu-method"} else {}
    bent = figures(draws(given, 200))["bent"]
    publish(out, "bimodal", told, found, TITLES, checks, note=f"the prior's draws are lines: bent by {bent:.2g}")


if __name__ == "__main__":
    main()
