"""Calibrating a map: what is asked for, and what was found."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.judgement.map_calibration import Measurement, Target
from core.judgement.verdict import Calibration
from service.http.schemas import CameraName

Method = Literal["frames", "sequence", "map"]

MOST_FRAMES = 2000

ORDER_EXAMPLE: dict[str, Any] = {
    "method": "sequence",
    "sequence": "tuesday",
    "target": {"rule": "precision", "value": 0.95},
    "dry_run": True,
}


class Label(BaseModel):
    """The true place of one frame of the form."""

    model_config = ConfigDict(extra="forbid")

    file: str = Field(max_length=256, description="Name of the frame's part.")
    place: str | None = Field(max_length=128, description="Id of the place that it shows; null: the map has it not.")
    camera: CameraName = None


class CalibrationOrder(BaseModel):
    """By what a map is to be calibrated, and what for."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [ORDER_EXAMPLE]})

    method: Method = Field(
        description="`frames`: the labelled frames of this form. `sequence`: one traverse of the map, asked of the "
        "others. `map`: the map's own frames, each asked of its neighbours; better than nothing."
    )
    target: Target = Field(default=Target(rule="precision", value=0.95), description="What the threshold is to reach.")
    dry_run: bool = Field(strict=True, default=False, description="Measure and tell, store nothing.")
    background: bool = Field(
        strict=True, default=False, description="Answer 202 with a job, whose result is the report."
    )
    sequence: str | None = Field(default=None, max_length=128, description="The traverse that is asked.")
    pairs: dict[str, str | None] | None = Field(
        default=None,
        min_length=1,
        max_length=MOST_FRAMES,
        description="Of places of the sequence to the places among the others that show the same, null for one that "
        "they lack; only these are asked. Left out: the poses tell.",
    )
    most: int = Field(strict=True, default=300, ge=20, le=MOST_FRAMES, description="Frames to ask, spread evenly.")
    labels: list[Label] | None = Field(
        default=None, min_length=1, max_length=MOST_FRAMES, description="One for each frame of the form."
    )

    @model_validator(mode="after")
    def _what_belongs_to_the_method(self) -> CalibrationOrder:
        if (self.sequence is None) == (self.method == "sequence"):
            raise ValueError("sequence belongs to the method sequence, and to it only")
        if self.pairs is not None and self.method != "sequence":
            raise ValueError("pairs belong to the method sequence")
        if (self.labels is None) == (self.method == "frames"):
            raise ValueError("labels belong to the method frames, and to it only")
        if self.background and self.method == "frames":
            raise ValueError("frames are calibrated by at once; background belongs to the other methods")
        return self


class CalibrationReport(BaseModel):
    """A calibration, what was measured in making it, and what to know of it."""

    map: str
    encoder: str
    method: Method
    target: Target
    stored: bool = Field(description="It is the map's own from now on; false for a dry run.")
    calibration: Calibration
    previous: Calibration = Field(description="The one that judged so far.")
    measurement: Measurement
    warnings: list[str]
