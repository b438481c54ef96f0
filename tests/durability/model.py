"""A model of a data directory in plain values: maps, places and their order, with none of the real code.

Only the rules of field values (:class:`core.places.PlaceFields`) are shared with what is tested.  A value that is not
known, such as the time of a write that was never acknowledged, is ``ANY`` and learnt when it is found.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from core.places import PlaceFields


class _Any:
    """Equal to whatever is found."""

    def __repr__(self) -> str:
        return "ANY"

    def __deepcopy__(self, memo: object) -> _Any:
        return self


ANY: Any = _Any()

Fields = dict[str, Any]

MOST_HIDDEN = 8
"""A view may be hidden for so many positions of its sequence."""


class Refused(Exception):
    """The operation must fail with the error of this name, and change nothing."""


@dataclass(frozen=True)
class Shown:
    """What may be kept of a frame: hexadecimal SHA-256 sums, or ``ANY``.

    descriptor, local: by the precision of the map.
    """

    digest: str
    regions: Any
    thumbnail: Any
    image: Any
    descriptor: Mapping[str, Any]
    local: Mapping[str, Any]
    keypoints: Any = ANY


GONE = "(gone)"
"""The name of a track whose sequence is gone."""

Station = tuple[str, int]
"""The name of a track, and an ordinal along it."""


@dataclass
class LookModel:
    """One look of a place besides its first.

    number: grows in the order in which places and looks were added.
    """

    shown: Shown
    seen: Any
    camera: str | None
    run: str | None
    least: float | None
    kept: str
    number: int
    descriptor: Any
    keypoints: Any = None
    created: Any = ANY
    served: tuple[int, int, int] = (0, 0, 0)


@dataclass
class PlaceModel:
    """One place.

    track: where another traverse shows what it shows, as it was stored; None: at its own ordinal.
    pose_of: the place whose pose it got.
    picture: grows in the order in which the places of a map got their pictures.
    looks: by their names, those besides the first.
    number: as of a look.
    """

    shown: Shown
    fields: Fields
    kept: str
    ordinal: int
    created: Any = ANY
    updated: Any = ANY
    descriptor: Any = ANY
    regions: Any = ANY
    keypoints: Any = None
    track: Station | None = None
    pose_of: str | None = None
    picture: int = 0
    looks: dict[str, LookModel] = field(default_factory=dict)
    number: int = 0

    @property
    def station(self) -> Station | None:
        """Where along which track it is; None for a place without a sequence that has no counterpart."""
        if self.track is not None:
            return self.track
        return None if self.sequence is None else (self.sequence, self.ordinal)

    @property
    def sequence(self) -> str | None:
        """The traverse it belongs to."""
        name: str | None = self.fields.get("sequence")
        return name


def canonical(fields: Fields) -> Fields:
    """Fields as an answer has them."""
    return PlaceFields.model_validate(fields).model_dump(mode="json")


def merged(target: Any, patch: Any) -> Any:
    """``target`` after a JSON merge patch (RFC 7396)."""
    if not isinstance(patch, dict):
        return patch
    result = dict(target) if isinstance(target, dict) else {}
    for name, value in patch.items():
        if value is None:
            result.pop(name, None)
        else:
            result[name] = merged(result.get(name), value)
    return result


@dataclass
class MapModel:
    """One map.  ``ends`` are the ordinals that come next in each sequence.

    review: the frames that are stored for review, the newest first: digest, answer and label of each.
    showed: the digests of all frames that were ever stored.
    erased: those of which the file has nothing any more, unless they are stored again.

    Frames of one picture show one view, unless poses put them apart; those of different pictures do not.
    """

    settings: dict[str, Any]
    precision: str = "half"
    listed: bool = True
    revision: int = 1
    created: Any = ANY
    updated: Any = ANY
    calibration: Any = None
    places: dict[str, PlaceModel] = field(default_factory=dict)
    ends: dict[str | None, int] = field(default_factory=lambda: {None: 0})
    cameras: dict[str, Any] = field(default_factory=dict)
    pictures: int = 0
    numbers: int = 0
    review: list[list[Any]] = field(default_factory=list)
    showed: set[str] = field(default_factory=set)
    erased: set[str] = field(default_factory=set)

    # Writes; each returns the answer that it must get

    def enrol(
        self,
        place_id: str,
        shown: Shown,
        fields: Fields,
        keep: str | None = None,
        keypoints: Any | None = None,
        ordinal: int | None = None,
    ) -> str:
        """Enrol a frame, with these keypoints or none; created, replaced, updated or unchanged.

        Args:
            ordinal: of a new place; None: that of its view.
        """
        keypoints = keypoints if self.settings.get("verification", True) else None
        self._expect_coordinates(place_id, fields)
        known = self.places.get(place_id)
        if known is not None and known.shown.digest == shown.digest:
            known.keypoints = keypoints if known.keypoints is None else known.keypoints
            return self.set_fields(place_id, fields)
        self._shows(shown.digest)
        kept = self.settings["keep"] if keep is None else keep
        if known is None:
            sequence = fields.get("sequence")
            self.ends.setdefault(sequence, 0)
            at = self._next(sequence, shown.digest, fields) if ordinal is None else ordinal
            self.numbers += 1
            made = PlaceModel(shown, dict(fields), kept, at, number=self.numbers)
            self.places[place_id] = made
        else:
            known.shown, known.kept = shown, kept
            known.looks = {
                name: look
                for name, look in known.looks.items()
                if look.run is None and look.shown.digest != shown.digest
            }
            self._place_in(known, fields, replaced=True)
            known.track = known.pose_of = None
            made = known
        self.pictures += 1
        made.picture, made.keypoints = self.pictures, keypoints
        made.descriptor, made.regions, made.updated = shown.descriptor.get(self.precision, ANY), shown.regions, ANY
        return "created" if known is None else "replaced"

    def add_look(
        self,
        place_id: str,
        shown: Shown,
        seen: Any,
        camera: str | None,
        run: str | None,
        least: float | None,
        keypoints: Any,
    ) -> str:
        """Add a look to a place; created, or unchanged if the place has it."""
        place, name = self.place(place_id), shown.digest[:16]
        keypoints = keypoints if self.settings.get("verification", True) else None
        if (known := place.looks.get(name)) is not None:
            known.keypoints = keypoints if known.keypoints is None else known.keypoints
            return "unchanged"
        if place.shown.digest == shown.digest:
            raise Refused("RepeatedLook")
        self._shows(shown.digest)
        self.numbers += 1
        stored = shown.descriptor.get(self.precision, ANY)
        place.looks[name] = LookModel(
            shown, seen, camera, run, least, self.settings["keep"], self.numbers, stored, keypoints
        )  # fmt: skip
        return "created"

    def forget_look(self, place_id: str, name: str) -> None:
        """Remove a look of a place."""
        if name not in self.place(place_id).looks:
            raise Refused("UnknownLook")
        del self.place(place_id).looks[name]

    def count_served(self, place_id: str, name: str, more: tuple[int, int, int]) -> None:
        """Add to how a look has served; nothing happens if it is not there."""
        if place_id in self.places and (look := self.places[place_id].looks.get(name)) is not None:
            right, wrong, passed = (a + b for a, b in zip(look.served, more, strict=True))
            look.served = right, wrong, passed

    def forget_learnt(self, run: str) -> int:
        """Remove the looks that were learnt from a run; their number."""
        count = 0
        for place in self.places.values():
            left = {name: look for name, look in place.looks.items() if look.run != run}
            count += len(place.looks) - len(left)
            place.looks = left
        return count

    def set_fields(self, place_id: str, fields: Fields) -> str:
        """Change the fields of a place and keep its frame."""
        place = self.place(place_id)
        if canonical(place.fields) == canonical(fields):
            return "unchanged"
        self._expect_coordinates(place_id, fields)
        self._place_in(place, fields)
        place.updated = ANY
        return "updated"

    def patch(self, place_id: str, changes: Fields) -> str:
        """Apply a merge patch to the fields of a place."""
        return self.set_fields(place_id, merged(self.place(place_id).fields, changes))

    def adopt(self, place_id: str, of: PlaceModel, ordinal: int | None) -> list[str]:
        """Take over a place of another map with its history; returns what is left out, which no place is."""
        before = self.places.get(place_id)
        same = before is not None and before.shown.digest == of.shown.digest
        self.enrol(place_id, of.shown, of.fields, of.kept, of.keypoints, ordinal)
        place = self.places[place_id]
        place.created, place.updated = of.created, of.updated
        if not same:
            place.descriptor = of.descriptor
        place.ordinal = place.ordinal if ordinal is None else ordinal
        self.ends[place.sequence] = max(self.ends[place.sequence], place.ordinal + 1)
        return []

    def fill_in(self, limit: int) -> int:
        """Find the keypoints of the first places that have none and keep a picture; how many were stored."""
        frames: list[PlaceModel | LookModel] = list(self.places.values())
        frames += [look for place in self.places.values() for look in place.looks.values()]
        frames.sort(key=lambda frame: frame.number)
        lacking = [frame for frame in frames if frame.keypoints is None and frame.kept != "none"]
        if not self.settings.get("verification", True):
            return 0
        for frame in lacking[:limit]:
            frame.keypoints = frame.shown.keypoints
        return len(lacking[:limit])

    def store_counterparts(self, stations: Sequence[Sequence[str]], poses: Sequence[Sequence[str]]) -> None:
        """Put places to the stations of others, and give places the poses of others; pairs of ids."""
        before = {place_id: copy.copy(place) for place_id, place in self.places.items()}
        for place_id, other in stations:
            place, station = self.places[place_id], before[other].station
            place.track = None if station == (place.sequence, place.ordinal) else station
        for place_id, other in poses:
            place, pose = self.places[place_id], before[other].fields["pose"]
            if canonical(place.fields)["pose"] != canonical({"pose": pose})["pose"]:
                place.fields, place.updated = {**place.fields, "pose": pose}, ANY
            place.pose_of = other

    def forget(self, place_id: str) -> None:
        """Remove a place."""
        gone = self.place(place_id)
        del self.places[place_id]
        self._drop_if_empty(gone.sequence)

    def forget_sequence(self, name: str) -> int:
        """Remove all places of a traverse; their number."""
        gone = [place_id for place_id, place in self.places.items() if place.sequence == name]
        if not gone:
            raise Refused("UnknownSequence")
        for place_id in gone:
            self.forget(place_id)
        return len(gone)

    def keep_for_review(self, digest: str, answer: dict[str, Any], most: int) -> bool:
        """Store a frame for review, and drop those beyond so many; False if it is there already."""
        if any(frame[0] == digest for frame in self.review):
            return False
        self._shows(digest)
        self.review.insert(0, [digest, answer, None])
        while len(self.review) > most:
            going = [frame for frame in self.review if frame[2] is None] or self.review
            self.review.remove(going[-1])
        return True

    def erase(self) -> None:
        """Leave nothing in the file of frames that are not there any more."""
        self.erased = self.showed - self.frames

    def imported(self) -> MapModel:
        """The map that is made of this one's export file."""
        made = copy.deepcopy(self)
        for number, place in enumerate(made.places.values()):
            place.picture = number  # an archive does not say which places got another picture
        made.review = [frame for frame in made.review if frame[2] is not None]
        made.showed, made.erased = made.frames, set()
        return made

    @property
    def frames(self) -> set[str]:
        """The digests of the frames that its places show, and of those that are stored for review."""
        places = self.places.values()
        looks = {look.shown.digest for place in places for look in place.looks.values()}
        return {place.shown.digest for place in places} | looks | {frame[0] for frame in self.review}

    def _shows(self, digest: str) -> None:
        self.showed.add(digest)
        self.erased.discard(digest)

    def edit(self, changes: dict[str, Any]) -> int:
        """Change settings; the new revision."""
        if any(self.settings[name] != value for name, value in changes.items()):
            self.settings = {**self.settings, **changes}
            self.revision, self.updated = self.revision + 1, ANY
        return self.revision

    def place(self, place_id: str) -> PlaceModel:
        """The place of this id."""
        if place_id not in self.places:
            raise Refused("UnknownPlace")
        return self.places[place_id]

    def kinds_of_poses(self, but: str = "") -> set[bool]:
        """Which kinds of poses there are, by whether they are metric; those of one place do not count."""
        poses = [place.fields.get("pose") for place_id, place in self.places.items() if place_id != but]
        return {"x" in pose for pose in poses if pose}

    def _expect_coordinates(self, place_id: str, fields: Fields) -> None:
        pose, kinds = fields.get("pose"), self.kinds_of_poses(but=place_id)
        if pose and kinds and ("x" in pose) not in kinds:
            raise Refused("MixedCoordinates")

    def _along(self, sequence: str | None) -> list[PlaceModel]:
        """The places of a sequence in the order of their enrolment."""
        return [place for place in self.places.values() if sequence is not None and place.sequence == sequence]

    def _next(self, sequence: str | None, digest: str, fields: Fields) -> int:
        """The ordinal of the next frame of a sequence; that of the frame's view if it is there already."""
        if along := self._along(sequence):
            last, end = along[-1].ordinal, self.ends[sequence]
            hidden = min(self.settings["same_place_frames"], MOST_HIDDEN)
            at = {last, *range(end - 1 - hidden, end)}
            first = {place.ordinal: place for place in reversed(along) if place.ordinal in at}
            there = {at for at, place in first.items() if not self._apart(place.fields, fields)}
            there = {at for at in there if first[at].shown.digest == digest}
            if last in there and along[-1].shown.digest == digest:
                return last
            if there:
                return max(there)
        ordinal = self.ends.setdefault(sequence, 0)
        self.ends[sequence] = ordinal + 1
        return ordinal

    def _apart(self, one: Fields, other: Fields) -> bool:
        """Whether poses say that two frames do not show one view."""
        poses = [PlaceFields.model_validate(fields).pose for fields in (one, other)]
        if poses[0] is None or poses[1] is None or poses[0].kind() != poses[1].kind():
            return False
        reach: float = 3 * self.settings["same_place_radius"]
        return math.dist(poses[0].position(), poses[1].position()) > reach

    def _leaves(self, place: PlaceModel, fields: Fields, replaced: bool) -> bool:
        """Whether a place does not belong to its position any more, with other fields and maybe another picture."""
        there = [other for other in self._along(place.sequence) if other.ordinal == place.ordinal]
        own = next((number for number, other in enumerate(there) if other is place), 0)
        if own == 0:
            return False
        posed = replaced or canonical(place.fields)["pose"] != canonical(fields)["pose"]
        if posed and self._apart(there[0].fields, fields):
            return True
        later = [other for other in there[:own] if other.picture > place.picture]
        beside = [later[-1], there[own - 1], *there[own + 1 : own + 2]] if replaced and later else []
        return bool(beside) and all(other.shown.digest != place.shown.digest for other in beside)

    def _place_in(self, place: PlaceModel, fields: Fields, replaced: bool = False) -> None:
        if canonical(place.fields)["pose"] != canonical(fields)["pose"]:
            place.pose_of = None
        before, sequence = place.sequence, fields.get("sequence")
        if sequence != before or self._leaves(place, fields, replaced):
            place.ordinal = self._next(sequence, place.shown.digest, fields)
        place.fields = dict(fields)
        if sequence != before:
            self._drop_if_empty(before)

    def _drop_if_empty(self, sequence: str | None) -> None:
        if sequence is not None and all(place.sequence != sequence for place in self.places.values()):
            self.ends.pop(sequence, None)
            for place in self.places.values():
                if place.track is not None and place.track[0] == sequence:
                    place.track = (GONE, place.track[1])

    # What must be found

    def expected(self) -> dict[str, Any]:
        """The map in the form of :func:`tests.durability.contents.map_contents`."""
        return {
            "listed": self.listed,
            "settings": self.settings,
            "precision": self.precision,
            "revision": self.revision,
            "created_at": self.created,
            "updated_at": self.updated,
            "calibration": self.calibration,
            "cameras": self.cameras,
            "ends": sorted(([name, end] for name, end in self.ends.items()), key=str),
            "review": self.review,
            "places": [self._expected_place(place_id, place) for place_id, place in self.places.items()],
        }

    def _expected_place(self, place_id: str, place: PlaceModel) -> dict[str, Any]:
        shown = place.shown
        own = (place.sequence, place.ordinal)
        kept = {"none": None, "thumbnail": shown.thumbnail, "image": shown.image}[place.kept]
        return {
            "id": place_id,
            **canonical(place.fields),
            "regions": place.regions,
            "picture": place.kept,
            "created_at": place.created,
            "updated_at": place.updated,
            "digest": shown.digest,
            "ordinal": place.ordinal,
            "kept": kept,
            "keypoints": place.keypoints,
            "track": None if place.track in (None, own) else list(place.track or own),
            "pose_of": place.pose_of,
            "descriptor": place.descriptor,
            "local": shown.local.get(self.precision, ANY),
            "found_first": shown.digest,
            **({"looks": len(place.looks)} if place.looks else {}),
            "other_looks": [self._expected_look(name, look) for name, look in place.looks.items()],
        }

    def _expected_look(self, name: str, look: LookModel) -> dict[str, Any]:
        shown = look.shown
        return {
            "name": name,
            "timestamp": canonical({"timestamp": look.seen})["timestamp"],
            "camera": look.camera,
            "run": look.run,
            "least_score": look.least,
            **dict(zip(("right", "wrong", "passed"), look.served, strict=True)),
            "regions": shown.regions,
            "picture": look.kept,
            "created_at": look.created,
            "kept": {"none": None, "thumbnail": shown.thumbnail, "image": shown.image}[look.kept],
            "keypoints": look.keypoints,
            "descriptor": look.descriptor,
            "local": shown.local.get(self.precision, ANY),
            "found_first": shown.digest,
        }

    def told(self, places: Sequence[Mapping[str, Any]]) -> None:
        """Note the times of places in an answer.

        Raises:
            Lost: a time differs from one that is known already.
        """
        for told in places:
            place = self.places[told["id"]]
            if wrong := differences([place.created, place.updated], [told["created_at"], told["updated_at"]]):
                raise Lost(f"the answer about {told['id']}: {wrong[0]}")
            place.created, place.updated = told["created_at"], told["updated_at"]

    def learn(self, found: Mapping[str, Any]) -> None:
        """Note what was found where nothing was known."""
        self.created, self.updated = found["created_at"], found["updated_at"]
        self.calibration = found["calibration"]
        for told in found["places"]:
            place = self.places[told["id"]]
            place.created, place.updated = told["created_at"], told["updated_at"]
            place.descriptor, place.regions = told["descriptor"], told["regions"]
            place.keypoints = told["keypoints"]
            for look in told["other_looks"]:
                known = place.looks[look["name"]]
                known.created, known.descriptor, known.keypoints = (
                    look["created_at"], look["descriptor"], look["keypoints"],
                )  # fmt: skip


World = dict[str, MapModel]
"""Maps by id."""

Change = Callable[[World], Any]
"""An operation on the model; returns what the answer must be, or raises :class:`Refused`."""


def changed(world: World, change: Change) -> tuple[World, Any]:
    """The world after an operation, and the answer that it must give; the world before stays as it is."""
    after = copy.deepcopy(world)
    try:
        return after, change(after)
    except Refused as refused:
        return world, {"error": str(refused)}


def differences(expected: Any, found: Any, where: str = "") -> list[str]:
    """Where two values differ, a sentence each."""
    if expected is ANY:
        return []
    if isinstance(expected, dict) and isinstance(found, dict):
        told = []
        for name in sorted({*expected, *found}, key=str):
            if name not in expected:
                told.append(f"{where}/{name}: is there, though it must not be")
            elif name not in found:
                told.append(f"{where}/{name}: is not there")
            else:
                told += differences(expected[name], found[name], f"{where}/{name}")
        return told
    if isinstance(expected, list) and isinstance(found, list):
        names = [[item.get("id") if isinstance(item, dict) else None for item in items] for items in (expected, found)]
        if len(expected) != len(found) or names[0] != names[1]:
            shown = names if any(names[0] + names[1]) else [expected, found]
            return [f"{where}: {shown[0]} expected, {shown[1]} found"]
        return [
            line
            for number, (one, other) in enumerate(zip(expected, found, strict=True))
            for line in differences(one, other, f"{where}/{number}")
        ]
    return [] if expected == found else [f"{where}: {expected!r} expected, {found!r} found"]


class Lost(AssertionError):
    """The disk holds none of the worlds that it may hold."""


def settled(candidates: Sequence[World], found: Mapping[str, Mapping[str, Any]]) -> tuple[World, int]:
    """The world among the candidates that was found, with what was unknown filled in, and its index.

    What an operation began to store may be in the file though it was not found.

    Raises:
        Lost: none of them was found.
    """
    told = []
    for number, world in enumerate(candidates):
        wrong = differences({name: one.expected() for name, one in world.items()}, dict(found))
        if not wrong:
            world = copy.deepcopy(world)
            for name, one in world.items():
                one.learn(found[name])
                for other in candidates:
                    if name in other:
                        one.erased &= other[name].erased
            return world, number
        told.append(f"not as {'before' if number == 0 else 'after'} the last operation:\n  " + "\n  ".join(wrong[:12]))
    raise Lost("\n".join(told))
