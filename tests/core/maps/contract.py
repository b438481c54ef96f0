"""What every store of maps has to do (:class:`core.store.Store`): random writes and queries, with a model beside them.

A suite of one store derives a class from :class:`StoreContract` that says how the store is opened.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from core import errors
from core.frames.masks import Mask, with_range
from core.judgement.priors import Disc, Period
from core.ledger.maps import rows
from core.maps import Correspondence, History, PlaceFilter, ReviewSetting, SameFrame, Selection
from core.maps.archives.reading import Archive, check
from core.maps.records import Outline
from core.maps.selection import Conditions, RecentFrames
from core.places import NO_TIME, Neighborhood, PlaceFields, Pose, Whereabouts, level_code, look_address, microseconds
from core.store import Map, Store
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of
from tests.durability.contents import sha
from tests.durability.model import GONE, MapModel, PlaceModel, Refused, changed, differences
from tests.durability.storage.operations import DEFAULTS, enrolment, look_enrolment, shown

MAP = "lab"
NAMES = ("monday", "tuesday")

ids = st.sampled_from([f"p{number}" for number in range(9)])
pictures = st.sampled_from([f"picture {number}" for number in range(12)])
sequences = st.sampled_from([None, *NAMES])
scalars = st.one_of(st.none(), st.booleans(), st.integers(0, 2), st.sampled_from([1.0, 0.5, "a", 'q"\\\u0000ü']))
metadata = st.dictionaries(st.sampled_from(["floor", 'a "key"']), scalars | st.just([1]), max_size=2)
times = st.sampled_from([f"2026-11-{day:02}T10:00:00Z" for day in (1, 2, 3)])
metres = st.integers(0, 30)
poses = st.one_of(
    st.builds(lambda x, y, heading: {"x": x, "y": y, "heading": heading}, metres, metres, st.none() | st.just(90)),
    st.builds(lambda x, z: {"x": x, "y": 10, "z": z}, metres, st.sampled_from([-4.0, 0.0])),
    st.builds(lambda latitude: {"latitude": latitude / 1e5, "longitude": 7.5}, metres),
)
fields = st.fixed_dictionaries(
    {}, optional={"pose": poses, "sequence": sequences, "timestamp": times, "metadata": metadata,
                  "camera": st.sampled_from(["front", "rear"]), "level": st.sampled_from(["B", "Ü", -1]),
                  "pose_accuracy": st.sampled_from([{"metres": 0.5}, {"metres": 2.0, "degrees": 3.0}])}
)  # fmt: skip
items = st.fixed_dictionaries({"id": ids, "picture": pictures, "fields": fields, "keypoints": st.booleans()})
patches = st.one_of(
    st.fixed_dictionaries({"sequence": sequences}),
    st.fixed_dictionaries({"metadata": st.none() | metadata}),
    st.just({"pose": None}),
    st.just({"level": None, "pose_accuracy": None}),
)
conditions = st.builds(
    Conditions,
    st.lists(
        st.one_of(
            st.builds(lambda x, radius: Disc(Pose(x=x, y=10), radius), metres, st.integers(1, 20)),
            st.builds(lambda latitude: Disc(Pose(latitude=latitude / 1e5, longitude=7.5), 8.0), metres),
            st.builds(lambda day: Period(_moment(f"2026-11-{day:02}T10:00:00Z"), None), st.integers(1, 3)),
        ),
        max_size=2,
    ).map(tuple),
    st.none() | st.lists(st.sampled_from([*NAMES, "never"]), max_size=2).map(tuple),
    st.dictionaries(st.sampled_from(["floor", 'a "key"']), scalars, max_size=1),
)
selections = st.builds(
    Selection,
    filters=conditions,
    recent=st.none() | st.builds(RecentFrames, st.sampled_from(NAMES), st.integers(1, 2)),
    excluded=st.none() | ids,
)


def _moment(text: str) -> int:
    moment = PlaceFields.model_validate({"timestamp": text}).timestamp
    assert moment is not None
    return microseconds(moment)


def _same(a: Any, b: Any) -> bool:
    """Whether two values of metadata are the same: numbers as numbers, and true is not 1."""
    return (type(a) in (int, float) and type(b) in (int, float) and a == b) or (type(a) is type(b) and a == b)


class StoreContract(RuleBasedStateMachine):
    """One map of a store, written to and searched at random."""

    store: Store
    model: MapModel

    @abstractmethod
    def opened(self) -> Store:
        """The store, empty at the first call; at a later call with what was written to it before."""

    @property
    def map(self) -> Map:
        return self.store.get(MAP)

    @initialize(picture=pictures)
    def begin(self, picture: str) -> None:
        self.store = self.opened()
        made = self.store.create(MAP, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        self.model = MapModel(dict(DEFAULTS))
        assert made.record == self.map.record and self.map.record.revision == 1
        with pytest.raises(errors.MapExists):
            self.store.create(MAP, ENCODER, DIMENSION)
        with pytest.raises(errors.UnknownMap):
            self.store.get("nowhere")

    def agree(self, of_model: Callable[[MapModel], Any], of_map: Callable[[Map], Any]) -> None:
        """Do the same to the model and to the map, and compare the answers."""
        world, expected = changed({MAP: self.model}, lambda world: of_model(world[MAP]))
        try:
            found = of_map(self.map)
        except errors.PlacerecError as error:
            found = {"error": type(error).__name__}
        self.model = world[MAP]
        assert found == expected

    # Writes

    @rule(batch=st.lists(items, min_size=1, max_size=4), blank=st.sampled_from([False] * 7 + [True]))
    def enrol(self, batch: list[dict[str, Any]], blank: bool) -> None:
        given = [enrolment(**item) for item in batch]
        if blank:
            with pytest.raises(errors.NoRegions):
                self.map.enrol([*given, enrolment("blank", "blank", {}, False)])
            return
        self.agree(
            lambda model: [
                model.enrol(one["id"], of := shown(one["picture"]), one["fields"],
                            keypoints=of.keypoints if one["keypoints"] else None)
                for one in batch
            ],
            lambda lab: [change for _, change in lab.enrol(given)],
        )  # fmt: skip

    @rule(place_id=ids, picture=pictures, given=fields)
    def enrol_same_frame(self, place_id: str, picture: str, given: dict[str, Any]) -> None:
        item = SameFrame(place_id, PlaceFields.model_validate(given), bytes.fromhex(shown(picture).digest))
        known = self.model.places.get(place_id)
        same = known is not None and known.shown.digest == shown(picture).digest
        self.agree(
            lambda model: model.set_fields(place_id, given) if same else None,
            lambda lab: None if (found := lab.enrol([item])[0]) is None else found[1],
        )

    @rule(place_id=ids, given=fields)
    def set_fields(self, place_id: str, given: dict[str, Any]) -> None:
        self.agree(
            lambda model: model.set_fields(place_id, given),
            lambda lab: lab.set_fields(place_id, PlaceFields.model_validate(given))[1],
        )

    @rule(place_id=ids, changes=patches)
    def patch(self, place_id: str, changes: dict[str, Any]) -> None:
        self.agree(
            lambda model: (model.patch(place_id, changes), None)[1], lambda lab: (lab.patch(place_id, changes), None)[1]
        )

    @rule(
        place_id=ids, picture=pictures, seen=st.none() | times, run=st.none() | st.sampled_from(["night", "snow"]),
        least=st.none() | st.sampled_from([0.0, 0.3]), camera=st.none() | st.just("front"), keypoints=st.booleans(),
    )  # fmt: skip
    def add_look(
        self, place_id: str, picture: str, seen: Any, run: Any, least: Any, camera: Any, keypoints: bool
    ) -> None:
        of = shown(picture)
        self.agree(
            lambda model: model.add_look(place_id, of, seen, camera, run, least, of.keypoints if keypoints else None),
            lambda lab: lab.enrol([look_enrolment(place_id, picture, seen, camera, run, least, keypoints)])[0][1],
        )

    @rule(place_id=ids, picture=pictures)
    def forget_look(self, place_id: str, picture: str) -> None:
        name = shown(picture).digest[:16]
        self.agree(lambda model: model.forget_look(place_id, name), lambda lab: lab.forget_look(place_id, name))

    @rule(place_id=ids, picture=pictures, more=st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(0, 2)))
    def count_served(self, place_id: str, picture: str, more: tuple[int, int, int]) -> None:
        name = shown(picture).digest[:16]

        def counted(lab: Map) -> None:
            (row,) = lab.rows_of([look_address(place_id, name)])
            lab.count_served({} if row is None else {row: more})

        self.agree(lambda model: model.count_served(place_id, name, more), counted)

    @rule(place_id=ids, picture=pictures)
    def withdraw(self, place_id: str, picture: str) -> None:
        """Only a learnt look can be withdrawn by its row."""
        name = shown(picture).digest[:16]
        (row,) = self.map.rows_of([look_address(place_id, name)])
        look = self.model.places[place_id].looks[name] if row is not None else None
        learnt = look is not None and look.run is not None
        assert (row in self.map.learnt_looks()) == learnt

        def withdrawn(model: MapModel) -> int:
            if learnt:
                model.forget_look(place_id, name)
            return int(learnt)

        self.agree(withdrawn, lambda lab: lab.withdraw([] if row is None else [row]))

    @rule(run=st.sampled_from(["night", "snow"]))
    def forget_learnt(self, run: str) -> None:
        self.agree(lambda model: model.forget_learnt(run), lambda lab: lab.forget_learnt(run))

    @rule(back=st.booleans())
    def forget_learnt_in_a_period(self, back: bool) -> None:
        """All that was ever learnt was added before now, and nothing after."""
        now = datetime.now(UTC) + timedelta(seconds=1)

        def forgotten(model: MapModel) -> int:
            return sum(map(model.forget_learnt, ("night", "snow"))) if back else 0

        self.agree(
            forgotten,
            lambda lab: lab.forget_learnt(None, until=now) if back else lab.forget_learnt(None, since=now),
        )

    @rule(place_id=ids)
    def forget(self, place_id: str) -> None:
        self.agree(lambda model: model.forget(place_id), lambda lab: lab.forget(place_id))

    @rule(name=st.sampled_from(NAMES))
    def forget_sequence(self, name: str) -> None:
        self.agree(lambda model: model.forget_sequence(name), lambda lab: lab.forget_sequence(name))

    @rule(
        camera=st.sampled_from(["front", "rear"]), where=st.dictionaries(st.just("floor"), scalars, max_size=1),
        level=st.sampled_from([None, "B", "1"]),
    )  # fmt: skip
    def forget_all(self, camera: str, where: dict[str, Any], level: str | None) -> None:
        wanted = PlaceFilter(camera=camera, level=level, metadata=where)

        def forgotten(model: MapModel) -> list[str]:
            found = [name for name, place in model.places.items()
                     if place.fields.get("camera") == camera and _has(place, where)
                     and level in (None, PlaceFields.model_validate(place.fields).level)]  # fmt: skip
            if len(found) > 2:
                raise Refused("TooManyToDelete")
            for name in found:
                model.forget(name)
            return found

        self.agree(forgotten, lambda lab: lab.forget_all(wanted, 2))

    @rule(text=st.sampled_from(["a", "b"]), behind=st.integers(-1, 1))
    def edit(self, text: str, behind: int) -> None:
        expected = self.model.revision + behind

        def edited(model: MapModel) -> int:
            if behind:
                raise Refused("RevisionMismatch")
            return model.edit({"description": text})

        self.agree(edited, lambda lab: lab.edit({"description": text}, expected).revision)

    @rule(setting=st.sampled_from(["auto", "exact", "compact"]))
    def search_otherwise(self, setting: str) -> None:
        self.agree(lambda model: model.edit({"index": setting}), lambda lab: lab.edit({"index": setting}).revision)

    @rule()
    def erase(self) -> None:
        """What is deleted leaves no row."""
        with patch.object(rows, "LEFT_SECONDS", -1):
            self.map.erase()
        with self.map.viewing() as (connection, _):
            assert rows.left(connection)[0] == 0 and rows.of_no_place(connection) == []

    @rule(place_id=ids, picture=pictures, given=fields, ordinal=st.none() | st.integers(0, 9))
    def adopt(self, place_id: str, picture: str, given: dict[str, Any], ordinal: int | None) -> None:
        """A place of another map keeps its history."""
        of, moment = shown(picture), datetime(2026, 1, 2, tzinfo=UTC)
        made = PlaceModel(of, given, "none", 0, created="2026-01-02T00:00:00Z", updated="2026-01-02T00:00:00Z",
                          keypoints=of.keypoints)  # fmt: skip
        item = enrolment(place_id, picture, given, True)
        self.agree(
            lambda model: model.adopt(place_id, made, ordinal),
            lambda lab: lab.transfer.adopt([(item, History("none", ordinal, moment, moment))]),
        )

    @rule(chosen=st.lists(ids, max_size=3, unique=True), stale=st.booleans())
    def forget_many(self, chosen: list[str], stale: bool) -> None:
        digests = {name: self.map.digest(name) for name in chosen}
        there = {name: b"?" * 32 if stale else digest for name, digest in digests.items() if digest is not None}

        def forgotten(model: MapModel) -> int:
            for name in () if stale else there:
                model.forget(name)
            return 0 if stale else len(there)

        self.agree(forgotten, lambda lab: lab.transfer.forget(there))

    @rule(limit=st.integers(1, 3))
    def find_keypoints_later(self, limit: int) -> None:
        found = [(one, enrolment("any", _picture_of(one.digest), {}, True).keypoints)
                 for one in self.map.without_keypoints(0, limit)]  # fmt: skip
        self.agree(
            lambda model: model.fill_in(limit),
            lambda lab: lab.add_keypoints([(one, keypoints) for one, keypoints in found if keypoints is not None]),
        )

    @rule(pair=st.tuples(ids, ids), hand_over=st.booleans(), paused=st.booleans())
    def align(self, pair: tuple[str, str], hand_over: bool, paused: bool) -> None:
        """One place is put to the station of another, and may get its pose."""
        (one, other), places = pair, self.model.places
        if one == other or one not in places or other not in places or places[other].station is None:
            return
        poses = [pair] if hand_over and places[other].fields.get("pose") is not None else []

        def stored(lab: Map) -> None:
            with lab.transfer.paused_writes() if paused else nullcontext():
                first, second = lab.rows_of(pair)
                assert first is not None and second is not None
                where = lab.snapshot().whereabouts
                at = int(where.track[second]), int(where.station[second])
                lab.counterparts.store(Correspondence({first: at}, {first: second} if poses else {}))

        self.agree(lambda model: model.store_counterparts([pair], poses), stored)

    @rule(
        name=st.sampled_from(["front", "rear"]),
        covered=st.sampled_from([None, 0.5]),
        values=st.sampled_from([None, (0, 1023)]),
    )
    def put_camera(self, name: str, covered: float | None, values: tuple[int, int] | None) -> None:
        mask = None if covered is None else Mask(polygons=(((0, 0), (covered, 0), (0, covered)),))

        def put(model: MapModel) -> bool:
            is_new = name not in model.cameras
            model.cameras[name] = with_range(mask, values)
            return is_new

        self.agree(put, lambda lab: lab.cameras.put(name, mask, value_range=values)[1])

    @rule(name=st.sampled_from(["front", "rear"]))
    def forget_camera(self, name: str) -> None:
        def forgotten(model: MapModel) -> None:
            if name not in model.cameras:
                raise Refused("UnknownCamera")
            del model.cameras[name]

        self.agree(forgotten, lambda lab: lab.cameras.forget(name))

    @rule(picture=pictures, most=st.integers(1, 3))
    def keep_for_review(self, picture: str, most: int) -> None:
        """The oldest frame without a label goes first; a label is found again."""
        review, data = self.map.review, picture.encode()
        numbers = [frame.number for frame in review.page(None, 10).frames]
        known = next((frame for frame in review.page(None, 10).frames if frame.digest == sha256(data).digest()), None)
        setting = ReviewSetting(most_frames=most)
        assert review.keep(data, {"verdict": "unknown"}, setting) == (known is None)
        review.shrink(setting)
        page = self.map.review.page(None, 10)
        kept = page.frames
        assert len(kept) == min(most, len(numbers) + (known is None))
        unlabelled = [frame.number for frame in kept if frame.label is None]
        assert unlabelled == sorted(unlabelled, reverse=True)
        latest = kept[0]
        said = {"label": {"place": "p1"}, "at": "2026-11-28T10:00:00.500000+00:00", "by": None}
        assert review.label(latest.number, said).label == said
        assert latest.number in [frame.number for frame in self.map.review.labelled()]
        assert sha256(self.map.review.picture(latest.number)).digest() == latest.digest
        assert (page.count, page.size) == (len(kept), sum(frame.size for frame in kept))
        if len(kept) == 3:
            review.discard(latest.number)
            with pytest.raises(errors.UnknownFrame):
                self.map.review.find(latest.number)

    @rule()
    def copy_through_a_file(self) -> None:
        """What is exported, imported and exported again is the same, to the last bit of each part."""
        with TemporaryDirectory() as folder:
            first, second = Path(folder) / "first.tar", Path(folder) / "second.tar"
            self.map.exporter.write(first)
            with Archive(first) as archive:
                check(archive)
                self.store.import_map(archive, "copy", lambda *_: None, lambda _: None, 10**6, lambda _: None)
                with pytest.raises(errors.MapExists):
                    self.store.import_map(archive, "copy", lambda *_: None, lambda _: None, 10**6, lambda _: None)
            copy = self.store.get("copy")
            copy.exporter.write(second)
            with Archive(first) as archive, Archive(second) as other:
                assert other.manifest.parts == archive.manifest.parts
                assert other.manifest.map == archive.manifest.map.model_copy(update={"id": "copy"})
            self.store.delete("copy")

    @rule()
    def reopen(self) -> None:
        """What was acknowledged is there after a restart, and sound."""
        self.store.close()
        self.store = self.opened()
        report = self.store.verify(MAP)
        assert (report.ok, report.problems, report.stale_caches) == (True, [], [])

    @rule()
    def delete(self) -> None:
        self.store.delete(MAP)
        for action in (self.store.get, self.store.delete):
            with pytest.raises(errors.UnknownMap):
                action(MAP)
        self.store.create(MAP, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        self.model = MapModel(dict(DEFAULTS))

    # Reads

    @rule(picture=pictures, selection=selections, cut=st.integers(1, 3))
    def query(self, picture: str, selection: Selection, cut: int) -> None:
        kinds = self.model.kinds_of_poses()
        wanted = {one.centre.kind() == "metric" for one in selection.filters.geometry if isinstance(one, Disc)}
        if kinds and not wanted <= kinds:
            with pytest.raises(errors.MixedCoordinates):
                self.map.scope(selection)
            return
        scope, asked = self.map.scope(selection), descriptor_of(picture)
        ((rows, products),) = scope.search(asked[np.newaxis])
        found = [place and place.id for place in self.map.places_at(rows.tolist())]
        allowed = self._allowed(selection)
        looks = {name: 1 + len(self.model.places[name].looks) for name in allowed}
        assert sorted(str(name) for name in found) == sorted(name for name in allowed for _ in range(looks[name]))
        exact = scope.snapshot.descriptors_at(rows) @ asked
        assert np.allclose(products, exact, atol=1e-5) and (np.diff(products) <= 0).all()
        assert scope.weights_at(rows) is None
        if not len(rows):
            return
        neighborhood, where = Neighborhood(5.0, 1), scope.snapshot.whereabouts_at(rows)
        others = ~where.near(0, neighborhood)
        others[:cut] = False
        more, _ = scope.search_elsewhere(asked, (rows[:cut], products[:cut]), int(rows[0]), neighborhood)
        assert more.tolist() == rows[others].tolist()

    @rule(sequence=st.sampled_from(NAMES), trust=st.sampled_from([0.5, 0.9]))
    def weigh(self, sequence: str, trust: float) -> None:
        scope = self.map.scope(Selection(prior=Conditions(sequences=(sequence,)), trust=trust))
        ((rows, _),) = scope.search(descriptor_of("picture 0")[np.newaxis])
        weights, places = scope.weights_at(rows), self.map.places_at(rows.tolist())
        looks = sum(len(place.looks) for place in self.model.places.values())
        assert weights is not None and len(rows) == len(self.model.places) + looks
        expected = [0.0 if place and place.sequence == sequence else np.log(1 - trust) for place in places]
        assert np.allclose(weights, expected)

    @rule(limit=st.integers(1, 4), sequence=sequences)
    def list_places(self, limit: int, sequence: str | None) -> None:
        wanted, found, cursor = PlaceFilter(sequence=sequence), list[str](), None
        while True:
            page, cursor = self.map.places(cursor, limit, wanted)
            found += [place.id for place in page]
            assert len(page) == limit or cursor is None
            if cursor is None:
                break
        every = self.model.places.items()
        assert found == [name for name, place in every if sequence in (None, place.sequence)]
        for malformed in ("?", "AAAA"):
            with pytest.raises(errors.InvalidCursor):
                self.map.places(malformed, limit)

    @invariant()
    def holds_what_the_model_holds(self) -> None:
        expected, lab = self.model.expected(), self.map
        assert [record.id for record in self.store.records(None, 10)[0]] == [MAP]
        assert lab.record.revision == expected["revision"] and lab.count_places() == len(expected["places"])
        found = _places(lab)
        wanted = [_without(place, "found_first") for place in expected["places"]]
        assert len(found) == len(expected["places"])
        assert not (wrong := differences(wanted, found)), "\n".join(wrong)
        self.model.told(found)
        assert {camera.name: lab.cameras.mask(camera.name) for camera in lab.cameras.all()} == expected["cameras"]
        ends = sorted(([name, end] for name, end in lab.transfer.sequence_ends().items()), key=str)
        assert ends == expected["ends"]
        names = sorted({place.sequence for place in self.model.places.values() if place.sequence is not None})
        assert [(one.name, one.places) for one in lab.sequences(None, 10)[0]] == [
            (name, sum(place.sequence == name for place in self.model.places.values())) for name in names
        ]
        assert lab.unknown_sequences([*NAMES, "never"]) == {*NAMES, "never"} - set(names)

    def _allowed(self, selection: Selection) -> list[str]:
        """The ids of the places that a query may find, by the model."""
        filters, recent = selection.filters, selection.recent
        lately: list[str] = []
        if recent is not None:
            along = {name: place.ordinal for name, place in self.model.places.items()
                     if place.sequence == recent.sequence}  # fmt: skip
            oldest = min(list(along.values())[-recent.frames :], default=0)
            lately = [name for name, ordinal in along.items() if ordinal >= oldest]
        return [
            name
            for name, place in self.model.places.items()
            if name not in (selection.excluded, *lately)
            and (filters.sequences is None or place.sequence in filters.sequences)
            and _has(place, filters.metadata)
            and all(_holds(one, place) for one in filters.geometry)
        ]


def _without(content: Any, name: str) -> Any:
    """A place as the model has it, without a value that is not compared, also of its looks."""
    if isinstance(content, list):
        return [_without(one, name) for one in content]
    if isinstance(content, dict):
        return {key: _without(value, name) for key, value in content.items() if key != name}
    return content


def _has(place: PlaceModel, where: Any) -> bool:
    values = place.fields.get("metadata") or {}
    return all(key in values and _same(values[key], value) for key, value in where.items())


def _holds(condition: Any, place: PlaceModel) -> bool:
    stored = PlaceFields.model_validate(place.fields)
    if isinstance(condition, Period):
        assert condition.after is not None
        return stored.timestamp is not None and microseconds(stored.timestamp) >= condition.after
    assert isinstance(condition, Disc)
    if stored.pose is None or stored.pose.kind() != condition.centre.kind():
        return False
    apart = np.linalg.norm(stored.pose.position() - condition.centre.position())
    return bool(apart <= condition.radius + 1e-6)


def _picture_of(digest: bytes) -> str:
    """Which of the pictures has this digest."""
    return next(f"picture {number}" for number in range(12) if shown(f"picture {number}").digest == digest.hex())


def _track(where: Whereabouts, at: int, names: Mapping[int, str | None]) -> list[Any] | None:
    """At which station of which track a place is, as the model has it; None for its own."""
    track, station = int(where.track[at]), int(where.station[at])
    if (track, station) == (int(where.sequence[at]), int(where.ordinal[at])):
        return None
    return [names.get(track) or GONE, station]


def _places(lab: Map) -> list[dict[str, Any]]:
    """All places of a map, as the model has them."""
    every, snapshot = lab.transfer.outline(looks=True), lab.snapshot()
    assert len(snapshot) == len(every)
    outline = lab.transfer.outline()
    assert outline == [one for one in every if not one.is_look]
    looks = _other_looks(lab, every)
    rows = np.array([place.row for place in outline], np.int64)
    listed, cursor = lab.places(None, 1000)
    assert cursor is None and [place.id for place in listed] == [place.id for place in outline]
    assert lab.places_at(rows.tolist()) == listed == [lab.place(place.id) for place in outline]
    assert lab.rows_of([place.id for place in outline]) == rows.tolist()
    living = sorted(one.row for one in every)
    assert np.flatnonzero(snapshot.alive).tolist() == living and snapshot.rows > max(living, default=-1)
    descriptors, local, where = snapshot.descriptors_at(rows), snapshot.locals_at(rows), snapshot.whereabouts_at(rows)
    keypoints = lab.keypoints_at(rows.tolist())
    names = {int(where.sequence[at]): place.sequence for at, place in enumerate(outline)}
    for at, place in enumerate(listed):
        pose, moment = place.pose, place.timestamp
        assert where.timestamp[at] == (NO_TIME if moment is None else microseconds(moment))
        assert np.array_equal(where.position[at], np.zeros(3) if pose is None else pose.position())
        heading = None if pose is None else pose.heading
        assert np.isnan(where.heading[at]) if heading is None else where.heading[at] == np.float32(heading)
        exact = np.nan if place.pose_accuracy is None else place.pose_accuracy.metres
        assert np.array_equal(where.accuracy[at], exact, equal_nan=True) and where.level[at] == level_code(place.level)
        assert np.array_equal(where.height[at], np.nan if pose is None or pose.z is None else pose.z, equal_nan=True)
    return [
        {
            **place.model_dump(mode="json"),
            "digest": outline[at].digest.hex(),
            "ordinal": int(where.ordinal[at]),
            "track": _track(where, at, names),
            "kept": None if (picture := lab.picture(place.id)) is None else sha(picture),
            "keypoints": None if (of_frame := keypoints[at]) is None else sha(of_frame.record()),
            "descriptor": sha(descriptors[at].tobytes()),
            "local": sha(local[at].tobytes()),
            "other_looks": looks[place.id],
        }
        for at, place in enumerate(listed)
    ]


def _other_looks(lab: Map, every: Sequence[Outline]) -> dict[str, list[dict[str, Any]]]:
    """The looks of all places besides their first, as the model has them; they are where their places are."""
    rows, snapshot = {one.id: one.row for one in every}, lab.snapshot()
    found: dict[str, list[dict[str, Any]]] = {one.id: [] for one in every if not one.is_look}
    for place_id, looks in found.items():
        for look in lab.looks(place_id):
            address = look_address(place_id, look.name)
            row = np.array([rows[address]])
            where = snapshot.whereabouts_at(np.array([rows[address], rows[place_id]]))
            columns = dict(vars(where))
            assert columns.pop("least").tolist() == [
                -np.inf if look.least_score is None else np.float32(look.least_score), -np.inf
            ]  # fmt: skip
            assert all((column[0] == column[1]).all() or (column != column).all() for column in columns.values())
            (shown_by,), (keypoints,) = lab.places_at(row.tolist()), lab.keypoints_at(row.tolist())
            changes = {"look": look.name, **{name: getattr(look, name) for name in ("camera", "regions", "picture")}}
            moments = {name: getattr(shown_by, name) for name in ("created_at", "updated_at")}
            assert shown_by == lab.place(place_id).model_copy(update=changes | moments)
            picture = lab.picture(address)
            looks.append({
                **look.model_dump(mode="json"),
                "kept": None if picture is None else sha(picture),
                "keypoints": None if keypoints is None else sha(keypoints.record()),
                "descriptor": sha(snapshot.descriptors_at(row)[0].tobytes()),
                "local": sha(snapshot.locals_at(row)[0].tobytes()),
            })  # fmt: skip
    assert sum(map(len, found.values())) == sum(one.is_look for one in every)
    return found
