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


MOTOR = """\
# A motor on a test bench.
name: motor
dt: 0.1
states:
  angle: {unit: rad, range: [-9, 9], role: position}
  n: {unit: 1/min, range: [0, 6000]}
  T: {unit: K, range: [0, 90], role: temperature}
inputs: {u: {unit: "1", range: [0, 1]}}
parameters: {J: {unit: kg m^2, range: [0.1, 0.2]}, gain: 2.0}
intermediates:
  w: {unit: rad/s, expression: n*pi/30}
  net: torque - 0.01*n
tables:
  torque: {unit: N m, inputs: [n, u], file: map.csv}
dynamics: {angle: w, n: net/J, T: u - T}
outputs:
  volts: {unit: V, expression: w, scale: gain, bias: -1, saturates: [0, null]}
  tacho: {unit: 1/min, expression: n, lag: 0.2, range: [0, 6000]}
"""


def test_intermediates_tables_roles_and_sensors_are_shown(tmp_path: Path) -> None:
    (tmp_path / "conf" / "sim").mkdir(parents=True)
    (tmp_path / "conf" / "sim" / "motor.yaml").write_text(MOTOR)
    (tmp_path / "conf" / "sim" / "map.csv").write_text("n,u,torque\n0,0,-1\n0,1,9\n6000,0,-4\n6000,1,5\n")
    result = simpel(tmp_path, "sims", "motor", "--config-dir", "conf")
    assert result.code == 0, result.err
    lines = [" ".join(line.split()) for line in result.out.splitlines()]
    for line in (
        "angle rad -9 9 position",
        "n 1/min 0 6000 velocity (inferred: unit 1/min)",
        "T K 0 90 temperature",
        "tacho 1/min 0 6000 lagging reading",
        "volts V - -",
        "torque N m n, u linear 2 x 2 -4 to 9 map.csv",
        "w = n*pi/30 [rad/s]",
        "net = torque - 0.01*n",
        "torque = table of n, u [N m]",
        "dn/dt = net/J",
        "volts = gain*w - 1 [V] (saturates at 0 and no end)",
        "tacho = n [1/min] (follows with a lag of 0.2 s)",
    ):
        assert line in lines, result.out
    more = "_target_: simulators.extended.Extended\nname: more\ndynamics: {n: -0.1*n}\nbase:\n"
    base = "".join(f"  {line}\n" for line in MOTOR.splitlines())
    (tmp_path / "conf" / "sim" / "more.yaml").write_text(more + base)
    shown = simpel(tmp_path, "sims", "more", "--config-dir", "conf").out
    for line in ("dn/dt = net/J", "dn/dt = rate_n + -0.1*n", "2 x 2"):
        assert line in shown
    shown = simpel(tmp_path, "sims", "pendulum").out
    assert "velocity (inferred: unit rad/s)" in shown
    assert "angle, position (inferred: its rate is omega)" in shown
