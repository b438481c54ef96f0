"""What runs here: encoders, versions, health."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel

from core.method.catalogue import EncoderSummary
from service.http.schemas import Cursor
from service.maps.schemas import QuarantinedMap


class EncoderPage(BaseModel):
    """All encoders installed."""

    items: list[EncoderSummary]
    next_cursor: Cursor


class Health(BaseModel):
    """The process runs."""

    status: Literal["ok"] = "ok"


class Readiness(BaseModel):
    """The service can work."""

    status: Literal["ready"] = "ready"
    checks: dict[str, str]
    encoder: str
    quarantined: list[QuarantinedMap]


class Version(BaseModel):
    """What runs here."""

    name: str = "placerec"
    version: str
    api: str = "v1"
    encoder: str
    python: str
    torch: str
    faiss: str
