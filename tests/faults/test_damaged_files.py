"""Files damaged on the disk: the damage is found or harmless, no answer is wrong, and other maps are unharmed."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core.storage.search import index_files
from numpy.typing import NDArray

from core.errors import MapQuarantined, StorageFailure
from core.maps import MapSettings, PlaceFilter
from core.store import Directory, Map
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame
from tests.faults.damage import DAMAGES, Damage, flip, flip_anywhere, flip_used
from tests.faults.model import State, told
from tests.faults.script import MASK

SEED = int(os.environ.get("PLACEREC_FAULT_SEED", "0"))
MAPS = ("lab", "hall", "coded")


def make_map(atlas: Directory, name: str) -> Map:
    """A dozen places of every kind, some of which were changed or forgotten."""
    made = atlas.create(name, ENCODER, DIMENSION, MapSettings(keep="image"), LOCAL_SHAPE)
    made.cameras.put("left", MASK)
    made.enrol(
        [
            frame(f"{name}{i}", x=i + 0.5, sequence=("mo", "tu")[i % 2], metadata={"floor": i % 3, "note": "n" * 40})
            for i in range(12)
        ]
    )
    made.enrol([frame(f"{name}3", "again")])
    made.set_fields(f"{name}4", made.place(f"{name}4").model_copy(update={"camera": "left"}))
    made.forget(f"{name}5")
    return made


@pytest.fixture(scope="module", autouse=True)
def small_groups() -> Any:
    """Codes of few segments go into one file, so that there are several files."""
    before, index_files.GROUP_ROWS = index_files.GROUP_ROWS, 4
    yield
    index_files.GROUP_ROWS = before


@dataclass(frozen=True)
class Sound:
    """A data directory, and the answers that each map may give, the last commit first."""

    directory: Path
    allowed: dict[str, list[State]]


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Sound:
    """A data directory after an orderly end, with the caches of the map "coded"."""
    folder = tmp_path_factory.mktemp("sound")
    atlas = Directory(folder / "data", rows_per_segment=4)
    for name in MAPS:
        make_map(atlas, name)
    coded = atlas.get("coded")
    coded.edit({"index": "compact"})
    until = time.monotonic() + 60
    while coded.index_status().state != "ready" or coded.index_status().tier != "compact":
        assert time.monotonic() < until
        time.sleep(0.01)
    allowed = {name: [answers(atlas.get(name))] for name in MAPS}
    atlas.close()
    return Sound(folder / "data", allowed)


@pytest.fixture(scope="module")
def crashed(closed: Sound, tmp_path_factory: pytest.TempPathFactory) -> Sound:
    """A data directory after a crash, with two more commits in SQLite's log."""
    folder = tmp_path_factory.mktemp("crashed")
    shutil.copytree(closed.directory, folder / "written")
    atlas, allowed = Directory(folder / "written"), {name: list(states) for name, states in closed.allowed.items()}
    for late in ("a", "b"):
        for name in ("lab", "coded"):
            atlas.get(name).enrol([frame(f"late-{late}", x=77.0)])
            allowed[name].insert(0, answers(atlas.get(name)))
    while atlas.get("coded").index_status().state != "ready":
        time.sleep(0.01)
    shutil.copytree(folder / "written", folder / "data")
    atlas.close()
    return Sound(folder / "data", allowed)


class Scores:
    """Scores that equal others up to rounding."""

    def __init__(self, values: NDArray[np.float32]) -> None:
        self._values = values.copy()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scores) and bool(np.allclose(self._values, other._values, atol=1e-5))

    __hash__ = None  # type: ignore[assignment]


def answers(map_: Map) -> State:
    """Everything that a map tells, and what is found in it."""
    found = []
    for name in ("lab2", "again", "coded7", "nobody"):
        rows, products = map_.snapshot().search(descriptor_of(name))
        found.append((rows.tolist()[:8], Scores(products[:8])))
    by_metadata = map_.ids_of(PlaceFilter(metadata={"floor": 2}), 1000)
    whereabouts = vars(map_.snapshot().whereabouts.take(map_.snapshot().alive.nonzero()[0]))
    spots = zlib.crc32(b"".join(column.tobytes() for column in whereabouts.values()))
    ends = map_.transfer.sequence_ends()
    return {**told(map_), "found": found, "by_metadata": by_metadata, "spots": spots, "ends": ends}


def outcome(sound: Sound, copy: Path, name: str, may_lose: bool = False) -> str:
    """How a map with damaged files fares: ``harmless``, or how the damage was found; the other maps must be unharmed.

    Args:
        may_lose: the last commits may be missing, because a log that ends early is what a crash leaves.

    Raises:
        AssertionError: it answers differently, and nothing reports the damage.
    """
    atlas = Directory(copy)
    try:
        found = _outcome(atlas, name, sound.allowed[name] if may_lose else sound.allowed[name][:1])
        for other in set(MAPS) - {name}:
            assert answers(atlas.get(other)) == sound.allowed[other][0], f"{other} is harmed"
        assert set(atlas.quarantined()) <= {name}
        return found
    finally:
        atlas.close()


def _outcome(atlas: Directory, name: str, allowed: list[State]) -> str:
    try:
        read = answers(atlas.get(name))
    except MapQuarantined:
        report = atlas.verify(name)
        assert not report.ok
        assert any(".sqlite" in line or ".seg" in line for line in report.problems), report
        return "quarantined"
    except StorageFailure:
        with suppress(StorageFailure):  # verifying may fail because the file cannot be read
            assert not atlas.verify(name).ok
        return "refused"
    report = atlas.verify(name)
    if read not in allowed and any(read == _without_keypoints(state, read) for state in allowed):
        expected = ("the keypoints of place", "pictures or keypoints of")
        assert any(text in line for line in report.problems for text in expected), report
        return "without keypoints"
    if read not in allowed:
        assert not report.ok, "another answer, and verify finds nothing"
        return "wrong until verified"
    return "harmless" if report.ok else "verified"


def _without_keypoints(state: State, read: State) -> State:
    """The answers of a sound map without the keypoints that are not read."""
    lost = {place_id for place_id, place in read["places"].items() if place["keypoints"] is None}
    places = {name: {**place, "keypoints": None} if name in lost else place for name, place in state["places"].items()}
    return {**state, "places": places}


def damaged(sound: Sound, folder: Path, path: Path, damage: Damage, chosen: random.Random) -> Path:
    """A copy of a data directory with one file damaged."""
    copy = folder / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(sound.directory, copy)
    damage(copy / path.relative_to(sound.directory), chosen)
    return copy


def files_of(sound: Sound) -> list[Path]:
    """The files of the two maps that are damaged."""
    found = [path for name in ("lab", "coded") for path in sorted((sound.directory / "maps" / name).iterdir())]
    assert len(found) > 12
    return found


def run_cases(
    sound: Sound, folder: Path, paths: list[Path], count: int, damages: Sequence[Damage] = DAMAGES
) -> Counter[str]:
    """Damage files in ``count`` ways; the number of cases with each outcome."""
    chosen, outcomes, failures = random.Random(SEED), Counter[str](), []
    for number in range(count):
        path, damage = paths[number % len(paths)], chosen.choice(damages)
        try:
            copy = damaged(sound, folder, path, damage, chosen)
            outcomes[outcome(sound, copy, path.parent.name, path.name.endswith("-wal"))] += 1
        except Exception as error:
            where = f"seed {SEED}, case {number}, {path.relative_to(sound.directory)}, {damage.__name__}"
            failures.append(f"{where}: {type(error).__name__}: {str(error)[:300]}")
    assert not failures, f"{len(failures)} of {count}:\n" + "\n".join(failures)
    return outcomes


def kind(sound: Sound, suffix: str) -> list[Path]:
    """The files of a kind."""
    return [path for path in files_of(sound) if path.name.endswith(suffix)]


@pytest.mark.thorough
def test_a_damaged_database_is_found(closed: Sound, tmp_path: Path) -> None:
    outcomes = run_cases(closed, tmp_path, kind(closed, ".sqlite"), 10)
    assert outcomes["quarantined"] and not outcomes["wrong until verified"]


def test_a_damaged_database_with_a_log_is_found(crashed: Sound, tmp_path: Path) -> None:
    paths = [path for suffix in (".sqlite", "-wal", "-shm") for path in kind(crashed, suffix)]
    run_cases(crashed, tmp_path, paths, 8)


@pytest.mark.thorough
def test_damaged_descriptors_are_found(closed: Sound, tmp_path: Path) -> None:
    outcomes = run_cases(closed, tmp_path, kind(closed, ".seg"), 8)
    assert outcomes["quarantined"]


@pytest.mark.thorough
def test_a_damaged_cache_is_made_again(closed: Sound, tmp_path: Path) -> None:
    """Every file of the index, each in another way: the answers stay the same, and the file is made again."""
    chosen = random.Random(SEED)
    for number, path in enumerate(kind(closed, ".index")):
        copy = damaged(closed, tmp_path, path, DAMAGES[(number + SEED) % len(DAMAGES)], chosen)
        assert outcome(closed, copy, "coded") == "harmless"
        check_rebuilt(copy)


def check_rebuilt(copy: Path) -> None:
    """All files of the index must be made again."""
    atlas = Directory(copy)
    try:
        coded = atlas.get("coded")
        until = time.monotonic() + 60
        while (coded.index_status().state != "ready" or coded.verify().stale_caches) and time.monotonic() < until:
            time.sleep(0.01)
        assert coded.index_status().tier == "compact"
        assert coded.verify().stale_caches == []
    finally:
        atlas.close()


def test_a_log_that_is_damaged_in_its_middle_is_found(crashed: Sound, tmp_path: Path) -> None:
    """The commits after the damage were acknowledged, so the map must not go on without them."""
    path, chosen = crashed.directory / "maps" / "lab" / "map.sqlite-wal", random.Random(SEED)
    for offset in (16, 32 + 16, 32 + 24 + 5):  # the header's salt, the first frame's checksum, its page
        copy = damaged(crashed, tmp_path, path, lambda found, _, at=offset: flip(found, at), chosen)  # type: ignore[misc]
        assert outcome(crashed, copy, "lab") == "quarantined"


def test_the_end_of_a_log_that_is_damaged_is_as_a_crash_leaves_it(crashed: Sound, tmp_path: Path) -> None:
    path = crashed.directory / "maps" / "lab" / "map.sqlite-wal"
    copy = damaged(crashed, tmp_path, path, lambda found, _: flip(found, found.stat().st_size - 9), random.Random(SEED))
    atlas = Directory(copy)
    assert answers(atlas.get("lab")) == crashed.allowed["lab"][1], "all but the last commit"
    assert atlas.verify("lab").ok
    atlas.get("lab").enrol([frame("goes-on")])
    atlas.close()


EXPECTED = {"keypoints": ("without keypoints",), "pictures": ("refused",), "tokens": ("harmless",)}
"""Outcomes of other tables: an index of metadata that is wrong is made again."""


@pytest.mark.thorough
def test_every_value_of_a_row_has_a_checksum(closed: Sound, tmp_path: Path) -> None:
    """Values that are changed by other means than the map, in a way that SQLite accepts."""
    moment = "'2026-01-01T00:00:00.000000+00:00'"
    changes = {
        "places": {
            "x": "99.5", "heading": "12.0", "timestamp": moment, "regions": "regions + 1", "metadata": "'{}'",
            "created_at": moment, "digest": "randomblob(32)", "camera": "'right'",
            "track": "1", "station": "7", "pose_of": "'lab1'",
        },
        "maps": {
            "record": "replace(record, 'image', 'none')", "seal": "seal + 1", "id": "'lab2'", "places": "places + 1",
            "rows": "rows - 1", "numbers": "1", "codes": "0", "revision": "0",
        },
        "layout": {"rows_per_segment": "3"},
        "pictures": {"bytes": "zeroblob(80)", "digest": "randomblob(32)"},
        "tokens": {"row": "row + 77", "token": "'feed' || token"},
        "cameras": {"mask": "NULL", "intrinsics": "'{}'"},
        "sequences": {"next_ordinal": "0"},
        "keypoints": {"checksum": "checksum + 1", "record": "zeroblob(80)"},
    }  # fmt: skip
    for table, columns in changes.items():
        for column, value in columns.items():
            copy = damaged(closed, tmp_path, closed.directory / "FORMAT", lambda *_: None, random.Random(SEED))
            connection = sqlite3.connect(copy / "maps" / "lab" / "map.sqlite")
            wanted = "WHERE id = 'lab7'" if table == "places" else ""
            before = connection.execute(f"SELECT {column} FROM {table} {wanted}").fetchall()
            connection.execute(f"UPDATE {table} SET {column} = {value} {wanted}")
            assert connection.execute(f"SELECT {column} FROM {table} {wanted}").fetchall() != before
            connection.commit()
            connection.close()
            found = outcome(closed, copy, "lab")
            expected = EXPECTED.get(table, ("quarantined", "verified"))
            assert found in expected, f"{table}.{column}: {found}"


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("state", ["closed", "crashed"])
def test_every_file_in_every_way(state: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    sound: Sound = request.getfixturevalue(state)
    count = int(os.environ.get("PLACEREC_FAULT_CASES", "1500"))
    outcomes = run_cases(sound, tmp_path, files_of(sound), count)
    print(dict(outcomes))
    flips = (flip_anywhere, flip_used)
    print(dict(run_cases(sound, tmp_path, kind(sound, ".sqlite"), count, flips)))
