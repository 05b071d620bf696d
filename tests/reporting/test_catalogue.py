"""`simpel sims`, `simpel effects` and `simpel doctor`: what exists, and whether it computes right."""

from pathlib import Path

import pytest
from command_line import CART, rig, simpel

from simpel_cli.config.folders import conf_dir
from simpel_cli.reporting import doctor


def test_every_simulator_is_listed_and_can_be_shown(tmp_path: Path) -> None:
    my = rig(tmp_path)
    listed = simpel(tmp_path, "sims", "--config-dir", my).out
    for path in (conf_dir() / "sim").glob("*.yaml"):
        assert f"  {path.stem} " in listed
    (cart,) = (line for line in listed.splitlines() if line.startswith("  cart "))
    assert cart.split()[1:] == ["s", "[m],", "v", "[m/s]", "u", "[V]", "2"]
    shown = simpel(tmp_path, "sims", "cart", "--config-dir", my).out
    for words in ("dv/dt = (c*u - k*s)/m", "ds/dt = v", "c = 2", "kg    0.5   2"):
        assert words in shown
    assert "equations: simulators.sergio.Sergio, in Python" in simpel(tmp_path, "sims", "sergio").out
    assert "x      1     -5    5" in simpel(tmp_path, "sims", "sinusoid").out
    assert simpel(tmp_path, "sims", "pendulum_world").code == 0


def test_every_effect_is_listed_and_can_be_shown(tmp_path: Path) -> None:
    listed = simpel(tmp_path, "effects").out
    for path in (conf_dir() / "effect").glob("*.yaml"):
        assert path.stem in listed
        assert simpel(tmp_path, "effects", path.stem).code == 0
    assert "-tau_c*tanh(v/w)" in listed
    assert "0.003*V  0.1*V  0.02*V" in simpel(tmp_path, "effects", "coulomb_friction").out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("sims", "crat"), "sim: got crat; there is no sim of that name. Did you mean cart? `simpel sims` lists them."),
        (("effects", "colomb_friction"), "Did you mean coulomb_friction?"),
        (("sims", "cart"), "sim.dynamics.w: is no state"),
    ],
)
def test_wrong_names(tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    my = rig(tmp_path, cart=CART + ("  w: v\n" if words[1] == "cart" else ""))
    result = simpel(tmp_path, *words, "--config-dir", my)
    assert result.code == 2
    assert message in result.err


@pytest.mark.parametrize("value", ["9" * 5000, "&a [*a, *a]"])
def test_a_yaml_that_no_computer_can_hold(value: str, tmp_path: Path) -> None:
    my = rig(tmp_path, cart=CART.replace("dt: 0.05", f"dt: {value}"))
    for words in (("sims", "cart", "--config-dir", my), ("fit", "--config-dir", my, "sim=cart", "data=rig")):
        result = simpel(tmp_path, *words)
        assert (result.code, "Traceback" in result.err) == (2, False), result.err


def test_doctor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = simpel(tmp_path, "doctor")
    assert (result.code, result.err) == (0, "")
    assert "nothing is wrong" in result.out
    # an installation that computes wrong is told so, with an exit code
    monkeypatch.setitem(doctor.TESTS, "gradients", lambda: (False, "off by 3"))
    monkeypatch.setitem(doctor.TESTS, "files", lambda: (_ for _ in ()).throw(OSError("no room")))
    result = simpel(tmp_path, "doctor")
    assert result.code == 1
    assert "error: gradients, files: this installation computes or stores wrong results" in result.err
    assert "OSError: no room" in result.out
