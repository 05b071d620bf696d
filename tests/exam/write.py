"""Files of a set: what the tool gets in one folder, the truth in another tree."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from tests.exam.draw import OUTSIDE, Set
from tests.exam.nuisances import DIFFERING, DRIFT
from tests.exam.plants import SYSTEMS
from tests.exam.record import TRAIN, Record, record, truth
from tests.exam.visible import visible

NOMINAL = Path(__file__).parent / "nominal"


def table(drawn: Set, made: Record) -> pd.DataFrame:
    """Return the rows that the tool gets."""
    system = SYSTEMS[drawn.system]
    count, rows, _ = made.measured.shape
    columns = {"episode": np.repeat(np.arange(count), rows), "t": np.tile(np.arange(rows) * system.dt, count)}
    for i, name in enumerate(system.states):
        if name in drawn.measured:
            columns[name] = made.measured[..., i].ravel()
    columns |= {name: made.commands[..., j].ravel() for j, name in enumerate(system.inputs)}
    frame = pd.DataFrame(columns)
    if DIFFERING in drawn.nuisances:  # every episode is another unit of the rig, which the data say
        frame["unit"] = frame.episode.map("unit{}".format)
    frame["split"] = np.where(frame.episode < TRAIN, "train", "test")
    return frame


def write(drawn: Set, folder: Path, truth_file: Path) -> None:
    """Write `sim/rig.yaml`, `data/rig.yaml` and `data/run.parquet` into `folder`, the truth to a file outside it.

    Raises:
        ValueError: the truth would lie where the tool can look.
    """
    if folder.resolve() in truth_file.resolve().parents:
        raise ValueError(f"{truth_file}: inside the folder that the tool is given")
    made = record(drawn)
    for name in ("sim", "data"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "sim" / "rig.yaml").write_text((NOMINAL / f"{drawn.system}.yaml").read_text())
    table(drawn, made).to_parquet(folder / "data" / "run.parquet")
    missing = ", ".join(f"{n}: null" for n in SYSTEMS[drawn.system].states if n not in drawn.measured)
    groups = "groups: [unit]\n" if DIFFERING in drawn.nuisances else ""
    (folder / "data" / "rig.yaml").write_text(
        f"path: run.parquet\ntime: t\nepisode: episode\ncolumns: {{{missing}}}\nsplit: {{column: split}}\n{groups}"
    )
    known = truth(drawn, made)
    if drawn.kind == OUTSIDE:
        known["visible"] = visible(drawn, made)
    known["shows"] = {n: visible(drawn, made, moving=True) for n in drawn.nuisances if n in (DIFFERING, DRIFT)}
    truth_file.parent.mkdir(parents=True, exist_ok=True)
    truth_file.write_text(json.dumps(known, indent=1))
