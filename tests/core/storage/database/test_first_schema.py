"""A data directory that the first released storage wrote, as it wrote it: opened, searched, written on, moved.

``fixtures/README.md`` says which commit wrote it and how.
"""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.storage import Atlas, Map
from tests.core.storage.archives.files import exported, imported
from tests.core.storage.frames import descriptor_of, digest_of, frame

FIXTURE = Path(__file__).parents[1] / "fixtures" / "first-schema.tar.xz"
NO_LOCAL = (0, 0)


def unpacked(directory: Path) -> dict[str, Any]:
    """Write the fixture's files below ``directory``; what the code of that time said of them."""
    expected: dict[str, Any] = {}
    with tarfile.open(FIXTURE, "r:xz") as archive:
        for member in archive:
            file = archive.extractfile(member)
            assert member.isreg() and file is not None and ".." not in member.name
            if member.name == "expected.json":
                expected = json.load(io.TextIOWrapper(file, "utf-8"))
                continue
            target = directory / member.name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read())
    return expected


def check(found: Map, expected: dict[str, Any]) -> None:
    """Every place, field and vector as it was, and nothing else."""
    record = found.record.model_dump(mode="json")
    for name, value in expected["record"].items():
        if name == "calibration" and value is not None:
            assert {key: record[name][key] for key in value} == value
        else:
            assert record[name] == value, name
    places = {place.id: place for place in found.places(None, 100)[0]}
    assert list(places) == list(expected["places"])
    snapshot = found.snapshot()
    assert len(snapshot) == len(places)
    for place_id, known in expected["places"].items():
        shown = places[place_id].model_dump(mode="json")
        assert {name: shown[name] for name in shown if name != "camera"} == {
            name: known[name] for name in shown if name != "camera"
        }
        assert shown["camera"] is None
        digest = found.digest(place_id)
        assert digest is not None and digest.hex() == known["digest"] == digest_of(known["picture_of"]).hex()
        rows = np.array(found.rows_of([place_id]))
        wanted = descriptor_of(known["picture_of"])
        np.testing.assert_array_equal(snapshot.descriptors_at(rows)[0], wanted)
        assert snapshot.search(wanted)[0][0] == rows[0]
        picture = found.picture(place_id)
        kind = known["picture"]
        assert picture == (None if kind == "none" else f"{kind} of {known['picture_of']}".encode())
    sequences = [summary.model_dump(mode="json") for summary in found.sequences(None, 100)[0]]
    assert sequences == expected["sequences"]
    report = found.verify()
    assert (report.ok, report.problems) == (True, [])


@pytest.mark.parametrize("map_id", ["lab", "bare", "empty", "killed"])
def test_a_directory_of_the_first_release(tmp_path: Path, map_id: str) -> None:
    """``killed`` was being written to when its process ended: its log was never brought into its file."""
    expected = unpacked(tmp_path)
    atlas = Atlas(tmp_path / "data")
    assert [record.id for record in atlas.records(None, 10)[0]] == sorted(expected)
    old = atlas.get(map_id)
    check(old, expected[map_id])
    atlas.close()
    # Again: it was migrated when it was opened first.
    atlas = Atlas(tmp_path / "data")
    old = atlas.get(map_id)
    check(old, expected[map_id])
    # Moved to another directory it is the same.
    path = tmp_path / "moved.tar"
    path.write_bytes(exported(old, tmp_path / "kept"))
    other = Atlas(tmp_path / "other")
    check(imported(other, path, map_id), expected[map_id])
    other.close()
    # And it is written on.
    known = set(expected[map_id]["places"])
    old.enrol([frame("new", local_shape=NO_LOCAL, sequence="monday"), frame("newer", local_shape=NO_LOCAL)])
    if "p5" in known:
        old.forget("p5")
    atlas.close()
    atlas = Atlas(tmp_path / "data")
    old = atlas.get(map_id)
    assert {place.id for place in old.places(None, 100)[0]} == (known | {"new", "newer"}) - {"p5"}
    assert old.snapshot().search(descriptor_of("new"))[0][0] == old.rows_of(["new"])[0]
    assert old.verify().ok
    atlas.close()
