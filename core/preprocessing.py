"""From colour pixels to the network's input (thesis, section 4.3: the frame is resized whole)."""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

Pixels = NDArray[np.uint8]
Number = Annotated[float, Field(allow_inf_nan=False)]

INTERPOLATION = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA}


class InputDefinition(BaseModel):
    """What a network wants to see: ``(pixels - mean) * scale`` at its own size.

    ``mean`` (0–255 units) and ``scale`` are in the channel order of the network.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    height: int = Field(ge=16, le=4096)
    width: int = Field(ge=16, le=4096)
    channel_order: Literal["bgr", "rgb"] = "bgr"
    mean: tuple[Number, Number, Number]
    scale: tuple[Number, Number, Number] = (1.0, 1.0, 1.0)
    resize: Literal["linear", "area"] = "linear"


def prepare(pixels: Pixels, definition: InputDefinition) -> NDArray[np.float32]:
    """One frame as network input.

    The whole frame is resized without a crop; its aspect ratio is not kept (method, section 1).

    Args:
        pixels: H x W x 3 uint8, BGR.

    Returns:
        height x width x 3 float32 in the network's channel order.
    """
    size = (definition.width, definition.height)
    if pixels.shape[1::-1] != size:
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=INTERPOLATION[definition.resize]), np.uint8)
    if definition.channel_order == "rgb":
        pixels = pixels[:, :, ::-1]
    centred = np.subtract(pixels, np.array(definition.mean, np.float32), dtype=np.float32)
    return np.multiply(centred, np.array(definition.scale, np.float32), out=centred)


def contrast(pixels: Pixels) -> float:
    """The largest standard deviation of a colour channel, in 0–255 units, over a grid of some 5 000 pixels.

    Args:
        pixels: H x W x 3 uint8.
    """
    stride = max(1, min(pixels.shape[:2]) // 64)
    return float(pixels[::stride, ::stride].reshape(-1, 3).std(axis=0).max())
