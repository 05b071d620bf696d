"""What a verdict must add to its sentence."""

from typing import Any

from simpel_cli.discovery.verdict.undetectable import SURPRISING, caveats

FOUND: dict[str, Any] = {
    "verdict": "none", "not_tested": [], "data_checks": [{"check": "kinematics", "ok": True}],
    "error": {"surprise": {"s": 1.0, "v": 1.2, "w": float("nan")}},
}  # fmt: skip


def test_test_episodes_that_surprise_are_told_whatever_the_verdict() -> None:
    assert caveats(FOUND) == ""
    for verdict in ("none", "effect", "ambiguous"):
        text = caveats(
            FOUND | {"verdict": verdict, "error": {"surprise": {"s": 1.0, "v": SURPRISING + 0.9, "w": float("nan")}}}
        )
        assert "in v are 2.4 times as large as the model predicts" in text
    assert caveats(FOUND | {"error": {"surprise": {"s": float("nan")}}}) == ""


def test_what_was_not_tested_and_faults_are_told_where_nothing_was_found() -> None:
    entry = {"name": "end_stop", "acts_on": "v", "reason": "its size has no visible influence on these data"}
    faults = [{"check": "kinematics", "ok": False}, {"check": "gaps", "ok": False}]
    text = caveats(FOUND | {"not_tested": [entry], "data_checks": faults})
    assert "Not tested by these data: end stop on v" in text
    assert text.endswith("Correct these faults of the data first: kinematics.")
    assert caveats(FOUND | {"verdict": "effect", "not_tested": [entry], "data_checks": faults}) == ""
