"""Places and their looks: finding, listing and storing them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from math import nan
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import and_, bindparam, delete, exists, func, literal_column, select, update

from core.errors import UnknownPlace
from core.ledger.maps.checksums import DamagedRow, is_sound, sealed, sealed_columns
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import PLACES, SEQUENCES, TOKENS
from core.ledger.statements import Statement, among, joined
from core.maps.counterparts import PlaceStation
from core.maps.place_filter import EVERY_PLACE, PlaceFilter, Scalar
from core.maps.records import Keep, Outline
from core.maps.stored_fields import POSE_VALUES, field_columns, moment_text
from core.names import spellings
from core.places import (
    GEOGRAPHIC,
    METRIC,
    NO_POSE,
    NO_TIME,
    Look,
    Place,
    PlaceFields,
    Pose,
    PoseKind,
    Whereabouts,
    accuracy_of,
    level_code,
    microseconds,
    place_and_look,
)

LONGEST_TEXT = 512
"""Most characters of a text in a place's metadata by which the place can be found; longer texts are only stored."""

_P, _S, _T = PLACES.c, SEQUENCES.c, TOKENS.c
_COLUMNS = sealed_columns(PLACES)
# A join might begin with the sequences of the map, and so read all its places.
_NAME = select(_S.name).where(_S.map == _P.map, _S.code == _P.sequence).scalar_subquery()
_STORED = select(*(_P[name] for name in _COLUMNS), _P.seal, _NAME).where(_P.map == bindparam("map"))
_NUMBERS = (
    "number", "row", "digest", "sequence", "ordinal", "track", "station", "revision", "look_of", "seen", "run", "least",
    "right", "wrong", "passed",
)  # fmt: skip

_IS_PLACE = _P.look_of.is_(None)

_BY_ID = Statement(_STORED.where(_P.id == bindparam("id")))
_BY_IDS = Statement(_STORED.where(among(_P.id, "ids")))
_BY_ROWS = Statement(_STORED.where(among(_P.row, "rows")))
_LOOKS_OF = Statement(_STORED.where(_P.look_of == bindparam("place")).order_by(_P.number))
_SOME_LOOKS = (
    _STORED.where(_P.look_of.is_not(None), _P.number > bindparam("after")).order_by(_P.number).limit(bindparam("most"))
)
_LOOKS = Statement(_SOME_LOOKS)
_LEARNT_FROM = Statement(_SOME_LOOKS.where(_P.run == bindparam("run")))
_LEARNT_PLACES = Statement(
    select(func.count(func.coalesce(_P.look_of, _P.number).distinct())).where(
        _P.map == bindparam("map"), _P.run.is_not(None)
    )
)
_PLACES_FROM = Statement(_STORED.where(_IS_PLACE, _P.run == bindparam("run")).order_by(_P.number))
_ROWS_OF = Statement(select(_P.id, _P.row).where(_P.map == bindparam("map"), among(_P.id, "ids")))
_NUMBERS_OF = Statement(select(_P.id, _P.number).where(_P.map == bindparam("map"), among(_P.id, "ids")))
_ROWS_OF_PLACE = Statement(
    select(_P.row).where(
        _P.map == bindparam("map"),
        (_P.number == bindparam("place")) | (_P.look_of == bindparam("place")),
    )
)
_PICTURED_BEFORE = Statement(
    select(_P.id)
    .where(_P.map == bindparam("map"), _P.picture != "none", _P.created_at < bindparam("moment"))
    .order_by(_P.number)
    .limit(bindparam("most"))
)
_INSERT = Statement(
    lambda insert: insert(PLACES).values({name: bindparam(name) for name in ("map", *_COLUMNS, "seal")})
)
_UPDATE = Statement(
    update(PLACES)
    .where(_P.map == bindparam("map"), _P.number == bindparam("which"))
    .values({name: bindparam(f"new_{name}") for name in (*_COLUMNS, "seal") if name != "number"})
)
_DELETE = Statement(delete(PLACES).where(_P.map == bindparam("map"), _P.number == bindparam("number")))
_PUT_TOKEN = Statement(
    lambda insert: (
        insert(TOKENS).values({name: bindparam(name) for name in ("map", "token", "row")}).on_conflict_do_nothing()
    )
)
_DELETE_TOKEN = Statement(
    delete(TOKENS).where(_T.map == bindparam("map"), _T.token == bindparam("token"), _T.row == bindparam("row"))
)
_DELETE_TOKENS = Statement(delete(TOKENS).where(_T.map == bindparam("map")))
_TOKENS = Statement(select(_T.row, _T.token).where(_T.map == bindparam("map")))
_METADATA = Statement(select(_P.row, _P.metadata).where(_P.map == bindparam("map"), _P.metadata != "{}"))
_ROWS_WITH = Statement(select(joined(_T.row)).where(_T.map == bindparam("map"), _T.token == bindparam("token")))
_ROWS_WITH_AMONG = Statement(
    select(joined(_T.row)).where(_T.map == bindparam("map"), _T.token == bindparam("token"), among(_T.row, "rows"))
)
_WITH_LOOKS = Statement(_STORED.where(_P.number > bindparam("after")).order_by(_P.number).limit(bindparam("most")))
_OUTLINES = Statement(
    select(
        _P.number, _P.id, _P.row, _P.digest, _P.picture, _P.camera, _S.name, _P.ordinal, _P.updated_at, _P.run, _P.least
    )
    .join(SEQUENCES, and_(_S.map == _P.map, _S.code == _P.sequence))
    .where(_P.map == bindparam("map"))
    .order_by(_P.number)
)
_STATIONS = Statement(
    select(_P.id, _P.digest, _P.sequence, _P.ordinal, _P.track, _P.station, _P.pose_of)
    .where(_P.map == bindparam("map"), _IS_PLACE)
    .order_by(_P.number)
)
_HANDED_OVER = Statement(select(_P.row, _P.pose_of).where(_P.map == bindparam("map"), _P.pose_of.is_not(None)))
_WITHOUT_IMAGE = Statement(
    select(func.count()).select_from(PLACES).where(_P.map == bindparam("map"), _P.picture != "image")
)
_COUNT = Statement(select(func.count(), func.count(_P.look_of)).select_from(PLACES).where(_P.map == bindparam("map")))
_PICTURED = Statement(
    select(_P.id, _P.row, _P.picture, _P.digest, _P.camera).where(_P.map == bindparam("map")).order_by(_P.number)
)
_SEALS = Statement(
    select(*(_P[name] for name in _COLUMNS), _P.seal)
    .where(_P.map == bindparam("map"), _P.number > bindparam("after"))
    .order_by(_P.number)
    .limit(bindparam("most"))
)

_AT_ONCE = 4096
FEW = 5000
"""Up to this number, rows are looked up one by one, which is faster than reading all rows with a value."""


@dataclass(frozen=True)
class StoredPlace:
    """A place as it is stored.

    number: grows in the order of enrolment.
    row: of its frame.
    digest: SHA-256 of its image, 32 bytes.
    sequence: code of its sequence, NO_SEQUENCE without one.
    ordinal: its position in its sequence (``core.maps.views``).
    track, station: code of the sequence whose frames show what it shows, and where in it; None: its own.
    revision: of the map's write that changed it last.
    look_of: the number of the place whose look it is; None: it is a place.
    seen: when a look's frame was taken, as text; run: the run from which a look or a place was learnt.
    least: the score of two stages from which a match with its frame is believed; None: from any.
    right, wrong, passed: how a look has served.
    """

    number: int
    row: int
    digest: bytes
    sequence: int
    ordinal: int
    place: Place
    track: int | None = None
    station: int | None = None
    revision: int = 0
    look_of: int | None = None
    seen: str | None = None
    run: str | None = None
    least: float | None = None
    right: int = 0
    wrong: int = 0
    passed: int = 0

    def shown(self) -> Place:
        """The place as an answer has it: that of a look's row has the place's id, and the name of the look."""
        if self.look_of is None:
            return self.place
        place_id, look = place_and_look(self.place.id)
        return self.place.model_copy(update={"id": place_id, "look": look})

    def look(self) -> Look:
        """The look of its row."""
        _, name = place_and_look(self.place.id)
        return Look.model_construct(
            name=name,
            timestamp=None if self.seen is None else datetime.fromisoformat(self.seen),
            camera=self.place.camera,
            run=self.run,
            least_score=self.least,
            right=self.right,
            wrong=self.wrong,
            passed=self.passed,
            regions=self.place.regions,
            picture=self.place.picture,
            created_at=self.place.created_at,
        )

    def outline(self) -> Outline:
        """The place in brief."""
        place = self.place
        return Outline(
            self.number, place.id, self.row, self.digest, place.picture, place.camera, place.sequence, self.ordinal,
            moment_text(place.updated_at), self.run, self.least,
        )  # fmt: skip

    def of_frame(self) -> Place:
        """The place as its frame was enrolled: the time of a look is that of its own frame."""
        if self.look_of is None:
            return self.place
        return self.place.model_copy(update={"timestamp": self.look().timestamp})


def _stored(values: Sequence[Any]) -> StoredPlace:
    *columns, seal, sequence = values
    if not is_sound(columns, seal):
        raise DamagedRow(f"the row of place {columns[1]!r} does not match its checksum")
    return _from_columns(dict(zip(_COLUMNS, columns, strict=True)), sequence)


def _from_columns(columns: Mapping[str, Any], sequence: str | None) -> StoredPlace:
    pose = {name: columns[name] for name in POSE_VALUES if columns[name] is not None}
    try:
        place = Place.model_construct(  # without validation: these are values of a valid place, and have a checksum
            id=columns["id"],
            pose_of=columns["pose_of"],
            regions=columns["regions"],
            picture=columns["picture"],
            looks=columns["looks"],
            pose=Pose(**pose) if pose else None,
            timestamp=None if columns["timestamp"] is None else datetime.fromisoformat(columns["timestamp"]),
            sequence=sequence,
            camera=columns["camera"],
            level=columns["level"],
            pose_accuracy=accuracy_of(columns["accuracy_metres"], columns["accuracy_degrees"]),
            metadata=json.loads(columns["metadata"]),
            created_at=datetime.fromisoformat(columns["created_at"]),
            updated_at=datetime.fromisoformat(columns["updated_at"]),
        )
    except ValueError as error:
        raise DamagedRow(f"the row of place {columns['id']!r} is invalid") from error
    return StoredPlace(**{name: columns[name] for name in _NUMBERS}, place=place)


def _columns_of(stored: StoredPlace) -> dict[str, Any]:
    place = stored.place
    return {
        **{name: getattr(stored, name) for name in _NUMBERS},
        "id": place.id,
        "regions": place.regions,
        "picture": place.picture,
        "looks": place.looks,
        "pose_of": place.pose_of,
        "created_at": moment_text(place.created_at),
        "updated_at": moment_text(place.updated_at),
        **field_columns(place),
    }


# Reading


def find(connection: MapConnection, place_id: str) -> StoredPlace | None:
    """The place of this id; None if there is none."""
    values = connection.one(_BY_ID, id=place_id)
    return None if values is None else _stored(values)


def expect(connection: MapConnection, place_id: str) -> StoredPlace:
    """The place of this id.

    Raises:
        UnknownPlace: there is none.
    """
    stored = find(connection, place_id)
    if stored is None:
        raise UnknownPlace(f"The map has no place {place_id[:140]!r}.")
    return stored


def of_ids(connection: MapConnection, place_ids: Sequence[str]) -> dict[str, StoredPlace]:
    """Places by id; ids that do not exist are left out."""
    found = map(_stored, connection.execute(_BY_IDS, ids=list(place_ids)))
    return {stored.place.id: stored for stored in found}


def at_rows(connection: MapConnection, rows: Sequence[int]) -> dict[int, StoredPlace]:
    """The places whose frames are in ``rows`` now, by row."""
    return {stored.row: stored for stored in map(_stored, connection.execute(_BY_ROWS, rows=list(rows)))}


def looks_of(connection: MapConnection, stored: StoredPlace) -> list[StoredPlace]:
    """The looks of a place besides its first, in the order in which they were added."""
    if stored.look_of is not None or not stored.place.looks:
        return []
    return [_stored(values) for values in connection.execute(_LOOKS_OF, place=stored.number)]


def learnt_from(
    connection: MapConnection, run: str | None, since: datetime | None, until: datetime | None
) -> list[StoredPlace]:
    """The looks that were learnt from a run, or any, and added in a period: from ``since`` on, and before ``until``."""
    return [
        stored
        for stored in looks_after(connection, -1, 1 << 62, run)
        if stored.run is not None
        and (since is None or stored.place.created_at >= since)
        and (until is None or stored.place.created_at < until)
    ]


def places_learnt_from(connection: MapConnection, run: str) -> list[StoredPlace]:
    """The places that are new ground of a run."""
    return [_stored(values) for values in connection.execute(_PLACES_FROM, run=run)]


def looks_after(connection: MapConnection, after: int, limit: int, run: str | None) -> list[StoredPlace]:
    """Up to ``limit`` looks behind number ``after``, of any run or of one, in the order in which they were added."""
    if run is None:
        found = connection.execute(_LOOKS, after=after, most=limit)
    else:
        found = connection.execute(_LEARNT_FROM, after=after, most=limit, run=run)
    return [_stored(values) for values in found]


def count_learnt(connection: MapConnection) -> int:
    """How many places were learnt from runs, or have looks that were."""
    ((count,),) = connection.execute(_LEARNT_PLACES)
    return int(count)


def numbers_of(connection: MapConnection, place_ids: Sequence[str]) -> dict[str, int]:
    """The numbers of places by id; ids that do not exist are left out."""
    return dict(connection.execute(_NUMBERS_OF, ids=list(place_ids)))


def all_rows_of(connection: MapConnection, place_id: str) -> list[int]:
    """The rows of a place and of its looks; none if there is no such place."""
    number = numbers_of(connection, [place_id]).get(place_id)
    return [] if number is None else [row for (row,) in connection.execute(_ROWS_OF_PLACE, place=number)]


def rows_of(connection: MapConnection, place_ids: Sequence[str]) -> dict[str, int]:
    """The rows of places by id; ids that do not exist are left out."""
    return dict(connection.execute(_ROWS_OF, ids=list(place_ids)))


def listed(connection: MapConnection, after: int, limit: int, wanted: PlaceFilter = EVERY_PLACE) -> list[StoredPlace]:
    """Up to ``limit`` places behind number ``after`` that fulfil some conditions, in the order of their enrolment."""
    statement, values = _listing(_conditions(wanted), False), _values(wanted)
    return [_stored(found) for found in connection.execute(statement, after=after, most=limit, **values)]


def listed_with_looks(connection: MapConnection, after: int, limit: int) -> list[StoredPlace]:
    """Up to ``limit`` places and looks behind number ``after``, in the order in which they were added."""
    return [_stored(found) for found in connection.execute(_WITH_LOOKS, after=after, most=limit)]


def ids_of(connection: MapConnection, wanted: PlaceFilter, limit: int) -> list[str]:
    """The ids of up to ``limit`` places that fulfil some conditions, in the order of their enrolment."""
    statement, values = _listing(_conditions(wanted), True), _values(wanted)
    return [place_id for (place_id,) in connection.execute(statement, after=-1, most=limit, **values)]


def pictured_before(connection: MapConnection, moment: datetime, limit: int) -> list[str]:
    """The ids of up to ``limit`` places with a picture that were enrolled before a moment, the first enrolled first."""
    found = connection.execute(_PICTURED_BEFORE, moment=moment_text(moment), most=limit)
    return [str(place_id) for (place_id,) in found]


NO_PLACE = -1
"""The number of no place."""

_NUMBERED = select(_P.x.is_not(None)).where(_P.map == bindparam("map"), _IS_PLACE, _P.number != bindparam("but"))
_NEWEST_FIRST = _NUMBERED.order_by(_P.number.desc()).limit(1)
_HAS_POSE = _P.x.is_not(None) | _P.latitude.is_not(None)
_NEWEST_POSE = Statement(_NEWEST_FIRST.where(_HAS_POSE))
_POSE_AT = Statement(_NUMBERED.where(_HAS_POSE, _P.number == bindparam("number")))
_POSE_OF: dict[PoseKind, Statement] = {
    "metric": Statement(_NEWEST_FIRST.where(_P.x.is_not(None))),
    "geographic": Statement(_NEWEST_FIRST.where(_P.latitude.is_not(None))),
}

Conditions = tuple[tuple[str, ...], int]
"""The conditions of a listing by name, and how many values of metadata are wanted."""


def _conditions(wanted: PlaceFilter) -> Conditions:
    names = ("ids", "sequence", "camera", "level", "after", "before")
    return tuple(name for name in names if getattr(wanted, name) is not None), len(wanted.metadata)


def _values(wanted: PlaceFilter) -> dict[str, Any]:
    given = {
        "ids": None if wanted.ids is None else list(wanted.ids),
        "sequence_name": wanted.sequence,
        "spellings": None if wanted.sequence is None else spellings(wanted.sequence),
        "camera_name": wanted.camera,
        "level_name": wanted.level,
        "from_moment": wanted.after and moment_text(wanted.after),
        "to_moment": wanted.before and moment_text(wanted.before),
        **{f"token_{at}": token for at, token in enumerate(wanted_tokens(wanted.metadata))},
    }
    return {name: value for name, value in given.items() if value is not None}


@cache
def _listing(conditions: Conditions, ids_alone: bool) -> Statement:
    names, values = conditions
    query = select(_P.id).where(_P.map == bindparam("map")) if ids_alone else _STORED
    code = (
        select(_S.code)
        .where(_S.map == bindparam("map"), among(_S.name, "spellings"))
        .order_by((_S.name == bindparam("sequence_name")).desc())
        .limit(1)
    )
    all_conditions = {
        "ids": among(_P.id, "ids"),
        "sequence": _P.sequence == code.scalar_subquery(),
        "camera": _P.camera == bindparam("camera_name"),
        "level": _P.level == bindparam("level_name"),
        "after": _P.timestamp >= bindparam("from_moment"),
        "before": _P.timestamp <= bindparam("to_moment"),
    }
    query = query.where(_IS_PLACE)
    for name in names:
        query = query.where(all_conditions[name])
    for at in range(values):
        has_token = exists(literal_column("1")).where(
            _T.map == bindparam("map"), _T.token == bindparam(f"token_{at}"), _T.row == _P.row
        )
        query = query.where(has_token)
    return Statement(query.where(_P.number > bindparam("after")).order_by(_P.number).limit(bindparam("most")))


def kinds_of_poses(
    connection: MapConnection, kind: PoseKind, but: int = NO_PLACE, posed: int = NO_PLACE
) -> set[PoseKind]:
    """The kind of the pose of one place, and also ``kind`` if any place has a pose of it; none without poses.

    It is quick where the first is ``kind``, as in any map of one kind.

    Args:
        but: the number of a place that does not count.
        posed: the number of a place that may have a pose, and is looked at first; else it is the newest that has one.
    """
    known = connection.one(_POSE_AT, but=but, number=posed) if posed > 0 else None
    known = known or connection.one(_NEWEST_POSE, but=but)
    if known is None:
        return set()
    found: set[PoseKind] = {"metric" if known[0] else "geographic"}
    if kind not in found and connection.one(_POSE_OF[kind], but=but) is not None:
        found.add(kind)
    return found


def outlines(connection: MapConnection, looks: bool) -> list[Outline]:
    """All places in brief, and their looks if these are wanted, in the order in which they were added."""
    found = [Outline(*values) for values in connection.execute(_OUTLINES)]
    return found if looks else [one for one in found if not one.is_look]


def stations(connection: MapConnection) -> dict[str, PlaceStation]:
    """Where all places are along their sequences and tracks, by id, in the order of their enrolment."""
    return {values[0]: PlaceStation(*values) for values in connection.execute(_STATIONS)}


def handed_over(connection: MapConnection) -> dict[int, str]:
    """The rows of places and looks whose pose was handed over, each with the id of the place that it comes from."""
    return dict(connection.execute(_HANDED_OVER))


def count(connection: MapConnection) -> tuple[int, int]:
    """How many places there are, and how many looks they have besides their first ones."""
    ((rows, looks),) = connection.execute(_COUNT)
    return int(rows - looks), int(looks)


def count_without_image(connection: MapConnection) -> int:
    """How many places keep no original image."""
    return int(connection.execute(_WITHOUT_IMAGE)[0][0])


def pictured(connection: MapConnection) -> list[tuple[str, int, Keep, bytes, str | None]]:
    """Id, row, kind of picture, digest and camera of all places, in the order of their enrolment."""
    return connection.execute(_PICTURED)


def unsound(connection: MapConnection) -> list[str]:
    """The ids of the places whose row does not match its checksum."""
    found, after = [], -1
    while page := connection.execute(_SEALS, after=after, most=_AT_ONCE):
        found += [str(columns[1]) for *columns, seal in page if not is_sound(columns, seal)]
        after = page[-1][0]
    return found


# Writing


def placed(item_id: str, fields: PlaceFields, sequence: int, ordinal: int, **values: Any) -> StoredPlace:
    """A place that is not stored yet, with its fields as they will be read.

    Args:
        sequence, ordinal: the code of its sequence, and its position in it.
        values: the other columns; moments as text.
    """
    columns = {
        "id": item_id, "sequence": sequence, "ordinal": ordinal, "track": None, "station": None, "pose_of": None,
        "look_of": None, "looks": 0, "seen": None, "run": None, "least": None,
        "right": 0, "wrong": 0, "passed": 0, **values, **field_columns(fields),
    }  # fmt: skip
    return _from_columns(columns, fields.sequence)


def with_fields(stored: StoredPlace, fields: PlaceFields, now: datetime) -> StoredPlace:
    """A place with other fields, as they will be read; its sequence's code and position stay."""
    columns = {**_columns_of(stored), **field_columns(fields), "updated_at": moment_text(now)}
    if fields.pose != stored.place.pose:
        columns["pose_of"] = None
    return _from_columns(columns, fields.sequence)


def as_look(stored: StoredPlace, place: StoredPlace) -> StoredPlace:
    """A look with all that it shares with its place."""
    of, shared = place.place, (
        "pose", "pose_accuracy", "pose_of", "level", "timestamp", "sequence", "metadata", "looks",
    )  # fmt: skip
    return replace(
        with_place(stored, **{name: getattr(of, name) for name in shared}),
        sequence=place.sequence, ordinal=place.ordinal, track=place.track, station=place.station, look_of=place.number,
    )  # fmt: skip


def with_place(stored: StoredPlace, **changes: Any) -> StoredPlace:
    """A place with other values of its :class:`Place`, which are valid."""
    return replace(stored, place=stored.place.model_copy(update=changes))


def insert(connection: MapConnection, new: Sequence[StoredPlace]) -> None:
    """Store new places."""
    connection.execute_many(_INSERT, [sealed(_COLUMNS, _columns_of(stored)) for stored in new])
    tokens = [{"token": token, "row": one.row} for one in new for token in _tokens(one.place.metadata)]
    if tokens:
        connection.execute_many(_PUT_TOKEN, tokens)


def put(connection: MapConnection, stored: StoredPlace, before: StoredPlace) -> None:
    """Store a changed place in the place of its former state."""
    values = sealed(_COLUMNS, _columns_of(stored))
    del values["number"]
    connection.execute(_UPDATE, which=stored.number, **{f"new_{name}": value for name, value in values.items()})
    if (stored.row, stored.place.metadata) != (before.row, before.place.metadata):
        _delete_tokens(connection, before)
        _put_tokens(connection, stored.row, _tokens(stored.place.metadata))


def remove(connection: MapConnection, stored: StoredPlace) -> None:
    """Remove a place; what is stored of its frame stays."""
    connection.execute(_DELETE, number=stored.number)
    _delete_tokens(connection, stored)


def whereabouts_of(stored: Sequence[StoredPlace]) -> Whereabouts:
    """Where and when the frames of places were taken, in their order."""
    poses = [one.place.pose for one in stored]
    moments = [one.place.timestamp for one in stored]
    return Whereabouts(
        np.array(
            [NO_POSE if pose is None else METRIC if pose.kind() == "metric" else GEOGRAPHIC for pose in poses], np.int8
        ),
        np.array([np.zeros(3) if pose is None else pose.position() for pose in poses]).reshape(-1, 3),
        np.array([one.sequence for one in stored], np.int32),
        np.array([one.ordinal for one in stored], np.int64),
        np.array([nan if pose is None or pose.heading is None else pose.heading for pose in poses], np.float32),
        np.array([NO_TIME if moment is None else microseconds(moment) for moment in moments], np.int64),
        np.array([one.sequence if one.track is None else one.track for one in stored], np.int32),
        np.array([one.ordinal if one.station is None else one.station for one in stored], np.int64),
        np.array([-np.inf if one.least is None else one.least for one in stored], np.float32),
        np.array([level_code(one.place.level) for one in stored], np.int32),
        np.array([nan if pose is None or pose.z is None else pose.z for pose in poses], np.float64),
        np.array([getattr(one.place.pose_accuracy, "metres", nan) for one in stored], np.float32),
    )


# Metadata


def wanted_tokens(metadata: Mapping[str, Scalar]) -> list[str]:
    """The tokens that the places with all of these values have; no place has those of long texts."""
    return _tokens(metadata, whole=True)


def _tokens(metadata: Mapping[str, Any], whole: bool = False) -> list[str]:
    """The tokens by which places with this metadata are found.

    Args:
        whole: also of long texts, by which none is found.
    """
    return [
        token_of(key, value)
        for key, value in metadata.items()
        if not isinstance(value, dict | list) and (whole or not isinstance(value, str) or len(value) <= LONGEST_TEXT)
    ]


def tokens_of(metadata: Mapping[str, Any]) -> list[str]:
    """A token for each value at the top level that is no list, no object and no long text, in any order.

    Equal values under equal keys have equal tokens: numbers are equal as numbers (1 and 1.0), and true is not 1.  A
    token has 64 bits, so that different values have the same one as good as never.
    """
    return _tokens(metadata)


def token_of(key: str, value: Scalar) -> str:
    """The token of one value under its key."""
    number = isinstance(value, float) and value.is_integer()
    text = json.dumps([key, int(value) if number else value])  # type: ignore[arg-type]
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _put_tokens(connection: MapConnection, row: int, tokens: Iterable[str]) -> None:
    if given := [{"token": token, "row": row} for token in tokens]:
        connection.execute_many(_PUT_TOKEN, given)


def _delete_tokens(connection: MapConnection, stored: StoredPlace) -> None:
    for token in _tokens(stored.place.metadata):
        connection.execute(_DELETE_TOKEN, token=token, row=stored.row)


def rows_with(
    connection: MapConnection, metadata: Mapping[str, Scalar], rows: NDArray[np.int64] | None = None
) -> NDArray[np.int64]:
    """Rows of the places whose metadata has these values under these keys: int64 [n], ascending.

    Args:
        metadata: at least one key with its value.
        rows: to choose from; None: all.
    """
    found = None if rows is None else np.unique(rows)
    for token in wanted_tokens(metadata):
        if found is not None and len(found) <= FEW:
            ((text,),) = connection.execute(_ROWS_WITH_AMONG, token=token, rows=found.tolist())
        else:
            ((text,),) = connection.execute(_ROWS_WITH, token=token)
        having = np.fromstring(text or "", np.int64, sep=",")
        having = having if np.all(having[1:] > having[:-1]) else np.unique(having)  # the index has them in order
        found = having if found is None else np.intersect1d(found, having, assume_unique=True)
    assert found is not None
    return found


def stale_tokens(connection: MapConnection, limit: int = 10) -> list[str]:
    """Where the index of metadata does not match the places; :func:`rebuild_tokens` repairs it."""
    stored = set(connection.execute(_TOKENS))
    wanted = {(row, token) for row, metadata in connection.execute(_METADATA) for token in _tokens(_read(metadata))}
    wrong = sorted(stored ^ wanted)
    return [f"row {row} is not indexed correctly by its metadata" for row, _ in wrong[:limit]]


def rebuild_tokens(connection: MapConnection) -> None:
    """Make the index of metadata again, within a transaction."""
    connection.execute(_DELETE_TOKENS)
    for row, metadata in connection.execute(_METADATA):
        _put_tokens(connection, row, _tokens(_read(metadata)))


def _read(metadata: str) -> dict[str, Any]:
    read = json.loads(metadata)
    if not isinstance(read, dict):
        raise ValueError("the metadata of a place is no JSON object")
    return read
