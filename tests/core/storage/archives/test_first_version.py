"""Export files of format version 1, as placerec 0.1.0 writes them: read for ever.

``tests/core/storage/fixtures/README.md`` says where they come from.
"""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidArchive
from core.maps.archives.manifest import VERSION
from core.storage import Atlas
from tests.core.storage.archives.files import exported, imported, line_changed, parts_of

FIXTURE = Path(__file__).parents[1] / "fixtures" / "export-version-1.tar.xz"

NEW_FIELDS = ("pose_of", "track", "station", "keypoints")


def read(name: str) -> bytes:
    with tarfile.open(FIXTURE, "r:xz") as archive:
        file = archive.extractfile(name)
        assert file is not None
        return file.read()


@pytest.mark.parametrize("precision", ["half", "compressed"])
def test_a_file_of_version_1(tmp_path: Path, precision: str) -> None:
    expected = json.loads(read("expected.json"))[precision]
    path = tmp_path / "old.tar"
    path.write_bytes(read(f"{precision}.tar"))
    atlas = Atlas(tmp_path / "data")
    found = imported(atlas, path, precision)
    record = found.record.model_dump(mode="json")
    assert {name: record[name] for name in expected["record"]} == expected["record"]
    places = {place.id: place for place in found.places(None, 100)[0]}
    assert list(places) == list(expected["places"])
    snapshot = found.snapshot()
    for place_id, known in expected["places"].items():
        shown = places[place_id].model_dump(mode="json")
        rows = np.array(found.rows_of([place_id]))
        shown["descriptor"] = snapshot.descriptors_at(rows)[0].tolist()
        shown["local"] = snapshot.locals_at(rows)[0].tolist()
        digest, picture = found.digest(place_id), found.picture(place_id)
        shown["digest"] = digest and digest.hex()
        shown["picture_text"] = picture and picture.decode()
        assert {name: shown[name] for name in known} == known
    cameras = [camera | {"intrinsics": None} for camera in expected["cameras"]]
    assert [camera.model_dump(mode="json") for camera in found.cameras.all()] == cameras
    assert [list(end) for end in found.transfer.sequence_ends().items()] == expected["sequence_ends"]
    assert found.verify().ok
    atlas.close()


@pytest.mark.parametrize("precision", ["half", "compressed"])
def test_it_is_written_again_with_the_same_frames(tmp_path: Path, precision: str) -> None:
    path = tmp_path / "old.tar"
    path.write_bytes(read(f"{precision}.tar"))
    atlas = Atlas(tmp_path / "data")
    manifest, parts = parts_of(exported(imported(atlas, path, precision), tmp_path / "kept"))
    known, known_parts = parts_of(path.read_bytes())
    assert (known["version"], manifest["version"]) == (1, VERSION)
    assert {name: manifest["map"][name] for name in known["map"]} == known["map"]
    for name, content in known_parts.items():
        added = NEW_FIELDS if name.startswith("places-") else ("intrinsics",) if name == "cameras.jsonl" else None
        if added is None:
            assert parts[name] == content, name
            continue
        for line, known_line in zip(parts[name].splitlines(), content.splitlines(), strict=True):
            assert json.loads(line) == json.loads(known_line) | dict.fromkeys(added)
    assert not any(content for name, content in parts.items() if name.startswith("keypoints-"))
    atlas.close()


def test_it_has_no_keypoints(tmp_path: Path) -> None:
    path = tmp_path / "old.tar"
    path.write_bytes(line_changed(read("half.tar"), "places-000001.jsonl", 0, keypoints=1))
    atlas = Atlas(tmp_path / "data")
    with pytest.raises(InvalidArchive, match="which files of version 1 do not hold"):
        imported(atlas, path, "half")
    atlas.close()


def test_single_precision_from_before_the_first_release_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.tar"
    path.write_bytes(read("full.tar"))
    atlas = Atlas(tmp_path / "data")
    with pytest.raises(InvalidArchive, match="precision"):
        imported(atlas, path, "full")
    assert atlas.records(None, 10)[0] == []
    atlas.close()
