"""Measurements: read, checked, cut into episodes, brought to the simulator's dt and split."""

from simpel_cli.data.config import Measurements
from simpel_cli.data.origins import Places, origins, places
from simpel_cli.data.reader import read
from simpel_cli.data.recording import (
    Check,
    Episode,
    Recording,
    Transitions,
    no_transitions,
    select,
    transitions,
    with_measured_targets,
)
from simpel_cli.data.tables.locate import absolute

__all__ = [
    "Check", "Episode", "Measurements", "Places", "Recording", "Transitions", "absolute", "no_transitions", "origins",
    "places", "read", "select", "transitions", "with_measured_targets",
]  # fmt: skip
