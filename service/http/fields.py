"""Fields that several answers share."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

IDENTITY_EXAMPLE = "m-region-vlad@3c9d…"

Milliseconds = Annotated[dict[str, float], Field(description="Milliseconds spent in each stage.")]
Cursor = Annotated[str | None, Field(description="Give it as ?cursor= for the next page; null on the last.")]
