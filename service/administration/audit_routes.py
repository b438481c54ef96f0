"""The route of the audit trail: who changed what, who saw pictures, and who was refused."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query
from pydantic import BaseModel, ConfigDict, Field

from core import errors
from core.maps.pagination import Listing, decode_name, encode_cursor
from core.places import Timestamp
from service.administration.audit_lines import AuditLine, Position
from service.administration.audit_trail import AuditTrail, Source
from service.errors.faults import InvalidRequest
from service.errors.problems import problem_documentation
from service.http.routing import FromState, StrictRoute, single_values
from service.http.schemas import Cursor, PageParameters

MOST_READ = 8 * 1024 * 1024
"""Bytes of the trail that are read for one page at most."""

UNORDERED = timedelta(minutes=1)
"""Lines may be this much out of order, since requests end at the same time; reading goes on so far beyond ``after``."""

AUDIT_EXAMPLE: dict[str, Any] = {
    "time": "2026-11-21T18:02:31.977Z",
    "event": "change",
    "operation": "enrol_place",
    "status": 201,
    "principal": "eve",
    "key": "c69fcf6b7439",
    "client": "10.0.0.7",
    "request_id": "565799d7ff8041ac7be3833c12160c09",
    "map": "lab",
    "job": None,
    "place": "p7",
    "change": "created",
}

router = APIRouter(prefix="/v1/audit", tags=["audit"], route_class=StrictRoute, dependencies=[Depends(single_values)])


class AuditEntry(BaseModel):
    """One line of the audit trail, with whatever else it says, such as `place`, `change` or `problem`."""

    model_config = ConfigDict(extra="allow", json_schema_extra={"examples": [AUDIT_EXAMPLE]})

    time: str = Field(description="When the line was written (ISO 8601 in UTC).")
    event: str = Field(description="`change`, `shown`, `refused`, or `job` with the state that it has reached.")
    operation: str | None = Field(description="The operation that was called.")
    status: int | None = Field(description="Of the answer; 0: none was sent. Null for the line of a job.")
    principal: str | None = Field(description="The name of the caller's key.")
    key: str | None = Field(description="The id of the caller's key; null if there are no keys.")
    client: str | None = Field(description="The address that the request came from.")
    request_id: str | None
    map: str | None
    job: str | None


class AuditPage(BaseModel):
    """A part of the audit trail, the latest line first."""

    items: list[AuditEntry] = Field(description="It may be shorter than the limit, or empty, although more follows.")
    next_cursor: Cursor
    source: Source = Field(
        description="database: the lines of all services that share their state. memory: no file of the trail is "
        "configured, so there are only the latest lines of this process."
    )


class AuditParameters(PageParameters):
    """Which lines of the audit trail."""

    map: str | None = Field(default=None, max_length=64, description="Only lines about this map.")
    key: str | None = Field(default=None, max_length=64, description="Only calls with the key of this id or name.")
    operation: str | None = Field(
        default=None, max_length=64, description="Only this operation.", examples=["delete_map"]
    )
    after: Timestamp | None = Field(default=None, description="Only lines of this time or later.")
    before: Timestamp | None = Field(default=None, description="Only lines of this time or earlier.")

    def listing(self) -> Listing:
        """The listing that a cursor belongs to."""
        moments = (None if moment is None else moment.isoformat() for moment in (self.after, self.before))
        return ["audit", self.map, self.key, self.operation, *moments]

    def match(self, fields: dict[str, Any], moment: datetime) -> bool:
        """Whether a line of a certain time is wanted."""
        wanted = {"map": self.map, "operation": self.operation}
        if any(value is not None and fields.get(name) != value for name, value in wanted.items()):
            return False
        if self.key is not None and self.key not in (fields.get("key"), fields.get("principal")):
            return False
        return (self.after is None or moment >= self.after) and (self.before is None or moment <= self.before)


@router.get("", responses=problem_documentation(errors.InvalidCursor, errors.StorageFailure))
def read_audit(
    options: Annotated[AuditParameters, Query()],
    trail: Annotated[AuditTrail, Depends(FromState("audit_trail"))],
) -> AuditPage:
    """Read the audit trail from its latest line: who changed what, who saw pictures, and who was refused.

    Parts of the file that were moved away are read, too, unless they are compressed. A request reads a bounded part of
    the trail, so a page can be shorter than its limit: go on while there is a `next_cursor`.
    """
    if options.after is not None and options.before is not None and options.after > options.before:
        raise InvalidRequest("after: the time is later than that of before.")
    listing = options.listing()
    at = None if options.cursor is None else Position.parsed(decode_name(listing, options.cursor))
    items, reached = _page(trail.lines(at), options)
    more = None if reached is None else encode_cursor(listing, reached.text())
    return AuditPage(items=items, next_cursor=more, source=trail.source)


def _page(lines: Iterator[AuditLine], options: AuditParameters) -> tuple[list[AuditEntry], Position | None]:
    """The lines of a page, and the position of the last one that was read; None if there are no more."""
    items: list[AuditEntry] = []
    read, reached = 0, None
    for line in lines:
        if reached is not None and (len(items) == options.limit or read > MOST_READ):
            return items, reached
        read, reached = read + line.size, line.position
        moment = _moment(line.fields)
        if line.fields is None or moment is None:
            continue
        if options.after is not None and moment < options.after - UNORDERED:
            break
        if options.match(line.fields, moment):
            items.append(_entry(line.fields))
    return items, None


def _moment(fields: dict[str, Any] | None) -> datetime | None:
    """When a line was written; None if it is none of the trail."""
    try:
        found = datetime.fromisoformat((fields or {})["time"])
    except (KeyError, TypeError, ValueError):
        return None
    return found if found.tzinfo is not None else None


def _entry(fields: dict[str, Any]) -> AuditEntry:
    known = {name: fields.get(name) for name in AuditEntry.model_fields}
    more = {name: value for name, value in fields.items() if name not in ("level", "logger", "message")}
    return AuditEntry.model_construct(**{**known, **more, "event": str(fields.get("message", ""))})
