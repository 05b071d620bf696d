"""The switches of XLA that simpel sets, beside the user's."""

import os

import pytest

import simpel_cli

THEIRS = "--xla_backend_extra_options=xla_cpu_fold_all_constants="


@pytest.mark.parametrize(
    ("flags", "small_loops", "kept"),
    [
        ("", True, ""),
        ("--xla_dump_to=d", True, "--xla_dump_to=d"),
        (THEIRS, False, THEIRS),
        ("flags.txt", False, "flags.txt"),
    ],
)  # fmt: skip
def test_switches_stand_beside_the_flags_of_the_user(
    flags: str, small_loops: bool, kept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XLA_FLAGS", flags)
    simpel_cli._with_switches()
    found = os.environ["XLA_FLAGS"]
    assert found.endswith(kept)
    assert (simpel_cli.SMALL_LOOPS in found) is small_loops
    simpel_cli._with_switches()
    assert os.environ["XLA_FLAGS"] == found  # as in a process that another one has started
