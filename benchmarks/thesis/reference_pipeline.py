"""The thesis's pipeline as one writes it from its text: the reference for ours.

FROZEN.  This file is never changed again: the speed of encoding is quoted as a multiple of this code.  The network is
torch's own pass; regions come from ``reference_regions``, map by map and region by region (eqs. 4.1–4.5); the VLAD
takes one regional feature after the other (eqs. 4.7–4.11).
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.thesis.reference_regions import reference_regions


def reference_vlad(features: NDArray[np.float32], centers: NDArray[np.float32]) -> NDArray[np.float32]:
    """Assignment, residuals, power of a half and intra-normalization, one feature and one word at a time.

    Args:
        features: float32 [T, K].
        centers: float32 [V, K].

    Returns:
        float32 [V, K].
    """
    vlad = np.zeros_like(centers)
    for feature in features:
        nearest = int(np.argmin(np.linalg.norm(centers - feature, axis=1)))
        vlad[nearest] += feature - centers[nearest]
    for word in range(len(vlad)):
        vlad[word] = np.sign(vlad[word]) * np.sqrt(np.abs(vlad[word]))
        norm = np.linalg.norm(vlad[word])
        if norm > 0:
            vlad[word] /= norm
    return vlad


def reference_encode(
    data: bytes,
    network: Callable[[torch.Tensor], tuple[torch.Tensor, ...]],
    size: tuple[int, int],
    mean: tuple[float, float, float],
    scale: tuple[float, float, float],
    step: float,
    count: int,
    centers: NDArray[np.float32],
) -> NDArray[np.float32]:
    """A JPEG to its M-Region-VLAD.

    Args:
        network: 1 x 3 x H x W to the rectified maps of the layers that are fused, 1 x K x X x Y each.
        size: width and height of its input.
        mean, scale: of its input, by channel in the order BGR.
        step: quantisation step of every layer.
        count: N, regions of each layer.
        centers: float32 [V, K].

    Returns:
        float32 [V·K].
    """
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError("not a JPEG")
    resized = cv2.resize(pixels, size).astype(np.float32)
    image = ((resized - np.array(mean, np.float32)) * np.array(scale, np.float32)).transpose(2, 0, 1)
    with torch.no_grad():
        maps = network(torch.from_numpy(np.ascontiguousarray(image))[None])
    features = [reference_regions(layer[0].numpy(), step, count)[2] for layer in maps]
    return reference_vlad(np.concatenate(features), centers).reshape(-1)
