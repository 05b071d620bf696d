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
    monkeypatch.setattr(simpel_cli, "version", lambda name: "0.10.2")
    simpel_cli._with_switches()
    found = os.environ["XLA_FLAGS"]
    assert found.endswith(kept)
    assert (simpel_cli.SMALL_LOOPS in found) is small_loops
    simpel_cli._with_switches()
    assert os.environ["XLA_FLAGS"] == found  # as in a process that another one has started


@pytest.mark.parametrize(
    ("jaxlib", "known"), [("0.9.2", False), ("0.10.2", True), ("0.12.0.1", True), ("0.13.0", False)]
)
def test_a_version_that_may_not_know_a_switch_is_not_given_it(
    jaxlib: str, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(simpel_cli, "version", lambda name: jaxlib)
    simpel_cli._with_switches()
    found = os.environ["XLA_FLAGS"]
    assert all((switch in found) is known for switch in (simpel_cli.SMALL_LOOPS, simpel_cli.NO_YNN))
