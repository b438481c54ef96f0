"""From colour pixels to the network's input (thesis, section 4.3: the whole frame is resized)."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from core.frames.masks import Mask

Pixels = NDArray[np.uint8]
Number = Annotated[float, Field(allow_inf_nan=False)]

INTERPOLATION = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA}


class InputDefinition(BaseModel):
    """The input of a network: ``(pixels - mean) * scale`` at its own size.

    ``mean`` (0–255 units) and ``scale`` are in the channel order of the network.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    height: int = Field(ge=16, le=4096)
    width: int = Field(ge=16, le=4096)
    channel_order: Literal["bgr", "rgb"] = "bgr"
    mean: tuple[Number, Number, Number]
    scale: tuple[Number, Number, Number] = (1.0, 1.0, 1.0)
    resize: Literal["linear", "area"] = "linear"


def prepare(pixels: Pixels, definition: InputDefinition, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Make a frame the input of a network.

    The whole frame is resized without a crop; its aspect ratio is not preserved (method, section 1).

    Args:
        pixels: uint8 [H, W, 3], BGR.
        out: where to put the result, contiguous; None: a new array.

    Returns:
        float32 [height, width, 3], in the network's channel order.
    """
    height, width = definition.height, definition.width
    if pixels.shape[:2] != (height, width):
        resized = cv2.resize(pixels, (width, height), interpolation=INTERPOLATION[definition.resize])
        pixels = np.asarray(resized, np.uint8)
    if definition.channel_order == "rgb":
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)
    if out is None:
        out = np.empty((height, width, 3), np.float32)
    mean, scale = _of_a_row(definition.mean, width), _of_a_row(definition.scale, width)
    rows = out.reshape(height, -1)
    np.subtract(pixels.reshape(height, -1), mean, out=rows)
    np.multiply(rows, scale, out=rows)
    return out


@lru_cache(maxsize=32)
def _of_a_row(values: tuple[float, float, float], width: int) -> NDArray[np.float32]:
    """The three channels' values, repeated for each pixel of a row; float32 [3 W]."""
    return np.tile(np.array(values, np.float32), width)


def contrast(pixels: Pixels, mask: Mask | None = None) -> float:
    """The largest standard deviation of a colour channel, in 0–255 units, over a grid of some 5 000 pixels.

    Args:
        pixels: uint8 [H, W, 3].
        mask: pixels that it covers do not count; the contrast is 0 if none is left.
    """
    stride = max(1, min(pixels.shape[:2]) // 64)
    sampled = np.ascontiguousarray(pixels[::stride, ::stride])
    counted = None if mask is None else (~mask.covered(*sampled.shape[:2])).view(np.uint8)
    return float(cv2.meanStdDev(sampled, mask=counted)[1].max())


def second_look(pixels: Pixels) -> Pixels:
    """Imitate a second visit: the frame shifted by 8 % of its width, darker and with less contrast.

    Args:
        pixels: uint8 [H, W, 3].

    Returns:
        uint8 [H, W, 3].
    """
    height, width = pixels.shape[:2]
    aside = pixels[:, round(0.08 * width) :]
    darker = cv2.convertScaleAbs(aside, alpha=0.75, beta=6)
    return np.asarray(cv2.resize(darker, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
