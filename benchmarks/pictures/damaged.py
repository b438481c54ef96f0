"""Damaged pictures that are taken for sound ones, and sound ones that are refused, by the way of decoding.

    python -m benchmarks.pictures.damaged FOLDER... [--count 300]

JPEG files, as they are and written again in other formats, are damaged in six ways: cut; cut and given an end; one
byte flipped; 64 bytes zeroed; 64 bytes taken out; the header given 16 more rows.  A damaged picture is *wrong* where it
is decoded to other pixels than the same way makes of the sound one.  A way is also given whole pictures with bytes
after their end, and JPEG files with the stray bytes before a marker that cheap cameras write; its refusal of these
counts as sound.  The times are medians of sound pictures, in milliseconds.
"""

from __future__ import annotations

import time
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Annotated

import cv2
import numpy as np
import typer

from benchmarks.pictures.decoders import WAYS, PictureRefused, by_opencv
from benchmarks.report import report
from core.frames.preprocessing import Pixels

WRITTEN: dict[str, tuple[str, list[int]]] = {
    "JPEG": (".jpg", []),
    "progressive JPEG": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "PNG": (".png", []),
    "WebP": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
    "lossless WebP": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
}
LENGTH = 64
"""Bytes that are zeroed or taken out."""


def written(pixels: Pixels, name: str) -> bytes:
    """The file of a picture in a format of WRITTEN."""
    ending, how = WRITTEN[name]
    return bytes(cv2.imencode(ending, pixels, how)[1])


def body(data: bytes, random: np.random.Generator) -> int:
    """A place behind the header."""
    return int(random.integers(min(len(data) // 8 + 32, len(data) - LENGTH - 1), len(data) - LENGTH))


def cut(data: bytes, random: np.random.Generator) -> bytes:
    return data[: body(data, random)]


def cut_and_ended(data: bytes, random: np.random.Generator) -> bytes:
    part = data[: body(data, random)]
    if data.startswith(b"\xff\xd8"):
        return part + b"\xff\xd9"
    if data.startswith(b"RIFF"):  # the sizes of the file and of its only chunk are made right
        part = part[: len(part) // 2 * 2]
        sizes = [(len(part) - before).to_bytes(4, "little") for before in (8, 20)]
        return part[:4] + sizes[0] + part[8:16] + sizes[1] + part[20:]
    at = data.index(b"IDAT") - 4
    chunk = b"IDAT" + part[at + 8 :]
    return data[:at] + (len(chunk) - 4).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big") + data[-12:]


def flipped(data: bytes, random: np.random.Generator) -> bytes:
    place = body(data, random)
    return data[:place] + bytes([data[place] ^ int(random.integers(1, 256))]) + data[place + 1 :]


def zeroed(data: bytes, random: np.random.Generator) -> bytes:
    place = body(data, random)
    return data[:place] + bytes(LENGTH) + data[place + LENGTH :]


def shortened(data: bytes, random: np.random.Generator) -> bytes:
    place = body(data, random)
    return data[:place] + data[place + LENGTH :]


def heightened(data: bytes, random: np.random.Generator) -> bytes:
    """The header announces 16 more rows; a PNG's checksum is made right."""
    changed = bytearray(data)
    if data.startswith(b"\xff\xd8"):
        place = next(at for marker in (b"\xff\xc0", b"\xff\xc2") if (at := data.find(marker)) > 0) + 5
        changed[place : place + 2] = (int.from_bytes(data[place : place + 2], "big") + 16).to_bytes(2, "big")
    elif data.startswith(b"RIFF"):
        if data[12:16] == b"VP8L":
            changed[21:25] = (int.from_bytes(data[21:25], "little") + (16 << 14)).to_bytes(4, "little")
        else:
            changed[28:30] = (int.from_bytes(data[28:30], "little") + 16).to_bytes(2, "little")
    else:
        changed[20:24] = (int.from_bytes(data[20:24], "big") + 16).to_bytes(4, "big")
        changed[29:33] = zlib.crc32(changed[12:29]).to_bytes(4, "big")
    return bytes(changed)


DAMAGES: dict[str, Callable[[bytes, np.random.Generator], bytes]] = {
    "cut": cut,
    "cut, ended": cut_and_ended,
    "flipped": flipped,
    "zeroed": zeroed,
    "shortened": shortened,
    "more rows": heightened,
}


def sound_variants(data: bytes) -> list[bytes]:
    """The picture as it is, with bytes after its end, and with a camera's stray bytes."""
    variants = [data, data + bytes(500)]
    if data.startswith(b"\xff\xd8"):
        for marker in (b"\xff\xd9", b"\xff\xdb"):
            place = data.rindex(marker)
            variants.append(data[:place] + bytes(30) + data[place:])
    return variants


class Tally:
    """The results of one way with the pictures of one format."""

    def __init__(self, way: Callable[[bytes], Pixels]) -> None:
        self._way = way
        self.wrong, self.refused, self.sound = Counter[str](), 0, 0
        self.milliseconds: list[float] = []

    def add(self, data: bytes, damaged: dict[str, bytes]) -> None:
        """Try a sound picture and its damaged copies."""
        began = time.perf_counter()
        whole = self._way(data)
        self.milliseconds.append(1000 * (time.perf_counter() - began))
        for one in sound_variants(data):
            found = self._decoded(one)
            self.sound += 1
            self.refused += found is None or not np.array_equal(found, whole)
        for name, one in damaged.items():
            found = self._decoded(one)
            self.wrong[name] += found is not None and not np.array_equal(found, whole)

    def _decoded(self, data: bytes) -> Pixels | None:
        try:
            return self._way(data)
        except PictureRefused:
            return None


def main(
    folders: list[Path],
    count: Annotated[int, typer.Option(help="Pictures of each format.")] = 300,
    seed: int = 0,
) -> None:
    """Measure, print a table and write JSON."""
    random = np.random.default_rng(seed)
    paths = sorted(path for folder in folders for path in folder.rglob("*.jpg"))
    chosen = [paths[at] for at in random.choice(len(paths), min(count, len(paths)), replace=False)]
    tallies: dict[str, dict[str, Tally]] = defaultdict(lambda: {name: Tally(way) for name, way in WAYS.items()})
    for path in chosen:
        original = path.read_bytes()
        pixels = by_opencv(original)
        files = {name: written(pixels, name) for name in WRITTEN}
        for name, data in {"as they are": original, **files}.items():
            damaged = {kind: damage(data, random) for kind, damage in DAMAGES.items()}
            for tally in tallies[name].values():
                tally.add(data, damaged)
    rows: list[list[object]] = []
    figures: dict[str, dict[str, float]] = {}
    for name, of_ways in tallies.items():
        for way, tally in of_ways.items():
            each, wrong = median(tally.milliseconds), tally.wrong
            rows.append([f"{name}: {way}", *wrong.values(), wrong.total(), f"{tally.refused} / {tally.sound}", each])
            figures[f"{name}: {way}"] = {**wrong, "refused": tally.refused, "sound": tally.sound, "milliseconds": each}
    for way in WAYS:
        total = sum((tallies[name][way].wrong for name in tallies), Counter[str]())
        refused = sum(of_ways[way].refused for of_ways in tallies.values())
        rows.append([f"all: {way}", *(total[kind] for kind in DAMAGES), total.total(), refused, ""])
    columns = ["", *DAMAGES, "wrong", "sound refused", "ms"]
    title = f"wrong pictures of {len(chosen)} of each format and damage"
    report("damaged_pictures", title, columns, rows, {"pictures": len(chosen), "seed": seed, "ways": figures})


if __name__ == "__main__":
    typer.run(main)
