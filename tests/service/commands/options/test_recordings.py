"""Bags, videos and folders of other formats, enrolled by ``placerec enrol``."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from core.store import Directory
from tests.core.recordings.bags import (
    CAMERA,
    ODOMETRY,
    ROS2,
    SECOND,
    START,
    WRITERS,
    Said,
    compressed,
    fix,
    moved,
    walk,
    write_mcap,
    write_ros1,
)
from tests.core.recordings.test_transforms import said as transformed
from tests.core.recordings.test_transforms import transform
from tests.core.recordings.test_video import write_video
from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import ROOT, Server


def stored(data: Path, name: str) -> tuple[list[dict[str, Any]], Any]:
    """The places of a map as the disk has them, in their order, without the times of storing; and their descriptors."""
    atlas = Directory(data)
    try:
        map_ = atlas.get(name)
        map_.open()
        outline = map_.transfer.outline()
        places = []
        for one in outline:
            place = map_.place(one.id).model_dump(mode="json", exclude={"created_at", "updated_at"})
            places.append({**place, "digest": one.digest.hex(), "ordinal": one.ordinal})
        return places, map_.snapshot().descriptors_at(np.array([one.row for one in outline], np.int64))
    finally:
        atlas.close()


@pytest.mark.thorough
@pytest.mark.parametrize(
    "writer",
    [
        "sqlite",
        *(pytest.param(name, marks=pytest.mark.thorough) for name in ("mcap-of-rosbags", "ros1-lz4")),
    ],
)
def test_a_bag_gives_the_map_that_its_frames_in_a_folder_give(writer: str, placerec: Placerec, tmp_path: Path) -> None:
    bag = WRITERS[writer](tmp_path, walk(5))
    done = placerec("enrol", bag, "--map", "of-bag", "--create", "--pose-topic", ODOMETRY, "--sequence", "walk")
    assert "5 of 5 frames are places of of-bag, sequence walk: 5 created; 5 with a pose; 5 sent" in done.stdout

    folder = tmp_path / "folder"
    folder.mkdir()
    rows = ["file,id,x,y,z,heading,timestamp"]
    for index in range(5):
        (folder / f"{index}.jpg").write_bytes(jpeg(index))
        name = f"camera-image_raw-compressed-{1_700_000_000 + index}.000000000"
        rows.append(f"{index}.jpg,{name},{index},0,0.5,0,2023-11-14T22:13:{20 + index}Z")
    (folder / "places.csv").write_text("\n".join(rows) + "\n")
    placerec("enrol", folder, "--map", "of-folder", "--create", "--sequence", "walk")

    (of_bag, found), (of_folder, expected) = (stored(tmp_path / "data", name) for name in ("of-bag", "of-folder"))
    assert of_bag == of_folder and len(of_bag) == 5
    assert of_bag[2]["pose"]["x"] == 2 and of_bag[2]["timestamp"] == "2023-11-14T22:13:22Z"
    np.testing.assert_allclose(found, expected, atol=1e-5)

    again = placerec("enrol", bag, "--map", "of-bag", "--pose-topic", ODOMETRY, "--sequence", "walk")
    assert "5 unchanged" in again.stdout and "0 sent" in again.stdout


def small_walk(frames: int) -> list[Said]:
    return [compressed(START + index * SECOND, jpeg(index, 96, 72)) for index in range(frames)]


@pytest.mark.thorough
def test_killed_in_the_middle_and_run_again_nothing_is_sent_twice_or_missing(
    placerec: Placerec, tmp_path: Path, server: Server, map_id: str
) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", small_walk(120))
    words = ["enrol", bag, "--map", map_id, "--url", server.client.base_url]
    command = [sys.executable, "-m", "service.commands", *map(str, words)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (count := server.client.get(f"/v1/maps/{map_id}").json()["places"]):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait(60)
    assert 0 < count < 120

    done = placerec(*words)
    created, unchanged, sent = (
        int(re.findall(rf"(\d+) {word}", done.stdout)[0]) for word in ("created", "unchanged", "sent")
    )
    assert created + unchanged == 120 and unchanged >= count, "what was under way may still have been stored"
    assert created <= sent <= 120 - count
    assert [place.rpartition("-")[2] for place in server.places(map_id)] == [
        f"{1_700_000_000 + index}.000000000" for index in range(120)
    ]


@pytest.mark.thorough
def test_a_truncated_bag_enrols_what_it_holds_and_the_whole_one_the_rest(placerec: Placerec, tmp_path: Path) -> None:
    bag = write_ros1(tmp_path / "walk.bag", small_walk(60))
    whole = bag.read_bytes()
    bag.write_bytes(whole[: len(whole) // 2])
    first = placerec("enrol", bag, "--map", "lab", "--create")
    assert "walk.bag is cut short" in first.stderr and "the part that could be read is used" in first.stderr
    count = len(json.loads(placerec("maps", "places", "list", "lab", "--json").stdout))
    assert 10 < count < 40

    bag.write_bytes(whole)
    second = placerec("enrol", bag, "--map", "lab")
    assert f"{60 - count} created, {count} unchanged" in second.stdout and f"{60 - count} sent" in second.stdout


@pytest.mark.thorough
def test_a_video_is_enrolled_by_its_keyframes(placerec: Placerec, tmp_path: Path) -> None:
    write_video(tmp_path / "walk.mp4")
    timed = placerec("enrol", tmp_path / "walk.mp4", "--map", "timed", "--create", "--every-seconds", 1)
    assert "3 of 12 frames are keyframes" in timed.stderr and "3 of 3 frames are places" in timed.stdout
    seen = placerec("enrol", tmp_path / "walk.mp4", "--map", "seen", "--create", "--every-change", 0.3)
    assert "4 of 12 frames are keyframes" in seen.stderr  # each scene once
    ids = [place["id"] for place in json.loads(placerec("maps", "places", "list", "seen", "--json").stdout)]
    assert ids == ["walk-000000", "walk-000003", "walk-000006", "walk-000009"]
    again = placerec("enrol", tmp_path / "walk.mp4", "--map", "seen", "--every-change", 0.3)
    assert "4 unchanged" in again.stdout and "0 sent" in again.stdout


@pytest.mark.thorough
def test_of_a_video_the_frames_of_a_stop_are_left_out_unless_wanted(placerec: Placerec, tmp_path: Path) -> None:
    write_video(tmp_path / "walk.mp4")
    moved = placerec("enrol", tmp_path / "walk.mp4", "--map", "moved", "--create")
    assert "8 of 12 frames show the same" in moved.stderr and "4 of 4 frames are places" in moved.stdout
    whole = placerec("enrol", tmp_path / "walk.mp4", "--map", "whole", "--create", "--keep-standing")
    assert "12 of 12 frames are places" in whole.stdout


@pytest.mark.thorough
@pytest.mark.parametrize("where", ["--url", "--data-dir"])
def test_what_the_mask_of_a_camera_covers_is_no_stop(
    placerec: Placerec, tmp_path: Path, server: Server, where: str
) -> None:
    """A robot's body takes up 80 % of the picture, and a little of the rest changes as it drives."""

    def seen(number: int) -> bytes:
        pixels = scene(0, 320, 240)
        pixels[:48] = 128 + 0.08 * (scene(1 + number, 320, 240)[:48].astype(np.float32) - 128)
        return encoded(pixels, ".png")

    bag = [compressed(START + number * SECOND, seen(number), form="png") for number in range(4)]
    words = ("enrol", write_mcap(tmp_path / "walk.mcap", bag), "--map", f"masked{where}")
    server.create_map(f"masked{where}")
    server.client.put(f"/v1/maps/masked{where}/cameras/front", json={"mask": BODY}).raise_for_status()
    at = ("--url", f"http://127.0.0.1:{server.port}")
    if where == "--data-dir":
        file = tmp_path / "masked.tar"
        file.write_bytes(server.client.get(f"/v1/maps/masked{where}/export").content)
        at = ("--data-dir", str(tmp_path / "data"))
        placerec("maps", "import", file, *at)
    assert "4 of 4 frames are places" in placerec(*words, "--camera", "front", *at).stdout
    whole = placerec("enrol", *words[1:], "--sequence", "without", "--id-prefix", "without-", *at)
    assert "3 of 4 frames show the same" in whole.stderr, "without the mask they show the body"


BODY = {"polygons": [[[0, 0.2], [1, 0.2], [1, 1], [0, 1]]]}
"""What covers four fifths of the picture."""


@pytest.mark.thorough
def test_keyframes_of_a_bag_follow_its_poses(placerec: Placerec, tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", walk(6))
    words = ("enrol", bag, "--map", "lab", "--create", "--pose-topic", ODOMETRY)
    done = placerec(*words, "--every-metres", 2)
    assert "3 of 6 frames are keyframes" in done.stderr
    none = placerec("enrol", bag, "--map", "lab", "--every-metres", 2, status=1)
    assert "No frame of walk can be judged by the --every options" in none.stderr


@pytest.mark.thorough
def test_a_folder_of_other_formats_equals_one_of_png(placerec: Placerec, tmp_path: Path) -> None:
    for name in ("bmp", "png", "ppm"):
        (tmp_path / name).mkdir()
        for index in range(3):
            (tmp_path / name / f"{index}.{name}").write_bytes(encoded(scene(index, 96, 72), f".{name}"))
        placerec("enrol", tmp_path / name, "--map", name, "--create", "--sequence", "walk")
    (of_bmp, found), (of_png, expected), (of_ppm, _) = (
        stored(tmp_path / "data", name) for name in ("bmp", "png", "ppm")
    )
    assert of_bmp == of_ppm  # digests as well: the same PNG bytes
    assert [place["id"] for place in of_bmp] == [place["id"] for place in of_png] == ["0", "1", "2"]
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.thorough
def test_poses_come_from_satellites_and_files(placerec: Placerec, tmp_path: Path) -> None:
    seen = small_walk(3)
    told = [fix(START + index * SECOND, 48 + index, 2) for index in range(3)]
    bag = write_mcap(tmp_path / "walk.mcap", [*seen, *told])
    placerec("enrol", bag, "--map", "earth", "--create", "--pose-topic", "/fix")
    places = json.loads(placerec("maps", "places", "list", "earth", "--json").stdout)
    assert [place["pose"] for place in places] == [
        {"latitude": 48.0 + index, "longitude": 2.0, "z": 30.0} for index in range(3)
    ]

    file = tmp_path / "path.tum"
    file.write_text("1700000000 0 0 0 0 0 0 1\n1700000001 1 0 0 0 0 0 1\n")
    done = placerec("enrol", bag, "--map", "plane", "--create", "--trajectory", file)
    assert "2 with a pose" in done.stdout and "1 of 3 frames get no pose" in done.stderr
    file.write_text("1700000000 0 0\n")
    bad = placerec("enrol", bag, "--map", "plane", "--trajectory", file, status=1)
    assert "path.tum, line 1: 3 values are neither" in bad.stderr


def test_a_recording_that_loses_its_poses_is_refused_unless_allowed(placerec: Placerec, tmp_path: Path) -> None:
    told = [moved(START + n * SECOND // 10, n / 10 + 500 * (n % 2), 0.0) for n in range(40)]
    bag = write_mcap(tmp_path / "walk.mcap", [*small_walk(4), *told])
    words = ("enrol", bag, "--map", "lab", "--create", "--pose-topic", ODOMETRY)
    refused = placerec(*words, status=1)
    assert refused.stderr.count("/odom alternates between two publishers") == 1
    assert "Error: 4 of 4 frames lose their pose, more than a tenth, for what is remarked above" in refused.stderr
    assert "--allow-lost-poses" in refused.stderr
    assert json.loads(placerec("maps", "list", "--json").stdout)["items"] == [], "nothing was created"
    done = placerec(*words, "--allow-lost-poses")
    assert "4 of 4 frames are places" in done.stdout and "0 with a pose" in done.stdout


def test_odometry_that_begins_anew_gives_two_traverses(placerec: Placerec, tmp_path: Path) -> None:
    told = [moved(START + n * SECOND // 10, n - 20.0 * (n >= 20), 0.0) for n in range(40)]
    bag = write_mcap(tmp_path / "walk.mcap", [*small_walk(4), *told])
    done = placerec("enrol", bag, "--map", "lab", "--create", "--pose-topic", ODOMETRY)
    assert "Path 10 m, extent 10 × 0.0 m, 2 of 4 frames with a pose." in done.stderr
    assert "leaps once, by 19.0 m within 0.1 s (at 1700000002.000 s) and goes on from there" in done.stderr
    assert "sequence walk, walk~2: 4 created; 2 with a pose" in done.stdout
    places, _ = stored(tmp_path / "data", "lab")
    assert [(one["sequence"], one["pose"] is not None) for one in places] == [
        ("walk", True),
        ("walk", True),
        ("walk~2", False),
        ("walk~2", False),
    ]
    again = placerec("enrol", bag, "--map", "lab", "--pose-topic", ODOMETRY)
    assert "4 unchanged" in again.stdout and "0 sent" in again.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--topic", "/rear"), "has no topic '/rear'. It has these topics of pictures: /camera/image_raw/compressed"),
        (("--pose-topic", "/tf"), "has no topic '/tf'. It has these topics of poses: /odom (nav_msgs/msg/Odometry, 2"),
        (("--topic", ODOMETRY), "is of the type nav_msgs/msg/Odometry, not of pictures"),
        (("--trajectory", "missing.tum"), "missing.tum cannot be read: No such file"),
        (("--id-prefix", "x" * 100), "would be longer than an id may be"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_sent(
    placerec: Placerec, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    said = [compressed(START, jpeg(0)), moved(START, 0, 0), moved(START + SECOND, 1, 0)]
    bag = write_mcap(tmp_path / "walk.mcap", said)
    refused = placerec("enrol", bag, "--map", "lab", "--create", *words, "--url", "http://127.0.0.1:1", status=1)
    assert message in refused.stderr and "Traceback" not in refused.stderr


def test_options_that_do_not_go_together_are_refused(placerec: Placerec, monday: Path) -> None:
    both = placerec("enrol", monday, "--map", "lab", "--pose-topic", "/odom", "--trajectory", "a.tum", status=2)
    assert "--pose-topic or --trajectory, not both" in both.stderr
    alone = placerec("enrol", monday, "--map", "lab", "--trajectory-times", "times.txt", status=2)
    assert "goes with --trajectory" in alone.stderr


@pytest.mark.thorough
def test_a_damaged_picture_in_a_bag_fails_alone_and_is_named(placerec: Placerec, tmp_path: Path) -> None:
    said = [
        *small_walk(2),
        compressed(START + 9 * SECOND, b"no picture"),
        compressed(START + 10 * SECOND, jpeg(9)[:500]),
    ]
    done = placerec("enrol", write_mcap(tmp_path / "walk.mcap", said), "--map", "lab", "--create", status=1)
    assert "2 of 4 frames are places" in done.stdout
    assert f"Error: {CAMERA} at 1700000009.000000000: " in done.stderr
    assert f"Error: {CAMERA} at 1700000010.000000000: " in done.stderr


@pytest.mark.thorough
def test_two_cameras_of_a_bag_do_not_overwrite_each_other(placerec: Placerec, tmp_path: Path) -> None:
    rear = [compressed(START + index * SECOND, jpeg(10 + index, 96, 72), "/rear") for index in range(2)]
    bag = write_mcap(tmp_path / "walk.mcap", [*small_walk(2), *rear])
    for topic in (CAMERA, "/rear"):
        placerec("enrol", bag, "--map", "lab", "--create", "--topic", topic)
    assert len(json.loads(placerec("maps", "places", "list", "lab", "--json").stdout)) == 4


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_memory_does_not_grow_with_the_bag(tmp_path: Path) -> None:
    peaks = []
    for count in (300, 1500):
        data = encoded(scene(1, 640, 480), ".bmp")[:-4]  # 0.9 MB each
        said = (compressed(START + n * SECOND, data + n.to_bytes(4, "big"), form="bmp") for n in range(count))
        bag = write_mcap(tmp_path / f"{count}.mcap", said, chunk_size=4_000_000)
        program = (
            "import re, sys\nfrom pathlib import Path\nfrom core.recordings import open_recording\n"
            "with open_recording(Path(sys.argv[1])) as recording:\n"
            "    for frame in recording.frames:\n        frame.load()\n"
            "print(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])"
        )
        done = subprocess.run(
            [sys.executable, "-c", program, bag], cwd=ROOT, capture_output=True, text=True, check=True
        )
        peaks.append(int(done.stdout))
    assert peaks[1] < peaks[0] + 16_000, peaks  # kilobytes


@pytest.mark.thorough
def test_frames_of_bags_videos_and_folders_are_queried(placerec: Placerec, tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", walk(4))
    placerec("enrol", bag, "--map", "lab", "--create")
    (tmp_path / "again.bmp").write_bytes(encoded(seen_again(scene(2)), ".bmp"))
    words = ("query", tmp_path / "again.bmp", bag, "--map", "lab", "--every-seconds", 2, "--json")
    done = placerec(*words)
    single, first, last = (json.loads(line) for line in done.stdout.splitlines())
    assert single["place"]["id"].endswith("1700000002.000000000") and "frame" not in single
    assert [one["frame"] for one in (first, last)] == [one["place"]["id"] for one in (first, last)]
    assert last["frame"].endswith("1700000002.000000000")

    write_video(tmp_path / "walk.avi")
    table = placerec("query", tmp_path / "walk.avi", "--map", "lab", "--every-change", 0.3)
    assert "4 of 12 frames are keyframes" in table.stderr and "walk.avi, frame 3 at 0.750 s" in table.stdout
    bad = placerec("query", bag, "--map", "lab", "--topic", "/rear", status=1)
    assert "has no topic '/rear'" in bad.stderr


@pytest.mark.thorough
def test_a_map_is_calibrated_by_labelled_frames_of_a_bag(placerec: Placerec, tmp_path: Path) -> None:
    placerec("enrol", write_mcap(tmp_path / "walk.mcap", small_walk(11)), "--map", "lab", "--create")
    again = [
        compressed(START + (100 + index) * SECOND, encoded(seen_again(scene(index, 96, 72), index)), "/rear")
        for index in range(22)  # half of them the map lacks
    ]
    bag = write_ros1(tmp_path / "again.bag", again)
    rows = [
        f"rear-{1_700_000_100 + index}.000000000,"
        + (f"camera-image_raw-compressed-{1_700_000_000 + index}.000000000" if index < 11 else "")
        for index in range(22)
    ]
    (tmp_path / "labels.csv").write_text("\n".join(["file,place", *rows]))
    words = (
        "calibrate",
        "lab",
        "--frames",
        tmp_path / "labels.csv",
        "--recording",
        bag,
        "--precision",
        0.8,
        "--dry-run",
        "--json",
    )
    report = json.loads(placerec(*words).stdout)
    assert (report["measurement"]["frames"], report["measurement"]["known"]) == (22, 11)
    (tmp_path / "labels.csv").write_text("file,place\nrear-1,\n")
    assert "has no frame 'rear-1'" in placerec(*words, status=1).stderr
    assert "--recording needs --frames" in placerec("calibrate", "lab", "--itself", "--recording", bag, status=2).stderr


def test_recordings_are_evaluated_as_their_frames_are(placerec: Placerec, tmp_path: Path) -> None:
    again = [
        *(compressed(START + index * SECOND, encoded(seen_again(scene(index)))) for index in range(6)),
        *(moved(START + index * SECOND, index, 0.1) for index in range(7)),
    ]
    bag, other = write_mcap(tmp_path / "walk.mcap", walk(6)), write_ros1(tmp_path / "again.bag", again)
    for name, said in (("walk", walk(6)), ("again", again)):
        (tmp_path / name).mkdir()
        seen = [one for one in said if one.topic == CAMERA]
        for index, one in enumerate(seen):
            (tmp_path / name / f"{index}.jpg").write_bytes(bytes(one.make(ROS2).data))

    def figures(reference: Path, query: Path, *words: object) -> Any:
        out = tmp_path / "out.json"
        placerec("evaluate", "--reference", reference, "--query", query, *words, "--encoder", "hog", "--json", out)
        return json.loads(out.read_text())

    of_bags = figures(bag, other, "--tolerance", 0)
    of_folders = figures(tmp_path / "walk", tmp_path / "again", "--tolerance", 0)
    for name in ("queries", "references", "recall_at", "auc_pr", "right"):
        assert of_bags[name] == of_folders[name]
    poses = ("--pose-topic", ODOMETRY, "--query-pose-topic", ODOMETRY, "--poses", "--metres", 0.5)
    assert figures(bag, other, *poses)["recall_at"] == of_folders["recall_at"]
    few = figures(bag, other, *poses, "--every-metres", 2)
    assert (few["queries"], few["references"]) == (3, 3)
    mixed = figures(bag, tmp_path / "again", "--tolerance", 0)
    assert mixed["recall_at"] == of_folders["recall_at"]
    wrong = ("evaluate", "--reference", bag, "--query", other, "--tolerance", 0, "--query-topic", "/rear")
    assert "again.bag has no topic '/rear'" in placerec(*wrong, status=1).stderr


@pytest.mark.thorough
def test_recordings_are_evaluated_by_transforms(placerec: Placerec, tmp_path: Path) -> None:
    """The camera of one robot is half a metre ahead of its base; the other one's bag has also another robot's base."""
    bags = []
    for name, ahead, base in (("walk", 0.5, "base_link"), ("again", 0.0, "rover")):
        messages = [transformed("/tf_static", START, transform(base, "camera", 0, (ahead, 0, 0)))]
        for number in range(6):
            at = START + number * SECOND
            messages.append(compressed(at, encoded(seen_again(scene(number), number))))
            messages.append(transformed("/tf", at, transform("map", "odom", at, (0, 100, 0))))
            messages.append(transformed("/tf", at, transform("odom", base, at, (number, 0, 0))))
        bags.append(write_mcap(tmp_path / f"{name}.mcap", messages))
    known, asked = bags
    words: tuple[object, ...] = ("--reference", known, "--query", asked, "--poses", "--metres", 0.2)
    words += ("--encoder", "hog", "--pose-topic", "/tf", "--query-pose-topic", "/tf")

    def recall(*more: object) -> float:
        placerec("evaluate", *words, *more, "--json", tmp_path / "out.json")
        return float(json.loads((tmp_path / "out.json").read_text())["recall_at"]["1"])

    def refused(*more: object) -> str:
        return placerec("evaluate", *words, *more, status=1).stderr

    assert recall("--moving-frame", "base_link") == 1.0
    assert recall("--moving-frame", "base_link", "--fixed-frame", "odom", "--query-fixed-frame", "odom") == 1.0
    assert recall("--query-moving-frame", "rover", "--moving-frame", "base_link") == 1.0
    assert "the nearest 0.5 m off" in refused(), "the pictures name their camera, not the base"
    assert "the nearest 100.0 m off" in refused("--moving-frame", "base_link", "--query-fixed-frame", "odom")
    assert "no transform of a frame 'base_link'" in refused("--query-moving-frame", "base_link")


@pytest.mark.thorough
def test_pictures_of_other_formats_are_evaluated(placerec: Placerec, tmp_path: Path) -> None:
    for folder, suffix in (("known", ".pgm"), ("asked", ".tif")):
        (tmp_path / folder).mkdir()
        for index in range(4):
            grey = np.asarray(cv2.cvtColor(scene(index), cv2.COLOR_BGR2GRAY), np.uint8)
            (tmp_path / folder / f"{index}{suffix}").write_bytes(encoded(grey, suffix))
    words = ("--reference", tmp_path / "known", "--query", tmp_path / "asked", "--tolerance", 0, "--encoder", "hog")
    placerec("evaluate", *words, "--json", tmp_path / "out.json", "--report", tmp_path / "report")
    assert json.loads((tmp_path / "out.json").read_text())["recall_at"]["1"] == 1.0
    assert "data:image/jpeg" in (tmp_path / "report/index.html").read_text()
