"""What is well-formed and wrong, by every way in: each row is refused, left out or remarked; none passes in silence.

``scripts/test tests/service/test_awkward_inputs.py -rP`` prints what each way does with each input.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unicodedata import normalize

import cv2
import httpx
import numpy as np
import pytest
from PIL import ExifTags, Image
from typer.testing import CliRunner

from core.errors import PlacerecError
from core.recordings import Poses, open_recording
from placerec_client import Client
from placerec_client.errors import PlacerecError as ClientError
from placerec_ros.pictures import UnfitPicture, picture_of
from service.commands.application import application
from tests.clients.ros2 import ros_messages
from tests.core.recordings import bags
from tests.core.recordings.bags import SECOND, START, Said, compressed, fix, image, moved
from tests.core.recordings.test_plausibility import (
    Fault,
    bag,
    no_number,
    restart,
    spike,
    transforms,
    tum,
    two_publishers,
    walked,
    without_headings,
)
from tests.service.map_jobs import finished
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server, text, typed

FRAMES = [jpeg(number, 128, 96) for number in range(3)]
GREY = cv2.cvtColor(scene(1, 64, 48), cv2.COLOR_BGR2GRAY)
TEN_BITS, THERMAL = GREY.astype(np.uint16) * 4, 29_000 + GREY.astype(np.uint16)
METRES: dict[str, Any] = {"x": 1, "y": 2}
DEGREES: dict[str, Any] = {"latitude": 48.5, "longitude": 2.25}
NO_POSES = Poses()
NOW = datetime.now(UTC).replace(microsecond=0) - timedelta(minutes=5)


@dataclass
class Ways:
    """All ways in, for one row: its folder, and a map of three places."""

    folder: Path
    server: Server
    map: str

    def recording(self, path: Path, poses: Poses = NO_POSES, topic: str | None = None) -> str:
        """What is said of a recording, and how many of its frames have a pose."""
        try:
            with open_recording(path, topic, poses) as found:
                found.check_format()
                posed = sum(frame.described().pose is not None for frame in found.frames)
                return " ".join([*found.remarks, f"[{posed} of {len(found.frames)} with a pose]"])
        except PlacerecError as error:
            return f"{type(error).__name__}: {error}"

    def walk(self, fault: Fault, source: Callable[..., tuple[Path, Poses]] = bag) -> str:
        return self.recording(*source(walked(fault), self.folder))

    def bag(self, *said: Said, topic: str | None = None, poses: Poses = NO_POSES) -> str:
        return self.recording(bags.write_mcap(self.folder / "one.mcap", said), poses, topic)

    def pixels(self, name: str, data: bytes, width: int = 64, height: int = 48, step: int = 0) -> str:
        """What a bag and the node make of pixels: the same, or it is said."""
        of_bag = self.bag(image(START, width, height, name, data, step), topic="/raw")
        return f"{of_bag} node: {self.node(ros_messages.image(name, width, height, data, step))}"

    def node(self, message: object) -> str:
        try:
            made = picture_of(message)
        except UnfitPicture as error:
            return f"UnfitPicture: {error}"
        return f"{len(made)} bytes" if isinstance(made, bytes) else f"{made.dtype} {made.shape}"

    def command(self, *words: object) -> str:
        words = (*words, "--url", self.server.client.base_url)
        result = CliRunner().invoke(application, [str(word) for word in words])
        return " ".join(f"exit {result.exit_code}: {result.stdout} {result.stderr}".split())

    def enrol(self, path: Path, *words: object) -> str:
        return self.command("enrol", path, "--map", self.map, *words)

    def http(
        self, method: str, path: str, data: bytes = b"", headers: dict[str, str] | None = None, **parameters: Any
    ) -> str:
        response = self.server.client.request(
            method,
            f"/v1/maps/{self.map}{path}",
            content=data,
            headers={**typed(data), **(headers or {})},
            params=text(parameters),
        )
        return shown(response)

    def query(self, data: bytes = FRAMES[0], headers: dict[str, str] | None = None, **parameters: Any) -> str:
        return self.http("POST", "/query", data, headers, **parameters)

    def put(self, data: bytes = FRAMES[0], place: str = "new", **parameters: Any) -> str:
        return self.http("PUT", f"/places/{place}", data, **parameters)

    def frames(self, *sent: dict[str, object]) -> str:
        """The answers of one session to some frames, by the client and by HTTP."""
        said = []
        with Client(str(self.server.client.base_url)) as client:
            session = client.maps[self.map].sessions.begin()
            for parameters in sent:
                try:
                    answer = session.send(FRAMES[0], **parameters)  # type: ignore[arg-type]
                    said.append(answer.note or f"taken as frame {answer.frame}")
                except ClientError as error:
                    said.append(f"{type(error).__name__}: {error}")
        return "; then ".join(said)


def shown(response: httpx.Response) -> str:
    body = response.json()
    problem = f"{body.get('type', '').rpartition(':')[2]}: {body.get('detail')}" if "detail" in body else ""
    return f"{response.status_code} {problem or body.get('note') or body.get('reason') or 'taken'}"


def png16(pixels: object) -> bytes:
    return encoded(pixels, ".png")  # type: ignore[arg-type]


def gps(latitude: float, longitude: float) -> bytes:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: (latitude, 0.0, 0.0), 3: "E", 4: (longitude, 0.0, 0.0)})
    file = io.BytesIO()
    Image.fromarray(scene(0)).save(file, "JPEG", exif=exif.tobytes())
    return file.getvalue()


def folder(ways: Ways, files: dict[str, bytes]) -> Path:
    made = ways.folder / "pictures"
    made.mkdir()
    for name, data in files.items():
        (made / name).write_bytes(data)
    return made


def fixes(*positions: tuple[float, float]) -> list[Said]:
    seen = [compressed(START + number * SECOND, FRAMES[number % 3]) for number in range(len(positions))]
    told = [fix(START + number * SECOND, *where) for number, where in enumerate(positions)]
    return sorted([*seen, *told], key=lambda said: said.received)


def far_line(ways: Ways) -> str:
    path, poses = tum(walked(lambda samples: None), ways.folder)
    assert poses.file is not None
    lines = poses.file.read_text().splitlines()
    lines[100] = " ".join([lines[100].split()[0], "5000000", *lines[100].split()[2:]])
    poses.file.write_text("\n".join(lines))
    return ways.recording(path, poses)


def empty_split(ways: Ways) -> str:
    path = bags.write_rosbag2(ways.folder / "split", bags.walk(), "mcap")
    (path / "split_1.mcap").touch()
    (path / "metadata.yaml").unlink()
    return ways.recording(path)


def restarted(ways: Ways) -> str:
    told = [moved(one.stamp, one.x, one.y) for one in walked(restart)]
    seen = [compressed(START + number * SECOND, jpeg(number, 64, 48)) for number in range(20)]
    path = bags.write_mcap(ways.folder / "walk.mcap", sorted([*told, *seen], key=lambda said: said.received))
    return ways.enrol(path, "--pose-topic", "/odom")


def batch(ways: Ways, *places: dict[str, Any], job: bool = False) -> str:
    parts = [("places", ("places.json", json.dumps([{**one, "file": "a"} for one in places]), "application/json"))]
    parts.append(("a", ("a.jpg", FRAMES[0], "image/jpeg")))  # type: ignore[arg-type]
    path = f"/v1/maps/{ways.map}/places"
    response = ways.server.client.post(path, files=parts, params={"background": str(job).lower()})
    if job:
        return json.dumps(finished(ways.server, response.json())["result"])
    return "; ".join(str(one.get("problem", {}).get("detail", one["status"])) for one in response.json()["items"])


def twice(ways: Ways) -> str:
    """Two folders, whose files have the same names."""
    for number, name in enumerate(("left", "right")):
        made = ways.folder / name / "images"
        made.mkdir(parents=True)
        (made / "000.jpg").write_bytes(FRAMES[number])
        said = ways.enrol(made)
    return said


def one_name(ways: Ways) -> str:
    """A traverse that is written in one form of Unicode and asked for in another."""
    said = ways.put(place="cafe", sequence=normalize("NFD", "été"))
    assert said.startswith("20"), said
    found = ways.server.client.get(f"/v1/maps/{ways.map}/places", params={"sequence": normalize("NFC", "été")}).json()
    return f"found {len(found['items'])} in {found['items'][0]['sequence']!r}"


def ahead(seconds: float) -> str:
    return (NOW + timedelta(seconds=seconds)).isoformat()


Row = tuple[str, Callable[[Ways], str], str]
BAYER = (TEN_BITS[::2] * 8).tobytes()
YEARS = 20 * 365.25 * 86_400

ROWS: list[Row] = [
    ("two publishers on one topic, bag", lambda w: w.walk(two_publishers),
        r"alternates between two publishers.*\[0 of"),
    ("two publishers on one topic, command", lambda w: w.enrol(bag(walked(two_publishers), w.folder)[0],
        "--pose-topic", "/odom"), r"exit 1.*lose their pose.*--allow-lost-poses"),
    ("a spike of 10⁶ m, bag", lambda w: w.walk(spike), r"/odom leaps once, by 999 99\d m"),
    ("a jump in /tf", lambda w: w.walk(spike, transforms), r"/tf .*leaps once"),
    ("a line of 5 000 km, TUM", far_line, r"path\.tum.* leaps once, by \d \d\d\d \d\d\d m.*line 101"),
    ("odometry begins anew, bag", lambda w: w.walk(restart), r"begins anew.*~2"),
    ("odometry begins anew, command", restarted, r"exit 0.*walk, walk~2.*begins anew.*Path 9\.\d m"),
    ("a NaN, bag", lambda w: w.walk(no_number), r"1 of 200 .*a number that is none"),
    ("a NaN, TUM", lambda w: w.walk(no_number, tum), r"1 of 200 .*a number that is none"),
    ("1e308, bag", lambda w: w.bag(compressed(START, FRAMES[0]), *(moved(START + n * SECOND // 9,
        1e308 if n == 5 else n / 9, 0) for n in range(10)), poses=Poses(topic="/odom")), r"1 of 10 .*beyond 1e\+09 m"),
    ("no heading, bag", lambda w: w.walk(without_headings), r"12 of 200 .*have no orientation"),
    ("no heading, TUM", lambda w: w.walk(without_headings, tum), r"12 of 200 .*have no orientation"),
    ("three fixes at (0, 0)", lambda w: w.bag(*fixes(*[(48.0 + n / 1e5, 2.0) if n not in (4, 5, 6) else (0, 0)
        for n in range(12)]), poses=Poses(topic="/fix")), r"3 of 12 .*no fix.*\[9 of 12|3 of 12 .*no fix"),
    ("a whole bag at (0, 0)", lambda w: w.bag(*fixes(*[(0, 0)] * 6), poses=Poses(topic="/fix")), r"no fix"),
    ("a fix that jumps by half a degree", lambda w: w.bag(*fixes(*[(48.5 if n == 5 else 48.0, 2.0) for n in range(12)]),
        poses=Poses(topic="/fix")), r"/fix leaps once, by 55 \d\d\d m"),
    ("GPS of zeros, EXIF", lambda w: w.recording(folder(w, {"a.jpg": gps(0, 0), "b.jpg": gps(48, 2)})),
        r"1 of 2 .*no fix.*\[1 of 2"),
    ("poses that leap, job", lambda w: batch(w, *({"id": f"j{n}", "x": 1e6 if n == 3 else n, "y": 0, "sequence": "s",
        "timestamp": ahead(n)} for n in range(8)), job=True), r"j3.*implausible-pose"),
    ("names of data sets", lambda w: w.enrol(folder(w, {f"@0548164.{n}@4180910@10@S@@@p{n}@@{n}@@@@2018@@.jpg":
        FRAMES[n] for n in range(3)})), r"exit 0.*3 with a pose.*UTM zone 10N"),
    ("a frame an hour back", lambda w: w.frames({"timestamp": ahead(0)}, {"timestamp": ahead(-3600)},
        {"timestamp": ahead(-3599)}), r"clock went back: .*then taken"),
    ("one stamp twenty years ahead", lambda w: w.frames({"timestamp": ahead(0)}, {"timestamp": ahead(YEARS)},
        {"timestamp": ahead(2)}, {"timestamp": ahead(3)}), r"clock went ahead.*clock went back.*then taken"),
    ("a stamp half a second back", lambda w: w.frames({"timestamp": ahead(0)}, {"timestamp": ahead(-0.5)}),
        r"before the last one"),
    ("frame=2147483648", lambda w: w.frames({"frame": 0}, {"frame": 2147483648}, {"frame": 2}, {"frame": 3}),
        r"from 0 to 2147483648.*from 2147483648 to 2.*then taken as frame 3"),
    ("a date twenty years ahead, HTTP", lambda w: w.put(timestamp=ahead(YEARS)), r"422 .*ahead of the service's clock"),
    ("8uc1", lambda w: w.pixels("8uc1", GREY.tobytes()), r"^\[0 of 1 with a pose\] node: uint8 \(48, 64\)"),
    ("BGR16", lambda w: w.pixels("BGR16", (scene(1, 64, 48).astype("<u2") * 257).tobytes()),
        r"^\[0 of 1 .* node: uint16 \(48, 64, 3\)"),
    ("bayer_rggb16", lambda w: w.pixels("bayer_rggb16", BAYER, height=24), r"^\[0 of 1 .* node: uint16 \(24, 64, 3\)"),
    ("nv12", lambda w: w.pixels("nv12", bytes(64 * 72)), r"^\[0 of 1 .* node: uint8 \(48, 64, 3\)"),
    ("an unknown encoding", lambda w: w.pixels("32FC1", bytes(64 * 48 * 4)),
        r"'32FC1' is not read.*node: Unfit.*32FC1"),
    ("ten bits of sixteen, HTTP", lambda w: w.put(png16(TEN_BITS)), r"422 .*reach only \d+ of 65535"),
    ("ten bits of sixteen, query", lambda w: w.query(png16(TEN_BITS)), r"200 few-values"),
    ("ten bits of sixteen, command", lambda w: w.enrol(folder(w, {"a.png": png16(TEN_BITS)})),
        r"exit 1.*reach only \d+ of 65535"),
    ("a thermal base", lambda w: w.put(png16(THERMAL)), r"422 .*of 65535"),
    ("h264", lambda w: f"{w.bag(compressed(START, b'abcdef', form='h264'))} node: "
        + w.node(SimpleNamespace(format="h264", data=b"abcdef")), r"'h264'.*another transport.*node: .*h264"),
    ("compressedDepth", lambda w: w.bag(compressed(START, encoded(GREY, ".png"), form="16UC1; compressedDepth png")),
        r"depth image, which shows no place"),
    ("Bayer within PNG", lambda w: w.bag(compressed(START, encoded(GREY, ".png"), form="bayer_rggb8; png compressed "
        "bayer_rggb8")), r"^\[0 of 1"),
    ("an empty split", empty_split, r"left out.*split_1\.mcap is not"),
    ("NFC and NFD", one_name, r"found 1 in 'été'"),
    ("a compressed body", lambda w: w.query(headers={"Content-Encoding": "gzip"}), r"415 .*gzip"),
    ("another digest", lambda w: w.query(headers={"Content-Digest": "sha-256=:" + 43 * "A" + "=:"}),
        r"4\d\d digest-mismatch"),
    ("image/jpg", lambda w: w.query(headers={"Content-Type": "image/jpg"}), r"^200"),
    ("k=1_0", lambda w: w.query(k="1_0"), r"422 .*k.*such as 5 or -1"),
    ("k=+5", lambda w: w.query(k="+5"), r"422 .*k"),
    ("metres and degrees, HTTP", lambda w: w.put(**METRES) and w.put(place="other", **DEGREES),
        r"4\d\d .*a map has one"),
    ("metres and degrees, batch", lambda w: batch(w, {"id": "m", **METRES}, {"id": "d", **DEGREES}),
        r"a map has one kind"),
    ("metres and degrees, query", lambda w: w.put(**METRES) and w.query(near_latitude=48, near_longitude=2, radius=5),
        r"4\d\d .*"),
    ("odometry_heading=400", lambda w: w.frames({"frame": 0}, {"odometry_x": 0, "odometry_y": 0,
        "odometry_heading": 400.0}), r"odometry_heading|heading"),
    ("NaN as a coordinate, HTTP", lambda w: w.put(x=math.nan, y=0), r"422 .*x"),
    ("two folders of one name", twice, r"exit 1.*--replace"),
]  # fmt: skip


@pytest.fixture
def ways(tmp_path: Path, server: Server, map_id: str) -> Iterator[Ways]:
    yield Ways(tmp_path, server, map_id)


@pytest.mark.parametrize(("act", "wanted"), [pytest.param(act, wanted, id=name) for name, act, wanted in ROWS])
def test_nothing_awkward_passes_in_silence(ways: Ways, act: Callable[[Ways], str], wanted: str) -> None:

    said = act(ways)
    print(said)
    assert re.search(wanted, said), said
