"""``placerec enrol`` in both modes, and what it refuses."""

from __future__ import annotations

import http.server
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from unicodedata import normalize

import httpx
import pytest
from PIL import ExifTags, Image

from placerec_client.batches import FIRST_BATCH
from service.commands.connection.batches import SendingOutcome
from service.commands.enrol import Report
from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import ROOT, Server

HEADER = "file,id,x,y,z,heading,latitude,longitude,timestamp\n"


@pytest.mark.thorough
def test_a_directory_becomes_a_traverse(placerec: Placerec, monday: Path) -> None:
    done = placerec("enrol", monday, "--map", "lab", "--create")
    assert "4 of 4 frames are places of lab, sequence monday: 4 created; 0 with a pose" in done.stdout

    places = json.loads(placerec("maps", "places", "list", "lab", "--json").stdout)
    assert [place["id"] for place in places] == ["1", "2", "9", "10"]
    assert {place["sequence"] for place in places} == {"monday"}
    assert all(place["pose"] is None for place in places)

    again = placerec("enrol", monday, "--map", "lab")
    assert "4 unchanged" in again.stdout

    (monday / "2.jpg").write_bytes(jpeg(7))
    replaced = placerec("enrol", monday, "--map", "lab", "--replace")
    assert "1 replaced, 3 unchanged" in replaced.stdout


def test_an_interrupted_command_says_how_far_it_is(
    placerec: Placerec, monday: Path, server: Server, map_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = Report.add

    def interrupting(report: Report, outcome: SendingOutcome) -> None:
        add(report, outcome)
        if sum(report.changes.values()) == 4:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Report, "add", interrupting)
    words = "enrol", monday, "--map", map_id, "--url", server.client.base_url
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for index in range(40):
            (monday / f"more-{index:02}.jpg").write_bytes(jpeg(index))
        stopped = placerec(*words, status=130)
    finally:
        signal.signal(signal.SIGINT, before)
    told = re.search(r"Interrupted: (\d+) of 44 frames are enrolled; run the command again to go on.", stopped.stderr)
    assert told and 4 <= int(told[1]) < 44
    assert server.client.get(f"/v1/maps/{map_id}").json()["places"] >= int(told[1])


def test_poses_come_from_the_list_over_http(placerec: Placerec, monday: Path, server: Server, map_id: str) -> None:
    (monday / "places.csv").write_text(
        HEADER
        + "9.jpg,door,1.5,-2,0.25,370,,,2026-11-20T10:00:00+01:00\n"
        + "1.jpg,,48.5,2.25,,,,,\n"
        + "2.jpg,,,,,,,,\n".replace("370", ""),
        encoding="utf-8",
    )
    # A heading of more than a turn is refused with its line, before anything is sent.
    refused = placerec("enrol", monday, "--map", map_id, "--url", server.client.base_url, status=1)
    assert "places.csv, line 2: heading" in refused.stderr
    assert server.client.get(f"/v1/maps/{map_id}").json()["places"] == 0

    text = (monday / "places.csv").read_text().replace("370", "-90")
    (monday / "places.csv").write_text(text)
    done = placerec("enrol", monday, "--map", map_id, "--url", server.client.base_url, "--sequence", "walk")

    assert "3 of 3 frames" in done.stdout
    assert "2 with a pose" in done.stdout
    assert "1 images of" in done.stderr  # 10.jpg is not listed
    door = server.client.get(f"/v1/maps/{map_id}/places/door").json()
    assert door["pose"] == {"x": 1.5, "y": -2.0, "z": 0.25, "heading": 270.0}
    assert door["timestamp"] == "2026-11-20T09:00:00Z"
    assert door["sequence"] == "walk"
    assert server.client.get(f"/v1/maps/{map_id}/places/1").json()["pose"] == {"x": 48.5, "y": 2.25}
    assert server.client.get(f"/v1/maps/{map_id}/places/2").json()["pose"] is None


def test_a_level_and_an_accuracy_for_all_frames_that_have_none(
    placerec: Placerec, monday: Path, server: Server, map_id: str
) -> None:
    (monday / "places.csv").write_text("file,x,y,floor,accuracy_metres\n9.jpg,1,2,-1,0.5\n1.jpg,1,2,,\n")
    given = ("--level", "EG", "--pose-accuracy", 2, "--url", server.client.base_url)
    placerec("enrol", monday, "--map", map_id, *given)
    found = {name: (place["level"], place["pose_accuracy"]["metres"]) for name, place in server.places(map_id).items()}
    assert found == {"9": ("-1", 0.5), "1": ("EG", 2.0)}
    listed = placerec("maps", "places", "list", map_id, "--level", "EG", *given[4:]).stdout
    assert "9" not in listed and "1" in listed


def test_places_of_the_other_kind_fail_alone_and_say_why(
    placerec: Placerec, monday: Path, server: Server, map_id: str
) -> None:
    (monday / "places.csv").write_text(HEADER + "9.jpg,door,1.5,-2,,,,,\n1.jpg,,,,,,48.5,2.25,\n")
    done = placerec("enrol", monday, "--map", map_id, "--url", server.client.base_url, status=1)
    assert "1 of 2 frames are places" in done.stdout
    assert "1.jpg: " in done.stderr and "a map has one kind" in " ".join(done.stderr.split())


def test_poses_come_from_the_names_of_files(placerec: Placerec, tmp_path: Path, server: Server, map_id: str) -> None:
    folder = tmp_path / normalize("NFD", "Straße é")
    folder.mkdir()
    for number in range(3):
        name = f"@0548164.3{number}@4180910.43@10@S@37.7@-122.4@pano{number}@@{90 * number}@@@@20180312@@.jpg"
        (folder / name).write_bytes(jpeg(number))
    url = ("--url", server.client.base_url)
    done = placerec("enrol", folder, "--map", map_id, *url)
    assert "sequence Straße é: 3 created; 3 with a pose" in done.stdout  # in the one form of texts
    assert "UTM zone 10N" in done.stderr and "3 with a heading" in " ".join(done.stderr.split())
    found = [place["pose"] for place in server.places(map_id).values()]
    assert found == [{"x": float(f"548164.3{n}"), "y": 4180910.43, "heading": (90 - 90 * n) % 360} for n in range(3)]
    assert "3 unchanged" in placerec("enrol", folder, "--map", map_id, "--poses", "names", *url).stdout
    refused = placerec("enrol", folder, "--map", map_id, "--poses", "names", "--trajectory", "a.txt", *url, status=2)
    assert "not both" in " ".join(refused.stderr.split())


@pytest.mark.thorough
def test_poses_come_from_exif(placerec: Placerec, tmp_path: Path) -> None:
    folder = tmp_path / "outdoor"
    folder.mkdir()
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "S", 2: (48.0, 30.0, 0.0), 3: "E", 4: (2.0, 15.0, 0.0)})
    file = io.BytesIO()
    Image.fromarray(scene(0)).save(file, "JPEG", exif=exif.tobytes())
    (folder / "a.jpg").write_bytes(file.getvalue())

    done = placerec("enrol", folder, "--map", "paris", "--create")

    assert "1 with a pose" in done.stdout
    shown = json.loads(placerec("maps", "places", "show", "paris", "a", "--json").stdout)
    assert shown["pose"] == {"latitude": -48.5, "longitude": 2.25}


def test_a_bad_image_fails_alone_and_is_named(placerec: Placerec, monday: Path) -> None:
    (monday / "3.jpg").write_bytes(b"not an image")
    (monday / "4.png").write_bytes(encoded(scene(5), ".png")[:500])
    done = placerec("enrol", monday, "--map", "lab", "--create", status=1)
    assert "4 of 6 frames are places of lab" in done.stdout
    assert "Error: 3.jpg: " in done.stderr
    assert "Error: 4.png: " in done.stderr
    assert "1.jpg" not in done.stderr


def test_a_map_that_is_created_for_nothing_is_deleted_again(placerec: Placerec, tmp_path: Path) -> None:
    folder = tmp_path / "torn"
    folder.mkdir()
    (folder / "1.jpg").write_bytes(b"not an image")
    words = ("enrol", folder, "--map", "for-nothing")
    said = placerec(*words, "--create", status=1).stderr
    assert "The map for-nothing, which --create made, is deleted again" in " ".join(said.split())
    assert "There is no map 'for-nothing'" in placerec(*words, status=1).stderr
    placerec("maps", "create", "for-nothing")
    assert "deleted again" not in placerec(*words, "--create", status=1).stderr, "it was there before"
    assert "for-nothing" in placerec("maps", "list").stdout


@pytest.mark.parametrize("option", ["--every-metres", "--every-degrees", "--every-seconds"])
def test_keyframes_need_a_distance_above_zero(placerec: Placerec, monday: Path, option: str) -> None:
    for value in ("0", "-1"):
        refused = placerec("enrol", monday, "--map", "lab", "--create", option, value, status=2).stderr
        assert "more than 0" in " ".join(refused.split()), (option, value)


@pytest.mark.thorough
def test_a_name_that_makes_no_id_fails_alone_and_is_named(placerec: Placerec, monday: Path) -> None:
    odd = monday / "ä ö.jpg"
    odd.write_bytes(jpeg(5))
    done = placerec("enrol", monday, "--map", "lab", "--create", status=1)
    assert "4 of 5 frames are places of lab" in done.stdout and "4 sent in" in done.stdout
    assert "Error: ä ö.jpg: no id can be made from its name; give it one in places.csv." in done.stderr
    assert "1.jpg" not in done.stderr
    assert "ä ö.jpg" in placerec("query", odd, "--map", "lab").stdout
    (monday / "places.csv").write_text("file,id\nä ö.jpg,umlauts\n", encoding="utf-8")
    assert "1 of 1 frames are places of lab" in placerec("enrol", monday, "--map", "lab").stdout


@pytest.mark.thorough
def test_a_map_is_made_only_on_request(placerec: Placerec, monday: Path) -> None:
    refused = placerec("enrol", monday, "--map", "lab", status=1)
    assert "There is no map 'lab'. Give --create to create it." in refused.stderr
    placerec("enrol", monday, "--map", "lab", "--create", "--encoder", "region-vlad", "--keep", "none")
    made = json.loads(placerec("maps", "show", "lab", "--json").stdout)
    assert made["encoder"].startswith("region-vlad@")
    assert made["keep"] == "none"
    wrong = placerec("enrol", monday, "--map", "lab", "--encoder", "m-region-vlad", status=1)
    assert "bound to region-vlad@" in wrong.stderr
    assert "0 of 4 frames are enrolled" in wrong.stderr


def test_a_camera_that_is_not_there_is_refused_before_a_map_is_made(
    placerec: Placerec, monday: Path, server: Server, map_id: str
) -> None:
    there = ("--camera", "front", "--url", server.client.base_url)
    new = f"{map_id}-new"
    refused = placerec("enrol", monday, "--map", new, "--create", *there, status=2).stderr
    said = " ".join(refused.replace("│", " ").split())
    assert f"There is no map '{new}', and a map that --create makes has no camera yet." in said
    assert f"'placerec maps create {new}', then 'placerec maps cameras put {new} front'" in said
    assert server.client.get(f"/v1/maps/{new}").status_code == 404

    for words in ((), ("--create",)):
        missing = placerec("enrol", monday, "--map", map_id, *words, *there, status=1).stderr
        assert f"has no camera 'front'. 'placerec maps cameras put {map_id} front' creates it." in missing
    placerec("maps", "cameras", "put", map_id, "front", *there[2:])
    assert "4 of 4 frames" in placerec("enrol", monday, "--map", map_id, "--create", *there).stdout
    shown = placerec("maps", "places", "show", map_id, "1", *there[2:]).stdout
    assert ["camera", "front"] in [line.split() for line in shown.splitlines()]


@pytest.mark.thorough
def test_another_folder_replaces_nothing_unless_it_is_to(
    placerec: Placerec, tmp_path: Path, server: Server, map_id: str
) -> None:
    """Cameras count from 000: two folders have files of the same names, and may be called the same."""
    there = ("--map", map_id, "--url", str(server.client.base_url))
    first, second = many(tmp_path / "left", 3), tmp_path / "night" / "left"
    second.mkdir(parents=True)
    for number in range(3):
        (second / f"{number}.jpg").write_bytes(jpeg(100 + number, 96, 72))
    placerec("enrol", first, *there)
    refused = placerec("enrol", second, *there, status=1).stderr
    assert "3 of 3 frames exist already in the traverse 'left', with other pictures." in refused
    assert "--sequence 'left~2' --id-prefix 'left~2-'" in refused and "--replace" in refused
    moved = placerec("enrol", first, *there, "--sequence", "right", status=1).stderr
    assert "3 of 3 frames exist already in the traverse 'left', with these very pictures." in moved
    assert "--sequence left to go on with it" in moved
    before = {one: place["updated_at"] for one, place in server.places(map_id).items()}
    assert len(before) == 3, "nothing was sent"
    assert "3 unchanged" in placerec("enrol", first, *there).stdout
    # Beside it, and broken off, and gone on with by the same command.
    (second / "2.jpg").rename(tmp_path / "2.jpg")
    beside = ("--sequence", "left~2", "--id-prefix", "left~2-")
    assert "2 created" in placerec("enrol", second, *there, *beside).stdout
    (tmp_path / "2.jpg").rename(second / "2.jpg")
    assert "1 created, 2 unchanged" in placerec("enrol", second, *there, *beside).stdout
    assert {one: place["updated_at"] for one, place in server.places(map_id).items() if one in before} == before
    # Other names of files: nobody chose this name of a traverse, so it is another one, also when it is gone on with.
    for number in range(3):
        (second / f"{number}.jpg").rename(second / f"n{number}.jpg")
    third = placerec("enrol", second, *there)
    assert "sequence left~3: 3 created" in third.stdout and "these frames are in 'left~3'" in third.stderr
    assert "sequence left~3: 3 unchanged" in placerec("enrol", second, *there).stdout
    # The word.
    for number in range(3):
        (second / f"n{number}.jpg").rename(second / f"{number}.jpg")
    assert "sequence left: 3 replaced" in placerec("enrol", second, *there, "--replace").stdout


@pytest.mark.thorough
def test_file_names_become_ids(placerec: Placerec, tmp_path: Path) -> None:
    folder = tmp_path / "odd names"
    folder.mkdir()
    for index, name in enumerate(("_hall (2)", "Küche", "x.y~z")):
        (folder / f"{name}.png").write_bytes(encoded(scene(index, 64, 48), ".png"))
    placerec("enrol", folder, "--map", "lab", "--create")
    places = json.loads(placerec("maps", "places", "list", "lab", "--json").stdout)
    assert [place["id"] for place in places] == ["K-che", "hall-2-", "x.y~z"]  # in the order of the files
    assert {place["sequence"] for place in places} == {"odd names"}

    (folder / "K che.png").write_bytes(encoded(scene(4, 64, 48), ".png"))
    clash = placerec("enrol", folder, "--map", "lab", status=1)
    assert "would both have the id 'K-che'" in clash.stderr


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("file,lattitude\n1.jpg,4\n", "an unknown column 'lattitude'"),
        ("id,x,y\np,1,2\n", "columns missing or given twice"),
        ("file,x,x\n1.jpg,1,2\n", "columns missing or given twice"),
        ("file\n", "lists no frame"),
        ("", "columns missing"),
        ("file\nmissing.jpg\n", "line 2: there is no file 'missing.jpg'"),
        ("file,x,y\n1.jpg,1\n", "line 2: the row has more or fewer cells"),
        ("file,x,y\n1.jpg,1,2,3\n", "line 2: the row has more or fewer cells"),
        ("file,x,y\n1.jpg,one,2\n", "line 2: x: 'one' is not a number"),
        ("file,heading\n1.jpg,90\n", "line 2: a pose is either x, y[, z] or latitude, longitude"),
        ("file,x,y,latitude,longitude\n1.jpg,1,2,3,4\n", "line 2: a pose is either"),
        ("file,timestamp\n1.jpg,yesterday\n", "line 2: timestamp: "),
        ("file,id\n1.jpg,-p\n", "'-p' cannot name a place"),
        ("file,id\n1.jpg,p\n2.jpg,p\n", "line 3: 1.jpg and 2.jpg would both have the id 'p', which line 2 has"),
        ("file\n1.jpg\n2.jpg\n1.jpg\n", "line 4: 1.jpg is listed in line 2 already, with the same id '1'"),
        ('file\n"1.jpg\n', "is not a CSV file in UTF-8"),
    ],
)
def test_a_wrong_list_is_refused_before_anything_is_sent(
    placerec: Placerec, monday: Path, content: str, message: str
) -> None:
    (monday / "places.csv").write_text(content)
    refused = placerec("enrol", monday, "--map", "lab", "--create", "--url", "http://127.0.0.1:1", status=1)
    assert message in refused.stderr


def test_a_directory_without_images_is_refused(placerec: Placerec, tmp_path: Path) -> None:
    refused = placerec("enrol", tmp_path / "nowhere", "--map", "lab", "--url", "http://127.0.0.1:1", status=1)
    assert "cannot be read as a directory" in refused.stderr


class FullAfterOne(http.server.BaseHTTPRequestHandler):
    """A service whose disk is full after the first batch."""

    protocol_version = "HTTP/1.1"
    taken = 0

    def answer(self, status: int, kind: str, body: Mapping[str, object]) -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def do_GET(self) -> None:
        self.answer(200, "application/json", {"items": [], "next_cursor": None})

    def do_POST(self) -> None:
        if self.path.endswith(":compare"):
            length = int(self.headers["Content-Length"])
            sequence = json.loads(self.rfile.read(length))["sequence"]
            compared = {"sequence": sequence, "free": sequence, "known": 0, "taken": []}
            self.answer(200, "application/json", compared)
            return
        frames = self.rfile.read(int(self.headers["Content-Length"])).count(b"filename=")
        type(self).taken += 1
        if self.taken == 1:
            items = [{"id": None, "status": 201, "change": "created"}] * frames
            self.answer(200, "application/json", {"items": items, "encoder": "any"})
        else:
            problem = {"type": "urn:placerec:problem:storage-full", "detail": "The disk is full."}
            self.answer(507, "application/problem+json", problem)

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: the test's output stays readable."""


def test_a_full_disk_ends_the_run(placerec: Placerec, tmp_path: Path) -> None:
    folder = many(tmp_path / "many", 5 * FIRST_BATCH)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), FullAfterOne) as full:
        threading.Thread(target=full.serve_forever, daemon=True).start()
        stopped = placerec("enrol", folder, "--map", "lab", "--url", f"http://127.0.0.1:{full.server_port}", status=1)
        full.shutdown()
    assert f"The disk is full. {FIRST_BATCH} of 80 frames are enrolled; run the command again" in stopped.stderr
    assert FullAfterOne.taken <= 3  # what comes after the batch that was under way meanwhile was not sent


def many(folder: Path, count: int) -> Path:
    """A traverse of so many different small frames."""
    folder.mkdir()
    for index in range(count):
        (folder / f"{index}.jpg").write_bytes(jpeg(index, 96, 72))
    return folder


@pytest.mark.thorough
def test_many_frames_keep_their_order_and_are_not_sent_twice(
    placerec: Placerec, tmp_path: Path, server: Server, map_id: str
) -> None:
    folder, url = many(tmp_path / "many", 60), server.client.base_url
    (folder / "17.jpg").write_bytes(b"not an image")
    first = placerec("enrol", folder, "--map", map_id, "--url", url, status=1)
    assert "59 of 60 frames are places" in first.stdout and "59 sent" in first.stdout
    assert "Error: 17.jpg: " in first.stderr
    items = server.client.get(f"/v1/maps/{map_id}/places", params={"limit": 100}).json()["items"]
    assert [place["id"] for place in items] == [str(index) for index in range(60) if index != 17]

    (folder / "17.jpg").write_bytes(jpeg(170, 96, 72))
    (folder / "30.jpg").write_bytes(jpeg(300, 96, 72))
    refused = placerec("enrol", folder, "--map", map_id, "--url", url, status=1)
    assert "1 of 60 frames exist already in the traverse 'many', with other pictures." in refused.stderr
    second = placerec("enrol", folder, "--map", map_id, "--url", url, "--replace")
    assert "60 of 60 frames are places" in second.stdout
    assert "1 created, 1 replaced, 58 unchanged" in second.stdout and "2 sent" in second.stdout

    (folder / "places.csv").write_text(HEADER + "5.jpg,,1,2,,,,,\n")
    moved = placerec("enrol", folder, "--map", map_id, "--url", url)
    assert "1 updated" in moved.stdout and "0 sent" in moved.stdout
    assert server.client.get(f"/v1/maps/{map_id}/places/5").json()["pose"]["x"] == 1.0


@pytest.mark.thorough
def test_a_service_that_takes_little_at_a_time(
    placerec: Placerec, tmp_path: Path, tight_server: Server, tight_map: str
) -> None:
    folder = many(tmp_path / "many", 14)
    done = placerec("enrol", folder, "--map", tight_map, "--url", tight_server.client.base_url)
    assert "14 of 14 frames are places" in done.stdout
    items = tight_server.client.get(f"/v1/maps/{tight_map}/places").json()["items"]
    assert [place["id"] for place in items] == [str(index) for index in range(14)]


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_memory_does_not_grow_with_the_folder(tmp_path: Path, server: Server) -> None:
    """Of the command's process, whatever the number of frames; what the service holds grows with its maps alone."""
    peaks = []
    for count in (400, 1200):  # the smaller one reaches the largest batches, too
        folder, name = tmp_path / str(count), f"soak-{count}"
        folder.mkdir()
        for index in range(count):
            # 300 KB each: all of the larger folder would be 360 MB.
            (folder / f"{index}.jpg").write_bytes(jpeg(index % 40, 96, 72) + index.to_bytes(4) + bytes(300_000))
        words = ["enrol", str(folder), "--map", name, "--create", "--url", str(server.client.base_url)]
        process = subprocess.Popen([sys.executable, "-m", "service.commands", *words], cwd=ROOT)
        peak = 0
        while process.poll() is None:
            status = Path(f"/proc/{process.pid}/status").read_text()
            found = re.search(r"VmHWM:\s+(\d+)", status)
            peak = max(peak, int(found[1]) if found else 0)
            time.sleep(0.05)
        assert process.returncode == 0
        assert server.client.get(f"/v1/maps/{name}").json()["places"] == count
        peaks.append(peak)
        server.client.delete(f"/v1/maps/{name}")
    assert peaks[1] < peaks[0] + 32_000, peaks  # kilobytes


def test_the_data_of_a_running_service_is_left_alone(
    placerec: Placerec, monday: Path, server: Server, client: httpx.Client
) -> None:
    refused = placerec("enrol", monday, "--map", "left-alone", "--create", "--data-dir", server.data_dir, status=1)
    assert refused.stderr.startswith("Error: ")
    assert "Traceback" not in refused.stderr
    assert "--url" in refused.stderr
    assert client.get("/v1/maps/left-alone").status_code == 404
