"""The description of a network that others trained: its input, its output, and the use that is made of it.

It is a small file in JSON beside the network's own file::

    {
      "input": {"height": 322, "width": 322, "channel_order": "rgb",
                "mean": [123.675, 116.28, 103.53], "scale": [0.01712, 0.01751, 0.01743], "resize": "area"},
      "sizes": {"least": 224, "most": 1022, "multiple": 14},
      "output": {"kind": "tokens", "patch": 14, "skip": 1},
      "aggregation": {"method": "vlad", "words": 32, "whitening": 512}
    }

A global descriptor is a map of one cell, and tokens are the cells of a map row by row, so that any output of a network
is a map of features to everything that follows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition

MAX_DESCRIPTION = 65_536
"""Bytes of a description's file."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Sizes(_Part):
    """The sizes of input that a network takes, if it takes more than one: each side from ``least`` to ``most``."""

    least: int = Field(ge=16, le=4096)
    most: int = Field(ge=16, le=4096)
    multiple: int = Field(default=1, ge=1, le=4096, description="Each side is a multiple of this.")


class Output(_Part):
    """The output that is taken from a network.

    ``descriptor``: one vector of a frame, [1, K].  ``maps``: [1, K, X, Y].  ``tokens``: [1, N, K], one for each square
    of ``patch`` pixels, row by row, after ``skip`` others, such as a class token.
    """

    kind: Literal["descriptor", "maps", "tokens"]
    name: str | None = Field(default=None, description="Of the file's output; none: its first one.")
    patch: int | None = Field(default=None, ge=1, le=256)
    skip: int = Field(default=0, ge=0, le=64)
    rectify: bool = Field(default=False, description="Values below zero become zero.")

    @model_validator(mode="after")
    def _tokens_have_patches(self) -> Output:
        if (self.patch is None) == (self.kind == "tokens") or (self.skip and self.kind != "tokens"):
            raise ValueError("patch and skip belong to tokens, and patch is needed for them")
        return self


class Aggregation(_Part):
    """How the cells of a network's map become one descriptor.

    ``none``: there is one cell, a global descriptor.  ``gem``: their generalized mean (Radenović, Tolias, Chum, 2018).
    ``vlad``: the residuals of all cells from the words of a vocabulary.  ``regions``: M-Region-VLAD, those of the
    regions of interest.
    """

    method: Literal["none", "gem", "vlad", "regions"]
    exponent: Annotated[float, Field(ge=1, le=100)] = Field(default=3.0, description="p of the generalized mean.")
    words: int = Field(default=64, ge=1, le=65_536, description="V of a vocabulary.")
    regions: int = Field(default=300, ge=1, le=10_000, description="N of regions.")
    step: float = Field(default=1.0, gt=0, allow_inf_nan=False, description="Quantisation step of regions.")
    unit_features: bool = Field(default=True, description="Each feature is scaled to unit length first.")
    gamma: float = Field(default=1.0, gt=0, le=1, description="Exponent of the power normalization.")
    normalization: Literal["intra", "global"] = "intra"
    whitening: int | None = Field(default=None, ge=1, le=65_536, description="Values that PCA whitening retains.")


class SecondStage(_Part):
    """How the cells of two frames are compared after the first search, if at all (``core.method.agreement``).

    Their features are projected to ``values``; two cells that correspond are at most ``reach`` rows and columns apart.
    """

    values: int = Field(default=64, ge=1, le=512)
    reach: tuple[int, int] = (2, 5)
    candidates: int = Field(default=30, ge=1, le=1000)
    share: float = Field(default=0.5, gt=0, lt=1)


class NetworkDescription(_Part):
    """Input, output and aggregation of a network that others trained; ``citation`` names them."""

    input: InputDefinition
    output: Output
    aggregation: Aggregation = Aggregation(method="none")
    second_stage: SecondStage | None = Field(default=None, description="Of a network that gives maps or tokens.")
    sizes: Sizes | None = Field(default=None, description="None: the input has one size.")
    citation: str = Field(default="", max_length=1000)

    @model_validator(mode="after")
    def _parts_fit(self) -> NetworkDescription:
        if (self.output.kind == "descriptor") != (self.aggregation.method == "none"):
            raise ValueError("a descriptor is not aggregated, and maps and tokens are")
        if self.second_stage is not None and self.output.kind == "descriptor":
            raise ValueError("a descriptor has no cells that a second stage could compare")
        shown, sizes = self.input, self.sizes
        sides = (shown.height, shown.width)
        if sizes is not None and not all(
            sizes.least <= side <= sizes.most and side % sizes.multiple == 0 for side in sides
        ):
            raise ValueError(
                f"its input of {shown.width}x{shown.height} is not from {sizes.least} to {sizes.most} in steps of "
                f"{sizes.multiple}"
            )
        if self.output.patch is not None and any(side % self.output.patch for side in sides):
            raise ValueError(
                f"its input of {shown.width}x{shown.height} is not cut into patches of {self.output.patch}"
            )
        return self

    @property
    def learned(self) -> bool:
        """Whether an encoder of it needs pictures: a vocabulary, a whitening or a projection is fitted to them."""
        made = self.aggregation
        return made.method in ("vlad", "regions") or made.whitening is not None or self.second_stage is not None

    def at(self, height: int, width: int) -> NetworkDescription:
        """The same with another size of input, in pixels.

        Raises:
            InvalidModel: the network does not take it.
        """
        shown = self.input
        if self.sizes is None and (height, width) != (shown.height, shown.width):
            raise InvalidModel(f"The network takes an input of {shown.width}x{shown.height} only.")
        resized = self.model_dump() | {"input": shown.model_dump() | {"height": height, "width": width}}
        return checked(resized)


def checked(fields: object) -> NetworkDescription:
    """The description with these fields.

    Raises:
        InvalidModel: they do not make one; the text names the first that is wrong.
    """
    try:
        return NetworkDescription.model_validate(fields)
    except ValidationError as error:
        raise _unusable("The description", error) from error


def read_description(path: Path) -> NetworkDescription:
    """Read a description's file.

    Raises:
        InvalidModel: it cannot be read, or is not a description.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_DESCRIPTION + 1)
    except OSError as error:
        raise InvalidModel(f"{path.name} cannot be read: {error.strerror}.") from error
    if len(text) > MAX_DESCRIPTION:
        raise InvalidModel(f"{path.name} is too long for a description: more than {MAX_DESCRIPTION} bytes.")
    try:
        return NetworkDescription.model_validate_json(text)
    except ValidationError as error:
        raise _unusable(path.name, error) from error


def _unusable(what: str, error: ValidationError) -> InvalidModel:
    problem = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"])
    return InvalidModel(f"{what} cannot be used: {where}{': ' if where else ''}{problem['msg']}.")
