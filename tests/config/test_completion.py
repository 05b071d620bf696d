"""Completion in the shell: groups, options, keys; with bash's habit of taking words apart at `=`."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import rig

from simpel_cli.config.completion import candidates
from simpel_cli.config.groups import options


@pytest.mark.parametrize(
    ("verb", "text", "before", "found"),
    [
        ("fit", "meth", [], ["method=", "method."]),
        ("fit", "method=simpel_", [], ["method=simpel_high_fidelity", "method=simpel_only_sim"]),
        ("sweep", "method=gp,fs", [], ["method=gp,fsvgd"]),
        ("fit", "method.steps", [], ["method.steps=5000"]),
        ("fit", "method.steps", ["method=fsvgd"], ["method.steps=5000"]),
        ("fit", "method.sysid.sta", ["method=gp"], ["method.sysid.starts=8"]),
        ("fit", "run.figures=", [], ["run.figures=true", "run.figures=false"]),
        ("discover", "effect=[leak,overf", [], ["effect=[leak,overflow", "effect=[leak,overflow_into"]),
        ("rl-offline", "sim@truth=parking_c", [], ["sim@truth=parking_car"]),
        ("rl-online", "rewa", [], ["reward=parking", "reward=swing_up"]),
        ("evaluate", "meth", [], []),
        ("fit", "nonsense", [], []),
    ],
)  # fmt: skip
def test_candidates(verb: str, text: str, before: list[str], found: list[str]) -> None:
    assert candidates(verb, text, before) == found


def test_groups_of_the_user(tmp_path: Path) -> None:
    my = rig(tmp_path)
    assert candidates("fit", "sim=ca", [], my) == ["sim=cart", "sim=cascaded_tanks"]
    assert set(options("sim")) < set(options("sim", my))


@pytest.mark.parametrize(
    ("words", "at", "found"),
    [
        ("simpel fit meth", 2, "method= method."),
        ("simpel fit method = simpel_o", 4, "simpel_only_sim"),
        ("simpel fit method = gp method.sysid.star", 5, "method.sysid.starts=8"),
        ("simpel swee", 1, "sweep"),
        ("simpel fit --multi", 2, "--multirun"),
        ("simpel effects coul", 2, "coulomb_friction"),
    ],
)
def test_bash(words: str, at: int, found: str, tmp_path: Path) -> None:
    if shutil.which("bash") is None:
        pytest.skip("no bash here")
    script = tmp_path / "simpel"  # what completion calls
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m simpel_cli.main "$@"\n')
    script.chmod(0o755)
    typed = f"""
        eval "$(_SIMPEL_COMPLETE=source_bash {script})"
        COMP_WORDS=({words}); COMP_CWORD={at}
        _simpel_completion {script}
        echo "${{COMPREPLY[@]}}"
    """
    shown = subprocess.run(["bash", "-c", typed], capture_output=True, text=True, env=os.environ, timeout=120)
    assert shown.stdout.split() == found.split(), shown.stderr
