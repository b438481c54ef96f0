"""Which places a listing shows, and which places are deleted together."""

from __future__ import annotations

import json
from typing import Annotated, Any

from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.ledger.maps.places import LONGEST_TEXT
from core.maps.place_filter import PlaceFilter, Scalar
from core.places import Camera, Level, Timestamp
from service.errors.faults import InvalidRequest
from service.http.bodies import read_json
from service.http.schemas import PageParameters

MOST_NAMES = 100
"""The most sequences, and the most keys of metadata, that one request may name."""

MOST_DELETED = 10_000
"""Places that one request may delete."""


def parsed_json(text: str, what: str) -> Any:
    """The value of JSON text in a parameter.

    Raises:
        InvalidRequest: the text is not JSON, or has values that cannot be stored (NaN, half a surrogate pair, a name
            twice).
    """

    def refuse(constant: str) -> Any:
        raise ValueError(constant)

    try:
        found = read_json(text, parse_constant=refuse)
        json.dumps(found, ensure_ascii=False, allow_nan=False).encode()
        return found
    except (ValueError, RecursionError):
        raise InvalidRequest(f"{what}: the value is not JSON, or has a name twice.") from None


def checked_metadata(found: Any) -> dict[str, Scalar]:
    """The values that metadata has to have, which are wanted under the name ``where``.

    Raises:
        InvalidRequest: it is no object of a few values by which places can be found.
    """
    if not isinstance(found, dict) or not 0 < len(found) <= MOST_NAMES:
        raise InvalidRequest(f"where: the value is not a JSON object with 1 to {MOST_NAMES} keys.")
    for key, value in found.items():
        if isinstance(value, dict | list):
            raise InvalidRequest(f"where: the value of {key[:80]!r} must be a text, number, true, false or null.")
        if isinstance(value, str) and len(value) > LONGEST_TEXT:
            raise InvalidRequest(f"where: the text under {key[:80]!r} has more than {LONGEST_TEXT} characters.")
    return found


class PlacePageParameters(PageParameters):
    """Which places."""

    sequence: str | None = Field(default=None, max_length=128, description="Only the places of this traverse.")
    camera: str | None = Field(default=None, max_length=128, description="Only places that this camera took.")
    level: Level | None = Field(default=None, description="Only places on this storey.")
    after: Timestamp | None = Field(default=None, description="Only places with this timestamp or a later one.")
    before: Timestamp | None = Field(default=None, description="Only places with this timestamp or an earlier one.")
    where: str | None = Field(
        default=None,
        max_length=100_000,
        description="A JSON object: only places whose metadata has these values under these keys, at its top level.",
        examples=['{"floor": 2}'],
    )

    def wanted(self) -> PlaceFilter:
        """The conditions.

        Raises:
            InvalidRequest: they contradict each other, or ``where`` is malformed.
        """
        metadata = {} if self.where is None else checked_metadata(parsed_json(self.where, "where"))
        if self.after is not None and self.before is not None and self.after > self.before:
            raise InvalidRequest("after: the time is later than that of before.")
        return PlaceFilter(None, self.sequence, self.camera, self.level, self.after, self.before, metadata)


PlacePageQuery = Annotated[PlacePageParameters, Query()]


class PlaceConditions(BaseModel):
    """Conditions on a place; all that are given have to hold."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"sequence": "monday", "where": {"floor": 2}}]}
    )

    sequence: str | None = Field(default=None, max_length=128, description="It belongs to this traverse.")
    camera: Camera | None = Field(default=None, description="This camera took its frame.")
    level: Level | None = Field(default=None, description="It is on this storey.")
    after: Timestamp | None = Field(default=None, description="It has this timestamp or a later one.")
    before: Timestamp | None = Field(default=None, description="It has this timestamp or an earlier one.")
    where: dict[str, Any] | None = Field(
        default=None, description="Its metadata has these values under these keys, at its top level."
    )

    def wanted(self) -> PlaceFilter:
        """The conditions.

        Raises:
            InvalidRequest: there are none, or they contradict each other.
        """
        if self.after is not None and self.before is not None and self.after > self.before:
            raise InvalidRequest("filter: after is later than before.")
        metadata = {} if self.where is None else checked_metadata(self.where)
        made = PlaceFilter(None, self.sequence, self.camera, self.level, self.after, self.before, metadata)
        if not made:
            raise InvalidRequest("filter: give at least one condition; to delete all places, delete the map.")
        return made


DELETION_EXAMPLES: tuple[Any, ...] = (
    {"ids": ["p7", "p8"], "dry_run": False},
    {"filter": {"sequence": "monday", "before": "2026-11-20T10:00:00Z"}},
)


class Deletion(BaseModel):
    """Which places to delete: those of some ids, or those that fulfil some conditions."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [*DELETION_EXAMPLES]})

    ids: list[Annotated[str, Field(max_length=128)]] | None = Field(
        default=None,
        min_length=1,
        max_length=MOST_DELETED,
        description="Ids of places; those that are gone are listed in the answer.",
    )
    filter: PlaceConditions | None = Field(default=None, description="Conditions, at least one.")
    dry_run: bool = Field(strict=True, default=True, description="Only say which places would be deleted.")

    @model_validator(mode="after")
    def _says_which(self) -> Deletion:
        if (self.ids is None) == (self.filter is None):
            raise ValueError("give either ids or a filter")
        return self

    def wanted(self) -> PlaceFilter:
        """The conditions.

        Raises:
            InvalidRequest: there are none, or they contradict each other.
        """
        if self.filter is None:
            return PlaceFilter(tuple(dict.fromkeys(self.ids or ())))
        return self.filter.wanted()


class DeletedPlaces(BaseModel):
    """Places that were deleted or, in a dry run, would be."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"dry_run": True, "places": 2, "ids": ["p7", "p8"], "missing": []}]}
    )

    dry_run: bool
    places: int
    ids: list[str] = Field(description="All of them, in the order of their enrolment.")
    missing: list[str] = Field(description="Ids that were given and do not exist.")
