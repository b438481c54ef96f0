"""Bags that are read in a child process: such as are made to take memory or time, and what is told of them."""

from __future__ import annotations

import os
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from core.errors import InvalidRecording, UnknownTopic
from core.recordings import Recording
from service.recordings import reader as reading
from service.recordings.reader import Order, Reader
from tests.core.recordings.bags import (
    ODOMETRY,
    SECOND,
    START,
    compressed,
    moved,
    walk,
    write_mcap,
    write_rosbag2,
)

MOST = 1 << 20


def order(path: Path, most: int = MOST) -> Order:
    return Order(
        path=path, topic=None, pose_topic=None, fixed=None, moving=None, largest_gap=1.5, most_speed=60.0, prefix="",
        most=most,
    )  # fmt: skip


def go_on(_opening: bool) -> None:
    """Nobody cancels."""


@contextmanager
def read_apart(wanted: Order) -> Iterator[Recording]:
    with closing(Reader(wanted, go_on)) as reader:
        yield reader.recording()


def with_message(path: Path, data: bytes, topic: str = "/camera") -> Path:
    """A bag whose only message is one of Foxglove's pictures in JSON."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        channel = writer.register_channel(topic, "json", schema)
        writer.add_message(channel, 1, data, 1)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_frames_come_as_they_are_in_the_bag_and_no_further_than_is_wanted(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", walk())
    with read_apart(order(bag)) as recording:
        assert recording.name == "walk" and len(recording.frames) == 6
        whole = [frame.load() for frame in recording.frames]
        assert all(data.startswith(b"\xff\xd8\xff") for data in whole) and recording.frames[2].load() == whole[2]
    with read_apart(order(bag, most=100)) as recording:
        assert recording.frames[1].load() == whole[1][:100]


def test_frames_of_a_later_part_come_with_its_own_odometry(tmp_path: Path) -> None:
    seen = [compressed(START + n * SECOND, b"%d" % n) for n in range(4)]
    told = [moved(START + n * SECOND // 10, n - 20.0 * (n >= 20), 0.0) for n in range(40)]
    bag = write_mcap(tmp_path / "anew.mcap", [*seen, *told])
    with read_apart(order(bag).model_copy(update={"pose_topic": ODOMETRY})) as recording:
        assert [one.pose and one.pose.x for one in recording.frames] == [0, 10, None, None]
        assert [one.local and one.local.x for one in recording.frames] == [None, None, 0, 10]


@pytest.mark.thorough
def test_a_message_that_becomes_gigabytes_of_objects_is_refused(tmp_path: Path) -> None:
    count = 3_000_000
    bag = with_message(tmp_path / "bomb.mcap", b'{"data": [' + b"{}," * count + b"{}]}")
    assert bag.stat().st_size < 100_000
    reader = Reader(order(bag), go_on, 256 << 20)
    with pytest.raises(InvalidRecording, match="too much memory"):
        reader.recording()
    reader.close()


def test_a_deep_message_is_no_frame_and_ends_nothing(tmp_path: Path) -> None:
    bag = with_message(tmp_path / "deep.mcap", b"[" * 1_000_000)
    with read_apart(order(bag)) as recording, pytest.raises(InvalidRecording, match="damaged"):
        recording.frames[0].load()


@pytest.mark.thorough
@pytest.mark.parametrize("table", ["topics", "messages"])
def test_a_database_whose_tables_are_views_is_refused(tmp_path: Path, table: str) -> None:
    (bag,) = write_rosbag2(tmp_path / "views", walk()).glob("*.db3")
    with read_apart(order(bag)) as recording:
        assert len(recording.frames) == 6
    with sqlite3.connect(bag) as database:
        database.execute(f"ALTER TABLE {table} RENAME TO former")
        columns = "x AS id, x AS topic_id, 0 AS timestamp, x'' AS data, 'n' AS name, 't' AS type, 'cdr' AS "
        database.execute(
            f"CREATE VIEW {table} AS WITH RECURSIVE endless(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM endless) "
            f"SELECT {columns} serialization_format FROM endless"
        )
    with pytest.raises(InvalidRecording), read_apart(order(bag)):
        pass


def test_who_waits_for_a_bag_may_stop_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stopped(Exception):
        """The job is cancelled."""

    def stop(_opening: bool) -> None:
        raise Stopped

    bag = write_mcap(tmp_path / "walk.mcap", walk())
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with pytest.raises(Stopped), closing(Reader(order(bag), stop)) as reader:
        reader.recording()
    assert [path.name for path in tmp_path.iterdir()] == ["walk.mcap"], "a child that is killed leaves no files"


def test_what_is_wrong_is_told_without_the_folder(tmp_path: Path) -> None:
    path = tmp_path / "no.mcap"
    path.write_bytes(b"no bag at all")
    with pytest.raises(InvalidRecording) as told, read_apart(order(path)):
        pass
    assert "no.mcap" in str(told.value) and str(tmp_path) not in str(told.value)


@pytest.mark.thorough
def test_what_is_told_has_the_length_of_a_text(tmp_path: Path) -> None:
    path = with_message(tmp_path / "long.mcap", b"{}", "/camera" * 100_000)
    with read_apart(order(path)) as recording:
        assert len(recording.frames[0].name) == 1000 and max(map(len, recording.remarks)) == 1000
    with pytest.raises(UnknownTopic) as told, read_apart(order(path).model_copy(update={"topic": "/none"})):
        pass
    assert len(str(told.value)) <= 1000


@pytest.mark.thorough
def test_a_child_that_has_too_little_memory_for_its_bag_is_ended(tmp_path: Path) -> None:
    reader = Reader(order(with_message(tmp_path / "large.mcap", b'{"data": "' + b"A" * (64 << 20) + b'"}')), go_on, 1)
    with pytest.raises(InvalidRecording, match="memory"):
        reader.recording()
    reader.close()


def killed(reader: Reader) -> None:
    reader._child.kill()
    reader._child.wait()


def test_a_frame_that_ends_the_child_is_refused_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "MOST_CHILDREN", 3)
    bag = write_mcap(tmp_path / "walk.mcap", walk())
    with closing(Reader(order(bag), go_on)) as reader:
        frames = reader.recording().frames
        whole = [frame.load() for frame in frames]
        killed(reader)  # as when memory is short
        assert frames[0].load() == whole[0]
        os.kill(reader._child.pid, signal.SIGSTOP)  # it never answers
        monkeypatch.setattr(reading, "FRAME_SECONDS", 0.0)
        with pytest.raises(InvalidRecording, match="too long"):
            frames[1].load()
        monkeypatch.setattr(reading, "FRAME_SECONDS", 60.0)
        assert [frame.load() for frame in frames[2:]] == whole[2:]
        killed(reader)
        with pytest.raises(InvalidRecording, match="again and again"):
            frames[2].load()


def test_a_bag_that_has_become_another_one_is_not_read_on(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", walk())
    with closing(Reader(order(bag), go_on)) as reader:
        frames = reader.recording().frames
        write_mcap(bag, walk(4))
        killed(reader)
        with pytest.raises(InvalidRecording):
            frames[0].load()
