"""Data from which nothing can be learned end in an honest verdict or a clear error, and faulty ones do not mislead."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import CART, RIG, csv, rig, simpel

from simpel_cli.data import Episode, Recording
from simpel_cli.errors import DataError
from simpel_cli.filtering.measurements.cleaning import cleaned, is_noise, measured
from simpel_cli.filtering.measurements.windows import windows_of
from simpel_cli.runs.files import strict
from simulators.model import Declared, Model

SEARCH = ("discover", "--config-dir", "my", "sim=cart", "data=rig", "close=false", "hydra.run.dir=run")
FEW = "effect=[viscous_friction,coulomb_friction,input_delay,leak]"
DATA = 3
RUN, TIME, S, V, U = range(5)  # columns
NOISE = 1e-4, 1e-3  # m, m/s


def table(friction: float = 0.0, volts: Callable = np.sin, start: float = 0.3, episodes: int = 6) -> np.ndarray:
    """Rows of a cart with friction/m = `friction` 1/s that its simulator does not know of."""
    random, rows, dt = np.random.default_rng(0), [], 0.05
    for run in range(episodes):
        s, v = start * random.uniform(-1, 1), 0.0
        for k in range(40):
            u = float(volts(0.3 * k + run))
            rows.append([run, round(k * dt, 4), s + NOISE[0] * random.normal(), v + NOISE[1] * random.normal(), u])
            for _ in range(100):
                v += ((2 * u - 20 * s) / 1.2 - friction * v) * dt / 200
                s += v * dt / 100
                v += ((2 * u - 20 * s) / 1.2 - friction * v) * dt / 200
    return np.array(rows)


def nothing(_: float) -> float:
    return 0.0


def changed(column: int, value: object, row: int | None = None) -> list[list[object]]:
    rows: list[list[object]] = table().tolist()
    for i, values in enumerate(rows):
        if row in (None, i):
            values[column] = value
    return rows


def noise_only() -> np.ndarray:
    rows = table()
    rows[:, [S, V]] = np.random.default_rng(1).normal(size=(len(rows), 2)) * [0.1, 0.5]
    return rows


def one_episode() -> np.ndarray:
    return table(episodes=1)


UNSEEN = CART.replace(
    "  v: {unit: m/s, range: [-2, 2]}", "  v: {unit: m/s, range: [-2, 2]}\n  w: {unit: K, range: [0, 9]}"
)
UNSEEN = UNSEEN.replace("  s: v\n", "  s: v\n  w: u - w\n")
CASES: dict[str, tuple[Any, dict[str, str], tuple[str, ...]]] = {
    "ten rows": (lambda: table()[[*range(5), *range(40, 45)]], {}, ("5 training rows", "at least 30", "Record more")),
    "at rest": (lambda: table(volts=nothing, start=0.0), {},
                ("nothing but noise is measured: in s, v", "Record a motion that is larger than the noise")),
    "no motion, noise": (noise_only, {}, ("nothing but noise is measured", "data.columns")),
    "exact rest": (lambda: table(volts=nothing) * [1, 1, 0, 0, 0], {}, ("nothing changes: s, v, u are constant",)),
    "empty column": (lambda: changed(V, ""), {}, ("'vel' has no numbers", "columns: {<state>: null}")),
    "NaN column": (lambda: changed(V, "nan"), {}, ("'vel' has no numbers",)),
    "repeated rows": (lambda: np.repeat(table(), 2, axis=0), {}, ("time stands still at line 3", "remove repeated rows")),
    "one episode": (one_episode, {}, ("one episode only", "by: time")),
    "huge states": (lambda: table() * [1, 1, 1e12, 1e12, 1], {},
                    ("s reaches", "more than 100 times the width of its range [-0.5, 0.5] m", "compare the units")),
    "huge input": (lambda: changed(U, 1e12, row=57), {}, ("u reaches 1e+12 V", "Take wrong rows out")),
    "episodes of two rows": (lambda: table(episodes=30)[np.arange(1200) % 40 < 2], {},
                             ("has 3 rows in a row", "longer episodes")),
    "everything computed": (table, {"data": RIG + "derived: [s, v]\n"},
                            ("data.derived: [s, v] leaves nothing that is measured",)),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_what_no_search_can_use_is_refused(tmp_path: Path, name: str) -> None:
    rows, files, fragments = CASES[name]
    made = rows()
    rig(tmp_path, measurements=csv(made if isinstance(made, list) else made.tolist()), **files)
    result = simpel(tmp_path, *SEARCH, FEW)
    text = re.sub(r"\s+", " ", result.err)
    assert "Traceback" not in text
    for fragment in fragments:
        assert fragment in text
    assert result.code == DATA
    assert not (tmp_path / "run" / "verdict.json").exists()


def test_a_derived_name_must_exist(tmp_path: Path) -> None:
    rig(tmp_path, measurements=csv(table().tolist()), data=RIG + "derived: [w]\n")
    result = simpel(tmp_path, *SEARCH, FEW)
    assert result.code == 2
    assert "data.derived.w: the simulator has no such quantity (it has: s, v)" in re.sub(r"\s+", " ", result.err)


# whole searches


def search(folder: Path, rows: np.ndarray, **files: str) -> tuple[dict[str, Any], str]:
    rig(folder, measurements=csv(rows.tolist()), **files)
    result = simpel(folder, *SEARCH, FEW)
    assert result.code == 0, result.err

    def refuse(constant: str) -> None:
        raise AssertionError(f"verdict.json has {constant}")

    return json.loads((folder / "run" / "verdict.json").read_text(), parse_constant=refuse), result.out


def spiked(rows: np.ndarray, seed: int, share: float = 0.02) -> tuple[np.ndarray, int]:
    """Spikes of 10 to 50 standard deviations of the noise in both channels, some at an end of an episode."""
    random = np.random.default_rng(seed)
    hit = random.random((len(rows), 2)) < share
    hit[20::40, 0] = True  # in every episode, also in those of the test
    hit[1:] &= ~hit[:-1] & ~hit[:-1, ::-1]  # no two side by side
    size = random.choice([-1, 1], hit.shape) * random.uniform(10, 50, hit.shape) * NOISE
    rows = rows.copy()
    rows[:, [S, V]] += hit * size
    return rows, int(hit.sum())


def checks(found: dict[str, Any]) -> dict[str, str]:
    return {c["check"]: c["detail"] for c in found["data_checks"]}


def counted(text: str) -> int:
    return sum(int(n) for n in re.findall(r"(\d+) of \d+ values of", text))


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str, int]:
    """Nothing is missing; no input, sensors that spike, a state that nothing tells, and an episode of one row."""
    rows, spikes = spiked(table(volts=nothing), 2)
    rows = np.concatenate([rows, [[99, 0.0, 0.1, 0.0, 0.0]]])
    data = RIG.replace("u: volts", "w: null, u: volts")
    return *search(tmp_path_factory.mktemp("idle"), rows, cart=UNSEEN, data=data), spikes


def test_spikes_create_no_effect_and_what_was_not_tested_is_said(idle: tuple[dict[str, Any], str, int]) -> None:
    found, out, _ = idle
    assert found["verdict"] == "none"
    assert found["effects"] == []
    untested = {(e["name"], e["acts_on"]): e["reason"] for e in found["not_tested"]}
    assert untested.keys() == {("input_delay", "u"), ("leak", "w")}
    assert untested["input_delay", "u"] == "u never changes"
    assert "input_delay" not in {e["name"] for e in found["not_found"]}
    assert "Not tested by these data: input delay on u (u never changes)" in found["summary"]
    assert "input delay on u (u never changes)" in re.sub(r"\s+", " ", out)
    assert "1 segments shorter than 5 rows dropped" in checks(found)["estimated"]


def test_spikes_are_counted_and_leave_the_errors_at_the_noise(idle: tuple[dict[str, Any], str, int]) -> None:
    found, _, spikes = idle
    assert spikes - 1 <= counted(checks(found)["outliers"]) <= spikes
    assert "test episodes, whose errors leave them out too" in checks(found)["outliers"]
    for name, std in zip("sv", NOISE, strict=True):
        assert found["error"]["before"]["one_step"][name] < 2 * std
        assert 0.7 * std < found["noise_floor"][name] < 1.3 * std


@pytest.mark.slow
def test_neither_spikes_nor_a_computed_velocity_hide_an_effect(tmp_path: Path) -> None:
    rows, _ = spiked(table(friction=0.5), 3, share=0.01)
    for run in range(6):
        own = rows[:, RUN] == run
        rows[own, V] = np.gradient(rows[own, S], 0.05)
    found, _ = search(tmp_path, rows)
    assert set(found["noise_floor"]) == {"s"}
    assert "v is the central difference of s" in checks(found)["derived"]
    assert "not taken for a measurement" in checks(found)["derived"]
    (effect,) = found["effects"]
    assert effect["class"] == ["viscous_friction"]
    assert abs(effect["parameters"]["b"]["value"] - 0.5) < 0.05


# parts


def cart() -> Model:
    quantity = {"unit": "m", "range": [-1, 1]}
    return Declared(
        name="cart", dt=0.05, states={"s": quantity, "v": quantity}, inputs={"u": quantity},
        parameters={"k": {"unit": "", "range": [1, 2]}}, dynamics={"s": "v", "v": "u - k*s"},
    ).model()  # fmt: skip


def recording(states: np.ndarray, **fields: Any) -> Recording:
    time = 0.05 * np.arange(len(states))
    episodes = [Episode(n, time, states.copy(), np.sin(time)[:, None], np.empty((len(time), 0))) for n in "abc"]
    noise = {"s": 0.001, "v": 0.001}
    return Recording(tuple(episodes[:2]), (episodes[2],), (), noise, (), (), ())._replace(**fields)


def swing(noise: float = 1e-3) -> np.ndarray:
    t = 0.05 * np.arange(80)
    return 0.3 * np.stack([np.sin(t), np.cos(t)], axis=1) + noise * np.random.default_rng(4).normal(size=(80, 2))


def test_a_spike_becomes_a_hole_and_not_a_noise() -> None:
    states = swing()
    states[30, 0] += 0.05
    found = cleaned(recording(states), cart(), ())
    assert [(p.name, p.split, p.episode, p.row) for p in found.left_out] == [
        ("s", split, i, 30) for split, i in (("train", 0), ("train", 1), ("test", 0))
    ]
    assert all(np.isnan(e.states[30, 0]) for e in (*found.recording.train, *found.recording.test))
    assert found.recording.noise_std["s"] < 0.0005  # with the spike the third differences say 0.001 as given here
    assert found.recording.noise_std["v"] == 0.001
    assert cleaned(recording(states), cart(), ("s",)).recording.noise_std["s"] == 0.001


def test_a_value_is_no_spike_for_noise_that_it_is_declared_to_have() -> None:
    states, scale = swing(), np.ones((80, 2))
    states[[30, 50], 0] += 0.05
    scale[30, 0] = 20.0  # fifty times the noise, of which twenty are its own

    def weighed(own: Recording) -> Recording:
        train, test = (tuple(e._replace(weight=scale**-2.0) for e in part) for part in (own.train, own.test))
        return own._replace(train=train, test=test)

    alike = cleaned(recording(states), cart(), ()).left_out
    assert {(p.name, p.row) for p in alike} == {("s", 30), ("s", 50)}
    assert {(p.name, p.row) for p in cleaned(weighed(recording(states)), cart(), ()).left_out} == {("s", 50)}
    states[30:33, 1] = np.nan  # beside what is missing
    assert {(p.name, p.row) for p in cleaned(weighed(recording(states)), cart(), ()).left_out} == {("s", 50)}


def test_too_many_spikes_are_not_chosen_from() -> None:
    states = swing()
    states[6:-6:12, 0] += 0.05
    found = cleaned(recording(states), cart(), ())
    assert found.left_out == ()
    assert found.too_many.keys() == {"s"}


def test_a_computed_column_is_no_channel() -> None:
    found = cleaned(recording(swing(), derived=("v",)), cart(), ())
    assert measured(found.recording, cart()) == ("s",)


def test_a_static_answer_to_a_random_input_is_no_noise() -> None:
    random = np.random.default_rng(5)
    inputs = [random.normal(size=(100, 1)) for _ in range(3)]
    noise = [random.normal(size=100) for _ in range(3)]
    assert is_noise(noise, inputs)
    assert not is_noise([n + np.roll(u[:, 0], 1) for n, u in zip(noise, inputs, strict=True)], inputs)
    assert not is_noise([n + 3 * i for i, n in enumerate(noise)], inputs)  # it rests, but not always at one place
    assert is_noise([np.full(100, 7.0)] * 3, inputs)


def test_a_channel_without_a_window_is_refused() -> None:
    (episode, *_) = recording(swing()).train
    short = Episode(*(c if isinstance(c, str) or c is None else c[:2] for c in episode))
    with pytest.raises(DataError, match=r"none of 1 episodes \(a\) has 3 rows in a row"):
        windows_of([short], ["s", "v"], ["s", "v"], [], np.zeros(2), np.ones(2), lead=2, dt=0.1)


def test_json_has_null_where_a_number_does_not_exist() -> None:
    found = strict({"a": [np.nan, 1.0], "b": {"c": (np.inf, np.float64(2.0))}, "d": np.int64(3), "e": None, "f": True})
    assert (
        json.dumps(found, allow_nan=False)
        == '{"a": [null, 1.0], "b": {"c": [null, 2.0]}, "d": 3, "e": null, "f": true}'
    )
