"""The parameters of queries, one class for each operation."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from core.judgement.priors import Constraint, Disc, Facing, GeographicBox, OnLevels, Period
from core.ledger.maps.places import LONGEST_TEXT
from core.maps.place_filter import Scalar
from core.maps.selection import TRUST, Conditions, RecentFrames, Selection
from core.places import Camera, Level, Pose, Sequence, Timestamp, check_map_id, level_code, microseconds
from core.recognition.question import Question
from service.errors.faults import InvalidRequest
from service.http.schemas import EncoderAssertion, Matches, Verification, validated
from service.places.filters import MOST_NAMES, checked_metadata, parsed_json
from service.places.parameters import FlatFields, PlaceDescription
from service.poses.geoposes import AnswerFormat

Kind = Literal["position", "bbox", "heading", "sequences", "levels", "time", "where"]
KINDS: tuple[Kind, ...] = ("position", "bbox", "heading", "sequences", "levels", "time", "where")

_NAMES: TypeAdapter[list[str]] = TypeAdapter(Annotated[list[Sequence], Field(min_length=1, max_length=MOST_NAMES)])
_LEVELS: TypeAdapter[list[str]] = TypeAdapter(Annotated[list[Level], Field(min_length=1, max_length=MOST_NAMES)])
_DEGREES = re.compile(r"[+-]?[0-9]{1,3}(\.[0-9]+)?")


class FilterParameters(PlaceDescription):
    """Prior knowledge of the place: filters on the places that may be found, or soft priors."""

    radius: float | None = Field(
        default=None,
        ge=0,
        le=1e9,
        allow_inf_nan=False,
        description="Metres: the place lies within this distance of the given position.",
        examples=[25.0],
    )
    heading_tolerance: float | None = Field(
        default=None,
        ge=0,
        le=180,
        allow_inf_nan=False,
        description="Degrees: the heading of the place differs by at most this much from `heading`.",
    )
    bbox: str | None = Field(
        default=None,
        max_length=200,
        description="west,south,east,north in degrees; a west greater than east crosses the antimeridian.",
        examples=["179.9,-17.1,-179.9,-16.9"],
    )
    sequences: str | None = Field(
        default=None,
        max_length=20_000,
        description="The place belongs to one of these traverses: names separated by commas, or a JSON array of texts.",
        examples=["monday,tuesday"],
    )
    level: Level | None = Field(
        default=None,
        description="The storey on which the frame was taken: a prior, as places on others are less probable then; "
        "`levels` is a filter.",
        examples=["2"],
    )
    levels: str | None = Field(
        default=None,
        max_length=20_000,
        description="The place is on one of these storeys: names separated by commas, or a JSON array.",
        examples=["1,2"],
    )
    after: Timestamp | None = Field(default=None, description="The place was enrolled with this timestamp or later.")
    before: Timestamp | None = Field(default=None, description="The place was enrolled with this timestamp or earlier.")
    where: str | None = Field(
        default=None,
        max_length=100_000,
        description="A JSON object: the place's metadata has these values under these keys, at its top level. Numbers "
        f"are compared as numbers; texts may have at most {LONGEST_TEXT} characters.",
        examples=['{"floor": 2, "light": "day"}'],
    )
    soft: str | None = Field(
        default=None,
        max_length=200,
        description=f"Which of {', '.join(KINDS)} are not filters but priors, which weigh the places; separated by "
        "commas.",
        examples=["position,heading"],
    )
    prior_trust: float | None = Field(
        default=None,
        ge=0,
        lt=1,
        description=f"The probability that level and the soft parameters are right; {TRUST} if left out. The odds of a "
        "place that contradicts them are multiplied by at least 1 - prior_trust.",
    )
    exclude_frames: int | None = Field(
        default=None, ge=0, le=10**9, description="Leave out this many of the last places of the frame's own sequence."
    )
    exclude_seconds: float | None = Field(
        default=None,
        ge=0,
        le=1e9,
        allow_inf_nan=False,
        description="Leave out the places of the frame's own sequence that were taken within this many seconds of the "
        "frame, or that have no timestamp.",
    )

    def position(self) -> Pose | None:
        """The position of the frame, without a heading; None if no coordinate is given.

        Raises:
            InvalidRequest: the position is incomplete, or both metric and geographic.
        """
        names = ("x", "y", "z", "latitude", "longitude")
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        return validated(Pose, given) if given else None

    def selection(self) -> Selection | None:
        """The filters and priors of the query; None if there are none.

        Raises:
            InvalidRequest: the parameters contradict each other, or one of them is malformed.
        """
        geometry = self._geometry()
        sequences, metadata = self._sequences(), self._metadata()
        given = {*geometry, *(["sequences"] if sequences else []), *(["where"] if metadata else [])}
        soft = self._soft(given)
        made = Selection(
            _conditions(given - soft, geometry, sequences, metadata),
            _conditions(soft, geometry, sequences, metadata),
            TRUST if self.prior_trust is None else self.prior_trust,
            self._recent(),
        )
        made = made if self.level is None else made.at_level(self.level)
        return made if made else None

    def again(self) -> dict[str, Any]:
        """The parameters of a query that asks the same, as JSON values; those at their defaults are left out."""
        unused = {"radius": ("x", "y", "z", "latitude", "longitude"), "heading_tolerance": ("heading",)}
        left_out = {name for needed, names in unused.items() if getattr(self, needed) is None for name in names}
        if self._recent() is None:
            left_out |= {"sequence", "timestamp"}
        names = {*FilterParameters.model_fields, "k", "verify"} - left_out
        return self.model_dump(mode="json", include=names, exclude_defaults=True)

    def _geometry(self) -> dict[Kind, Constraint]:
        found: dict[Kind, Constraint] = {}
        if self.radius is not None:
            centre = self.position()
            if centre is None:
                raise InvalidRequest("radius: it needs a position, x and y or latitude and longitude.")
            found["position"] = Disc(centre, self.radius)
        if self.heading_tolerance is not None:
            if self.heading is None:
                raise InvalidRequest("heading_tolerance: it needs a heading.")
            found["heading"] = Facing(self.heading, self.heading_tolerance)
        if self.bbox is not None:
            found["bbox"] = parse_box(self.bbox)
        if self.levels is not None:
            names = _named(self.levels, _LEVELS, "levels", "storeys")
            found["levels"] = OnLevels(tuple(level_code(name) for name in names))
        if self.after is not None or self.before is not None:
            if self.after is not None and self.before is not None and self.after > self.before:
                raise InvalidRequest("after: the time is later than that of before.")
            after, before = (None if moment is None else microseconds(moment) for moment in (self.after, self.before))
            found["time"] = Period(after, before)
        return found

    def _sequences(self) -> tuple[str, ...] | None:
        return None if self.sequences is None else tuple(_named(self.sequences, _NAMES, "sequences", "traverses"))

    def _metadata(self) -> dict[str, Scalar]:
        if self.where is None:
            return {}
        return checked_metadata(parsed_json(self.where, "where"))

    def _soft(self, given: set[str]) -> set[str]:
        if self.soft is None:
            if self.prior_trust is not None and self.level is None:
                raise InvalidRequest("prior_trust: it needs soft, which names the parameters to which it applies.")
            return set()
        names = set(self.soft.split(","))
        if unknown := sorted(names - set(KINDS)):
            raise InvalidRequest(f"soft: {unknown[0][:80]!r} is not one of {', '.join(KINDS)}.")
        if absent := sorted(names - given):
            raise InvalidRequest(f"soft: the query has no parameter for {absent[0]}.")
        return names

    def _recent(self) -> RecentFrames | None:
        if not self.exclude_frames and not self.exclude_seconds:
            return None
        if self.sequence is None:
            raise InvalidRequest("exclude_frames and exclude_seconds need the frame's own sequence.")
        if self.exclude_seconds and self.timestamp is None:
            raise InvalidRequest("exclude_seconds: it needs the frame's own timestamp.")
        moment = None if self.timestamp is None else microseconds(self.timestamp)
        return RecentFrames(self.sequence, self.exclude_frames or 0, moment, self.exclude_seconds or 0.0)


def _named(text: str, names: TypeAdapter[list[str]], parameter: str, what: str) -> list[str]:
    """The names in a parameter, separated by commas or a JSON array.

    Raises:
        InvalidRequest: they are none.
    """
    given: Any = parsed_json(text, parameter) if text.startswith("[") else text.split(",")
    try:
        return names.validate_python(given, strict=True)
    except ValidationError as error:
        raise InvalidRequest(f"{parameter}: give the names of 1 to {MOST_NAMES} {what}.") from error


def _conditions(
    names: set[str],
    geometry: Mapping[Kind, Constraint],
    sequences: tuple[str, ...] | None,
    metadata: Mapping[str, Scalar],
) -> Conditions:
    return Conditions(
        tuple(constraint for name, constraint in geometry.items() if name in names),
        sequences if "sequences" in names else None,
        metadata if "where" in names else {},
    )


def parse_box(text: str) -> GeographicBox:
    """The box of a text ``west,south,east,north`` in degrees.

    Raises:
        InvalidRequest: the text is no such box.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 4 or not all(_DEGREES.fullmatch(part) for part in parts):
        raise InvalidRequest("bbox: the value is not four numbers, west,south,east,north.")
    west, south, east, north = map(float, parts)
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south <= north <= 90):
        raise InvalidRequest("bbox: west and east must be -180 to 180, and -90 <= south <= north <= 90.")
    return GeographicBox(west, south, east, north)


MOST_MAPS = 100
"""The most maps that one query may name."""

_CAMERAS: TypeAdapter[dict[str, str]] = TypeAdapter(dict[str, Camera])


class LocateParameters(FilterParameters):
    """The parameters of a frame that is located and not enrolled."""

    def selection(self) -> Selection | None:
        """See ``FilterParameters.selection``; a position or heading without its tolerance is refused as well."""
        if self.radius is None and self.position() is not None:
            raise InvalidRequest("A position needs a radius within which the place is.")
        if self.heading is not None and self.heading_tolerance is None:
            raise InvalidRequest("heading: it needs a heading_tolerance.")
        return super().selection()


class QueryParameters(LocateParameters):
    """The parameters of a query."""

    k: Matches = 5
    verify: Verification = "auto"
    explain: bool = Field(default=False, description="Explain the score of the best match.")
    encoder: EncoderAssertion = None

    def question(self) -> Question:
        """The question; see ``selection`` for errors."""
        return Question(self.k, self.selection(), self.verify, self.camera)


class SingleQueryParameters(QueryParameters):
    """The parameters of a query of one frame."""

    format: AnswerFormat = None


class ClosureParameters(FilterParameters, FlatFields):
    """The parameters of a loop closure; pose, timestamp and sequence are enrolled with the frame."""

    id: str = Field(description="Id of the place that is created if the frame is unknown.", examples=["p9"])
    metadata: str | None = Field(default=None, description="A JSON object.", examples=['{"floor": 2}'])
    k: Matches = 5
    verify: Verification = "auto"
    encoder: EncoderAssertion = None

    def question(self) -> Question:
        """The question; see ``selection`` for errors."""
        return Question(self.k, self.selection(), self.verify, self.camera)


class MultiMapParameters(LocateParameters):
    """The parameters of a query of several maps."""

    maps: str | None = Field(
        default=None,
        max_length=10_000,
        description=f"Ids of the maps, separated by commas, at most {MOST_MAPS}; all maps if left out.",
        examples=["lab,yard"],
    )
    cameras: str | None = Field(
        default=None,
        max_length=10_000,
        description="A JSON object with the camera of each part of the form.",
        examples=['{"left": "side-camera"}'],
    )
    k: Matches = 5
    verify: Verification = "auto"
    format: AnswerFormat = None

    def question(self) -> Question:
        """The question about a rig; each of its frames has a camera of its own; see ``selection`` for errors."""
        return Question(self.k, self.selection(), self.verify)

    def map_ids(self) -> list[str] | None:
        """The ids of the maps that are named; None: all maps.

        Raises:
            InvalidIdentifier: one of them is not a valid id.
            InvalidRequest: there are too many ids, or one of them twice.
        """
        if self.maps is None:
            return None
        found = [check_map_id(name.strip()) for name in self.maps.split(",")]
        if len(found) > MOST_MAPS or len(set(found)) < len(found):
            raise InvalidRequest(f"maps: name at most {MOST_MAPS} maps, each of them once.")
        return found

    def camera_of(self, parts: Collection[str]) -> dict[str, str]:
        """The name of the camera of each part of the form, for parts that have one.

        Raises:
            InvalidRequest: ``cameras`` is malformed, or names a part that the form does not have.
        """
        if self.cameras is None:
            return {} if self.camera is None else dict.fromkeys(parts, self.camera)
        if self.camera is not None:
            raise InvalidRequest("camera and cameras say the same thing; give one of them.")
        try:
            found = _CAMERAS.validate_python(parsed_json(self.cameras, "cameras"), strict=True)
        except ValidationError as error:
            raise InvalidRequest("cameras: the value is not a JSON object of parts and their cameras.") from error
        if strange := sorted(set(found) - set(parts)):
            raise InvalidRequest(f"cameras: the form has no part {strange[0][:80]!r}.")
        return found
