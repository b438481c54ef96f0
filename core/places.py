"""A place: its id, pose, time, sequence and metadata, its looks, and where the places of a map are."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from core import names
from core.errors import InvalidIdentifier, MixedCoordinates
from core.numerals import LOST_PLUS

MAP_IDS = names.file_names("a map", but="import")
PLACE_IDS = names.words("a place", 128)
SEQUENCES, CAMERAS = names.texts("a sequence"), names.words("a camera", 64)
LEVELS = names.texts("a level", 32)
MAP_ID, PLACE_ID = MAP_IDS.pattern, PLACE_IDS.pattern
LOOK = r"[0-9a-f]{16}"
"""The pattern of a look's name: the first digits of its frame's SHA-256, so that a frame gives a place one look."""
EARTH_RADIUS = 6_371_008.8  # metres, mean

NO_POSE, METRIC, GEOGRAPHIC = 0, 1, 2
"""The kinds of poses in a :class:`Whereabouts`: none, metres in the map's frame, degrees on the Earth."""

NO_SEQUENCE = -1
"""The code of the places that belong to no sequence; each of them has an ordinal that no other has."""

NO_LEVEL = -1
"""The code of the level of places of which it is not known."""

SAME_VIEW = 3
"""Frames at one position of a sequence, which show one view, are the same place up to this many times the radius.

A frame is put there only if its pose is no farther from that of the first frame there.  It is more than 1 because the
poses of one stop may be coarse."""

SAME_STOREY = 1.5
"""Metres up or down within which two places may be on one storey, where no levels say it.  Storeys are 2.5 m apart or
more, and barometers and odometry drift by less than half of that within a walk; nothing else was it chosen on."""

NO_FIX = 1e-6
"""Degrees: what a receiver without a fix writes is latitude 0 and longitude 0, to so much."""

Positions: TypeAlias = int | NDArray[np.integer] | slice

NO_TIME = -(1 << 63)
"""The timestamp of a place without one."""

Coordinate = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]


def check_map_id(text: str) -> str:
    """Return ``text`` if it can be the id of a map.

    Raises:
        InvalidIdentifier: it cannot.
    """
    return MAP_IDS.check(text)


def check_place_id(text: str) -> str:
    """Return ``text`` if it can be the id of a place.

    Raises:
        InvalidIdentifier: it cannot.
    """
    return PLACE_IDS.check(text)


def look_address(place_id: str, look: str) -> str:
    """The name under which a map stores a look, which no place can have."""
    return f"{place_id}/{look}"


def place_and_look(address: str) -> tuple[str, str | None]:
    """The id of a place and, if the address is that of a look, the look's name."""
    place_id, _, look = address.partition("/")
    return place_id, look or None


def check_address(text: str) -> str:
    """Return ``text`` if it can be the id of a place or the address of a look.

    Raises:
        InvalidIdentifier: it cannot.
    """
    place_id, slash, look = text.partition("/")
    check_place_id(place_id)
    if slash:
        check_look(look)
    return text


def check_look(text: str) -> str:
    """Return ``text`` if it can be the name of a look.

    Raises:
        InvalidIdentifier: it cannot.
    """
    if not re.fullmatch(LOOK, text):
        raise InvalidIdentifier(f"{text[:140]!a} cannot name a look: a name has 16 hexadecimal digits in lower case.")
    return text


def check_sequence(text: str) -> str:
    """Return ``text`` if it can be the name of a sequence.

    Raises:
        InvalidIdentifier: it cannot.
    """
    return SEQUENCES.check(text)


PoseKind = Literal["metric", "geographic"]
COORDINATES: dict[PoseKind, str] = {
    "metric": "metric coordinates (x and y in metres)",
    "geographic": "geographic coordinates (latitude and longitude in degrees)",
}


class Pose(BaseModel):
    """Where a frame was taken: metres in the map's frame, or degrees on the Earth (WGS 84).

    ``z`` is in metres: in the map's frame beside x and y, above the ellipsoid of WGS 84 beside latitude and longitude.
    It tells storeys apart; distances are those along the ground.
    ``heading`` is in degrees: counter-clockwise from +x beside x and y, clockwise from north beside
    latitude and longitude.  It is normalized to [0, 360).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    x: Coordinate | None = None
    y: Coordinate | None = None
    z: Coordinate | None = None
    latitude: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] | None = None
    longitude: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)] | None = None
    heading: Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False), AfterValidator(lambda a: a % 360)] | None = (
        None
    )

    @model_validator(mode="after")
    def _one_frame(self) -> Pose:
        metric = (self.x is not None, self.y is not None)
        geographic = (self.latitude is not None, self.longitude is not None)
        if any(metric) != all(metric) or (self.z is not None and not any(metric + geographic)):
            raise ValueError("a pose in metres needs x and y (z is optional)")
        if any(geographic) != all(geographic):
            raise ValueError("a pose in degrees needs latitude and longitude")
        if all(metric) == all(geographic):
            raise ValueError("a pose is either x, y[, z] or latitude, longitude[, z]")
        return self

    def position(self) -> NDArray[np.float64]:
        """The position as a vector, float64 [3], in metres: x, y, z (0 if absent), or the point on the Earth's sphere.

        The distance of two frames with poses of one kind is the Euclidean distance of their positions; on the sphere
        this takes the chord for the arc, an error of less than 1 mm in a kilometre.
        """
        if self.x is not None and self.y is not None:
            return np.array([self.x, self.y, self.z or 0.0])
        assert self.latitude is not None and self.longitude is not None
        phi, theta = math.radians(self.latitude), math.radians(self.longitude)
        unit = [math.cos(phi) * math.cos(theta), math.cos(phi) * math.sin(theta), math.sin(phi)]
        return EARTH_RADIUS * np.array(unit)

    def kind(self) -> PoseKind:
        """Whether the pose is in metres or in degrees."""
        return "metric" if self.x is not None else "geographic"


def pose_kinds(kinds: NDArray[np.int8]) -> set[PoseKind]:
    """Which kinds of poses are among some, int8 [n] (``Whereabouts.kind``)."""
    codes: tuple[tuple[PoseKind, int], ...] = (("metric", METRIC), ("geographic", GEOGRAPHIC))
    return {name for name, code in codes if (kinds == code).any()}


def coordinates_of(poses: Iterable[Pose | None]) -> PoseKind | None:
    """The kind of coordinates that some poses have; None if they are of both kinds, or there is none."""
    kinds = {pose.kind() for pose in poses if pose is not None}
    return kinds.pop() if len(kinds) == 1 else None


def check_coordinates(known: Collection[PoseKind], kind: PoseKind, subject: str) -> None:
    """Check that coordinates are of the kind that the places of a map have.

    Args:
        known: the kinds of their poses; none while no place has a pose, and both in a map of old.
        kind: of the coordinates.
        subject: what has these, as a sentence begins.

    Raises:
        MixedCoordinates: they are of the other kind.
    """
    if known and kind not in known:
        (there,) = known
        raise MixedCoordinates(
            f"{subject} has {COORDINATES[kind]}, and the places of the map have {COORDINATES[there]}: a map has one "
            "kind. Convert them, or use another map."
        )


def is_no_fix(latitude: ArrayLike, longitude: ArrayLike) -> NDArray[np.bool_]:
    """Whether positions in degrees are what a receiver without a fix writes."""
    found: NDArray[np.bool_] = np.abs(np.asarray(latitude)) <= NO_FIX
    return found & (np.abs(np.asarray(longitude)) <= NO_FIX)


def _utc(moment: datetime) -> datetime:
    """Convert a time to UTC; one without a zone is taken as UTC."""
    try:
        return moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("in UTC it is before the year 1 or after the year 9999") from None


def _written_out(moment: object) -> object:
    """Refuse a time that is a bare number, which could mean seconds as well as milliseconds."""
    if isinstance(moment, datetime):
        return moment
    if isinstance(moment, str) and _DATE.match(moment):
        if _SPACED_ZONE.search(moment):
            raise ValueError(f"a space stands before the zone of the time, where + or - belongs: {LOST_PLUS}")
        return moment
    raise ValueError("a time is written as in RFC 3339, such as 2026-11-20T10:00:00Z")


_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_SPACED_ZONE = re.compile(r":\d\d(\.\d+)? \d\d:?\d\d$")

Timestamp = Annotated[datetime, BeforeValidator(_written_out), AfterValidator(_utc)]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def microseconds(moment: datetime) -> int:
    """An instant as microseconds since 1970 UTC, exactly; negative before."""
    return (moment - _EPOCH) // timedelta(microseconds=1)


Sequence = Annotated[str, SEQUENCES]

Camera = Annotated[str, CAMERAS]


def _level_text(value: Any) -> Any:
    """The text of a level; a whole number becomes its digits, also if it is written as ``2.0`` or `` 02``."""
    if isinstance(value, str):
        stripped = value.strip()
        return str(int(stripped.split(".")[0])) if re.fullmatch(r"[+-]?\d{1,20}(\.0+)?", stripped) else stripped
    whole = isinstance(value, int | float) and not isinstance(value, bool) and value == value // 1
    return str(int(value)) if whole else value


Level = Annotated[str, LEVELS, BeforeValidator(_level_text, json_schema_input_type=str | int)]

LEVEL_KEYS = ("level", "floor", "storey", "story")
"""The keys of metadata under which the level of a place is looked for that states none."""


def level_in(metadata: Mapping[str, Any]) -> str | None:
    """The level that metadata states under the first of ``LEVEL_KEYS``, if that can name one; else None."""
    stated = next((_level_text(metadata[key]) for key in LEVEL_KEYS if key in metadata), None)
    try:
        return LEVELS.check(stated) if isinstance(stated, str) else None
    except InvalidIdentifier:
        return None


def level_code(level: str | None) -> int:
    """The code of a level in :class:`Whereabouts`, the same in all maps: 31 bits of its CRC-32; NO_LEVEL for None.

    Of a hundred levels two have one code with a probability of 2e-6, and would be one level then.
    """
    return NO_LEVEL if level is None else zlib.crc32(level.encode()) >> 1


class PoseAccuracy(BaseModel):
    """Standard deviations of a pose, as whoever states it knows them.

    metres: of each coordinate along the ground.
    degrees: of the heading; None: not stated.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    metres: Annotated[
        float, Field(gt=0, le=1e6, allow_inf_nan=False, description="Standard deviation of each coordinate.")
    ]
    degrees: Annotated[
        float | None,
        Field(
            gt=0, le=360, allow_inf_nan=False, description="Standard deviation of the heading; null: it is not stated."
        ),
    ] = None


def accuracy_of(metres: float | None, degrees: float | None) -> PoseAccuracy | None:
    """An accuracy of its stored numbers, which are valid; None if no metres are stored."""
    return None if metres is None else PoseAccuracy.model_construct(metres=metres, degrees=degrees)


class PlaceFields(BaseModel):
    """A caller's statements about a frame; each may be left out.

    A place that states no level has the one that its metadata states (:func:`level_in`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    pose: Pose | None = None
    timestamp: Timestamp | None = None
    sequence: Sequence | None = None
    camera: Camera | None = Field(default=None, description="Whose mask was applied to the frame.")
    level: Level | None = Field(default=None, description="The storey on which it is.")
    pose_accuracy: PoseAccuracy | None = Field(default=None, description="How exact its pose is; null: not stated.")
    metadata: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _level_of_metadata(self) -> Self:
        if self.level is None and (stated := level_in(self.metadata)) is not None:
            object.__setattr__(self, "level", stated)
        return self


class Place(PlaceFields):
    """One enrolled place; its sequence may have a name from before the rule for names, and keeps it."""

    id: str
    sequence: str | None = None
    look: str | None = Field(
        default=None,
        exclude_if=lambda name: name is None,
        description="In a match: the look whose frame it is; left out for the frame with which it was enrolled.",
    )
    looks: int = Field(
        default=0, ge=0, exclude_if=lambda count: count == 0, description="How many looks it has besides its first."
    )
    pose_of: str | None = Field(default=None, description="The place whose pose it got from an alignment.")
    regions: int = Field(ge=0, description="Regions of interest found in the frame.")
    picture: Literal["none", "thumbnail", "image"] = Field(description="The stored form of the frame.")
    created_at: Timestamp
    updated_at: Timestamp

    def fields(self) -> PlaceFields:
        """The statements of a caller about the frame, when it was enrolled or later."""
        return PlaceFields.model_construct(**{name: getattr(self, name) for name in PlaceFields.model_fields})


class Look(BaseModel):
    """A picture of a place under some condition, beside the frame with which the place was enrolled."""

    model_config = ConfigDict(frozen=True)

    name: str = Field(pattern=f"^{LOOK}$", description="The first 16 digits of the SHA-256 of its frame.")
    timestamp: Timestamp | None = Field(description="When its frame was taken.")
    camera: Camera | None = Field(description="Whose mask was applied to its frame.")
    run: str | None = Field(description="The run from which it was learnt; null: an operator added it.")
    least_score: float | None = Field(
        description="The score of two stages from which a match with it is believed; null: from any."
    )
    right: int = Field(description="Frames that it won and that their runs are certain to be at its place.")
    wrong: int = Field(description="Frames that it won and that their runs are certain to be elsewhere.")
    passed: int = Field(description="Frames certain to be at its place that other looks of it won.")
    regions: int = Field(ge=0, description="Regions of interest found in its frame.")
    picture: Literal["none", "thumbnail", "image"] = Field(description="The stored form of its frame.")
    created_at: Timestamp


@dataclass(frozen=True)
class Neighborhood:
    """Two frames show the same place within ``radius`` metres along the ground and ``height`` metres up or down or,
    without poses, within ``frames`` of a sequence; never on two levels."""

    radius: float
    frames: int
    height: float = SAME_STOREY

    def times(self, factor: float) -> Neighborhood:
        """The neighbourhood with its distances multiplied by ``factor``; a storey stays as high as it is."""
        return replace(self, radius=self.radius * factor, frames=int(self.frames * factor))


@dataclass(frozen=True)
class Whereabouts:
    """Where and when the frames of n places were taken, and from which score on they are believed; a row for each.

    kind: int8 [n], one of NO_POSE, METRIC, GEOGRAPHIC.
    position: float64 [n, 3], metres (``Pose.position``); zeros without a pose.
    sequence: int32 [n], a code for the sequence's name; NO_SEQUENCE for places without one.
    ordinal: int64 [n], the position in the sequence.  Positions count views, not frames: a new frame gets the position
        of a frame shortly before it if both show the same view, else the next free position (``core.maps.views``).  So
        positions need not grow from frame to frame, and some may be empty.  The looks of a place are at its position.
        Without a sequence only they share one, and what is between positions says nothing.
    heading: float32 [n], degrees in [0, 360), in the convention of the pose's kind; NaN where it is not known.
    timestamp: int64 [n], microseconds since 1970 UTC; NO_TIME where it is not known.
    track, station: int32 [n] and int64 [n], the sequence and the ordinal at which another traverse shows the same, as
        alignment found; the place's own where nothing is known.
    least: float32 [n], the score of two stages from which a match with the frame is believed; -inf for all but frames
        that a map learnt from runs.
    level: int32 [n], the codes of their storeys (:func:`level_code`); NO_LEVEL where it is not known.
    height: float64 [n], metres, the z of the pose; NaN where it is not known.
    accuracy: float32 [n], metres, the stated deviation of the pose (:class:`PoseAccuracy`); NaN where none is.

    Heading, timestamp, level, height and accuracy may be left out if none is known, track and station if all are the
    places' own, least if any score will do.
    """

    kind: NDArray[np.int8]
    position: NDArray[np.float64]
    sequence: NDArray[np.int32]
    ordinal: NDArray[np.int64]
    heading: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    timestamp: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    track: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    station: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    least: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    level: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    height: NDArray[np.float64] = field(default_factory=lambda: np.empty(0, np.float64))
    accuracy: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))

    def __post_init__(self) -> None:
        for name, nothing in _NOT_KNOWN.items():
            if len(column := getattr(self, name)) < len(self.kind):
                object.__setattr__(self, name, np.full(len(self.kind), nothing, column.dtype))
        if len(self.track) < len(self.kind):
            object.__setattr__(self, "track", self.sequence.copy())
            object.__setattr__(self, "station", self.ordinal.copy())

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def aligned(self) -> bool:
        """Whether any place is at another station than its own."""
        return bool((self.track != self.sequence).any() or (self.station != self.ordinal).any())

    @classmethod
    def along_sequence(cls, ordinals: ArrayLike) -> Whereabouts:
        """Places of one sequence without poses, by their order in it, int64 [n]."""
        order = np.asarray(ordinals, np.int64)
        count = len(order)
        return cls(np.full(count, NO_POSE, np.int8), np.zeros((count, 3)), np.zeros(count, np.int32), order)

    def take(self, rows: ArrayLike) -> Whereabouts:
        """The places ``rows`` (integers or a mask) in that order."""
        chosen = np.asarray(rows)
        return Whereabouts(**{name: column[chosen] for name, column in vars(self).items()})

    def without_poses(self, places: ArrayLike) -> Whereabouts:
        """The same, but for the poses of some places (integers or a mask), which then have none."""
        chosen = np.asarray(places)
        kind, position, heading = self.kind.copy(), self.position.copy(), self.heading.copy()
        height, accuracy = self.height.copy(), self.accuracy.copy()
        kind[chosen], position[chosen] = NO_POSE, 0.0
        heading[chosen] = height[chosen] = accuracy[chosen] = np.nan
        return replace(self, kind=kind, position=position, heading=heading, height=height, accuracy=accuracy)

    @classmethod
    def joined(cls, parts: Iterable[Whereabouts]) -> Whereabouts:
        """The places of several parts, in their order; of no parts none."""
        columns = [vars(part) for part in (cls.along_sequence([]), *parts)]
        return cls(**{name: np.concatenate([part[name] for part in columns]) for name in columns[0]})

    @property
    def ground(self) -> NDArray[np.float64]:
        """The positions whose differences are distances along the ground, float64 [n, 3]: of metric poses without z."""
        flat = self.position.copy()
        flat[self.kind == METRIC, 2] = 0
        return flat

    def on_other_levels(self, one: Positions, other: Positions, height: float) -> NDArray[np.bool_]:
        """Whether places are on different storeys, as far as that is known: by their levels or, unless both have one,
        by their heights.

        Args:
            one, other: integers, or a slice, that broadcast against each other.
            height: metres within which two places may be on one storey.
        """
        ours, theirs = self.level[one], self.level[other]
        apart = np.abs(self.height[one] - self.height[other]) > height
        return np.where((ours != NO_LEVEL) & (theirs != NO_LEVEL), ours != theirs, apart)

    def on_level_of(self, row: int, height: float) -> Whereabouts:
        """The same, but places that are known to be on another storey than ``row`` have no poses; height as above."""
        return self.without_poses(self.on_other_levels(slice(None), row, height)) if len(self) else self

    def near(self, row: int, neighborhood: Neighborhood) -> NDArray[np.bool_]:
        """Which of the places are the same place as ``row``, itself included; bool [n].

        Places on different storeys never are (:meth:`on_other_levels`).
        Two poses of one kind are compared by distance; other places must be of one sequence and few positions apart, or
        at few stations of one track.  A place with neither a pose nor a sequence nor a track is a place of its own,
        with its looks.
        Frames at one position of a sequence show one view.  They are the same place up to ``SAME_VIEW`` radii.
        """
        near = np.zeros(len(self), np.bool_)
        for sequence, ordinal in ((self.sequence, self.ordinal), (self.track, self.station)):
            frames = neighborhood.frames if sequence[row] != NO_SEQUENCE else 0
            near |= (sequence == sequence[row]) & (np.abs(ordinal - ordinal[row]) <= frames)
        kind = self.kind[row]
        if kind != NO_POSE:
            ground = self.ground
            x, y, z = (ground - ground[row]).T
            distance = np.sqrt(x * x + y * y + z * z)
            reach = np.full(len(self), neighborhood.radius)
            if self.sequence[row] != NO_SEQUENCE:
                reach[(self.sequence == self.sequence[row]) & (self.ordinal == self.ordinal[row])] *= SAME_VIEW
            near = np.where(self.kind == kind, distance <= reach, near)
        near &= ~self.on_other_levels(slice(None), row, neighborhood.height)
        near[row] = True
        return near

    def walks(self) -> Iterator[NDArray[np.int64]]:
        """The rows of the places of each sequence, in their order; places without one are in none."""
        members = np.flatnonzero(self.sequence != NO_SEQUENCE)
        order = members[np.lexsort((self.ordinal[members], self.sequence[members]))]
        if len(order):
            yield from np.split(order, np.flatnonzero(np.diff(self.sequence[order])) + 1)

    def others(self, row: int, neighborhood: Neighborhood, across: bool = True) -> NDArray[np.bool_]:
        """Which of the places are other places than ``row``, each counted once; bool [n].

        Several frames may show one other place.  Only the first of them is named.

        Args:
            across: frames at one station of a track show one place, also if they are of several traverses.  If false,
                only frames at one position of one sequence do.
        """
        others = ~self.near(row, neighborhood)
        at = np.flatnonzero(others)
        track, station = (self.track, self.station) if across else (self.sequence, self.ordinal)
        others[at[_repeated(track[at], station[at])]] = False
        return others

    def repeats(self, order: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the places ``order``, int64 [n], are at the position of an earlier one of them; bool [n]."""
        return _repeated(self.sequence[order], self.ordinal[order])

    def view_keys(self) -> NDArray[np.int64]:
        """A number for the position of each place, int64 [n]: frames with the same number show one view."""
        return _position_keys(self.sequence, self.ordinal)

    def of_views(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the places show a view that one of ``rows``, int64 [k], shows; bool [n]."""
        keys = self.view_keys()
        return np.isin(keys, keys[rows])


def _position_keys(sequence: NDArray[np.int32], ordinal: NDArray[np.int64]) -> NDArray[np.int64]:
    return (sequence.astype(np.int64) << _SEQUENCE) + ordinal


def _repeated(sequence: NDArray[np.int32], ordinal: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of n positions in sequences are those of an earlier one; bool [n]."""
    keys = _position_keys(sequence, ordinal)
    repeated = np.zeros(len(keys), np.bool_)
    ordered = np.sort(keys)
    if (ordered[1:] == ordered[:-1]).any():
        repeated[:] = True
        repeated[np.unique(keys, return_index=True)[1]] = False
    return repeated


_SEQUENCE = 40  # bits of a position
_NOT_KNOWN = {
    "heading": np.nan, "timestamp": NO_TIME, "least": -np.inf, "level": NO_LEVEL, "height": np.nan, "accuracy": np.nan
}  # fmt: skip
