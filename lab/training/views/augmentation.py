"""Photometric augmentations that imitate what changes for a robot's camera between two traverses.

Each takes and returns an H x W x 3 float32 BGR image in 0–1 (values may leave that range between
steps) and draws its strength from the generator.  Geometry is never changed: the teacher sees the
clean crop and both feature maps must stay aligned.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Generator = np.random.Generator


def smooth_field(shape: tuple[int, int], cells: int, generator: Generator) -> Image:
    """A smooth random field in 0–1, H x W, from cells x cells random corners."""
    corners = generator.random((cells, cells), np.float32)
    return np.asarray(cv2.resize(corners, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float32)


def night(image: Image, generator: Generator) -> Image:
    """Darkness: a steep tone curve, lamps with halos, a colour cast, lost colour, sensor noise."""
    height, width = image.shape[:2]
    dark = np.clip(image, 0, 1) ** generator.uniform(1.2, 3.0) * generator.uniform(0.08, 0.6)
    for _ in range(int(generator.integers(0, 6))):
        sigma = generator.uniform(0.01, 0.2) * width
        y = np.arange(height, dtype=np.float32) - generator.uniform(0, height)
        x = np.arange(width, dtype=np.float32) - generator.uniform(0, width)
        lamp = np.outer(np.exp(-0.5 * (y / sigma) ** 2), np.exp(-0.5 * (x / sigma) ** 2)).astype(np.float32)
        colour = np.array([generator.uniform(0.4, 1), generator.uniform(0.7, 1), 1], np.float32)
        # A lamp both lights the scene around it and glares into the lens.
        dark = dark + lamp[..., None] * colour * (
            image * generator.uniform(0, 1.0) + np.float32(generator.uniform(0, 0.5))
        )
    grey = dark.mean(axis=2, keepdims=True)
    dark = grey + (dark - grey) * generator.uniform(0, 1)
    dark = dark * generator.uniform(0.7, 1.3, 3).astype(np.float32)
    dark = dark + generator.standard_normal(dark.shape, np.float32) * generator.uniform(0, 0.06)
    if generator.random() < 0.5:  # automatic gain brings the noise up with the scene
        dark = dark * min(6.0, 0.4 / (float(dark.mean()) + 0.02)) ** generator.random()
    return dark


def exposure(image: Image, generator: Generator) -> Image:
    """Gain, contrast about the mean and gamma."""
    image = np.clip(image, 0, 1) ** math.exp(generator.uniform(-0.7, 0.7))
    mean = image.mean()
    image = mean + (image - mean) * generator.uniform(0.4, 1.6)
    return image * math.exp(generator.uniform(-0.6, 0.6))


def local_light(image: Image, generator: Generator) -> Image:
    """Sun and shade: a smooth gain of up to four times between parts of the frame."""
    field = smooth_field(image.shape[:2], int(generator.integers(2, 6)), generator)
    return image * np.exp((field[..., None] - 0.5) * generator.uniform(0.5, 3.0))


def shadow(image: Image, generator: Generator) -> Image:
    """A hard-edged shadow: one side of a random line is darker."""
    height, width = image.shape[:2]
    angle, offset = generator.uniform(0, 2 * np.pi), generator.uniform(-0.3, 0.3)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    side = np.cos(angle) * (x / width - 0.5) + np.sin(angle) * (y / height - 0.5) - offset
    mask = np.clip(side * generator.uniform(10, 100) + 0.5, 0, 1).astype(np.float32)
    return image * (1 - mask[..., None] * generator.uniform(0.3, 0.8))


def colour(image: Image, generator: Generator) -> Image:
    """Colour balance and saturation; one time in three the camera is grey."""
    grey = image @ np.array([0.114, 0.587, 0.299], np.float32)
    if generator.random() < 0.35:
        return np.repeat(grey[..., None], 3, axis=2)
    image = image * generator.uniform(0.7, 1.35, 3).astype(np.float32)
    return grey[..., None] + (image - grey[..., None]) * generator.uniform(0, 1.6)


def haze(image: Image, generator: Generator) -> Image:
    """Fog or rain: the frame fades towards a pale grey, more at the top."""
    depth = np.linspace(1, generator.uniform(0.2, 1), image.shape[0], dtype=np.float32)[:, None, None]
    amount = depth * generator.uniform(0.15, 0.75)
    return image * (1 - amount) + amount * generator.uniform(0.5, 1)


def snow(image: Image, generator: Generator) -> Image:
    """Snow on the ground and on ledges: patches turn white, more so in the lower part."""
    height = image.shape[0]
    field = smooth_field(image.shape[:2], int(generator.integers(3, 9)), generator)
    low = np.linspace(generator.uniform(-0.5, 0.2), generator.uniform(0.2, 0.8), height, dtype=np.float32)
    cover = np.clip((field + low[:, None] - 0.5) * generator.uniform(2, 8), 0, 1)[..., None]
    grey = image.mean(axis=2, keepdims=True)
    white = np.float32(generator.uniform(0.6, 0.95)) + (grey - grey.mean()) * generator.uniform(0.1, 0.5)
    return image * (1 - cover) + white * cover


def foliage(image: Image, generator: Generator) -> Image:
    """Season: hues turn in the colour circle where the picture is colourful."""
    hsv = np.asarray(cv2.cvtColor(np.clip(image, 0, 1), cv2.COLOR_BGR2HSV), np.float32)
    hsv[..., 0] = (hsv[..., 0] + generator.uniform(-70, 70)) % 360
    hsv[..., 1] *= np.float32(generator.uniform(0.3, 1.3))
    return np.asarray(cv2.cvtColor(np.clip(hsv, 0, (360, 1, 1)).astype(np.float32), cv2.COLOR_HSV2BGR))


def blur(image: Image, generator: Generator) -> Image:
    """Defocus, motion, or a coarser sensor."""
    kind = generator.integers(0, 3)
    if kind == 0:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), generator.uniform(0.4, 2.2)))
    if kind == 1:
        length = int(generator.integers(3, 12))
        kernel = np.zeros((length, length), np.float32)
        turn = cv2.getRotationMatrix2D(((length - 1) / 2, (length - 1) / 2), generator.uniform(0, 180), 1)
        kernel[length // 2] = 1
        kernel = np.asarray(cv2.warpAffine(kernel, turn, (length, length)), np.float32)
        return np.asarray(cv2.filter2D(image, -1, kernel / max(float(kernel.sum()), 1e-3)))
    height, width = image.shape[:2]
    factor = generator.uniform(0.25, 0.8)
    small = cv2.resize(image, (int(width * factor), int(height * factor)), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))


def noise(image: Image, generator: Generator) -> Image:
    """Sensor noise: a constant part and a part that grows with the signal."""
    signal = np.sqrt(np.clip(image, 0, 1))
    sigma = generator.uniform(0, 0.05) + signal * generator.uniform(0, 0.08)
    return image + generator.standard_normal(image.shape, np.float32) * sigma.astype(np.float32)


def occlusion(image: Image, generator: Generator) -> Image:
    """Vehicles and people: one to three boxes or ellipses of another texture."""
    image = image.copy()
    height, width = image.shape[:2]
    for _ in range(int(generator.integers(1, 4))):
        h, w = (int(side * generator.uniform(0.08, 0.4)) for side in (height, width))
        top, left = int(generator.integers(0, height - h)), int(generator.integers(0, width - w))
        texture = smooth_field((h, w), int(generator.integers(2, 8)), generator)[..., None]
        patch = generator.random(3, np.float32) * (0.5 + texture * generator.uniform(0, 1))
        mask = np.zeros((h, w, 1), np.float32)
        if generator.random() < 0.5:
            mask[:] = 1
        else:
            cv2.ellipse(mask, (w // 2, h // 2), (w // 2, h // 2), 0, 0, 360, (1.0,), -1)
        window = image[top : top + h, left : left + w]
        image[top : top + h, left : left + w] = window * (1 - mask) + patch * mask
    return image


def compression(image: Image, generator: Generator) -> Image:
    """The blocks of a strongly compressed JPEG."""
    quality = int(generator.integers(12, 60))
    pixels = (np.clip(image, 0, 1) * 255).astype(np.uint8)
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.float32) / np.float32(255)


# Applied in this order, each with its probability: light first, then air, then lens, then sensor.
STEPS: tuple[tuple[float, Callable[[Image, Generator], Image]], ...] = (
    (0.15, foliage),
    (0.12, snow),
    (0.25, occlusion),
    (0.25, shadow),
    (0.45, local_light),
    (0.40, night),
    (0.12, haze),
    (0.60, exposure),
    (0.50, colour),
    (0.40, blur),
    (0.50, noise),
    (0.25, compression),
)


def augment(pixels: NDArray[np.uint8], generator: Generator) -> NDArray[np.uint8]:
    """An H x W x 3 uint8 BGR picture as another camera, hour, weather or season might show it."""
    image: Image = pixels.astype(np.float32) / np.float32(255)
    for probability, step in STEPS:
        if generator.random() < probability:
            image = step(image, generator)
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)
