"""JSON of the routes at the root and of the list of encoders."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from core.method.catalogue import EncoderSummary
from service.http.schemas import Cursor
from service.maps.schemas import QuarantinedMap


class EncoderPage(BaseModel):
    """All installed encoders."""

    items: list[EncoderSummary]
    next_cursor: Cursor


class Health(BaseModel):
    """The process is alive."""

    status: Literal["ok"] = "ok"


class OpenState(BaseModel):
    """What is open, and how much may be."""

    maps: int = Field(description="Open maps; the others are opened when they are used.")
    most_maps: int = Field(description="One more makes the map that was used least close.")
    files: int | None = Field(description="Descriptors of the process; null where the system does not report it.")
    most_files: int = Field(description="Descriptors that the process may have.")


class Readiness(BaseModel):
    """The service is ready for requests."""

    status: Literal["ready"] = "ready"
    degraded: str | None = Field(
        default=None, description="Why it answers queries but takes no writes, as on a full disk; null: it takes them."
    )
    checks: dict[str, str] = Field(description="Each is `ok`, or a sentence that says what is wrong.")
    encoder: str
    quarantined: list[QuarantinedMap]
    open: OpenState


class Version(BaseModel):
    """Versions of the service and its libraries."""

    name: str = "placerec"
    version: str
    api: str = "v1"
    encoder: str
    python: str
    torch: str | None = Field(description="Null: it is not installed, and forward passes are computed in float32.")
    faiss: str
