"""`simpel simulate`: a simulator or a MuJoCo world becomes measurements, as Parquet plus card."""

import dataclasses
from pathlib import Path
from typing import Any

from simulators.worlds.simulate import Simulate

from simpel_cli.commands.study import source_of
from simpel_cli.config import Job, build, dump
from simpel_cli.console import Terminal
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.records import write_table, write_text
from simpel_cli.run import Settings, make_directory
