"""Sound pictures in all variants of the three formats, which the mutations start from."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from tests.service.scenes import scene

FROM_DATASETS = 12
"""Camera frames taken from a directory of datasets, where there is one."""

MOST_BYTES = 200_000


@dataclass(frozen=True)
class Original:
    """A file, its format (jpeg, png, webp) and a name that says how it was made."""

    name: str
    format: str
    data: bytes


def originals(datasets: Path | None = None) -> tuple[Original, ...]:
    """All of them, always in the same order.

    Args:
        datasets: directory searched for JPEG files besides those that are drawn; None for none.
    """
    return (*_drawn(), *(_photographed(datasets) if datasets is not None else ()))


@cache
def _drawn() -> tuple[Original, ...]:
    return tuple(_jpegs()) + tuple(_pngs()) + tuple(_webps())


def _photographed(datasets: Path) -> Iterator[Original]:
    found = sorted(path for path in datasets.rglob("*.jpg") if path.stat().st_size <= MOST_BYTES)
    for path in found[:: max(1, len(found) // FROM_DATASETS)][:FROM_DATASETS]:
        yield Original(f"photograph-{path.stem}", "jpeg", path.read_bytes())


def picture(seed: int, mode: str = "RGB", width: int = 160, height: int = 120) -> Image.Image:
    """A drawn scene in one of Pillow's modes."""
    drawn = scene(seed, max(width, 64), max(height, 64))[:height, :width, ::-1]
    return Image.fromarray(np.ascontiguousarray(drawn)).convert(mode)


def saved(image: Image.Image, name: str, **options: Any) -> bytes:
    """The bytes of a file."""
    file = io.BytesIO()
    image.save(file, name, **options)
    return file.getvalue()


def exif_block(orientation: int = 6) -> bytes:
    """An EXIF block such as a telephone writes: orientation, time, position."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif[0x010F] = "drawn"
    exif.get_ifd(0x8769).update({0x9003: "2024:02:29 23:59:59", 0x9011: "+01:00"})
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 22.0, 1.5), 3: "E", 4: (8.0, 32.0, 2.0), 17: 90.5, 16: "T"})
    return bytes(exif.tobytes())


def _jpegs() -> Iterator[Original]:
    kinds: dict[str, tuple[Image.Image, dict[str, Any]]] = {
        "baseline": (picture(0), {"quality": 80}),
        "unsubsampled": (picture(1), {"quality": 90, "subsampling": 0}),
        "coarse": (picture(2), {"quality": 10}),
        "progressive": (picture(3), {"quality": 80, "progressive": True}),
        "restarts": (picture(4), {"quality": 80, "restart_marker_blocks": 4}),
        "progressive-restarts": (picture(5), {"progressive": True, "restart_marker_rows": 1}),
        "grey": (picture(6, "L"), {"quality": 80}),
        "cmyk": (picture(7, "CMYK"), {"quality": 80}),
        "exif": (picture(8), {"quality": 80, "exif": exif_block()}),
        "tables": (picture(9), {"quality": 80, "optimize": True, "comment": b"drawn", "dpi": (72, 72)}),
        "odd": (picture(10, "RGB", 161, 97), {"quality": 75}),
        "least": (picture(11, "RGB", 16, 16), {"quality": 75}),
        "wide": (picture(12, "RGB", 640, 24), {"quality": 75}),
        "colours": (picture(13), {"icc_profile": bytes(range(256)) * 12}),
    }
    for name, (image, options) in kinds.items():
        yield Original(f"jpeg-{name}", "jpeg", saved(image, "JPEG", **options))


def _pngs() -> Iterator[Original]:
    for number, mode in enumerate(("1", "L", "LA", "P", "RGB", "RGBA")):
        yield Original(f"png-{mode.lower()}", "png", saved(picture(20 + number, mode), "PNG"))
    grey = np.asarray(picture(26, "L")).astype(np.uint16) * 257
    yield Original("png-deep-grey", "png", cv2.imencode(".png", grey)[1].tobytes())
    yield Original("png-transparent", "png", saved(picture(30, "P"), "PNG", transparency=3))
    yield Original("png-exif", "png", saved(picture(31), "PNG", exif=exif_block(), dpi=(72, 72)))
    yield Original("png-few-colours", "png", saved(picture(32).quantize(4), "PNG", bits=2))
    yield Original("png-colours", "png", saved(picture(33), "PNG", icc_profile=bytes(range(256)) * 4))
    deep = np.random.default_rng(0).integers(0, 65536, (60, 80, 3)).astype(np.uint16)
    yield Original("png-deep", "png", cv2.imencode(".png", deep)[1].tobytes())


def _webps() -> Iterator[Original]:
    kinds: dict[str, tuple[Image.Image, dict[str, Any]]] = {
        "lossy": (picture(40), {"quality": 70}),
        "lossless": (picture(41), {"lossless": True}),
        "alpha": (_with_alpha(42), {"quality": 70}),
        "lossless-alpha": (_with_alpha(43), {"lossless": True}),
        "exif": (picture(44), {"quality": 70, "exif": exif_block()}),
        "xmp": (picture(45), {"quality": 70, "xmp": b"<x:xmpmeta/>" * 20}),
        "animated": (picture(46), {"save_all": True, "append_images": [picture(47), picture(48)]}),
    }
    for name, (image, options) in kinds.items():
        yield Original(f"webp-{name}", "webp", saved(image, "WEBP", **options))


def _with_alpha(seed: int) -> Image.Image:
    image = picture(seed, "RGBA")
    image.putalpha(picture(seed + 100, "L"))
    return image
