"""What people have at hand: images of Pillow, ``time.time()``, headings that have gone around; and what is refused."""

from __future__ import annotations

import asyncio
import inspect
import io
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from core.frames.images import decode
from placerec_client import (
    AsyncClient,
    Client,
    InvalidFrame,
    InvalidParameter,
    Map,
    NewPlace,
    Odometry,
    Picture,
    PlacerecError,
    Retry,
    TransferFailed,
    UnreadableFile,
)
from placerec_client.frames import frame_bytes
from placerec_client.requests import as_meant, dumps, text_of
from tests.clients.python.test_names import finished
from tests.service.refusing import refusing_server
from tests.service.scenes import jpeg

FRAME = jpeg(1, 64, 48)
COLOURS = Image.open(io.BytesIO(FRAME)).convert("RGB")
NOW = 1_763_800_000.25
MILLISECONDS, UPTIME = 1e3 * NOW, 52_340.7


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "CMYK", "1", "LA"])
def test_an_image_of_pillow_is_sent_with_its_pixels(mode: str) -> None:
    image = COLOURS.convert(mode)
    grey = mode == "L"
    expected = np.asarray(image if grey else image.convert("RGB"))
    sent = Image.open(io.BytesIO(frame_bytes(image)))
    assert sent.format == "PNG" and sent.mode == ("L" if grey else "RGB")
    np.testing.assert_array_equal(np.asarray(sent), expected)


def test_it_keeps_16_bits_is_turned_upright_and_may_become_a_jpeg_file() -> None:
    deep = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(frame_bytes(Image.fromarray(deep))))), deep)
    turned, file = Image.Exif(), io.BytesIO()
    turned[0x0112] = 6  # the top is on the right
    COLOURS.save(file, "JPEG", exif=turned)
    upright = Image.open(io.BytesIO(frame_bytes(Image.open(file))))
    assert upright.size == COLOURS.size[::-1]
    np.testing.assert_array_equal(np.asarray(upright), decode(file.getvalue())[..., ::-1])
    assert frame_bytes(Picture(COLOURS, encoding="jpeg", quality=50)).startswith(b"\xff\xd8\xff")
    assert "64x48" in repr(Picture(COLOURS))


@pytest.mark.parametrize(
    "frame",
    [
        Image.new("F", (3, 3)),
        Image.new("RGB", (0, 3)),
        Picture(Image.new("I", (3, 3)), encoding="jpeg"),
        Picture(object()),  # type: ignore[arg-type]
        Path("no such file.jpg"),
        "\0",
        type("Reader", (), {"read": lambda self, size: b""})(),
    ],
)
def test_what_is_no_frame_is_refused_by_an_error_of_the_client(frame: Any) -> None:
    with pytest.raises(InvalidFrame) as refused:
        frame_bytes(frame)
    assert isinstance(refused.value, PlacerecError) and isinstance(refused.value, ValueError)


def test_a_damaged_image_of_pillow_is_refused() -> None:
    closed = Image.open(io.BytesIO(FRAME[: len(FRAME) // 2]))
    with pytest.raises(InvalidFrame, match="cannot be read"):
        frame_bytes(closed)


@pytest.mark.parametrize("kind", [float, np.float64])
def test_seconds_since_1970_are_a_time(kind: Callable[[float], Any]) -> None:
    assert text_of("timestamp", kind(NOW)) == "2025-11-22T08:26:40.250000+00:00"
    assert as_meant("after", kind(NOW)) == datetime.fromtimestamp(NOW, UTC)
    given = {"timestamp": kind(NOW), "metadata": {"timestamp": 7, "heading": 400}, "filter": {"before": kind(NOW)}}
    assert dumps(given) == (
        '{"timestamp": "2025-11-22T08:26:40.250000+00:00", "metadata": {"timestamp": 7, "heading": 400}, '
        '"filter": {"before": "2025-11-22T08:26:40.250000+00:00"}}'
    )


@pytest.mark.parametrize(
    ("seconds", "why"),
    [
        (MILLISECONDS, "milliseconds: divide by 1e3"),
        (1e9 * NOW, "nanoseconds: divide by 1e9"),
        (UPTIME, "monotonic"),
        (0, "monotonic"),
        (float("nan"), "seconds since 1970"),
    ],
)
def test_numbers_that_can_be_no_time_are_refused_with_what_they_seem_to_be(seconds: float, why: str) -> None:
    for send in (text_of, lambda name, value: dumps({name: value})):
        with pytest.raises(InvalidParameter, match=why):
            send("timestamp", seconds)


@pytest.mark.parametrize(("given", "sent"), [(-90, 270.0), (370.5, 10.5), (360, 0.0), (-1e-17, 0.0), (12, 12.0)])
def test_headings_of_any_size_are_sent_within_a_turn(given: float, sent: float) -> None:
    assert text_of("heading", given) == repr(sent)
    assert dumps([{"heading": given}]) == f'[{{"heading": {sent}}}]'
    assert Odometry(0, 0, given).fields().get("odometry_heading") == sent


@pytest.fixture(scope="module")
def lab(url: str) -> Iterator[Map]:
    with Client(url) as client:
        yield client.maps.create("at-hand")


def test_a_service_takes_them_everywhere(lab: Map) -> None:
    now = time.time()
    put = lab.places.put("p1", COLOURS, x=1, y=2, heading=-90, timestamp=now)
    assert put.timestamp is not None and put.timestamp.timestamp() == pytest.approx(now, abs=1e-3)
    assert put.pose is not None and put.pose.heading == 270
    fields = {"x": 2, "y": 2, "heading": 450, "timestamp": now}
    enrolled = lab.enrol([NewPlace("p2", COLOURS, fields), NewPlace("p3", lambda: COLOURS, fields)])
    assert [one.change for one in enrolled] == ["created", "created"]
    assert lab.places.edit("p2", {"timestamp": now - 60}).timestamp is not None
    assert [one.id for one in lab.places.list(before=now - 30)] == ["p2"]
    assert lab.query(COLOURS, timestamp=now, heading=-450, heading_tolerance=180).matches
    with lab.sessions.begin() as session:
        assert session.send(COLOURS, timestamp=now).frames == 1
        with session.stream() as stream:
            assert stream.send(COLOURS, timestamp=now + 1, odometry=Odometry(0, 0, -400)).frames == 2
    with pytest.raises(InvalidParameter, match="milliseconds"):
        lab.query(FRAME, timestamp=1e3 * now)


ODD: list[Any] = [
    *(None, object(), b"x", "", "..", "\0", "\ud800", 5, -1, float("nan"), 1e300, [], {}, [object()]),
    *({"a": object()}, Path("/no/such/file"), Image.new("F", (3, 3)), lambda: 1),
]
"""Values that hardly any parameter takes."""


def methods(one: object) -> Iterator[tuple[str, Callable[..., Any]]]:
    """The public methods of an object."""
    for name in dir(type(one)):
        if not name.startswith("_") and inspect.isfunction(inspect.getattr_static(type(one), name)):
            yield name, getattr(one, name)


def parts(client: Any) -> list[object]:
    """The client and all its parts that have methods."""
    lab = client.maps["m"]
    found = [client, client.maps, lab, lab.sessions["s"], client.jobs["j"]]
    for one in [client, lab]:
        for name in dir(one):
            value = None if name.startswith("_") or name == "connection" else getattr(one, name)
            if type(value).__module__.startswith("placerec_client") and type(value) not in map(type, found):
                found.append(value)
    return found


NOT_CALLED = {"close", "wait_ready", "events"}
"""They wait for the service or leave it."""


async def escaped(client: Any) -> list[str]:
    """What the methods raise that is no error of the client, called with odd values."""
    found: list[str] = []
    for part in parts(client):
        for name, method in methods(part):
            if name in NOT_CALLED:
                continue
            known = inspect.signature(method).parameters.values()
            places = [one for one in known if one.kind is one.POSITIONAL_OR_KEYWORD]
            words = [one.name for one in known if one.kind is one.KEYWORD_ONLY]
            more = ["timestamp", "heading"] if any(one.kind is one.VAR_KEYWORD for one in known) else []
            for odd in ODD:
                for named in (more, [*words, *more]):
                    try:
                        await finished(method(*[odd] * len(places), **dict.fromkeys(named, odd)))
                    except PlacerecError:
                        pass
                    except Exception as error:
                        found.append(f"{type(part).__name__}.{name}({odd!r}): {type(error).__name__}: {error}")
    return found


@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_every_refusal_of_every_method_is_one_of_the_client(
    kind: type[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a download begins with a file

    async def called() -> list[str]:
        with refusing_server() as (url, _):
            return await escaped(kind(url, retry=Retry(patience=0), timeout=5))

    assert asyncio.run(called()) == []


def test_a_recording_that_cannot_be_read_is_both_a_refusal_and_an_oserror(lab: Map, tmp_path: Path) -> None:
    (folder := tmp_path / "folder.mcap").mkdir()
    for file in ("/no/such.mcap", folder):
        with pytest.raises(UnreadableFile) as refused:
            lab.recordings.upload(file)
        assert isinstance(refused.value, OSError) and isinstance(refused.value, PlacerecError)
    with pytest.raises(TransferFailed, match="no path of a file"):
        lab.recordings.upload("\0")
