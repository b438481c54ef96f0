"""The review in the file of a map: its setting, and labelled frames with their files; frames without a label stay."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from core.errors import InvalidArchive
from core.judgement.verdict import Verdict
from core.maps import ReviewSetting
from core.maps.archives.manifest import LABELLED, LABELS, VERSION, WITHOUT_LABELS
from core.store import Directory, Map
from tests.core.store.archives.files import Parts, changed, exported, imported, line_changed, parts_of
from tests.core.store.edits import edit
from tests.core.store.frames import frame

SETTING = ReviewSetting(verdicts=("unknown",), most_frames=20)
SAID = {"at": "2026-11-28T10:00:00.250000+00:00", "by": "ann"}
LABELS_GIVEN: list[dict[str, Any]] = [
    {"place": "p1"},
    {"place": "p1", "look": "0123456789abcdef"},
    {"new": "p2"},
    {"stranger": True},
]


def answered(verdict: Verdict, **more: object) -> dict[str, Any]:
    """An answer as a service stores it, of a frame that a run also proposes as a look."""
    matches = [{"place": "p1", "score": 0.25}]
    return {
        "verdict": verdict, "reason": None, "probability": 0.5, "score": 0.25, "decision": 0.1, "threshold": 0.09,
        "best": "p1", "matches": matches, "revision": 3, "camera": "front", "session": None, "frame": 7, "file": None,
        "operation": "query", "request_id": "r", "key": "robot", **more,
    }  # fmt: skip


@pytest.fixture
def reviewed(lab: Map) -> Map:
    """A map with a labelled frame of each kind, and one without a label."""
    lab.enrol([frame("p1"), frame("p2")])
    lab.edit({"review": SETTING})
    for number, label in enumerate(LABELS_GIVEN, start=1):
        taken = {"taken": "2026-11-28T09:00:00+00:00"} if number == 2 else {}
        lab.review.keep(f"file {number}".encode(), answered("unknown", **taken), SETTING)
        lab.review.label(number, {"label": label, **SAID})
    lab.review.keep(b"not labelled", answered("ambiguous"), SETTING)
    return lab


def copied(content: bytes, folder: Path) -> Map:
    folder.mkdir()
    path = folder / "sent.tar"
    path.write_bytes(content)
    return imported(Directory(folder / "data"), path, "copy")


def test_labels_and_the_setting_come_back(reviewed: Map, tmp_path: Path) -> None:
    content = exported(reviewed, tmp_path / "kept")
    manifest, parts = parts_of(content)
    assert manifest["version"] == VERSION and parts[LABELLED] == b"file 1file 2file 3file 4"
    copy = copied(content, tmp_path / "other")
    assert copy.record.review == SETTING
    was, now = reviewed.review.labelled(), copy.review.labelled()
    assert [(one.at, one.digest, one.answer, one.label) for one in now] == [
        (one.at, one.digest, one.answer, one.label) for one in was
    ]
    assert [copy.review.picture(one.number) for one in now] == [b"file 1", b"file 2", b"file 3", b"file 4"]
    assert copy.review.page(None, 10).count == 4, "the frame without a label stays behind"
    assert copy.verify().ok
    assert parts_of(exported(copy, tmp_path / "again"))[1] == parts
    copy.review.keep(b"the next one", answered("unknown"), SETTING)
    assert copy.review.page(None, 1).frames[0].number == 5


def test_proposals_stay_behind(reviewed: Map, tmp_path: Path) -> None:
    """What a run proposed rests on rows of this very map."""
    reviewed.review.keep(b"proposed", answered("unknown", proposal={"place": "p1"}), SETTING)
    reviewed.review.label(6, {"label": {"place": "p1"}, **SAID})
    copy = copied(exported(reviewed, tmp_path / "kept"), tmp_path / "other")
    assert copy.review.labelled()[-1].answer == answered("unknown")


def test_a_file_without_labels_is_what_it_was(lab: Map, tmp_path: Path) -> None:
    """An earlier version can read it, and a setting of the review alone changes nothing of that."""
    lab.enrol([frame("p1")])
    manifest, parts = parts_of(exported(lab, tmp_path / "kept"))
    assert manifest["version"] == WITHOUT_LABELS and "review" not in manifest["map"] and LABELS not in parts
    lab.edit({"review": SETTING})
    lab.review.keep(b"not labelled", answered("unknown"), SETTING)
    manifest, parts = parts_of(exported(lab, tmp_path / "kept"))
    assert manifest["version"] == WITHOUT_LABELS and manifest["map"]["review"]["verdicts"] == ["unknown"]
    assert LABELS not in parts


def test_a_damaged_frame_harms_no_export(reviewed: Map, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    edit(reviewed, "UPDATE review_pictures SET bytes = x'00' WHERE number = 2")
    _, parts = parts_of(exported(reviewed, tmp_path / "kept"))
    assert parts[LABELLED] == b"file 1file 3file 4" and "left out" in caplog.text


def more_files(content: bytes) -> bytes:
    def change(_manifest: dict[str, Any], parts: Parts) -> None:
        parts[LABELLED] += b"more"

    return changed(content, change)


def twice(content: bytes) -> bytes:
    def change(manifest: dict[str, Any], parts: Parts) -> None:
        first = parts[LABELS].splitlines(keepends=True)[0]
        parts[LABELS], parts[LABELLED] = parts[LABELS] + first, parts[LABELLED] + b"file 1"
        manifest["parts"][2]["rows"] = manifest["parts"][3]["rows"] = 5

    return changed(content, change)


def uneven(content: bytes) -> bytes:
    def change(manifest: dict[str, Any], _parts: Parts) -> None:
        manifest["parts"][3]["rows"] = 3

    return changed(content, change)


def line(**values: Any) -> Callable[[bytes], bytes]:
    return lambda content: line_changed(content, LABELS, 0, **values)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (line(label={"place": "p1", "stranger": True}), "exactly one"),
        (line(label={}), "exactly one"),
        (line(label={"place": "../x"}), "label"),
        (line(label={"place": "p1", "more": 1}), "no field 'more'"),
        (line(answer={"verdict": "sure"}), "verdict"),
        (line(answer={"verdict": "unknown", "proposal": {}}), "no field 'proposal'"),
        (line(sha256="0" * 64), "SHA-256"),
        (line(bytes=7), "SHA-256"),
        (line(bytes=10**9), "at most"),
        (line(labelled_at="yesterday"), "labelled_at"),
        (more_files, "longer than its content"),
        (twice, "listed twice"),
        (uneven, "differ in the number of frames"),
    ],
)
def test_what_is_no_label_is_refused(reviewed: Map, tmp_path: Path, change: Callable[[bytes], bytes], why: str) -> None:
    content = exported(reviewed, tmp_path / "kept")
    (tmp_path / "other").mkdir()
    path = tmp_path / "other/sent.tar"
    path.write_bytes(change(content))
    with pytest.raises(InvalidArchive, match=why):
        imported(Directory(tmp_path / "other/data"), path, "copy", most_picture_bytes=1000)


def test_the_lines_are_plain_json(reviewed: Map, tmp_path: Path) -> None:
    _, parts = parts_of(exported(reviewed, tmp_path / "kept"))
    first = json.loads(parts[LABELS].splitlines()[0])
    assert first["label"] == {"place": "p1"} and first["labelled_by"] == "ann" and first["bytes"] == 6
