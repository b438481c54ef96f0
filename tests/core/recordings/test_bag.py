"""Bags of every kind: their frames, poses and times; and those that are damaged, empty, unsorted or of other topics."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from benchmarks.recordings.damaged_bags import by_recordings, damaged, hostile, tried
from core.errors import InvalidImage, InvalidRecording, InvalidTrajectory, UnknownTopic
from core.recordings import Poses, RecordedFrame, open_recording
from core.recordings.bag import STORAGES
from tests.core.recordings.bags import (
    CAMERA,
    ODOMETRY,
    SECOND,
    START,
    WRITERS,
    Said,
    compressed,
    fix,
    image,
    moved,
    walk,
    write_mcap,
    write_rosbag2,
)
from tests.core.recordings.foxglove import write as write_foxglove
from tests.service.scenes import encoded, jpeg, scene

ODOM = Poses(topic=ODOMETRY)


def pixels_of(png: bytes, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), flags))


def loaded(path: Path, topic: str | None = None) -> tuple[list[RecordedFrame], list[bytes], list[str]]:
    """The frames of a bag, their bytes and what is remarked."""
    with open_recording(path, topic) as recording:
        return recording.frames, [frame.load() for frame in recording.frames], recording.remarks


@pytest.mark.parametrize("writer", sorted(WRITERS))
def test_every_kind_of_bag_gives_the_same_frames(writer: str, tmp_path: Path) -> None:
    path = WRITERS[writer](tmp_path, walk())
    with open_recording(path, poses=ODOM) as recording:
        assert recording.name.startswith("walk")
        assert recording.remarks == []
        assert [frame.id for frame in recording.frames] == [
            f"camera-image_raw-compressed-{1_700_000_000 + index}.000000000" for index in range(6)
        ]
        assert [frame.pose.model_dump(exclude_none=True) for frame in recording.frames if frame.pose] == [
            {"x": float(index), "y": 0.0, "z": 0.5, "heading": 0.0} for index in range(6)
        ]
        times = [frame.timestamp.timestamp() for frame in recording.frames if frame.timestamp]
        assert times == [1_700_000_000 + index for index in range(6)]
        for index in (5, 0, 3, 3, 1, 2, 4):  # in any order
            assert recording.frames[index].load() == jpeg(index)


@pytest.mark.parametrize("writer", ["mcap-zstd", "mcap-lz4", "mcap-plain"])
def test_what_mcap_writes_rosbags_reads_alike(writer: str, tmp_path: Path) -> None:
    path = WRITERS[writer](tmp_path, walk())
    frames, data, _ = loaded(path)
    with AnyReader([path]) as reader:
        read: list[tuple[Any, int]] = [
            (reader.deserialize(raw, connection.msgtype), time)
            for connection, time, raw in reader.messages()
            if connection.topic == CAMERA
        ]
    assert [bytes(message.data) for message, _ in read] == data
    assert [time for _, time in read] == [frame.nanoseconds for frame in frames]


def test_rows_may_have_padding(tmp_path: Path) -> None:
    grey = cv2.cvtColor(scene(3, 64, 48), cv2.COLOR_BGR2GRAY)
    said = [image(START, 64, 48, "mono8", np.pad(grey, ((0, 0), (0, 16))).tobytes(), 80)]
    _, (png,), _ = loaded(write_mcap(tmp_path / "a.mcap", said))
    assert np.array_equal(pixels_of(png, cv2.IMREAD_ANYCOLOR), grey)
    assert [png] == loaded(tmp_path / "a.mcap")[1]  # the same bytes again


def test_a_picture_that_cannot_be_used_fails_alone(tmp_path: Path) -> None:
    said = [
        image(START, 8, 8, "32FC1", bytes(256), 32),
        image(START + 1, 64, 48, "bgr8", bytes(100), 192),
        image(START + 2, 4, 4, "mono8", bytes(range(16)), 4),
    ]
    with open_recording(write_mcap(tmp_path / "a.mcap", said)) as recording:
        with pytest.raises(InvalidImage, match="encoding '32FC1' is not read; mono8"):
            recording.frames[0].load()
        with pytest.raises(InvalidImage, match="announces 64x48 pixels of bgr8 in rows of 192 bytes and has 100 bytes"):
            recording.frames[1].load()
        assert recording.frames[2].load().startswith(b"\x89PNG")


def test_compressed_pictures_of_other_formats_become_png(tmp_path: Path) -> None:
    pixels = scene(2, 64, 48)
    said = [compressed(START + index, encoded(pixels, form)) for index, form in enumerate((".bmp", ".tiff", ".webp"))]
    _, data, _ = loaded(write_mcap(tmp_path / "a.mcap", [*said, compressed(START + 9, encoded(pixels, ".png"))]))
    assert [one[:4] for one in data] == [b"\x89PNG", b"\x89PNG", b"RIFF", b"\x89PNG"]
    assert data[0] == data[1]
    assert np.array_equal(pixels_of(data[0]), pixels)


@pytest.mark.parametrize("writer", ["sqlite-file-alone", "mcap-zstd", "mcap-no-chunks", "ros1", "ros1-lz4", "ros1-bz2"])
def test_a_bag_that_is_cut_short_gives_what_it_holds(writer: str, tmp_path: Path) -> None:
    path = WRITERS[writer](tmp_path, walk(30))
    whole = path.read_bytes()
    for share in (0.7, 0.3):
        path.write_bytes(whole[: int(len(whole) * share)])
        frames, data, remarks = loaded(path)
        assert 0.7 * share * 30 - 3 <= len(frames) <= 30 * share + 4, share
        # What is there is what was written: a part of the whole, from the beginning, with the same ids.
        assert data == [jpeg(index) for index in range(len(data))]
        assert frames[-1].id.endswith(f"{1_700_000_000 + len(data) - 1}.000000000")
        assert "cut short" in remarks[0] and "the part that could be read is used" in remarks[0], remarks


@pytest.mark.parametrize(("column", "value"), [("data", None), ("data", 7), ("timestamp", "soon"), ("timestamp", None)])
def test_a_row_with_something_else_in_it_spoils_no_other(column: str, value: object, tmp_path: Path) -> None:
    bag = write_rosbag2(tmp_path / "walk", walk(3))
    database = sqlite3.connect(next(bag.glob("*.db3")))
    last = "SELECT max(messages.id) FROM messages JOIN topics ON topic_id = topics.id WHERE name = ?"
    with database:
        database.execute("CREATE TABLE loose AS SELECT * FROM messages")  # without the types of the columns
        database.execute(f"UPDATE loose SET {column} = ? WHERE id = ({last})", (value, CAMERA))
        database.execute("DROP TABLE messages")
        database.execute("ALTER TABLE loose RENAME TO messages")
    database.close()
    with open_recording(bag) as recording:
        frames = recording.frames
        good = [frame for frame in frames if frame.nanoseconds and frame.nanoseconds >= START]
        assert len(frames) == 3 and [frame.load() for frame in good[:2]] == [jpeg(0), jpeg(1)]
        if column == "data":
            with pytest.raises(InvalidRecording, match="A message is damaged"):
                next(frame for frame in frames if frame not in good[:2]).load()


def test_a_time_that_no_clock_tells_spoils_no_other(tmp_path: Path) -> None:
    said = [compressed(0, jpeg(0), received=2**64 - 1), compressed(START, jpeg(1))]
    with open_recording(write_mcap(tmp_path / "walk.mcap", said)) as recording:
        assert [frame.load() for frame in recording.frames] == [jpeg(1), jpeg(0)]


def test_no_more_is_unpacked_than_a_chunk_may_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.recordings.storage.MOST_UNPACKED", 20_000)
    said = [compressed(START + index * SECOND, bytes(15_000)) for index in range(4)]
    for writer in ("ros1-bz2", "ros1-lz4", "mcap-zstd", "mcap-lz4"):
        (tmp_path / writer).mkdir()
        with open_recording(WRITERS[writer](tmp_path / writer, said)) as recording:
            assert len(recording.frames) < 2, writer
            assert "chunk" in recording.remarks[0], writer
    large = write_rosbag2(tmp_path / "large", [compressed(START, bytes(30_000))], packed="message")
    with pytest.raises(InvalidRecording, match="too large"):
        open_recording(large)


def test_of_a_chunk_that_unpacks_to_more_than_it_says_the_beginning_is_read(tmp_path: Path) -> None:
    for kind, path in hostile(tmp_path, 100_000).items():
        storage = STORAGES[path.suffix](path)
        assert "bytes only the beginning is read" in str(storage.problem), kind
        storage.close()


@pytest.mark.thorough
@pytest.mark.parametrize(
    "writer", ["sqlite-file-alone", "mcap-zstd", "mcap-plain", "mcap-no-chunks", "ros1", "ros1-lz4"]
)
def test_a_bag_with_a_bit_turned_over_loses_few_frames_or_is_refused(writer: str, tmp_path: Path) -> None:
    path = WRITERS[writer](tmp_path, walk(12))
    whole, written = path.read_bytes(), {jpeg(index) for index in range(12)}
    kept = []
    for _, data in damaged(whole, cuts=5, flips=40):
        path.write_bytes(data)
        found = tried(by_recordings, path, written)
        assert not found["other errors"]
        kept.append(found["frames"])
    assert sum(kept[5:]) >= 0.9 * 40 * 12  # one bit spoils a frame, or those of a chunk
    assert all(one >= 12 * (number + 1) / 6 - 6 for number, one in enumerate(kept[:5]))


def test_a_recorder_that_was_killed_leaves_a_database_without_metadata(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "walk", walk())
    (path / "metadata.yaml").unlink()
    assert len(loaded(path)[0]) == 6


def test_a_bag_in_several_files_is_one_bag(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "walk", walk(4))
    more = write_rosbag2(
        tmp_path / "more", [compressed(START + (10 + index) * SECOND, jpeg(index)) for index in (4, 5)]
    )
    shutil.move(next(more.glob("*.db3")), path / "walk_10.db3")
    frames, data, remarks = loaded(path)
    assert data == [jpeg(index) for index in range(6)]
    assert len({frame.id for frame in frames}) == 6 and remarks == []


@pytest.mark.parametrize("content", [b"", bytes(4096), b"this is no bag " * 500])
@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_a_file_of_a_bag_that_is_none_is_left_out(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "walk", walk(4), plugin="sqlite3" if suffix == ".db3" else "mcap")
    (path / "metadata.yaml").unlink()
    (path / f"walk_1{suffix}").write_bytes(content)
    frames, data, remarks = loaded(path)
    assert len(frames) == 4 and data == [jpeg(index) for index in range(4)]
    (remark,) = remarks
    assert remark.startswith("1 of 2 files are left out, and the others are read: ") and f"walk_1{suffix}" in remark
    (path / f"walk_0{suffix}").write_bytes(content)
    (path / f"walk{suffix}").write_bytes(content)
    with pytest.raises(InvalidRecording, match="walk"):
        open_recording(path)


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ([image(START + n, 8, 8, "32FC1", bytes(256), 32) for n in range(20)], "The encoding '32FC1' is not read"),
        ([compressed(START + n, b"\0\0\0\1video", form="h264") for n in range(20)], "h264 is another transport"),
        ([compressed(START + n, b"?", form="16UC1; compressedDepth png") for n in range(20)], "a depth image"),
    ],
)
def test_a_topic_of_which_no_picture_can_be_used_is_refused_once(said: list[Said], why: str, tmp_path: Path) -> None:
    with open_recording(write_mcap(tmp_path / "deep.mcap", said)) as recording:
        with pytest.raises(InvalidRecording, match=f"None of the 20 frames of deep can be used. .*{why}"):
            recording.check_format()
        recording.frames = [*recording.frames[:3], replace(recording.frames[0], load=lambda: jpeg(1))]
        recording.check_format()


def test_a_bag_of_videos_names_them(tmp_path: Path) -> None:
    path = write_foxglove(tmp_path / "a.mcap", "json", [("/front/video", "CompressedVideo", 1, {"format": "h264"})])
    with pytest.raises(UnknownTopic, match=r"Videos are not read, as /front/video \(foxglove.CompressedVideo\): repub"):
        open_recording(path)


@pytest.mark.parametrize("name", ["empty.db3", "empty.mcap", "empty.bag", "text.db3", "text.mcap", "text.bag"])
def test_a_file_that_is_no_bag_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("" if name.startswith("empty") else "this is no bag " * 500)
    with pytest.raises(InvalidRecording, match=name):
        open_recording(tmp_path / name)
    with pytest.raises(InvalidRecording, match="No such file"):
        open_recording(tmp_path / f"missing-{name}")


@pytest.mark.parametrize("writer", ["sqlite", "mcap-zstd", "ros1"])
def test_topics_that_do_not_fit_are_refused_with_those_that_do(writer: str, tmp_path: Path) -> None:
    second = [compressed(START + index, jpeg(index), "/rear/compressed") for index in range(2)]
    path = WRITERS[writer](tmp_path, [*walk(2), *second])
    with pytest.raises(UnknownTopic, match="2 topics of pictures") as several:
        open_recording(path)
    listed = "/camera/image_raw/compressed (sensor_msgs/msg/CompressedImage, 2 messages)"
    assert listed in str(several.value) and "/rear/compressed" in str(several.value)
    assert len(loaded(path, "/rear/compressed")[0]) == 2
    with pytest.raises(UnknownTopic, match=r"no topic '/front'.*/rear/compressed"):
        open_recording(path, "/front")
    with pytest.raises(UnknownTopic, match=r"/odom of .* is of the type nav_msgs/msg/Odometry, not of pictures"):
        open_recording(path, ODOMETRY)
    with pytest.raises(UnknownTopic, match=r"is of the type .*CompressedImage, not of poses"):
        open_recording(path, CAMERA, Poses(topic=CAMERA))


def test_bags_without_pictures_are_refused(tmp_path: Path) -> None:
    listed = r"a.mcap has no topic of pictures. It has these topics: /odom \(nav_msgs/msg/Odometry, 1 messages\)."
    with pytest.raises(UnknownTopic, match=rf"{listed}$"):
        open_recording(write_mcap(tmp_path / "a.mcap", [moved(START, 0, 0)]))
    with pytest.raises(UnknownTopic, match=r"b.mcap has no topic of pictures. It has no topics at all.$"):
        open_recording(write_mcap(tmp_path / "b.mcap", []))
    many = [replace(moved(START, 0, 0), topic=f"/odom_{number}") for number in range(30)]
    with pytest.raises(UnknownTopic, match=r"messages\); and 10 more.$"):
        open_recording(write_mcap(tmp_path / "d.mcap", many))
    (tmp_path / "c").mkdir()
    (tmp_path / "c/x.mcap").write_bytes((tmp_path / "b.mcap").read_bytes())
    with pytest.raises(UnknownTopic, match="has no topic"):
        open_recording(tmp_path / "c", CAMERA)


def test_unsorted_bags_are_read_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    order = [0, 3, 1, 2, 5, 4]
    said = [compressed(START + index * SECOND, jpeg(index), received=START + n) for n, index in enumerate(order)]
    for writer in ("sqlite", "mcap-zstd", "ros1"):
        (tmp_path / writer).mkdir()
        _, data, remarks = loaded(WRITERS[writer](tmp_path / writer, said))
        assert data == [jpeg(index) for index in range(6)]
        assert "go back 2 times in the bag, by up to 2.000 s" in remarks[0]


def test_clocks_that_jump_and_stamps_that_are_missing_are_remarked(tmp_path: Path) -> None:
    stamps = [5, 6, 7, 1_700_000_000, 1_700_000_001, 1_700_000_001]
    said = [compressed(stamp * SECOND, jpeg(index), received=START + index) for index, stamp in enumerate(stamps)]
    frames, _, remarks = loaded(write_mcap(tmp_path / "a.mcap", said))
    assert "jump ahead 1 times, by up to 1699999993 s" in remarks[0]
    assert remarks[1].startswith(f"1 messages of {CAMERA} have the stamp of another one, but other bytes")
    assert [frame.id.rpartition("-")[2] for frame in frames][-2:] == ["1700000001.000000000", "1700000001.000000000~2"]

    said = [compressed(0, jpeg(index), received=START + index * SECOND) for index in range(3)]
    frames, _, remarks = loaded(write_rosbag2(tmp_path / "b", said))
    assert "3 of 3 messages" in remarks[0] and "have no stamp" in remarks[0]
    assert [frame.nanoseconds for frame in frames] == [START + index * SECOND for index in range(3)]


@pytest.mark.parametrize("writer", ["sqlite", "mcap-zstd", "ros1"])
def test_a_message_that_is_repeated_is_taken_once_and_remarked(writer: str, tmp_path: Path) -> None:
    """As a bag that was recorded by two recorders, or merged with a part of itself, has them."""
    taken = [(0, 0), (1, 1), (1, 1), (1, 2), (2, 1), (1, 1), (2, 3)]  # second, picture
    said = [compressed(START + at * SECOND, jpeg(seed), received=START + n) for n, (at, seed) in enumerate(taken)]
    frames, data, remarks = loaded(WRITERS[writer](tmp_path, said))
    assert data == [jpeg(seed) for seed in (0, 1, 2, 1, 3)]
    ends = [frame.id.rpartition("-17000000")[2] for frame in frames]
    assert ends == ["00.000000000", "01.000000000", "01.000000000~2", "02.000000000", "02.000000000~2"]
    told = [remark for remark in remarks if "another one" in remark]
    assert told[0].startswith(f"2 messages of {CAMERA} repeat another one, with its stamp and its bytes")
    assert told[1].startswith(f"2 messages of {CAMERA} have the stamp of another one, but other bytes")


@pytest.mark.parametrize("kind", ["geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"])
@pytest.mark.parametrize("writer", ["sqlite", "ros1"])
def test_poses_come_from_stamped_poses(kind: str, writer: str, tmp_path: Path) -> None:
    half = 0.5**0.5
    path = WRITERS[writer](
        tmp_path,
        [
            moved(START, 0, 0, kind=kind),
            compressed(START + SECOND // 4, jpeg(0)),
            moved(START + SECOND, 4, 8, (0, 0, half, half), kind),
            compressed(START + 2 * SECOND, jpeg(1)),
        ],
    )
    with open_recording(path, poses=ODOM) as recording:
        between, beyond = recording.frames
    assert between.pose is not None and beyond.pose is None
    assert between.pose.model_dump() == pytest.approx(
        {"x": 1, "y": 2, "z": 0.5, "latitude": None, "longitude": None, "heading": 22.5}
    )
    assert "1 of 2 frames get no pose" in recording.remarks[0]


def test_poses_come_from_satellites_without_a_heading(tmp_path: Path) -> None:
    seen = [compressed(START + index * SECOND, jpeg(index)) for index in range(3)]
    told = [fix(START, 10, 179.9), fix(START + SECOND, 0, 0, -1), fix(START + 2 * SECOND, 12, -179.9)]
    path = write_mcap(tmp_path / "a.mcap", [*seen, *told])
    with open_recording(path, poses=Poses(topic="/fix", largest_gap=3, most_speed=1e6)) as recording:
        middle = recording.frames[1].pose
    assert middle is not None and middle.heading is None and middle.latitude == pytest.approx(11)
    assert abs(middle.longitude or 0) == pytest.approx(180)
    assert "1 messages of /fix have no position" in recording.remarks[0]
    with pytest.raises(InvalidTrajectory, match="No message of /fix has a position"):
        open_recording(write_mcap(tmp_path / "b.mcap", [seen[0], told[1]]), poses=Poses(topic="/fix"))


def test_without_the_extra_the_error_names_it(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", walk(1))
    program = (
        "import sys\nsys.modules['rosbags'] = None\n"
        "from pathlib import Path\nfrom core.errors import MissingExtra\nfrom core.recordings import open_recording\n"
        "try:\n    open_recording(Path(sys.argv[1]))\nexcept MissingExtra as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, check=True)
    assert "placerec[bags]" in done.stdout
