"""Descriptors, regions and scores of frames as JSON."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from service.http.schemas import Milliseconds, Parameters
from service.queries.schemas import ExplanationView


class Descriptor(BaseModel):
    """A frame's descriptor."""

    encoder: str
    dimension: int
    dtype: Literal["float32"] = "float32"
    byte_order: Literal["little"] = "little"
    descriptor: str = Field(description="The values, base64.")
    regions: int
    milliseconds: Milliseconds


class Layer(BaseModel):
    """A layer of the network from which regions come."""

    name: str
    rows: int
    columns: int


class Box(BaseModel):
    """A box in pixels of the upright frame, over which the cells of the layer are spread."""

    left: float
    top: float
    right: float
    bottom: float


class Region(BaseModel):
    """One region of interest."""

    layer: str
    channel: int
    energy: float
    cells: tuple[int, int, int, int] = Field(description="top, left, bottom, right in cells, half-open")
    box: Box


class RegionsView(BaseModel):
    """A frame's regions of interest."""

    encoder: str
    width: int
    height: int
    layers: list[Layer]
    found: int = Field(description="How many regions the frame has; the list may have fewer.")
    regions: list[Region]
    milliseconds: Milliseconds


class MatchScore(BaseModel):
    """How similar two frames are."""

    score: float = Field(description="The score of a query's match, after the second stage if the encoder has one.")
    encoder: str
    regions: dict[str, int] = Field(description="How many regions each frame has; without regions the score is 0.")
    explanation: ExplanationView | None = Field(
        default=None, description="With `explain`: the explanation of the score; a is the query, b the match."
    )
    milliseconds: Milliseconds


class EncoderParameters(Parameters):
    """Beside a frame that is encoded for no map."""

    encoder: str | None = Field(
        default=None, max_length=256, description="Name or identity; the default encoder if left out."
    )


class MatchParameters(EncoderParameters):
    """How to compare two frames."""

    explain: bool = Field(default=False, description="Say which words, regions and cells carried the score.")
    format: Literal["json", "png"] | None = Field(
        default=None,
        description="png: both frames side by side, corresponding points joined by lines; if left out, the Accept "
        "header decides, and json is the default.",
    )


class RegionsParameters(EncoderParameters):
    """How to show regions."""

    limit: int | None = Field(default=None, ge=1, le=10_000, description="Only this many, those of the highest energy.")
    format: Literal["json", "png"] | None = Field(
        default=None, description="json or png; if left out, the Accept header decides, and json is the default."
    )
