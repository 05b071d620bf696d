"""MCAP and rosbag2: topics as columns with times of their own, decoding, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from systems import CART

from simpel_cli.data import Measurements, read
from simpel_cli.data.tables.formats import optional
from simpel_cli.data.tables.formats.topics import Message, sheet_of_topics
from simpel_cli.data.tables.read_file import read_sheet
from simpel_cli.errors import DataError

START = 1_700_000_000_000_000_000  # ns
STEP = 100_000_000
POINT = "float64 x\nfloat64 y\nfloat64 z\n"


def mcap_json(path: Path, messages: list[tuple[str, int, Any]], encoding: str = "json") -> None:
    pytest.importorskip("mcap")
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(name="any", encoding="jsonschema", data=b"{}")
        channels: dict[str, int] = {}
        for topic, time, content in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, encoding, schema)
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            writer.add_message(channels[topic], log_time=time, publish_time=time, data=data)
        writer.finish()


def test_topics_become_columns_with_times_of_their_own(tmp_path: Path) -> None:
    messages: list[tuple[str, int, Any]] = [
        ("/imu", START, {"gyro": {"x": 1.5}, "ok": True, "frame": "base", "raw": None}),
        ("/joints", START + STEP, {"position": [0.1, 0.2]}),
        ("/imu", START + 2 * STEP, {"gyro": {"x": 2.5, "y": 3}, "ok": False, "frame": "base"}),
        ("/joints", START + 2 * STEP, {"position": [0.3, 0.4], "scan": [0.0] * 65}),
        ("temperature", START + 3 * STEP, 20.5),
    ]
    mcap_json(tmp_path / "run.mcap", messages)
    sheet = read_sheet(tmp_path / "run.mcap")
    nan = np.nan
    expected = {
        "time": [0, 0.1, 0.2, 0.3],
        "imu.gyro.x": [1.5, nan, 2.5, nan],
        "imu.gyro.y": [nan, nan, 3, nan],
        "imu.ok": [1, nan, 0, nan],
        "joints.position.0": [nan, 0.1, 0.3, nan],
        "joints.position.1": [nan, 0.2, 0.4, nan],
        "temperature.value": [nan, nan, nan, 20.5],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(sheet.numbers(name), values, atol=1e-12)
    assert sheet.labels("imu.frame").tolist() == ["base", "", "base", ""]
    assert set(sheet.columns) == {*expected, "imu.frame"}
    assert sheet.units == {"time": "s"}
    assert sheet.notes == ("a row per time at which one of 3 topics spoke; the columns of the others are empty there",)


def test_two_messages_of_a_topic_at_one_time(tmp_path: Path) -> None:
    said = [Message("a", START, {"x": 1.0}), Message("a", START, {"x": 2.0}), Message("a", START + 1, {"x": 3.0})]
    sheet = sheet_of_topics(tmp_path / "run", said, {}, ())
    assert sheet.numbers("a.x").tolist() == [2.0, 3.0]
    assert sheet.notes == ("1 messages of a at the time of another one of it: the last counts",)


def test_one_topic_is_read_as_measurements(tmp_path: Path) -> None:
    messages = [
        (
            "/cart/state",
            START + (run * 100 + i) * STEP,
            {"run": run, "s": np.sin(0.1 * i + run), "v": np.cos(0.1 * i + run), "u": i % 2},
        )
        for run in range(4)
        for i in range(10)
    ]
    mcap_json(tmp_path / "run.mcap", messages)
    columns = {name: f"cart/state.{name}" for name in ("s", "v", "u")}
    recording = read(
        Measurements("run.mcap", time="time", episode="cart/state.run", columns=columns), CART, tmp_path, 0
    )
    assert (len(recording.train), len(recording.test)) == (3, 1)
    for episode in recording.train:
        np.testing.assert_allclose(episode.states[:, 0], np.sin(0.1 * np.arange(10) + float(episode.name)))
        np.testing.assert_allclose(np.diff(episode.time), 0.1)


def test_messages_of_ros_2_in_mcap(tmp_path: Path) -> None:
    pytest.importorskip("mcap_ros2")
    from mcap_ros2.writer import Writer

    text = "builtin_interfaces/Time stamp\nfloat64[] position\nfloat32[3] rpm\nstring name\n"
    text += "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("my_msgs/msg/Joints", text)
        for i in range(3):
            content = {
                "stamp": {"sec": i, "nanosec": 500_000_000}, "position": [0.5 * i, 1.0], "rpm": [1.0, 2.0, i], "name": "arm"
            }  # fmt: skip
            writer.write_message("/joints", schema, content, log_time=START + i * STEP, publish_time=START)
        writer.finish()
    sheet = read_sheet(tmp_path / "run.mcap")
    np.testing.assert_allclose(sheet.numbers("joints.position.0"), [0, 0.5, 1])
    np.testing.assert_allclose(sheet.numbers("joints.rpm.2"), [0, 1, 2])
    np.testing.assert_allclose(sheet.numbers("joints.stamp"), [0.5, 1.5, 2.5])
    np.testing.assert_allclose(sheet.numbers("time"), [0, 0.1, 0.2])
    assert sheet.labels("joints.name").tolist() == ["arm"] * 3


def test_a_topic_in_another_encoding_is_named_when_it_is_asked_for(tmp_path: Path) -> None:
    mcap_json(tmp_path / "all.mcap", [("/u", START, b"\x08\x01")], encoding="protobuf")
    message = r"topic '/u' of all\.mcap is encoded as 'protobuf' with a schema in 'jsonschema', which is not read"
    with pytest.raises(DataError, match=r"all\.mcap has no message with a number\. " + message):
        read_sheet(tmp_path / "all.mcap")


def write_bag(path: Path, plugin: str = "SQLITE3", own_type: bool = False) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    if own_type:
        store.register(get_types_from_msg("float64 secret\n", "my_msgs/msg/Own"))
    number, point = store.types["std_msgs/msg/Float64"], store.types["geometry_msgs/msg/Point"]
    with Writer(path, version=9, storage_plugin=StoragePlugin[plugin]) as writer:
        state = writer.add_connection("/state", point.__msgtype__, typestore=store)
        motor = writer.add_connection("/motor", number.__msgtype__, typestore=store)
        own = writer.add_connection("/own", "my_msgs/msg/Own", typestore=store) if own_type else None
        for i in range(4):
            writer.write(
                state, START + i * STEP, store.serialize_cdr(point(x=0.5 * i, y=1.0, z=-1.0), point.__msgtype__)
            )
            if i % 2:
                writer.write(motor, START + i * STEP, store.serialize_cdr(number(data=float(i)), number.__msgtype__))
            if own is not None:
                message = store.types["my_msgs/msg/Own"](secret=1.0)
                writer.write(own, START + i * STEP, store.serialize_cdr(message, "my_msgs/msg/Own"))


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_rosbag(tmp_path: Path, plugin: str) -> None:
    write_bag(tmp_path / "bag", plugin, own_type=plugin == "MCAP")
    inside = next(p for p in (tmp_path / "bag").iterdir() if p.suffix in (".db3", ".mcap"))
    for path in (tmp_path / "bag", inside):
        sheet = read_sheet(path)
        np.testing.assert_allclose(sheet.numbers("time"), [0, 0.1, 0.2, 0.3])
        np.testing.assert_allclose(sheet.numbers("state.x"), [0, 0.5, 1, 1.5])
        np.testing.assert_allclose(sheet.numbers("motor.data"), [np.nan, 1, np.nan, 3])


def test_a_bag_is_a_path_and_every_file_of_it_is_named(tmp_path: Path) -> None:
    for name in ("bags/run2", "bags/run10", "bags/run1"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_bag(tmp_path / name)
    columns = {"s": "state.x", "v": "state.y", "u": "state.z"}
    config = Measurements("bags/run*", time="time", columns=columns, split={"test_files": ["bags/run10"]})
    recording = read(config, CART, tmp_path, 0)
    assert [e.name for e in recording.train] == ["run1", "run2"]
    assert [e.name for e in recording.test] == ["run10"]
    names = [str(file.relative_to(tmp_path)) for file in recording.files]
    assert names[:2] == ["bags/run1/run1.db3", "bags/run1/metadata.yaml"]
    assert len(names) == 6
    assert all(file.is_file() for file in recording.files)


def test_a_type_that_a_bag_does_not_define(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bag(tmp_path / "bag", own_type=True)
    database = next((tmp_path / "bag").glob("*.db3"))
    import sqlite3

    with sqlite3.connect(database) as connection:  # as recorded by a version that kept no definitions
        connection.execute("DELETE FROM message_definitions")
    connection.close()
    sheet = read_sheet(database)
    np.testing.assert_allclose(sheet.numbers("state.x"), [0, 0.5, 1, 1.5])
    assert "topic '/own' of" in sheet.unusable["own"]
    assert "my_msgs/msg/Own, which cannot be decoded" in sheet.unusable["own"]
    columns = {"s": "state.x", "v": "state.y", "u": "own.secret"}
    with pytest.raises(DataError, match="cannot be decoded"):
        read(Measurements(str(database), time="time", columns=columns), CART, tmp_path, 0)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.mcap", b"", r"empty\.mcap is empty \(0 bytes\)"),
        ("text.mcap", b"no mcap at all" * 20, r"text\.mcap is damaged, cut off or no MCAP file.*mcap recover"),
        ("text.db3", b"no database" * 20, r"text\.db3 is damaged, cut off or no rosbag2"),
        ("bag/metadata.yaml", b"rosbag2_bagfile_information: 3", r"bag is damaged, cut off or no rosbag2"),
    ],
)
def test_files_that_are_none(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    pytest.importorskip("mcap_ros2")
    pytest.importorskip("rosbags")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as error:
        read_sheet(tmp_path / name.partition("/metadata")[0])
    assert error.value.exit_code == 3


def test_damaged_mcap(tmp_path: Path) -> None:
    mcap_json(tmp_path / "whole.mcap", [("/a", START + i, {"x": i}) for i in range(200)])
    content = (tmp_path / "whole.mcap").read_bytes()
    assert len(read_sheet(tmp_path / "whole.mcap")) == 200
    for name, damaged in (
        ("cut", content[: len(content) // 2]),
        ("flipped", content[:150] + b"\xff" * 9 + content[159:]),
    ):
        (tmp_path / f"{name}.mcap").write_bytes(damaged)
        with pytest.raises(DataError, match=rf"{name}\.mcap is damaged"):
            read_sheet(tmp_path / f"{name}.mcap")
    mcap_json(tmp_path / "none.mcap", [("/a", START, {"x": "text"})])
    with pytest.raises(DataError, match=r"none\.mcap has no message with a number"):
        read_sheet(tmp_path / "none.mcap")
    mcap_json(tmp_path / "bad.mcap", [("/a", START, b"{not json")])
    with pytest.raises(DataError, match=r"bad\.mcap is damaged"):
        read_sheet(tmp_path / "bad.mcap")


def test_libraries_that_are_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(optional.importlib, "import_module", absent)
    for name, extra in (("run.mcap", "mcap"), ("run.db3", "rosbag")):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(DataError, match=rf"{name}: to read it, .* pip install 'simpel\[{extra}\]'"):
            read_sheet(tmp_path / name)
