from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest

from core.errors import (
    InvalidCursor,
    InvalidField,
    InvalidIdentifier,
    MixedCoordinates,
    NoRegions,
    NoThumbnail,
    RevisionMismatch,
    StorageFailure,
    UnknownMap,
    UnknownPlace,
    UnknownSequence,
)
from core.frames.images import decode, encode_png
from core.judgement.priors import Disc, GeographicBox
from core.judgement.verdict import Calibration
from core.ledger.maps import frames, places
from core.maps import Enrolment, MapSettings, SameFrame
from core.maps.place_filter import PlaceFilter
from core.maps.selection import Conditions, Selection
from core.places import PlaceFields, Pose
from core.store import Map, Store
from tests.core.maps.mixed import POSES, both_kinds, check_one_kind_wins, posed
from tests.core.store.conftest import ROWS, OpenStore, execute, file_of, on_both
from tests.core.store.frames import (
    DIMENSION,
    ENCODER,
    LOCAL_SHAPE,
    descriptor_of,
    digest_of,
    frame,
    keypoints_of,
    local_of,
)

EVENING = datetime(2026, 11, 20, 18, 30, 0, 250, tzinfo=UTC)


def changes(lab: Map, *items: object) -> list[str]:
    return [change for _, change in lab.enrol(items)]


def best(lab: Map, shown: str) -> str | None:
    """Id of the place that looks most like ``shown``."""
    rows, _ = lab.snapshot().search(descriptor_of(shown))
    (found,) = lab.places_at(rows[:1].tolist())
    return found.id if found else None


@on_both
def test_a_place_is_remembered_with_all_that_was_said_of_it(lab: Map) -> None:
    fields = PlaceFields(
        pose=Pose(x=1.5, y=-2, z=0.25, heading=90),
        timestamp=EVENING,
        sequence="Montag früh",
        metadata={"door": {"open": True, "n": [1, 2.5, None, "ü💡"]}},
    )
    ((place, change),) = lab.enrol([replace(frame("p7"), fields=fields)])
    assert change == "created"
    assert place == lab.place("p7")
    assert PlaceFields.model_validate(place.model_dump(include=set(PlaceFields.model_fields))) == fields
    assert (place.id, place.regions, place.picture) == ("p7", 2, "thumbnail")
    assert place.created_at == place.updated_at
    assert abs((datetime.now(UTC) - place.created_at).total_seconds()) < 60
    assert lab.digest("p7") == digest_of("p7")
    assert lab.thumbnail("p7") == b"thumbnail of p7"
    assert lab.count_places() == 1


def test_of_two_writers_of_both_kinds_of_coordinates_one_wins(lab: Map) -> None:
    check_one_kind_wins(lab, lab)


@on_both
def test_areas_of_the_other_kind_are_refused(lab: Map) -> None:
    metres, degrees = (Conditions((Disc(pose, 5.0),)) for pose in POSES)
    box = Conditions((GeographicBox(2, 48, 3, 49),))
    for area in (metres, degrees, box):
        lab.scope(Selection(filters=area))  # no place has a pose yet
    lab.enrol([posed("p0", POSES[0])])
    for area in (degrees, box):
        for selection in (Selection(filters=area), Selection(prior=area)):
            with pytest.raises(MixedCoordinates, match="area of the query has geographic"):
                lab.scope(selection)
    lab.scope(Selection(filters=metres))
    with both_kinds():
        lab.enrol([posed("p1", POSES[1])])
    for area in (metres, degrees, box):
        lab.scope(Selection(filters=area))
    lab.forget("p0")
    with pytest.raises(MixedCoordinates, match="area of the query has metric"):
        lab.scope(Selection(filters=metres))


@on_both
def test_a_height_on_the_earth_is_there_when_the_map_is_opened_again(
    open_store: OpenStore, store: Store, lab: Map
) -> None:
    poses = {"hill": Pose(latitude=48.9, longitude=2.35, z=130.5), "plain": Pose(latitude=48.8, longitude=2.35)}
    lab.enrol([replace(frame(name), fields=PlaceFields(pose=pose)) for name, pose in poses.items()])
    for again in (False, True):
        if again:
            store.close()
            lab = open_store().get("lab")
        assert {name: lab.place(name).pose for name in poses} == poses
        where = lab.snapshot().whereabouts
        assert where.kind.tolist() == [2, 2]
        np.testing.assert_allclose(where.position, [one.position() for one in poses.values()])


@on_both
def test_the_four_changes(lab: Map) -> None:
    assert changes(lab, frame("p", x=1)) == ["created"]
    before = lab.place("p")
    assert changes(lab, frame("p", x=1)) == ["unchanged"]
    assert lab.place("p") == before
    assert changes(lab, frame("p", x=2)) == ["updated"]
    updated = lab.place("p")
    assert updated.pose == Pose(x=2, y=0)
    assert updated.created_at == before.created_at < updated.updated_at
    assert changes(lab, frame("p", "another picture", x=2)) == ["replaced"]
    after = lab.place("p")
    assert (after.created_at, after.regions) == (before.created_at, len("another picture"))
    assert lab.thumbnail("p") == b"thumbnail of another picture"
    np.testing.assert_array_equal(lab.snapshot().locals_at(np.array([0, 1]))[1], local_of("another picture"))
    assert lab.count_places() == 1
    assert lab.snapshot().rows == 2
    assert lab.verify().ok


def test_fields_left_out_are_cleared(lab: Map) -> None:
    lab.enrol([frame("p", x=1, sequence="a", timestamp=EVENING, metadata={"a": 1})])
    assert changes(lab, frame("p")) == ["updated"]
    assert lab.place("p").model_dump(include=set(PlaceFields.model_fields)) == PlaceFields().model_dump()
    assert lab.sequences(None, 10) == ([], None)


@on_both
def test_one_and_true_are_different_metadata(lab: Map) -> None:
    lab.enrol([frame("p", metadata={"a": 1})])
    assert changes(lab, frame("p", metadata={"a": True})) == ["updated"]
    assert lab.place("p").metadata["a"] is True
    assert changes(lab, frame("p", metadata={"a": True})) == ["unchanged"]


def test_an_id_twice_in_one_call_is_taken_in_order(lab: Map) -> None:
    done = lab.enrol([frame("p", "one"), frame("q"), frame("p", "one", x=1), frame("p", "two"), frame("p", "two")])
    assert [change for _, change in done] == ["created", "created", "updated", "replaced", "unchanged"]
    assert [place.pose for place, _ in done] == [None, None, Pose(x=1, y=0), None, None]
    assert lab.count_places() == 2
    assert [place.id for place in lab.places(None, 10)[0]] == ["p", "q"]
    assert best(lab, "two") == "p"
    assert lab.verify().ok


def test_a_batch_over_several_segments_is_searched(lab: Map) -> None:
    lab.enrol([frame(f"p{i}") for i in range(11)])
    for i in range(11):
        assert best(lab, f"p{i}") == f"p{i}"
    assert [len(segment) for segment in lab.snapshot().segments] == [ROWS, ROWS, 3]


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        (replace(frame("q"), id="a b"), InvalidIdentifier),
        (replace(frame("q"), descriptor=descriptor_of("q", DIMENSION + 1)), ValueError),
        (replace(frame("q"), descriptor=descriptor_of("q").astype(np.float64)), ValueError),
        (replace(frame("q"), descriptor=np.full(DIMENSION, np.nan, np.float32)), ValueError),
        (replace(frame("q"), descriptor=np.full(DIMENSION, 1e30, np.float32)), ValueError),
        (replace(frame("q"), descriptor=np.zeros(DIMENSION, np.float32)), NoRegions),
        (replace(frame("q"), local=local_of("q", (5, 3))), ValueError),
        (replace(frame("q"), local=local_of("q", (0, 0))), ValueError),
        (replace(frame("q"), local=local_of("q").astype(np.uint8)), ValueError),
        (replace(frame("q"), digest=b"short"), ValueError),
        (replace(frame("q"), regions=-1), ValueError),
        (frame("q", metadata={"a": float("nan")}), InvalidField),
        (frame("q", metadata={"a": {1, 2}}), InvalidField),
    ],
)
def test_one_wrong_item_refuses_them_all(lab: Map, wrong: object, error: type[Exception]) -> None:
    lab.enrol([frame("before")])
    with pytest.raises(error):
        lab.enrol([frame("p"), wrong])
    assert lab.count_places() == 1
    with pytest.raises(UnknownPlace):
        lab.place("p")
    assert changes(lab, frame("after")) == ["created"]
    assert best(lab, "after") == "after"
    assert lab.verify().ok


@on_both
def test_known_frames_and_new_ones_are_one_commit_in_their_order(lab: Map) -> None:
    lab.enrol([frame("a"), frame("b"), frame("c")])
    monday = PlaceFields(sequence="monday")
    items: list[Enrolment | SameFrame] = [
        SameFrame("b", monday, digest_of("b")),
        frame("new", sequence="monday"),
        SameFrame("a", monday, digest_of("a")),
        SameFrame("c", monday, digest_of("another")),
        SameFrame("nobody", monday, digest_of("nobody")),
    ]
    done = lab.enrol(items)
    assert [one and one[1] for one in done] == ["updated", "created", "updated", None, None]
    order = {place.id: place.ordinal for place in lab.transfer.outline() if place.sequence == "monday"}
    assert order == {"b": 0, "new": 1, "a": 2}

    too_deep: dict[str, object] = {}
    for _ in range(100):
        too_deep = {"in": too_deep}
    with pytest.raises(InvalidField):
        lab.enrol([frame("newer"), SameFrame("a", PlaceFields(metadata=too_deep), digest_of("a"))])
    assert lab.digest("newer") is None, "all or none"
    assert lab.verify().ok


def test_nothing_to_enrol(lab: Map) -> None:
    assert lab.enrol([]) == []


def test_fields_are_set_without_a_frame(lab: Map) -> None:
    lab.enrol([frame("p", x=1, sequence="a")])
    place, change = lab.set_fields("p", PlaceFields(sequence="b"))
    assert (change, place.sequence, place.pose) == ("updated", "b", None)
    assert lab.set_fields("p", PlaceFields(sequence="b"))[1] == "unchanged"
    assert lab.thumbnail("p") == b"thumbnail of p"
    assert lab.snapshot().whereabouts.kind.tolist() == [0]
    with pytest.raises(UnknownPlace):
        lab.set_fields("absent", PlaceFields())


def test_a_patch_changes_what_it_names_and_is_searched(lab: Map) -> None:
    lab.enrol([frame("p", x=1, sequence="a", metadata={"a": 1, "b": 2})])
    before = lab.snapshot()
    place = lab.patch("p", {"pose": {"x": 7}, "metadata": {"a": None}})
    assert place == lab.place("p")
    assert (place.pose, place.sequence, place.metadata) == (Pose(x=7, y=0), "a", {"b": 2})
    assert lab.snapshot().whereabouts.position[0, 0] == 7
    assert before.whereabouts.position[0, 0] == 1
    with pytest.raises(InvalidField):
        lab.patch("p", {"pose": {"y": None}})
    assert lab.place("p") == place
    with pytest.raises(UnknownPlace):
        lab.patch("absent", {})


@on_both
def test_a_forgotten_place_is_gone_from_the_next_snapshot_but_not_from_the_last(lab: Map) -> None:
    lab.enrol([frame(f"p{i}") for i in range(6)])
    before = lab.snapshot()
    lab.forget("p3")
    rows, _ = before.search(descriptor_of("p3"))
    assert rows[0] == 3
    assert lab.places_at(rows[:2].tolist())[0] is None
    assert 3 not in lab.snapshot().search(descriptor_of("p3"))[0]
    assert lab.digest("p3") is None
    for call in (lab.place, lab.thumbnail, lab.forget):
        with pytest.raises(UnknownPlace):
            call("p3")
    assert changes(lab, frame("p3")) == ["created"]
    assert lab.places(None, 10)[0][-1].id == "p3"
    assert lab.verify().ok


def test_places_at_follow_the_order_of_the_rows(lab: Map) -> None:
    lab.enrol([frame(f"p{i}") for i in range(5)])
    lab.enrol([frame("p1", "other")])
    found = lab.places_at(np.array([4, 1, 0, 5, 99]))  # type: ignore[arg-type]
    assert [place and place.id for place in found] == ["p4", None, "p0", "p1", None]
    assert lab.places_at([]) == []


@on_both
def test_places_are_listed_page_by_page_in_the_order_of_enrolment(lab: Map) -> None:
    names = ["z", "a", "m", "b", "y"]
    lab.enrol([frame(name, sequence="s" if name in "amy" else None) for name in names])
    lab.enrol([frame("z", "another picture")])  # keeps its place
    pages, cursor = [], None
    while True:
        page, cursor = lab.places(cursor, 2)
        pages.append([place.id for place in page])
        if cursor is None:
            break
    assert pages == [["z", "a"], ["m", "b"], ["y"]]
    page, cursor = lab.places(None, 2, PlaceFilter(sequence="s"))
    assert [place.id for place in page] == ["a", "m"]
    page, last = lab.places(cursor, 2, PlaceFilter(sequence="s"))
    assert ([place.id for place in page], last) == (["y"], None)
    assert lab.places(None, 2, PlaceFilter(sequence="none such")) == ([], None)
    with pytest.raises(InvalidCursor):
        lab.places(cursor, 2)
    with pytest.raises(InvalidCursor):
        lab.places("nonsense", 2)
    with pytest.raises(ValueError, match="at least one"):
        lab.places(None, 0)


def test_a_listing_goes_on_although_its_last_place_was_forgotten(lab: Map) -> None:
    lab.enrol([frame(f"p{i}") for i in range(4)])
    _, cursor = lab.places(None, 2)
    lab.forget("p1")
    lab.enrol([frame("new")])
    assert [place.id for place in lab.places(cursor, 10)[0]] == ["p2", "p3", "new"]


@on_both
def test_sequences_are_counted(lab: Map) -> None:
    early, late = EVENING, EVENING.replace(hour=23)
    lab.enrol(
        [
            frame("a1", sequence="a", timestamp=late),
            frame("a2", sequence="a", timestamp=early),
            frame("a3", sequence="a"),
            frame("b1", sequence="b"),
            frame("none"),
        ]
    )
    found, cursor = lab.sequences(None, 1)
    assert [(each.name, each.places, each.first_at, each.last_at) for each in found] == [("a", 3, early, late)]
    found, cursor = lab.sequences(cursor, 1)
    assert [(each.name, each.places, each.first_at, each.last_at) for each in found] == [("b", 1, None, None)]
    assert cursor is None
    with pytest.raises(InvalidCursor):
        lab.sequences(lab.places(None, 1)[1], 1)


@on_both
def test_order_within_a_sequence(lab: Map) -> None:
    lab.enrol([frame(name, sequence=name[0]) for name in ("a1", "b1", "a2", "a3")])
    lab.enrol([frame("a1", "other", sequence="a")])  # keeps its place in the traverse
    lab.patch("b1", {"sequence": "a"})  # comes to its end
    rows = [3, 4, 1, 2]
    there = lab.snapshot().whereabouts.take(rows)
    assert [place and place.id for place in lab.places_at(rows)] == ["a3", "a1", "b1", "a2"]
    assert there.ordinal.tolist() == [2, 0, 3, 1]
    assert len(set(there.sequence.tolist())) == 1


def test_places_without_a_sequence_share_a_code(lab: Map) -> None:
    lab.enrol([frame("a"), frame("b"), frame("c", sequence="s")])
    there = lab.snapshot().whereabouts
    assert (there.sequence[:2].tolist(), there.ordinal.tolist()) == ([-1, -1], [0, 1, 0])
    assert there.sequence[2] >= 0


@on_both
def test_a_sequence_is_forgotten_as_a_whole(lab: Map) -> None:
    lab.enrol([frame(f"{name}{i}", sequence=name) for i in range(5) for name in "ab"])
    code = lab.snapshot().whereabouts.sequence[0]
    assert lab.forget_sequence("a") == 5
    assert [place.id for place in lab.places(None, 20)[0]] == [f"b{i}" for i in range(5)]
    assert lab.count_places() == 5
    with pytest.raises(UnknownSequence):
        lab.forget_sequence("a")
    lab.enrol([frame("a9", sequence="a")])
    there = lab.snapshot().whereabouts
    assert there.sequence[-1] != code
    assert there.ordinal[-1] == 0
    assert lab.verify().ok


CALIBRATION = Calibration(source="measured", threshold=3.0, margin=0.1, background_mean=0.1, background_deviation=0.02)


@on_both
def test_a_map_is_edited_by_revision(lab: Map, store: Store) -> None:
    before = lab.record
    assert (before.revision, before.encoder, before.dimension, before.calibration) == (1, ENCODER, DIMENSION, None)
    after = lab.edit({"description": "x", "calibration": CALIBRATION}, expected_revision=1)
    assert after == lab.record
    assert (after.revision, after.description, after.calibration) == (2, "x", CALIBRATION)
    assert after.updated_at > before.updated_at
    assert after.created_at == before.created_at
    with pytest.raises(RevisionMismatch):
        lab.edit({"description": "y"}, expected_revision=1)
    with pytest.raises(InvalidField):
        lab.edit({"encoder": "other"})
    assert lab.edit({"description": "x"}).revision == 2
    assert lab.edit({"calibration": None}).calibration is None
    assert store.records(None, 10)[0] == [lab.record]


def photograph() -> bytes:
    pixels = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    return encode_png(cv2.blur(pixels, (31, 31)).astype(np.uint8))


@on_both
def test_the_stored_picture_of_a_frame(store: Store) -> None:
    hall = store.create("hall", ENCODER, DIMENSION, MapSettings(keep="none"), local_shape=LOCAL_SHAPE)
    hall.enrol([frame("a")])
    assert hall.place("a").picture == "none"
    with pytest.raises(NoThumbnail):
        hall.thumbnail("a")
    hall.edit({"keep": "image"})
    image = photograph()
    hall.enrol([replace(frame("b"), image=image), replace(frame("c"), image=None), frame("a", "other")])
    assert [hall.place(name).picture for name in "abc"] == ["image", "image", "thumbnail"]
    assert decode(hall.thumbnail("b")).shape == (240, 320, 3)
    assert hall.thumbnail("c") == b"thumbnail of c"
    hall.edit({"keep": "thumbnail"})
    hall.enrol([replace(frame("d"), thumbnail=None)])
    assert hall.place("d").picture == "none"
    assert hall.place("b").picture == "image"
    hall.edit({"keep": "none"})
    hall.enrol([frame("b", "other")])
    with pytest.raises(NoThumbnail):
        hall.thumbnail("b")


@on_both
def test_all_of_it_is_there_after_a_restart(open_store: OpenStore, store: Store, lab: Map) -> None:
    lab.enrol([frame(f"p{i}", sequence="s", x=i, metadata={"i": i}) for i in range(11)])
    lab.enrol([frame("p2", "other"), frame("p3", sequence="t")])
    lab.forget("p5")
    lab.edit({"description": "x"})
    places, before, record = lab.places(None, 100), lab.snapshot(), lab.record
    store.close()
    with pytest.raises(StorageFailure):
        lab.place("p1")
    lab = open_store().get("lab")
    assert (lab.places(None, 100), lab.record) == (places, record)
    after = lab.snapshot()
    for shown in ("p1", "p2", "other", "p5"):
        for mine, theirs in zip(after.search(descriptor_of(shown)), before.search(descriptor_of(shown)), strict=True):
            np.testing.assert_array_equal(mine, theirs)
    living = after.search(descriptor_of("p1"))[0]
    np.testing.assert_array_equal(after.locals_at(living), before.locals_at(living))
    np.testing.assert_array_equal(after.locals_at(after.search(descriptor_of("other"))[0])[0], local_of("other"))
    for name, column in vars(after.whereabouts.take(living)).items():
        np.testing.assert_array_equal(column, getattr(before.whereabouts.take(living), name), err_msg=name)
    (found,) = lab.keypoints_at(lab.rows_of(["p1"]))  # type: ignore[arg-type]
    assert found is not None and found.record() == keypoints_of("p1").record()
    assert changes(lab, frame("p1", sequence="s", x=1, metadata={"i": 1})) == ["unchanged"]
    assert lab.enrol([frame("late", sequence="s")])[0][1] == "created"
    assert lab.snapshot().whereabouts.ordinal[-1] == 11
    assert lab.verify().ok


@on_both
def test_a_deleted_map_answers_no_more(lab: Map, store: Store) -> None:
    lab.enrol([frame("p")])
    held = lab.snapshot()
    store.delete("lab")
    assert held.search(descriptor_of("p"))[0].tolist() == [0]
    for call in (
        lambda: lab.place("p"),
        lambda: lab.enrol([frame("q")]),
        lambda: lab.places_at([0]),
        lab.snapshot,
        lab.verify,
    ):
        with pytest.raises(UnknownMap):
            call()


@pytest.mark.parametrize("value", ["'text'", "7"])
def test_a_damaged_picture_is_not_handed_out(lab: Map, value: str) -> None:
    """A flipped bit may change the type of a value, which the table itself does not allow."""
    lab.enrol([frame("p")])
    execute(lab, "DROP TABLE pictures", "CREATE TABLE pictures (map, row, digest, size, bytes)",
            f"INSERT INTO pictures SELECT map, row, x'00', 1, {value} FROM places")  # fmt: skip
    for read in (lab.thumbnail, lab.picture):
        with pytest.raises(StorageFailure, match="damaged"):
            read("p")
    assert lab.place("p").id == "p"


ENDLESS = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + (1 << 20).to_bytes(4, "big") * 2 + bytes(9)


@pytest.mark.parametrize(
    ("content", "why"), [(ENDLESS, "1048576x1048576 pixels"), (b"<script>", "not those of an image")]
)
def test_a_stored_picture_that_cannot_be_shown_is_no_thumbnail(lab: Map, content: bytes, why: str) -> None:
    lab.edit({"keep": "image"})
    lab.enrol([replace(frame("p"), image=content)])
    with pytest.raises(NoThumbnail, match=why):
        lab.thumbnail("p")


@pytest.mark.parametrize("name", ["..", ".", "\u202e", "\x85"])
def test_a_sequence_of_an_older_map_keeps_its_name(open_store: OpenStore, store: Store, lab: Map, name: str) -> None:
    """No sequence is given such a name any more; a map that has one is read, edited and emptied as ever."""
    old = PlaceFields.model_construct(sequence=name)
    lab.enrol([replace(frame(one), fields=old) for one in ("p0", "p1", "p2")])
    store.close()
    lab = open_store().get("lab")
    assert lab.verify().ok and [one.name for one in lab.sequences(None, 10)[0]] == [name]
    assert lab.patch("p0", {"pose": {"x": 1, "y": 2}}).sequence == lab.place("p1").sequence == name
    assert lab.place("p1").fields() == old
    assert lab.patch("p1", {"sequence": "monday"}).sequence == "monday"
    with pytest.raises(InvalidField, match="sequence"):
        lab.patch("p1", {"sequence": name})
    assert lab.forget_all(PlaceFilter(None, name), 10) == ["p0", "p2"]
    assert [one.name for one in lab.sequences(None, 10)[0]] == ["monday"]


def test_a_write_is_one_transaction_that_is_synced(lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is deleted later is deleted in one of its own, behind it."""
    lab.enrol([frame("p0", sequence="s", metadata={"floor": 1})])
    file, written, read = file_of(lab), list[str](), list[str]()
    assert file._writer is not None
    file._writer.set_trace_callback(written.append)
    for reader in file._idle:
        reader.set_trace_callback(read.append)
    monkeypatch.setattr(file, "_connected", lambda: pytest.fail("another connection"))
    lab.enrol([frame("p1", sequence="s", metadata={"floor": 1})])
    words = [statement.split()[0] for statement in written]
    assert set(words) <= {*SQL, "BEGIN", "COMMIT"} and read == []
    first = words[: words.index("COMMIT") + 1]
    assert written[0] == "BEGIN IMMEDIATE" and first.count("BEGIN") == 1 and "INSERT" in first
    assert [word for word in words[len(first) :] if word not in ("BEGIN", "COMMIT", "SELECT")] == []
    assert file._writer.execute("PRAGMA synchronous").fetchone() == (2,)
    assert file._writer.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    written.clear()
    lab.enrol([frame("p1", sequence="s", metadata={"floor": 1})])
    assert not [one for one in written if one.split()[0] in SQL - {"SELECT"}], "nothing changes"
    assert read == []


SQL = {"SELECT", "INSERT", "UPDATE", "DELETE"}


@on_both
def test_a_reading_is_of_one_moment(lab: Map) -> None:
    lab.enrol([frame("p0")])
    with lab._reading() as connection:
        stored = places.expect(connection, "p0")
        lab.enrol([frame("p0", "another picture"), frame("p1")])
        assert places.expect(connection, "p0") == stored and places.count(connection) == (1, 0)
        assert frames.pictures_at(connection, [stored.row]) == {stored.row: b"thumbnail of p0"}
    assert lab.count_places() == 2 and lab.picture("p0") == b"thumbnail of another picture"
