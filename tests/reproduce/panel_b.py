"""The paper's panel (b): test NLL and error against training size on the recordings of an RC car.

    SIMPEL_SHARED=FOLDER python -m tests.reproduce.panel_b --size small --out runs/reproduce/panel_b

Runs train_1 and train_2 are trained on (rows at random, by data seed), all rows of test_1 are tested on: no neighbour of a
test row is trained on. Seven past commands go into every network. Low fidelity: a kinematic bicycle without delay. High
fidelity: Pacejka tyres and commands that act late. Beside the paper: `gp` and `pathwise`; points of the
box and draws as in panel (a).
"""

import numpy as np

from simpel_cli.runs.files import write_text
from tests.reproduce.panel import (
    SPREAD,
    Fit,
    Table,
    advantage,
    best_of,
    collect,
    draw,
    markdown,
    methods_of,
    options,
    run,
    sizes_of,
    verdict,
    words_of,
)  # fmt: skip
from tests.reproduce.static import folder

SYSTEM = "rc_car"
LOW, HIGH = "rc_car", "rc_car_high_fidelity"
METHODS = {  # name -> (method of simpel, simulator)
    "simpel": ("simpel", LOW),
    "simpel_only_sim": ("simpel_only_sim", LOW),
    "simpel, high fidelity": ("simpel_high_fidelity", HIGH),
    "simpel_only_sim, high fidelity": ("simpel_only_sim", HIGH),
    "fsvgd": ("fsvgd", LOW),
    "svgd": ("svgd", LOW),
    "greybox": ("greybox", LOW),
    "greybox, high fidelity": ("greybox", HIGH),
    "sysid": ("sysid", LOW),
    "sysid, high fidelity": ("sysid", HIGH),
    "gp": ("gp", LOW),
    "pathwise": ("pathwise", LOW),
    "pathwise, high fidelity": ("pathwise", HIGH),
}
SIZES = (50, 100, 200, 400, 800, 1600, 3200, 6400)
SMALL = (50, 400, 3200)


def fits(methods: list[str], data_seeds: int, model_seeds: int, small: bool, share: float) -> list[Fit]:
    """Return every fit of the panel."""
    every = []
    for name in methods:
        method, sim = METHODS[name]
        for n in SMALL if small else SIZES:
            # as published: 60 passes of 8 rows beside 5000 steps
            steps = (
                max(1, round(share * min(60 * n // 8 + 5000, 100_000))) if not small else max(1, round(5000 * share))
            )
            for data_seed in range(data_seeds):
                words = [
                    "experiment=rc_car", f"sim={sim}", f"method={method}", f"data.n_train={n}", f"data.seed={data_seed}",
                    "run.name=rc_car", f"run.seeds={model_seeds}", *words_of(method, steps),
                ]  # fmt: skip
                place = name.replace(", ", "_").replace(" ", "_")
                every.append(Fit(SYSTEM, place, n, data_seed, tuple(words)))
    return every


def claims(nll: Table, error: Table) -> list[str]:
    """Check the paper's claims one by one."""
    lines = []
    sizes = sizes_of(nll, SYSTEM)
    baselines = [m for m in methods_of(nll, SYSTEM) if m.startswith(("fsvgd", "svgd", "greybox", "sysid"))]
    for own in ("simpel", "simpel_high_fidelity"):
        for words, table in (("NLL", nll), ("error", error)):
            rows, good = [], []
            for n in sizes:
                other = best_of(table, SYSTEM, baselines, n)
                if other is None or (SYSTEM, own, n) not in table:
                    rows.append(f"n = {n}: not run")
                    continue
                gain, half = advantage(table, SYSTEM, own, other, n)
                good.append(gain >= -table[SYSTEM, own, n].spread)
                rows.append(f"n = {n}: {gain:+.3g} ± {half:.2g} ahead of {other}")
            claim = f"{own} has the best {words} of all at every size, or lies within one spread of the best baseline"
            lines.append(verdict(claim, all(good) if len(good) == len(sizes) else None, "; ".join(rows)))
    gain, half = advantage(error, SYSTEM, "simpel", "simpel_only_sim", sizes[-1])
    good = gain <= 0.1 * error[SYSTEM, "simpel", sizes[-1]].mean if np.isfinite(gain) else None
    claim = "the simulator alone matches SimPEL's error at the largest size, within a tenth"
    lines.append(verdict(claim, good, f"n = {sizes[-1]}: {gain:+.3g} ± {half:.2g}"))
    gains = [advantage(nll, SYSTEM, "simpel_high_fidelity", "simpel", n) for n in sizes]
    why = "; ".join(f"n = {n}: {g:+.2f} ± {h:.2f} nats" for n, (g, h) in zip(sizes, gains, strict=True))
    good = gains[0][0] > 0 if np.isfinite(gains[0][0]) else None
    lines.append(verdict("the better simulator is the better prior where data are few", good, why))
    return lines


def main() -> None:
    """Fit, draw and judge."""
    parser = options("panel_b", __doc__, METHODS)
    asked = parser.parse_args()
    small = asked.size == "small"
    out = folder(asked.out, f"panel_b_{asked.size}")
    every = fits(
        asked.methods,
        asked.data_seeds or (2 if small else 5),
        asked.model_seeds or (1 if small else 5),
        small,
        asked.steps or (0.3 if small else 1.0),
    )
    run(every, out, asked.processes)
    tables = collect(every, out, "panel_b")
    labels = {"nll": "test NLL [nat]", "nrmse": "test RMSE, normalised"}
    draw(out / "panel_b.png", [(SYSTEM, metric, tables[metric]) for metric in labels], labels, columns=2)
    lines = [SPREAD, "Errors are normalised by the spread of the low-fidelity simulator."]
    lines += claims(tables["nll"], tables["nrmse"])
    for metric, label in labels.items():
        lines += ["", f"## {label}", *markdown(tables[metric], [SYSTEM])]
    text = "\n".join(lines) + "\n"
    write_text(out / "panel_b.md", text)
    print(f"\n{text}\n{out / 'panel_b.png'}")


if __name__ == "__main__":
    main()
