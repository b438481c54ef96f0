"""A map that is being made: nobody meets it before it is published, and a restart finds it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from core.disk import files as disk
from core.errors import MapExists, StorageFailure, UnknownMap
from core.store import Directory, Map
from core.store import directory as module
from core.store.directory import UNLISTED
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame


def making(store: Directory, map_id: str = "new") -> Map:
    return store.create(map_id, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE, unlisted=True)


def test_it_is_found_by_nobody_who_does_not_make_it(store: Directory) -> None:
    made = making(store)
    made.enrol([frame("a")])
    assert store.unlisted() == {"new": made}
    assert store.records(None, 10) == ([], None) and store.quarantined() == {}
    for action in (store.get, store.find, store.delete, store.verify):
        with pytest.raises(UnknownMap):
            action("new")


def test_its_name_is_taken(store: Directory, lab: Map) -> None:
    making(store)
    for unlisted in (True, False):
        for name in ("new", "lab"):
            with pytest.raises(MapExists):
                store.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE, unlisted=unlisted)


def test_publishing_lists_it_whole(store: Directory, directory: Path) -> None:
    made = making(store)
    made.enrol([frame(name) for name in "abcdef"])
    listed = store.publish("new")
    assert store.get("new") is listed and store.unlisted() == {}
    assert len(listed.snapshot()) == listed.count_places() == 6
    rows, _ = listed.snapshot().search(descriptor_of("d"))
    assert listed.places_at([int(rows[0])])[0] == listed.place("d")
    assert listed.verify().ok
    with pytest.raises(StorageFailure):
        made.enrol([frame("z")])  # the one that was handed in is closed
    with pytest.raises(UnknownMap):
        store.publish("new")
    assert os.listdir(directory / "maps") == ["new"]


def test_a_restart_finds_it_as_it_was(store: Directory, directory: Path) -> None:
    making(store).enrol([frame("a")])
    store.close()
    again = Directory(directory)
    try:
        assert again.records(None, 10) == ([], None)
        (found,) = again.unlisted().values()
        found.open()
        found.enrol([frame("b")])
        assert len(again.publish("new").snapshot()) == 2
    finally:
        again.close()


def test_abandoning_leaves_nothing(store: Directory, directory: Path) -> None:
    made = making(store)
    made.enrol([frame("a")])
    store.abandon("new")
    assert store.unlisted() == {} and os.listdir(directory / "maps") == []
    with pytest.raises(UnknownMap):
        made.enrol([frame("b")])
    store.abandon("new")
    store.create("new", ENCODER, DIMENSION)


def test_one_that_a_crash_has_damaged_is_removed(store: Directory, directory: Path) -> None:
    making(store)
    store.close()
    (directory / "maps" / f"{UNLISTED}new" / "map.sqlite").write_bytes(b"torn" * 1000)
    again = Directory(directory)
    assert again.unlisted() == {} and again.quarantined() == {}
    assert os.listdir(directory / "maps") == []
    again.close()


def refuse(*_: object) -> None:
    raise OSError(5, "Input/output error")


def test_a_name_that_cannot_be_given_leaves_it_unlisted(
    store: Directory, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    making(store).enrol([frame("a")])
    for action in (store.publish, store.abandon):
        with monkeypatch.context() as broken:
            broken.setattr(os, "rename", refuse)
            with pytest.raises(StorageFailure):
                action("new")
        assert list(store.unlisted()) == ["new"] and store.records(None, 10) == ([], None)
    assert len(store.publish("new").snapshot()) == 1


def test_abandoning_is_for_good_before_anything_is_removed(
    store: Directory, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    making(store).enrol([frame("a")])
    seen: list[list[str]] = []
    sync = disk.sync_folder

    def watched(folder: Path) -> None:
        sync(folder)
        seen.append([path.name for path in folder.iterdir() if (path / "map.sqlite").exists()])

    monkeypatch.setattr(module, "sync_folder", watched)
    store.abandon("new")
    # By its name of then, the next start removes it: a power cut may undo the removal, but not the new name.
    assert len(seen) == 1 and len(seen[0]) == 1 and seen[0][0].startswith(".removing-new-")
    assert os.listdir(directory / "maps") == []
