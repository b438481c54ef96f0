"""A map that is being made: nobody meets it before it is published, and a restart finds it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from core.disk import files as disk
from core.errors import MapExists, StorageFailure, UnknownMap
from core.store import Directory, Map
from core.store import atlas as storage_atlas
from core.storage.opening import UNLISTED
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame


def making(atlas: Directory, map_id: str = "new") -> Map:
    return atlas.create(map_id, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE, unlisted=True)


def test_it_is_found_by_nobody_who_does_not_make_it(atlas: Directory) -> None:
    made = making(atlas)
    made.enrol([frame("a")])
    assert atlas.unlisted() == {"new": made}
    assert atlas.records(None, 10) == ([], None) and atlas.quarantined() == {}
    for action in (atlas.get, atlas.find, atlas.delete, atlas.verify):
        with pytest.raises(UnknownMap):
            action("new")


def test_its_name_is_taken(atlas: Directory, lab: Map) -> None:
    making(atlas)
    for unlisted in (True, False):
        for name in ("new", "lab"):
            with pytest.raises(MapExists):
                atlas.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE, unlisted=unlisted)


def test_publishing_lists_it_whole(atlas: Directory, directory: Path) -> None:
    made = making(atlas)
    made.enrol([frame(name) for name in "abcdef"])
    listed = atlas.publish("new")
    assert atlas.get("new") is listed and atlas.unlisted() == {}
    assert len(listed.snapshot()) == listed.count_places() == 6
    rows, _ = listed.snapshot().search(descriptor_of("d"))
    assert listed.places_at([int(rows[0])])[0] == listed.place("d")
    assert listed.verify().ok
    with pytest.raises(StorageFailure):
        made.enrol([frame("z")])  # the one that was handed in is closed
    with pytest.raises(UnknownMap):
        atlas.publish("new")
    assert os.listdir(directory / "maps") == ["new"]


def test_a_restart_finds_it_as_it_was(atlas: Directory, directory: Path) -> None:
    making(atlas).enrol([frame("a")])
    atlas.close()
    again = Directory(directory)
    try:
        assert again.records(None, 10) == ([], None)
        (found,) = again.unlisted().values()
        found.open()
        found.enrol([frame("b")])
        assert len(again.publish("new").snapshot()) == 2
    finally:
        again.close()


def test_abandoning_leaves_nothing(atlas: Directory, directory: Path) -> None:
    made = making(atlas)
    made.enrol([frame("a")])
    atlas.abandon("new")
    assert atlas.unlisted() == {} and os.listdir(directory / "maps") == []
    with pytest.raises(UnknownMap):
        made.enrol([frame("b")])
    atlas.abandon("new")
    atlas.create("new", ENCODER, DIMENSION)


def test_one_that_a_crash_has_damaged_is_removed(atlas: Directory, directory: Path) -> None:
    making(atlas)
    atlas.close()
    (directory / "maps" / f"{UNLISTED}new" / "map.sqlite").write_bytes(b"torn" * 1000)
    again = Directory(directory)
    assert again.unlisted() == {} and again.quarantined() == {}
    assert os.listdir(directory / "maps") == []
    again.close()


def refuse(*_: object) -> None:
    raise OSError(5, "Input/output error")


def test_a_name_that_cannot_be_given_leaves_it_unlisted(
    atlas: Directory, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    making(atlas).enrol([frame("a")])
    for action in (atlas.publish, atlas.abandon):
        with monkeypatch.context() as broken:
            broken.setattr(os, "rename", refuse)
            with pytest.raises(StorageFailure):
                action("new")
        assert list(atlas.unlisted()) == ["new"] and atlas.records(None, 10) == ([], None)
    assert len(atlas.publish("new").snapshot()) == 1


def test_abandoning_is_for_good_before_anything_is_removed(
    atlas: Directory, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    making(atlas).enrol([frame("a")])
    seen: list[list[str]] = []
    sync = disk.sync_folder

    def watched(folder: Path) -> None:
        sync(folder)
        seen.append([path.name for path in folder.iterdir() if (path / "map.sqlite").exists()])

    monkeypatch.setattr(storage_atlas, "sync_folder", watched)
    atlas.abandon("new")
    # By its name of then, the next start removes it: a power cut may undo the removal, but not the new name.
    assert len(seen) == 1 and len(seen[0]) == 1 and seen[0][0].startswith(".removing-new-")
    assert os.listdir(directory / "maps") == []
