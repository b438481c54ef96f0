"""Poses that no vehicle drives: each kind of fault, in each source of poses."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from core.errors import InvalidTrajectory
from core.recordings import Poses, Recording, open_recording
from core.recordings.keyframes import Left, Spacing, keyframes
from core.recordings.paths import check_lost_poses, traverse_of, way_of
from core.recordings.plausibility import Source, judge
from core.recordings.trajectory import JudgedTrajectory
from core.recordings.trajectory_files import read_trajectory
from tests.core.recordings.bags import ODOMETRY, SECOND, START, Said, compressed, fix, moved, write_mcap
from tests.core.recordings.test_transforms import said as transformed
from tests.core.recordings.test_transforms import transform
from tests.service.scenes import jpeg

FRAMES, RATE = 20, 10
LEVEL = (0.0, 0.0, 0.0, 1.0)


@dataclass
class Sample:
    """One pose of a walk of a metre a second along x, ten a second."""

    number: int
    x: float
    y: float = 0.0
    turn: tuple[float, float, float, float] = LEVEL

    @property
    def stamp(self) -> int:
        return START + self.number * SECOND // RATE


Fault = Callable[[list[Sample]], None]


def walked(fault: Fault) -> list[Sample]:
    samples = [Sample(number, number / RATE) for number in range(FRAMES * RATE)]
    fault(samples)
    return samples


def clean(samples: list[Sample]) -> None:
    """Nothing is wrong."""


def spike(samples: list[Sample]) -> None:
    samples[55].x = 1e6


def long_spike(samples: list[Sample]) -> None:
    for sample in samples[50:58]:
        sample.x += 30


def three_spikes(samples: list[Sample]) -> None:
    for number in (35, 80, 81, 145):
        samples[number].x = -4e4


def at_both_ends(samples: list[Sample]) -> None:
    samples[0].x = samples[-1].x = 5e6


def endless(samples: list[Sample]) -> None:
    samples[63].x = 1e308


def no_number(samples: list[Sample]) -> None:
    samples[63].x = math.nan


def two_publishers(samples: list[Sample]) -> None:
    for sample in samples[1::2]:
        sample.x += 500


def apart_after_a_while(samples: list[Sample]) -> None:
    """Both odometries begin at 0, and the wheels of one slip."""
    for sample in samples[1::2]:
        sample.y = sample.x


def a_rare_publisher(samples: list[Sample]) -> None:
    for sample in samples[3::6]:
        sample.x += 500


def restart(samples: list[Sample]) -> None:
    for sample in samples[100:]:
        sample.x -= 10


def without_headings(samples: list[Sample]) -> None:
    for sample, turn in zip(samples[40:52], [(0.0,) * 4, (math.nan,) * 4] * 6, strict=True):
        sample.turn = turn


def turned_over(samples: list[Sample]) -> None:
    for sample in samples[40:43]:
        sample.turn = (0.0, 0.0, 1.0, 0.0)


def bag(samples: Iterable[Sample], folder: Path) -> tuple[Path, Poses]:
    said = [moved(one.stamp, one.x, one.y, one.turn) for one in samples]
    return written(folder, said), Poses(topic=ODOMETRY)


def transforms(samples: Iterable[Sample], folder: Path) -> tuple[Path, Poses]:
    said = [
        transformed("/tf", one.stamp, transform("odom", "base", one.stamp, (one.x, one.y, 0), turned=one.turn))
        for one in samples
    ]
    said += [transformed("/tf", START, transform("base", "camera", START, (0, 0, 1)))]
    return written(folder, said), Poses(topic="/tf")


def tum(samples: Iterable[Sample], folder: Path) -> tuple[Path, Poses]:
    lines = [
        f"{one.stamp // SECOND}.{one.stamp % SECOND:09d} {one.x} {one.y} 0.5 {' '.join(map(str, one.turn))}\n"
        for one in samples
    ]
    (folder / "path.tum").write_text("".join(lines))
    return written(folder, []), Poses(file=folder / "path.tum")


def written(folder: Path, said: list[Said]) -> Path:
    """A bag with a frame a second, and poses; frames need no pictures here."""
    seen = [compressed(START + number * SECOND, b"%d" % number) for number in range(FRAMES)]
    return write_mcap(folder / "walk.mcap", sorted([*seen, *said], key=lambda one: one.received))


SOURCES = {"bag": bag, "tf": transforms, "tum": tum}
NAMES = {"bag": "/odom", "tf": "/tf (camera in odom)", "tum": "path.tum"}


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize(
    ("fault", "posed", "lost", "told"),
    [
        (clean, 20, 0, ()),
        (spike, 20, 0, ("leaps once, by 999 99", "within 0.1 s", "those poses are left out")),
        (long_spike, 20, 0, ("leaps once, by 30.1 m within 0.1 s", "(8 ")),
        (three_spikes, 20, 0, ("leaps 3 times, by up to 40 014 m within 0.1 s (first ",)),
        (at_both_ends, 19, 1, ("leaps 2 times, by up to 5 000 000 m",)),
        (endless, 20, 0, ("1 of 200 ", "a number that is none, or a position beyond 1e+09 m (first ")),
        (no_number, 20, 0, ("1 of 200 ", "a number that is none")),
        (two_publishers, 0, 20, ("alternates between two publishers", "x 0.0 to 19.8", "x 500.1 to 519.9", "nobody")),
        (apart_after_a_while, 3, 17, ("alternates between two publishers", "nobody can know which are right")),
        (a_rare_publisher, 20, 0, ("alternates between two publishers", "x 500.3 to", "the latter are left out")),
        (restart, 10, 0, ("leaps once, by 9.9 m within 0.1 s", "begins anew", "10 of 20 frames are of a part", "~2")),
    ],
)
def test_what_no_vehicle_drives_is_left_out_and_said(
    source: str, fault: Fault, posed: int, lost: int, told: tuple[str, ...], tmp_path: Path
) -> None:
    path, poses = SOURCES[source](walked(fault), tmp_path)
    with open_recording(path, poses=poses) as recording:
        right = [frame for frame in recording.frames if frame.pose is not None]
        for frame in right:
            assert frame.nanoseconds is not None and frame.pose is not None
            assert frame.pose.x == pytest.approx((frame.nanoseconds - START) / SECOND, abs=1e-6), "a true one, or none"
        said = [one for one in recording.remarks if "before the first" not in one]
        assert (len(right), recording.lost) == (posed, lost), said
        for words in told:
            assert sum(words in one for one in said) == 1, (words, said)
        if told:
            assert any(NAMES[source].partition(" ")[0] in one for one in said)
            assert any(f"{(START + 1) // SECOND}"[:7] in one or "in line" in one for one in said), "it says where"
        else:
            assert said == []


@pytest.mark.parametrize("source", ["bag", "tum"])
def test_a_pose_without_an_orientation_has_a_position(source: str, tmp_path: Path) -> None:
    path, poses = SOURCES[source](walked(without_headings), tmp_path)
    with open_recording(path, poses=poses) as recording:
        headings = [frame.pose.heading for frame in recording.frames if frame.pose is not None]
        (told,) = recording.remarks
    assert headings == [*[0.0] * 4, None, None, *[0.0] * 14]
    assert told.startswith("12 of 200 ") and "have no orientation (first " in told
    assert "line 41" in told or "1700000004.000 s" in told


def test_a_transform_without_an_orientation_is_left_out(tmp_path: Path) -> None:
    path, poses = transforms(walked(without_headings), tmp_path)
    with open_recording(path, poses=poses) as recording:
        assert "12 of 200 transforms of /tf from odom to base have a number that is none" in recording.remarks[0]
        assert "first at 1700000004.000 s" in recording.remarks[0]
        assert recording.lost == 0 and all(frame.pose is not None for frame in recording.frames)


@pytest.mark.parametrize("source", ["bag", "tum"])
def test_an_orientation_that_leaps_is_none(source: str, tmp_path: Path) -> None:
    path, poses = SOURCES[source](walked(turned_over), tmp_path)
    with open_recording(path, poses=poses) as recording:
        headings = [frame.pose.heading for frame in recording.frames if frame.pose is not None]
        (told,) = recording.remarks
    assert headings == [*[0.0] * 4, None, *[0.0] * 15]
    assert "leaps once, by 180° within 0.1 s" in told and "those headings are left out (3 " in told


def test_frames_behind_a_restart_are_a_traverse_of_their_own(tmp_path: Path) -> None:
    path, poses = bag(walked(restart), tmp_path)
    with open_recording(path, poses=poses) as recording:
        assert [traverse_of("monday", one) for one in recording.frames] == ["monday"] * 10 + ["monday~2"] * 10
        assert way_of(recording.frames) == "path 9.0 m, extent 9.0 × 0.0 m, 10 of 20 frames with a pose"
        check_lost_poses(recording)


@pytest.mark.parametrize("source", SOURCES)
def test_keyframes_of_each_part_are_chosen_by_its_own_odometry(source: str, tmp_path: Path) -> None:
    path, poses = SOURCES[source](walked(restart), tmp_path)
    with open_recording(path, poses=poses) as recording:
        left = Left()
        chosen = list(keyframes(recording.frames, Spacing(metres=4), left=left))
        taken = [(one.nanoseconds - START) // SECOND for one in chosen if one.nanoseconds is not None]
    assert set(np.diff([one for one in taken if one < 10])) == {4}
    assert set(np.diff([one for one in taken if one >= 10])) == {4} and left.unjudged <= 2
    assert [one.pose is None for one in chosen] == [one >= 10 for one in taken], (
        "no pose of other coordinates is stored"
    )


def test_the_remark_says_which_parts_have_poses_in_their_order(tmp_path: Path) -> None:
    samples = walked(clean)
    for sample in samples:
        sample.x += 90 * (sample.number // 17)
    path, poses = bag(samples, tmp_path)
    with open_recording(path, poses=poses) as recording:
        told = recording.remarks[-1]
    assert "Poses are those of the first one; there are none of ~2, ~3, ~4, ~5, ~6, ~7, ~8, ~9 and 3 more" in told


def test_the_long_part_behind_an_early_restart_has_the_poses(tmp_path: Path) -> None:
    samples = walked(clean)
    for sample in samples[:25]:
        sample.x += 70
    path, poses = bag(samples, tmp_path)
    with open_recording(path, poses=poses) as recording:
        assert [one.segment for one in recording.frames] == [1] * 3 + [2] * 17
        assert [one.pose is not None for one in recording.frames] == [False] * 3 + [True] * 17
        assert "Poses are those of ~2; there are none of the first one" in recording.remarks[-1]


def test_more_than_a_tenth_of_lost_poses_is_refused(tmp_path: Path) -> None:
    path, poses = bag(walked(two_publishers), tmp_path)
    with open_recording(path, poses=poses) as recording:
        assert way_of(recording.frames) is None
        with pytest.raises(InvalidTrajectory, match=r"20 of 20 frames lose .*alternates between .*--allow-lost-poses"):
            check_lost_poses(recording)


@pytest.mark.parametrize(
    ("frame", "parts"), [("map", 1), ("robot/map", 1), ("odom", 2), ("camera", 2)], ids=lambda one: str(one)
)
def test_a_jump_in_a_frame_of_the_world_corrects_the_position(frame: str, parts: int, tmp_path: Path) -> None:
    samples = walked(clean)
    for sample in samples[100:]:
        sample.x += 40

    def told(one: Sample) -> Said:
        plain = moved(one.stamp, one.x, one.y, kind="geometry_msgs/msg/PoseStamped")

        def make(store: Any) -> Any:
            message = plain.make(store)
            message.header.frame_id = frame
            return message

        return Said(plain.topic, plain.kind, plain.received, make)

    path = written(tmp_path, [told(one) for one in samples])
    with open_recording(path, poses=Poses(topic=ODOMETRY)) as recording:
        assert max(one.segment for one in recording.frames) == parts
        assert sum(one.pose is not None for one in recording.frames) == (20 if parts == 1 else 10)
        assert any("goes on from there" in one for one in recording.remarks)
    # Nothing lies between where it was believed to be and where it was.
    found = JudgedTrajectory.of_samples(
        [one.stamp for one in samples], [[one.x, 0, 0] for one in samples], [LEVEL] * 200, Source("x"), absolute=True
    )
    assert found.trajectory.at([samples[99].stamp + SECOND // 20], 1.5) == [None]


def located(samples: Iterable[Sample], folder: Path) -> tuple[Path, Poses]:
    """A receiver of ten fixes a second, which drives north."""
    said = [fix(one.stamp, 48 + one.x / 111_195, 2 + one.y) for one in samples]
    return written(folder, said), Poses(topic="/fix")


@pytest.mark.parametrize(
    ("wrong", "posed", "told"),
    [
        ([], 20, ()),
        ([(30, 0.0, 0.0), (31, 1e-7, 0.0), (32, 0.0, 0.0)], 20, ("3 of 200 messages of /fix are at latitude 0, long",)),
        ([(30, 48.5, 2.0)], 20, ("/fix leaps once, by 55 59", "at 1700000003.000 s")),
        ([(30, 91.0, 2.0)], 20, ("a position that is not on the Earth",)),
        ([(number, 0.0, 0.0) for number in range(200)], 0, ("200 of 200 messages of /fix are at latitude 0, long",)),
    ],
)
def test_fixes_that_are_none(
    wrong: list[tuple[int, float, float]], posed: int, told: tuple[str, ...], tmp_path: Path
) -> None:
    samples = walked(clean)
    for number, latitude, longitude in wrong:
        samples[number].x, samples[number].y = (latitude - 48) * 111_195, longitude - 2
    path, poses = located(samples, tmp_path)
    with open_recording(path, poses=poses) as recording:
        assert sum(one.pose is not None for one in recording.frames) == posed
        assert recording.lost == 20 - posed
        for frame in recording.frames:
            assert frame.pose is None or frame.pose.latitude == pytest.approx(48, abs=1e-3)
        for words in told:
            assert sum(words in one for one in recording.remarks) == 1, recording.remarks
        assert bool(told) == bool(recording.remarks)


def test_noise_of_satellites_is_no_leap_and_neither_are_stamps_that_queue() -> None:
    generator = np.random.default_rng(1)
    times = START + np.arange(600) * SECOND // RATE
    times[100:110] = times[110]  # ten messages that had waited
    way = 15 * np.arange(600)[:, None] / RATE * [1, 0, 0] + generator.normal(0, 3, (600, 3)) * [1, 1, 0]
    assert judge(times, way, None, Source("noisy")).remarks == []
    degrees = way / 111_195 * [1, 1.5, 0] + [48, 2, 0]
    assert judge(times, degrees, None, Source("noisy"), geographic=True).remarks == []


@pytest.mark.parametrize("rate", [1, 10, 100])
def test_a_car_that_drives_as_cars_can_is_believed(rate: int) -> None:
    """Full throttle to 55 m/s, an emergency braking, a stop, and a gap of twelve seconds on the way."""
    at = np.arange(0, 90, 1 / rate)
    speed = np.interp(at, [0, 10, 22, 45, 51.5, 60, 90], [0, 0, 55, 55, 0, 0, 25])
    way = np.cumsum(speed) / rate
    on = (at < 30) | (at > 42)
    found = judge((at[on] * SECOND).astype(np.int64), way[on, None] * [1, 0, 0], None, Source("car"))
    assert found.remarks == [] and found.kept.all() and not found.part.any()


def test_an_excursion_of_a_slow_receiver_costs_its_own_samples_alone() -> None:
    times, way = START + np.arange(120) * SECOND, 5.0 * np.arange(120)[:, None] * [1, 0, 0]
    way[60:65] += [0, 3000, 0]
    found = judge(times, way, None, Source("slow"))
    assert np.flatnonzero(~found.kept).tolist() == list(range(60, 65)) and not found.part[found.kept].any()


def test_a_leap_at_the_very_start_names_the_first_sample_that_is_left_out() -> None:
    times, way = START + np.arange(200) * SECOND // RATE, np.arange(200)[:, None] / RATE * [1, 0, 0]
    way[:3] += [900, 0, 0]
    found = judge(times, way, None, Source("start"))
    assert np.flatnonzero(~found.kept).tolist() == [0, 1, 2]
    assert "leaps once, by 900 m within 0.1 s (at 1700000000.000 s): those poses are left out (3 " in found.remarks[0]


def test_the_limit_of_speed_is_a_setting() -> None:
    """An aeroplane."""
    times, way = START + np.arange(100) * SECOND, 240.0 * np.arange(100)[:, None] * [1, 0, 0]
    assert not judge(times, way, None, Source("air")).kept.all() or judge(times, way, None, Source("air")).part.any()
    assert judge(times, way, None, Source("air"), most_speed=300).remarks == []


def test_a_file_with_lines_that_are_none_gives_the_others(tmp_path: Path) -> None:
    path = tmp_path / "path.txt"
    lines = [f"{number} {number} 0 0 0 0 0 1" for number in range(20)]
    lines[4], lines[7], lines[9] = "4 nan 0 0 0 0 0 1", "nan nan nan nan nan nan nan nan", "9 9 0 0 0 0 0 inf"
    path.write_text("# a walk\n" + "\n".join(lines))
    found = read_trajectory(path)
    times = found.judged.trajectory.nanoseconds // SECOND
    assert times.tolist() == [one for one in range(20) if one not in (4, 7)]
    none, without = found.judged.remarks
    assert (
        none.startswith("2 of 20 lines of path.txt have a number that is none") and "first in line 6, 4.000 s" in none
    )
    assert without.startswith("1 of 20 lines of path.txt have no orientation (first in line 11, 9.000 s)")
    matrix = "1 0 0 {} 0 1 0 0 0 0 1 0"
    path.write_text("\n".join(matrix.format(3e6 if number == 11 else number) for number in range(20)))
    assert "leaps once" in read_trajectory(path).judged.remarks[0]
    path.write_text("\n".join(("nan " * 12 if number == 11 else matrix.format(number)) for number in range(20)))
    found = read_trajectory(path)
    assert found.poses == 20 and len(found.judged.trajectory) == 19 and "in line 12" in found.judged.remarks[0]


# Frames with poses of their own


def photographed(path: Path, latitude: float, longitude: float, taken: datetime | None = None) -> None:
    exif, to = Image.Exif(), "%Y:%m:%d %H:%M:%S"
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: (latitude, 0.0, 0.0), 3: "E", 4: (longitude, 0.0, 0.0)})
    if taken is not None:
        exif.get_ifd(ExifTags.IFD.Exif).update({0x9003: taken.strftime(to), 0x9011: "+00:00"})
    Image.new("RGB", (32, 24)).save(path, "JPEG", exif=exif.tobytes())


def listed(folder: Path, rows: list[dict[str, object]]) -> Recording:
    with (folder / "places.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["file", *rows[0]])
        writer.writeheader()
        for number, row in enumerate(rows):
            (folder / f"{number:03d}.jpg").write_bytes(jpeg(number % 3))
            writer.writerow({"file": f"{number:03d}.jpg", **row})
    return open_recording(folder)


NOON = datetime(2026, 11, 20, 12, tzinfo=UTC)


@pytest.mark.parametrize("timed", [True, False])
def test_zeros_and_leaps_of_photographs_are_no_poses(timed: bool, tmp_path: Path) -> None:
    for number in range(12):
        latitude, longitude = (0.0, 0.0) if number == 3 else (48.5 if number == 6 else 48 + number * 1e-4, 2.0)
        taken = NOON + timedelta(seconds=number) if timed else None
        photographed(tmp_path / f"{number:02d}.jpg", latitude, longitude, taken)
    with open_recording(tmp_path) as recording:
        without = [frame.name for frame in recording.frames if frame.pose is None]
        zeros, *leaps = recording.remarks
    assert without == (["03.jpg", "06.jpg"] if timed else ["03.jpg"])
    assert "1 of 12 frames of " in zeros and "latitude 0, longitude 0" in zeros and "03.jpg" in zeros
    assert recording.lost == len(without)
    assert ["55 5" in leap and "06.jpg" in leap for leap in leaps] == [True] * timed


def test_a_list_with_times_is_judged_in_their_order(tmp_path: Path) -> None:
    order = [7, 3, 11, 0, 5, 9, 1, 2, 10, 4, 8, 6]
    with listed(
        tmp_path,
        [
            {"x": 9e5 if at == 5 else at, "y": 0, "timestamp": (NOON + timedelta(seconds=at)).isoformat()}
            for at in order
        ],
    ) as recording:
        assert [frame.name for frame in recording.frames if frame.pose is None] == ["004.jpg"]
        (told,) = recording.remarks
        assert "leaps once, by 899 996 m within 1 s (004.jpg)" in told


def test_of_a_list_without_times_what_is_far_away_is_remarked(tmp_path: Path) -> None:
    with listed(tmp_path, [{"x": 5e6 if at == 5 else at, "y": 0} for at in (7, 3, 11, 0, 5, 9)]) as recording:
        assert all(frame.pose is not None for frame in recording.frames) and recording.lost == 0
        (told,) = recording.remarks
        assert "1 of 6 frames of " in told and "4 999 992 m" in told and "004.jpg" in told


def test_a_million_samples_are_judged_at_once() -> None:
    count = 1_000_000
    way = np.zeros((count, 3))
    way[:, 0] = np.arange(count) / 10
    way[np.random.default_rng(2).integers(1000, count, 500), 1] = 1e6
    found = judge(START + np.arange(count) * SECOND // 100, way, None, Source("long"))
    assert count - 500 <= found.kept.sum() < count and not found.part.any()
