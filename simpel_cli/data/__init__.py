"""Measurements: read, checked, cut into episodes, brought to the simulator's dt and split."""

from simpel_cli.data.config import Measurements
from simpel_cli.data.files import absolute
from simpel_cli.data.reader import read
from simpel_cli.data.recording import Check, Episode, Recording, Transitions, select, transitions

__all__ = [
    "Check",
    "Episode",
    "Measurements",
    "Recording",
    "Transitions",
    "absolute",
    "read",
    "select",
    "transitions",
]
