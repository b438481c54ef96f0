"""XFeat: a small network of local features (Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching",
CVPR 2024), in its sparse mode.

A frame becomes three maps: how likely each pixel is a keypoint, how reliable the surroundings of a pixel are, and a
descriptor of 64 values for each cell of eight by eight pixels.  The packaged graph, operators and weights, is made by
``python -m lab.conversion.xfeat``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from core.networks.forward import GraphRunner
from core.networks.onnx_graph import check_graph, read_graph

FORMAT = "placerec-xfeat/2"
NAME = "xfeat"
PACKAGED_XFEAT = Path(__file__).parents[1] / "models" / "xfeat.onnx"
CELL = 8
"""Pixels a side of a cell: the maps of descriptors and of reliability have one value for each."""
MULTIPLE = 32
"""Both sides of a frame are multiples of this many pixels, so that the levels of the pyramid lie on one another."""
LENGTH = 64
"""Values of a descriptor."""

Array = NDArray[np.float32]


@dataclass(frozen=True)
class FeatureMaps:
    """The output of the network for a frame of H x W pixels.

    heat: float32 [H, W], the probability within its cell that a pixel is the cell's keypoint, in [0, 1].
    reliability: float32 [H / 8, W / 8], in [0, 1].
    descriptors: float32 [H / 8, W / 8, 64], of unit length.
    """

    heat: Array
    reliability: Array
    descriptors: Array


class XFeat:
    """The network, computed by ONNX Runtime.  Thread-safe.

    Args:
        graph: in the ONNX format, with its weights and the property ``format`` of ``FORMAT``.

    Raises:
        InvalidModel: the graph is damaged or of another format.
    """

    def __init__(self, graph: bytes) -> None:
        model = read_graph(graph)
        if FORMAT not in [held.value for held in model.metadata_props if held.key == "format"]:
            raise InvalidModel(f"It is not a {FORMAT} file.")
        check_graph(model)
        self._run = GraphRunner(NAME, graph)

    def __call__(self, pixels: Pixels) -> FeatureMaps:
        """The maps of a frame.

        Args:
            pixels: uint8 [H, W, 3], both sides multiples of ``MULTIPLE``; the order of the channels does not matter.

        Raises:
            InvalidModel: a side is not a multiple of ``MULTIPLE``.
        """
        height, width = pixels.shape[:2]
        if height % MULTIPLE or width % MULTIPLE or not height or not width:
            raise InvalidModel(f"{NAME!r} needs sides that are multiples of {MULTIPLE}, not {height} x {width}")
        heat, reliability, descriptors = self._run({"image": np.ascontiguousarray(pixels)})
        return FeatureMaps(heat, reliability, descriptors)


def load_xfeat(path: Path = PACKAGED_XFEAT) -> XFeat:
    """Read the network from its file.

    Raises:
        InvalidModel: the file is missing, damaged or of another format.
    """
    try:
        return XFeat(path.read_bytes())
    except OSError as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} cannot be used: {error}") from error


@cache
def packaged_xfeat() -> XFeat:
    """The packaged network, which is loaded once; this takes a tenth of a second.  Thread-safe.

    Raises:
        InvalidModel: its file is missing or damaged.
    """
    return load_xfeat()
