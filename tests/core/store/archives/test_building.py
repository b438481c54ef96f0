"""Files whose checksums are right and whose contents are not: what no map may hold comes into none."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
import pytest

from core.errors import InvalidArchive, InvalidIdentifier, InvalidImage, MapExists, StorageFull
from core.ledger.maps.writing import Write
from core.maps.archives import unpacking
from core.maps.archives.manifest import Manifest
from core.places import look_address
from core.store import Directory
from tests.core.store.archives.files import Parts, changed, imported, line_changed, parts_of
from tests.core.store.frames import DIMENSION, ENCODER, digest_of, frame

Made = Callable[[bytes], bytes]
PLACES, FRAMES, PICTURES = "places-000001.jsonl", "descriptors-000001.bin", "pictures-000001.bin"
KEYPOINTS = "keypoints-000001.bin"
CAMERAS, SEQUENCES = "cameras.jsonl", "sequences.jsonl"


def place(**values: Any) -> Made:
    """Other values in the second place."""
    return lambda content: line_changed(content, PLACES, 1, **values)


def line(part: str, number: int, **values: Any) -> Made:
    return lambda content: line_changed(content, part, number, **values)


def raw(part: str, change: Callable[[bytes], bytes]) -> Made:
    def edit(_manifest: dict[str, Any], parts: Parts) -> None:
        parts[part] = change(parts[part])

    return lambda content: changed(content, edit)


def counted(part: str, number: int, change: Callable[[bytes], bytes]) -> Made:
    """Other lines, and as many as the manifest says."""

    def edit(manifest: dict[str, Any], parts: Parts) -> None:
        parts[part] = change(parts[part])
        manifest["parts"][number]["rows"] = parts[part].count(b"\n")

    return lambda content: changed(content, edit)


def descriptor(*values: float) -> Made:
    """Another descriptor of the first place."""

    def change(data: bytes) -> bytes:
        halves = np.zeros(DIMENSION, "<f2")
        halves[: len(values)] = values
        return halves.tobytes() + data[2 * DIMENSION :]

    return raw(FRAMES, change)


def again(data: bytes) -> bytes:
    first = data.splitlines(keepends=True)[1]
    return data + first


def many(data: bytes) -> bytes:
    return b"".join(data.splitlines(keepends=True)[0].replace(b"front", b"c%d" % i) for i in range(257))


def deep(levels: int) -> dict[str, Any]:
    value: dict[str, Any] = {}
    for _ in range(levels):
        value = {"a": value}
    return value


KEPT = {"kind": "image", "bytes": 11, "sha256": "0" * 64}
HOSTILE: dict[str, tuple[Made, str]] = {
    "a place twice": (place(id="p0"), "'p0' is listed twice"),
    "an id that is none": (place(id="../p1"), "id"),
    "an id with an end of line": (place(id="p1\n"), "id"),
    "a field more": (place(owner="me"), "owner"),
    "a field of the tables": (place(row=0), "row"),
    "a sequence not listed": (place(sequence="sunday"), "does not list"),
    "a sequence with a slash": (place(sequence="a/b"), "sequence"),
    "an ordinal behind the end": (place(ordinal=7), "behind its end"),
    "an ordinal below 0": (place(ordinal=-1), "ordinal"),
    "an ordinal too large": (place(ordinal=1 << 63), "ordinal"),
    "an ordinal that is true": (place(ordinal=True), "ordinal"),
    "regions too many": (place(regions=1 << 63), "regions"),
    "two poses": (place(pose={"x": 1, "y": 2, "latitude": 1, "longitude": 2}), "pose"),
    "half a pose": (place(pose={"x": 1}), "pose"),
    "a pose too far": (place(pose={"x": 1e300, "y": 0}), "pose"),
    "an infinite pose": (raw(PLACES, lambda d: d.replace(b'"x":0.0', b'"x":1e999')), "pose"),
    "no number": (raw(PLACES, lambda d: d.replace(b'"x":0.0', b'"x":NaN')), "NaN"),
    "a name twice": (raw(PLACES, lambda d: d.replace(b'"id":"p0"', b'"id":"p0","id":"p9"')), "twice"),
    "no time": (place(timestamp="noon"), "timestamp"),
    "no camera's name": (place(camera="../x"), "camera"),
    "deep metadata": (place(metadata=deep(70)), "nested"),
    "endless metadata": (raw(PLACES, lambda d: d.replace(b'"i":0', b'"i":1e999')), "JSON"),
    "long metadata": (place(metadata={"a": "x" * (1 << 20)}), "the metadata has more than"),
    "metadata that is a list": (place(metadata=[1]), "metadata"),
    "half a character": (raw(SEQUENCES, lambda d: d.replace(b"monday", b"\\ud800")), "cannot name a sequence"),
    "half a character in metadata": (place(metadata={"a": "\ud800"}), "half a character"),
    "no digest": (place(digest="ff"), "digest"),
    "a picture of another digest": (line(PLACES, 5, picture=KEPT), "does not match its SHA-256"),
    "a picture too long": (line(PLACES, 5, picture={**KEPT, "bytes": 1 << 40}), "picture"),
    "a picture that is not there": (line(PLACES, 5, picture={**KEPT, "bytes": 1 << 20}), "shorter"),
    "a picture of no kind": (line(PLACES, 5, picture={**KEPT, "kind": "none"}), "picture"),
    "pictures left over": (raw(PICTURES, lambda d: d + b"more"), "longer"),
    "pictures too few": (raw(PICTURES, lambda d: d[:-1]), "shorter"),
    "keypoints of other numbers": (place(keypoints=5), "keypoints of place 'p1' cannot be taken|shorter"),
    "keypoints too many": (place(keypoints=577), "keypoints"),
    "keypoints below 0": (place(keypoints=-1), "keypoints"),
    "keypoints that are true": (place(keypoints=True), "keypoints"),
    "keypoints not listed": (place(keypoints=None), "cannot be taken|longer"),
    "keypoints left over": (raw(KEYPOINTS, lambda d: d + b"more"), "longer"),
    "keypoints too few": (raw(KEYPOINTS, lambda d: d[:-1]), "shorter"),
    "keypoints of no frame": (raw(KEYPOINTS, lambda d: bytes(4) + d[4:]), "keypoints of place 'p0' cannot be taken"),
    "keypoints without descriptors": (raw(KEYPOINTS, lambda d: d[:12] + bytes(len(d) - 12)), "lacks a descriptor"),
    "endless keypoints": (raw(KEYPOINTS, lambda d: d + bytes(400_000)), "more bytes than the keypoints of 9 places"),
    "a look that is its place": (
        place(id=look_address("p0", digest_of("p0").hex()[:16]), digest=digest_of("p0").hex()),
        "with which its place was enrolled",
    ),
    "a track not listed": (place(track="sunday", station=1), "does not list"),
    "a track without a station": (place(track="monday"), "needs a station"),
    "a station without a track": (place(station=1), "needs a station"),
    "a pose of nobody": (place(pose_of="../p1"), "pose_of"),
    "a pose of another that is none": (place(pose=None, pose_of="p0"), "has no pose of another"),
    "a track below 0": (place(track=-1, station=1), "track"),
    "a station too far": (place(track=0, station=1 << 63), "station"),
    "descriptors left over": (raw(FRAMES, lambda d: d + d[:47]), ", not 9 times"),
    "descriptors too few": (raw(FRAMES, lambda d: d[:-47]), ", not 9 times"),
    "a descriptor of zeros": (descriptor(), "cannot be compared"),
    "a descriptor that is no number": (descriptor(1, np.nan), "cannot be compared"),
    "an infinite descriptor": (descriptor(1, np.inf), "cannot be compared"),
    "a line too few": (raw(PLACES, lambda d: d[: d.rindex(b"\n", 0, -1) + 1]), "lines, not 9|longer"),
    "a line too many": (
        raw(PLACES, lambda d: d + d.splitlines(keepends=True)[0].replace(b"p0", b"p99")),
        "more lines, not 9",
    ),
    "no end of line": (raw(PLACES, lambda d: d[:-1]), "end with a line end"),
    "an empty line": (raw(PLACES, lambda d: d.replace(b"\n", b"\n\n", 1)), "is not JSON"),
    "no UTF-8": (raw(PLACES, lambda d: d.replace(b"p0", b"\xff\xfe", 1)), "UTF-8"),
    "no object": (raw(PLACES, lambda d: b"[]\n" + d.split(b"\n", 1)[1]), "line 1"),
    "an endless line": (raw(PLACES, lambda d: b" " * (5 << 20) + d), "a line of more than"),
    "a sequence twice": (counted(SEQUENCES, 0, again), "'monday' is listed twice"),
    "a sequence of nobody": (line(SEQUENCES, 1, name="sunday"), "does not list"),
    "a sequence named ..": (line(SEQUENCES, 1, name=".."), "name"),
    "a sequence with a mark of direction": (line(SEQUENCES, 1, name="mon\u202eday"), "name"),
    "a place of a sequence named .": (place(sequence="."), "sequence"),
    "a track named ..": (place(track="..", station=1), "track"),
    "a camera named ..": (line(CAMERAS, 0, name=".."), "name"),
    "an empty sequence": (counted(SEQUENCES, 0, lambda d: d + b'{"name":"empty","next_ordinal":1}\n'), "is empty"),
    "sequences miscounted": (raw(SEQUENCES, lambda d: d + b'{"name":"empty","next_ordinal":1}\n'), "lines, not"),
    "more sequences than places": (
        counted(SEQUENCES, 0, lambda d: d + b"".join(b'{"name":"s%d","next_ordinal":1}\n' % i for i in range(20))),
        "no more than 10 sequences",
    ),
    "a camera twice": (counted(CAMERAS, 1, again), "'rear' is listed twice"),
    "too many cameras": (counted(CAMERAS, 1, many), "at most 256"),
    "a mask of everything": (line(CAMERAS, 0, mask={"polygons": [[[0, 0], [1, 0], [1, 1], [0, 1]]]}), "mask"),
    "intrinsics without a focal length": (line(CAMERAS, 1, intrinsics={"width": 640, "height": 480}), "intrinsics.fx"),
    "intrinsics of no lens": (
        line(CAMERAS, 1, intrinsics={"width": 640, "height": 480, "fx": 0.0, "fy": 5.0, "cx": 1.0, "cy": 1.0}),
        "intrinsics.fx",
    ),
}


def left_behind(directory: Path) -> list[str]:
    return [path.name for path in (directory / "maps").iterdir()]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Directory:
    return Directory(tmp_path_factory.mktemp("library") / "data", rows_per_segment=4)


@pytest.mark.thorough
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_contents_are_refused(content: bytes, library: Directory, tmp_path: Path, case: str) -> None:
    make, complaint = HOSTILE[case]
    path = tmp_path / "sent.tar"
    path.write_bytes(make(content))
    with pytest.raises(InvalidArchive, match=complaint):
        imported(library, path, "lab")
    assert left_behind(library._directory) == [] and library.records(None, 10) == ([], None)


def test_the_cases_are_refused_for_nothing_else(content: bytes, library: Directory, tmp_path: Path) -> None:
    path = tmp_path / "sent.tar"
    path.write_bytes(place(metadata={"changed": True})(content))
    made = imported(library, path, "another")
    assert made.place("p1").metadata == {"changed": True} and made.record.id == "another"
    assert made.verify().ok
    library.delete("another")


def test_pictures_can_be_looked_at(content: bytes, library: Directory, tmp_path: Path) -> None:
    def refuse(data: bytes) -> None:
        raise InvalidImage("no picture at all")

    path = tmp_path / "sent.tar"
    path.write_bytes(content)
    with pytest.raises(InvalidArchive, match="no picture at all"):
        imported(library, path, "lab", check_picture=refuse)
    assert left_behind(library._directory) == []


def test_large_pictures_are_not_even_read(content: bytes, library: Directory, tmp_path: Path) -> None:
    path = tmp_path / "sent.tar"
    path.write_bytes(content)
    with pytest.raises(InvalidArchive, match=r"cannot be taken: it has .* at most 3"):
        imported(library, path, "lab", most_picture_bytes=3)
    assert left_behind(library._directory) == []


@pytest.mark.parametrize(
    "values",
    [
        {"dimension": 1 << 24, "local_cells": 1 << 20, "local_values": 1 << 16},
        {"dimension": 1 << 24, "local_cells": 1 << 15, "local_values": (1 << 16) - 1},  # numpy counts it below zero
        {"local_cells": 1, "local_values": 0},
    ],
)
@pytest.mark.parametrize("precision", ["half", "compressed"])
def test_places_that_nothing_could_hold(content: bytes, values: dict[str, Any], precision: str) -> None:
    manifest = parts_of(content)[0]
    manifest["map"] |= {**values, "precision": precision}
    with pytest.raises(InvalidArchive, match="is impossible"):
        unpacking.check_sizes(Manifest.model_validate(manifest))


def test_it_can_be_broken_off_among_the_sequences(
    content: bytes, library: Directory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def advance(done: int, total: int) -> None:
        raise KeyboardInterrupt(f"{done} of {total}")

    monkeypatch.setattr(unpacking, "LINES_BETWEEN", 2)
    path = tmp_path / "sent.tar"
    path.write_bytes(content)
    with pytest.raises(KeyboardInterrupt, match="0 of 9"):
        imported(library, path, "lab", advance)
    assert left_behind(library._directory) == []


def test_few_long_lines_are_held_at_a_time(
    content: bytes, library: Directory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unpacking, "TEXT_BYTES", 4500)
    path, seen = tmp_path / "sent.tar", []
    for number in (2, 5):
        content = line_changed(content, PLACES, number, metadata={"a": "x" * 4400})
    path.write_bytes(content)
    made = imported(library, path, "long", advance=lambda done, _: seen.append(done))
    assert seen == [3, 6, 9] and made.verify().ok
    library.delete("long")


def test_the_id_is_taken_while_it_is_built(content: bytes, library: Directory, tmp_path: Path) -> None:
    path = tmp_path / "sent.tar"
    path.write_bytes(content)

    def give_up(places: int) -> None:
        assert places == 9
        with pytest.raises(MapExists, match="being made"):
            library.create("lab", ENCODER, DIMENSION)
        with pytest.raises(MapExists, match="being made"):
            imported(library, path, "lab")
        raise RuntimeError("no more of this")

    with pytest.raises(RuntimeError, match="no more"):
        imported(library, path, "lab", before_listing=give_up)
    imported(library, path, "lab")
    with pytest.raises(MapExists, match="already"):
        imported(library, path, "lab")
    library.delete("lab")
    with pytest.raises(InvalidIdentifier):
        imported(library, path, "../lab")


def test_nothing_of_it_is_seen_before_it_is_whole(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Broken off between two commits, and the process ended there: the next one finds no map, and no rest of one."""
    monkeypatch.setattr(unpacking, "CHUNK_BYTES", 1)
    path, directory = tmp_path / "sent.tar", tmp_path / "data"
    path.write_bytes(content)
    atlas = Directory(directory)
    seen = []

    def advance(done: int, total: int) -> None:
        assert atlas.records(None, 10) == ([], None) and total == 9
        seen.append(done)
        if done == 5:
            atlas.close()  # as if the process ended: nothing of the building can be undone
            left = left_behind(directory)
            assert len(left) == 1 and left[0].startswith(".making-lab-")
            again = Directory(directory)
            assert left_behind(directory) == [] and again.quarantined() == {}
            again.close()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        imported(atlas, path, "lab", advance)
    assert seen == [1, 2, 3, 4, 5]


def test_a_full_disk_leaves_nothing(content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "sent.tar"
    path.write_bytes(content)
    atlas = Directory(tmp_path / "data")

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Write, "add_stored", refuse)
    with pytest.raises(StorageFull):
        imported(atlas, path, "lab")
    assert left_behind(tmp_path / "data") == []
    monkeypatch.undo()
    made = imported(atlas, path, "lab")
    made.enrol([frame("next")])
    assert made.verify().ok
    atlas.close()


def test_lines_are_what_a_person_can_read(content: bytes) -> None:
    lines = {line["id"]: line for line in map(json.loads, parts_of(content)[1][PLACES].splitlines())}
    shown = lines["roof"]
    assert (shown["track"], shown["station"]) == (lines["q1"]["track"], 1) == (0, 1), "its sequence is gone"
    assert (lines["q0"]["track"], lines["q0"]["station"], lines["q0"]["pose_of"]) == ("monday", 2, "p2")
    assert shown["pose"] == {"latitude": 48.8, "longitude": 2.3, "heading": 10.0}
    assert shown["sequence"] == "Ünter den Linden"
    assert (lines["q0"]["level"], lines["q0"]["pose_accuracy"]) == ("2", {"metres": 0.5, "degrees": 2.0})


def test_a_file_of_old_gives_its_texts_their_one_form(
    content: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two traverses whose names look the same stay two, and metadata with such names stays as it is."""
    apart, path = normalize("NFD", "Ü"), tmp_path / "old.tar"
    walk, letter = json.dumps(f"{apart}nter den Linden").encode(), json.dumps(normalize("NFD", "ä")).encode()

    def edit(_manifest: dict[str, Any], parts: Parts) -> None:
        parts[SEQUENCES] = parts[SEQUENCES].replace(b'"monday"', walk)
        changed = parts[PLACES].replace(b'"monday"', walk).replace('"ä"'.encode(), letter, 1)
        parts[PLACES] = changed.replace('"ä"'.encode(), b"%b: 1, %b" % ('"ä"'.encode(), letter), 1)

    path.write_bytes(changed(content, edit))
    atlas = Directory(tmp_path / "data")
    made = imported(atlas, path, "old")
    assert made.verify().ok
    names = {one.name: one.places for one in made.sequences(None, 9)[0]}
    assert names == {"Ünter den Linden": 6, "Ünter den Linden~2": 1}
    assert "sequence renamed" in caplog.text
    first, second = (set(made.place(f"p{number}").metadata) for number in range(2))
    atlas.close()
    assert first == {"i", "ä"} and second == {"i", "ä", normalize("NFD", "ä")}


def test_a_file_of_old_has_no_levels_but_those_of_its_metadata(content: bytes, tmp_path: Path) -> None:
    def edit(_manifest: dict[str, Any], parts: Parts) -> None:
        lines = [json.loads(line) for line in parts[PLACES].splitlines()]
        assert [line["level"] for line in lines if line["level"] is not None] == ["2"]
        for line in lines:
            del line["level"], line["pose_accuracy"]
            line["metadata"] |= {"floor": 3} if line["id"] == "p1" else {}
        parts[PLACES] = b"".join(json.dumps(line).encode() + b"\n" for line in lines)

    path = tmp_path / "old.tar"
    path.write_bytes(changed(content, edit))
    atlas = Directory(tmp_path / "data")
    made = imported(atlas, path, "old")
    assert made.verify().ok
    places = made.places(None, 99)[0]
    atlas.close()
    assert {place.id: place.level for place in places if place.level} == {"p1": "3"}
    assert all(place.pose_accuracy is None for place in places)


def test_a_flipped_bit_anywhere_makes_no_map(content: bytes, library: Directory, tmp_path: Path) -> None:
    path = tmp_path / "sent.tar"
    for at in range(7, len(content), len(content) // 37):
        path.write_bytes(content[:at] + bytes([content[at] ^ (1 << at % 8)]) + content[at + 1 :])
        with pytest.raises(InvalidArchive):
            imported(library, path, "lab")
    assert left_behind(library._directory) == [] and library.records(None, 10) == ([], None)
