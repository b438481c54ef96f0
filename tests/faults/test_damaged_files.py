"""Files damaged on the disk: the damage is found or harmless, no answer is wrong, and other maps are unharmed."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import MapQuarantined, StorageFailure
from core.frames.masks import Mask
from core.ledger.maps import rows
from core.maps import Enrolment, MapSettings, PlaceFilter, ReviewSetting
from core.store import Directory, Map
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame
from tests.faults.damage import DAMAGES, Damage, cut, flip, remove, take_of_another, zero_tail
from tests.faults.model import State, told
from tests.faults.regions import Region, blobs_of, log_of, pages_of

MASK = Mask(polygons=(((0.0, 0.9), (1.0, 0.9), (1.0, 1.0), (0.0, 1.0)),))

SEED = int(os.environ.get("PLACEREC_FAULT_SEED", "0"))
MAPS = ("lab", "hall", "coded")

SHORTENING: tuple[Damage, ...] = (cut, zero_tail, remove)
"""After these a log ends at an earlier commit, as after a crash; other damage may hide its last commit alone."""


def pictured(made: Enrolment, size: int) -> Enrolment:
    """A frame with an image of which no part stands in another one."""
    image = random.Random(made.digest).randbytes(size).hex().encode()
    return replace(made, image=image, digest=sha256(image).digest())


def make_map(atlas: Directory, name: str) -> Map:
    """A dozen places of every kind, some of which were changed or forgotten."""
    made = atlas.create(name, ENCODER, DIMENSION, MapSettings(keep="image"), LOCAL_SHAPE)
    if name == "coded":
        assert made.edit({"index": "compact"})
    made.cameras.put("left", MASK)
    notes = {"note": "n" * 700}  # the places take more than one page
    made.enrol(
        [
            pictured(
                frame(f"{name}{i}", x=i + 0.5, sequence=("mo", "tu")[i % 2], metadata={"floor": i % 3, **notes}), 60
            )
            for i in range(12)
        ]
    )
    made.enrol([large := pictured(frame(f"{name}3", "again"), 45_000)])  # takes pages of its own
    made.set_fields(f"{name}4", made.place(f"{name}4").model_copy(update={"camera": "left"}))
    made.forget(f"{name}5")
    assert large.image is not None
    for asked in (b"doubtful", large.image[::-1]):
        assert made.review.keep(asked, {"verdict": "unknown"}, ReviewSetting())
    return made


@pytest.fixture(scope="module", autouse=True)
def at_once() -> Iterator[None]:
    """What no place names any more is deleted by the next write, not a minute later."""
    before, rows.LEFT_SECONDS = rows.LEFT_SECONDS, 0
    yield
    rows.LEFT_SECONDS = before


@dataclass(frozen=True)
class Sound:
    """A data directory, and the answers that each map may give, the last commit first."""

    directory: Path
    allowed: dict[str, list[State]]


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Sound:
    """A data directory after an orderly end; the map "coded" is searched by codes."""
    folder = tmp_path_factory.mktemp("sound")
    atlas = Directory(folder / "data", rows_per_segment=4)
    for name in MAPS:
        make_map(atlas, name)
    assert [atlas.get(name).index_status().tier for name in MAPS] == ["exact", "exact", "compact"]
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
        best, products = map_.snapshot().search(descriptor_of(name))
        found.append((best.tolist()[:8], Scores(products[:8])))
    by_metadata = map_.ids_of(PlaceFilter(metadata={"floor": 2}), 1000)
    whereabouts = vars(map_.snapshot().whereabouts.take(map_.snapshot().alive.nonzero()[0]))
    spots = zlib.crc32(b"".join(column.tobytes() for column in whereabouts.values()))
    ends = map_.transfer.sequence_ends()
    page = map_.review.page(None, 10)
    if len(page.frames) < page.count:
        raise StorageFailure("Damaged frames are left out.")
    reviewed = [(one.answer, one.label, one.at) for one in page.frames]
    return {
        **told(map_), "found": found, "by_metadata": by_metadata, "spots": spots, "ends": ends, "review": reviewed,
    }  # fmt: skip


def outcome(sound: Sound, copy: Path, name: str, may_lose: int = 0) -> str:
    """How a map with damaged files fares: ``harmless``, or how the damage was found; the other maps must be unharmed.

    Args:
        may_lose: so many of the last commits may be missing, because a log that ends early is what a crash leaves.

    Raises:
        AssertionError: it answers differently, and nothing reports the damage.
    """
    atlas = Directory(copy)
    try:
        found = _outcome(atlas, name, sound.allowed[name][: 1 + may_lose])
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
        assert any(".sqlite" in line for line in report.problems), report
        return "quarantined"
    except StorageFailure:
        with suppress(StorageFailure):  # verifying may fail because the file cannot be read
            assert not atlas.verify(name).ok
        return "refused"
    report = atlas.verify(name)
    if read not in allowed and any(read == _without_keypoints(state, read) for state in allowed):
        assert any("keypoints" in line or "malformed" in line for line in report.problems), report
        return "without keypoints"
    assert read in allowed, f"another answer; verify finds {report.problems}"
    if not report.ok:
        return "verified"
    try:
        atlas.get(name).enrol([frame("passing", sequence="passing")])
        atlas.get(name).forget("passing")
        atlas.get(name).edit({"description": ""})
    except (MapQuarantined, StorageFailure):
        return "refused a write"
    assert answers(atlas.get(name)) == read, "another answer after a write"
    return "harmless"


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
    return [path for name in ("lab", "coded") for path in sorted((sound.directory / "maps" / name).iterdir())]


def run_cases(
    sound: Sound, folder: Path, paths: list[Path], count: int, damages: Sequence[Damage] = DAMAGES
) -> Counter[str]:
    """Damage files in ``count`` ways; the number of cases with each outcome."""
    chosen, outcomes, failures = random.Random(SEED), Counter[str](), []
    for number in range(count):
        path, damage = paths[number % len(paths)], chosen.choice(damages)
        try:
            copy = damaged(sound, folder, path, damage, chosen)
            may_lose = len(sound.allowed[path.parent.name]) - 1 if damage in SHORTENING else 1
            outcomes[outcome(sound, copy, path.parent.name, may_lose if path.name.endswith("-wal") else 0)] += 1
        except Exception as error:
            where = f"seed {SEED}, case {number}, {path.relative_to(sound.directory)}, {damage.__name__}"
            failures.append(f"{where}: {type(error).__name__}: {str(error)[:300]}")
    assert not failures, f"{len(failures)} of {count}:\n" + "\n".join(failures)
    return outcomes


@contextmanager
def closing_at_end(copy: Path) -> Iterator[Directory]:
    atlas = Directory(copy)
    try:
        yield atlas
    finally:
        atlas.close()


def of_lab(sound: Sound, name: str = "map.sqlite", map_id: str = "lab") -> Path:
    return sound.directory / "maps" / map_id / name


def _flip(offset: int, bit: int, path: Path, _: random.Random) -> None:
    flip(path, offset, bit)


def flipped(sound: Sound, folder: Path, path: Path, regions: Sequence[Region]) -> Counter[str]:
    """Flip a bit of each of some regions of a file; the number of cases with each outcome."""
    chosen, outcomes, failures = random.Random(SEED), Counter[str](), []
    for region in regions:
        bit = chosen.randrange(8)
        try:
            copy = damaged(sound, folder, path, partial(_flip, region.offset, bit), chosen)
            outcomes[outcome(sound, copy, path.parent.name, int(path.name.endswith("-wal")))] += 1
        except Exception as error:
            failures.append(f"seed {SEED}, {region.name}, bit {bit}: {type(error).__name__}: {str(error)[:300]}")
    assert not failures, f"{len(failures)} of {len(regions)}:\n" + "\n".join(failures)
    return outcomes


def test_flipped_bits_of_a_file_and_its_log_are_found(closed: Sound, crashed: Sound, tmp_path: Path) -> None:
    """A few of the regions that the tests below have all of."""
    path, log = of_lab(closed), of_lab(crashed, "map.sqlite-wal")
    flipped(closed, tmp_path, path, [*pages_of(path)][SEED % 97 :: 97] + [*blobs_of(path)][SEED % 9 :: 9])
    flipped(crashed, tmp_path, log, [*log_of(log)][SEED % 23 :: 23])


@pytest.mark.thorough
def test_a_flipped_bit_of_every_region_of_a_file_is_found(closed: Sound, tmp_path: Path) -> None:
    """Pages of every table and index, free pages and the header; the answers stay right also after a write."""
    regions = list(pages_of(of_lab(closed)))
    assert {"free", "overflow", "internal"} <= {region.name.split(":")[0].split()[-1] for region in regions}
    outcomes = flipped(closed, tmp_path, of_lab(closed), regions)
    assert outcomes["quarantined"] and outcomes["verified"] and outcomes["harmless"]


@pytest.mark.thorough
@pytest.mark.parametrize("map_id", ["lab", "coded"])
def test_a_flipped_bit_of_every_long_value_is_found(closed: Sound, tmp_path: Path, map_id: str) -> None:
    """Codes are computed again from descriptors, which verifying says; all else is found by those who need it."""
    path = of_lab(closed, map_id=map_id)
    of_codes = [region for region in blobs_of(path) if " of codes" in region.name]
    others = [region for region in blobs_of(path) if region not in of_codes]
    assert len(others) >= 40
    assert "harmless" not in flipped(closed, tmp_path, path, others)
    if map_id == "lab":
        assert not of_codes, "places are compared whole"
        return
    assert len(of_codes) >= 9
    assert set(flipped(closed, tmp_path, path, of_codes)) == {"harmless"}
    copy = damaged(closed, tmp_path, path, partial(_flip, of_codes[1].offset, 0), random.Random(SEED))
    with closing_at_end(copy) as atlas:
        assert any("rebuild the index" in line for line in atlas.get(map_id).verify().stale_caches)
        atlas.get(map_id).rebuild_index()
        assert atlas.get(map_id).verify().stale_caches == []


@pytest.mark.thorough
def test_a_flipped_bit_of_every_region_of_a_log_is_found(crashed: Sound, tmp_path: Path) -> None:
    log = of_lab(crashed, "map.sqlite-wal")
    outcomes = flipped(crashed, tmp_path, log, list(log_of(log)))
    assert outcomes["quarantined"] and outcomes["harmless"], "before the last commit, and in it"


def test_a_log_that_is_damaged_in_its_middle_is_found(crashed: Sound, tmp_path: Path) -> None:
    """The commits after the damage were acknowledged, so the map must not go on without them."""
    chosen = random.Random(SEED)
    for offset in (16, 32 + 16, 32 + 24 + 5):  # the header's salt, the first frame's checksum, its page
        log = of_lab(crashed, "map.sqlite-wal")
        copy = damaged(crashed, tmp_path, log, partial(_flip, offset, 0), chosen)
        assert outcome(crashed, copy, "lab") == "quarantined"


def test_the_end_of_a_log_that_is_damaged_is_as_a_crash_leaves_it(crashed: Sound, tmp_path: Path) -> None:
    log = of_lab(crashed, "map.sqlite-wal")
    copy = damaged(crashed, tmp_path, log, partial(_flip, log.stat().st_size - 9, 0), random.Random(SEED))
    with closing_at_end(copy) as atlas:
        assert answers(atlas.get("lab")) == crashed.allowed["lab"][1], "all but the last commit"
        assert atlas.verify("lab").ok
        atlas.get("lab").enrol([frame("goes-on")])


def test_files_and_logs_that_change_places_are_found(crashed: Sound, tmp_path: Path) -> None:
    """Of two maps, and of a map and its copy of an earlier time; a log does not fit another file."""
    for name in ("map.sqlite", "map.sqlite-wal"):
        copy = damaged(crashed, tmp_path, of_lab(crashed, name), take_of_another, random.Random(SEED))
        assert outcome(crashed, copy, "lab") == "quarantined", name


def edit(copy: Path, *statements: str, map_id: str = "lab") -> int:
    """Change the database of a map by other means than the map; the number of rows changed."""
    with closing(sqlite3.connect(copy / "maps" / map_id / "map.sqlite")) as connection, connection:
        return sum(connection.execute(statement).rowcount for statement in statements)


@pytest.mark.thorough
@pytest.mark.parametrize("table", ["descriptors", "locals", "codes", "pictures", "keypoints", "places"])
def test_rows_that_change_places_are_found(closed: Sound, tmp_path: Path, table: str) -> None:
    """What one place has becomes what another has, with its checksum."""
    copy = damaged(closed, tmp_path, closed.directory / "FORMAT", lambda *_: None, random.Random(SEED))
    steps = ((-1, "row = 1"), (1, "row = 2"), (2, "row = -1"))
    to_check = "PRAGMA ignore_check_constraints = ON"
    map_id = "coded" if table == "codes" else "lab"
    assert (
        edit(copy, to_check, *(f"UPDATE {table} SET row = {to} WHERE {which}" for to, which in steps), map_id=map_id)
        > 1
    )
    if table == "pictures":  # each matches its own digest; that of the place is compared by verifying alone
        with closing_at_end(copy) as atlas:
            assert len(atlas.verify("lab").problems) == 2
        return
    found = outcome(closed, copy, map_id)
    expected = {"codes": "harmless", "keypoints": "without keypoints"}
    assert found == expected.get(table, "quarantined")


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
        "descriptors": {"bytes": "zeroblob(36)"},
        "locals": {"bytes": "zeroblob(19)"},
        "pictures": {"bytes": "zeroblob(80)", "digest": "randomblob(32)"},
        "tokens": {"row": "row + 77", "token": "'feed' || token"},
        "cameras": {"mask": "NULL", "intrinsics": "'{}'"},
        "sequences": {"next_ordinal": "0, negative = 0"},
        "keypoints": {"checksum": "checksum + 1", "record": "zeroblob(80)"},
        "review_frames": {"answer": "'{}'", "at": moment, "label": "'{}'"},
        "review_pictures": {"bytes": "zeroblob(80)"},
    }  # fmt: skip
    for table, columns in changes.items():
        for column, value in columns.items():
            copy = damaged(closed, tmp_path, closed.directory / "FORMAT", lambda *_: None, random.Random(SEED))
            wanted = "WHERE id = 'lab7'" if table == "places" else ""
            assert edit(copy, f"UPDATE {table} SET {column} = {value} {wanted}") > 0
            found = outcome(closed, copy, "lab")
            expected = EXPECTED.get(table, ("quarantined", "verified", "refused"))
            assert found in expected, f"{table}.{column}: {found}"


def test_a_damaged_database_with_a_log_is_found(crashed: Sound, tmp_path: Path) -> None:
    run_cases(crashed, tmp_path, files_of(crashed), 8)


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("state", ["closed", "crashed"])
def test_every_file_in_every_way(state: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    sound: Sound = request.getfixturevalue(state)
    count = int(os.environ.get("PLACEREC_FAULT_CASES", "1500"))
    print(dict(run_cases(sound, tmp_path, files_of(sound), count)))
