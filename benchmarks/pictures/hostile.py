"""The cost of hostile pictures of at most 16 MiB, by the way of decoding: processor time and peak memory.

    python -m benchmarks.pictures.hostile

Each is decoded in a process of its own, which may take 4 GB and ``LONGEST`` seconds.  Memory is its peak
beyond the memory that it has before.
"""

from __future__ import annotations

import io
import os
import resource
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.pictures.decoders import WAYS, PictureRefused
from benchmarks.process import memory, peak_memory
from benchmarks.report import report

LONGEST, MOST_MEMORY = 60, 4 * 10**9
MOST_BYTES = 16 * 2**20
START = len(b"\x89PNG\r\n\x1a\n") + 25
"""Where the header of a PNG file ends."""


def picture(name: str, side: int = 64, **options: object) -> bytes:
    """A picture of noise."""
    random = np.random.default_rng(0)
    file = io.BytesIO()
    Image.fromarray(random.integers(0, 256, (side, side, 3)).astype(np.uint8)).save(file, name, **options)
    return file.getvalue()


def chunk(kind: bytes, content: bytes) -> bytes:
    """A part of a PNG file."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def filled(start: bytes, part: bytes, end: bytes) -> bytes:
    """As many parts as a file may have between its start and its end."""
    return start + part * ((MOST_BYTES - len(start) - len(end)) // len(part)) + end


def many_segments() -> bytes:
    data = picture("JPEG")
    return filled(data[:2], b"\xff\xe0\0\2", data[2:])


def many_chunks() -> bytes:
    data = picture("PNG")
    return filled(data[:START], chunk(b"teXt", b""), data[START:])


def many_texts() -> bytes:
    data = picture("PNG")
    return filled(data[:START], chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(900_000), 9)), data[START:])


def many_parts() -> bytes:
    data = picture("WEBP", exif=b"Exif\0\0II*\0")
    made = filled(data, b"ABCD\0\0\0\0", b"")
    return b"RIFF" + struct.pack("<I", len(made) - 8) + made[8:]


def many_scans() -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (6300, 6300)).save(file, "JPEG", progressive=True)
    data = file.getvalue()
    at = data.rindex(b"\xff\xda")
    return data[:-2] + data[at:-2] * 300 + data[-2:]


def large_header() -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0))
    rows = zlib.compress(bytes(30_000 * 90_001), 9)
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def exif(length: int) -> bytes:
    """A block whose tags all have the whole block as their value, in fractions."""
    count = min(65_535, (length - 14) // 12)
    tags = b"".join(struct.pack("<HHII", tag, 5, (length - 8) // 8, 8) for tag in range(count))
    return (b"II*\0\x08\0\0\0" + struct.pack("<H", count) + tags + bytes(4)).ljust(length, b"\1")


def tags_of_jpeg() -> bytes:
    data, block = picture("JPEG"), b"Exif\0\0" + exif(65_000)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:]


def tags_of_png() -> bytes:
    data = picture("PNG")
    return data[:START] + chunk(b"eXIf", exif(2**20)) + data[START:]


HOSTILE: dict[str, Callable[[], bytes]] = {
    "JPEG of 4 million segments": many_segments,
    "JPEG of 300 empty scans, 40 megapixels": many_scans,
    "JPEG, 64 KB of overlapping EXIF tags": tags_of_jpeg,
    "PNG of 1.4 million chunks": many_chunks,
    "PNG, texts that unpack to 14 GB": many_texts,
    "PNG of 900 megapixels": large_header,
    "PNG, 1 MB of overlapping EXIF tags": tags_of_png,
    "WebP of 2 million chunks": many_parts,
}


def measure(way: str) -> None:
    """Decode the picture on standard input, and print seconds, memory and the outcome."""
    data = sys.stdin.buffer.read()
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MOST_MEMORY, held + MOST_MEMORY))
    before, began, outcome = memory(os.getpid()), time.process_time(), "decoded"
    try:
        WAYS[way](data)
    except PictureRefused:
        outcome = "refused"
    except MemoryError:
        outcome = "no memory"
    print(time.process_time() - began, max(0, peak_memory(os.getpid()) - before), outcome)


def measured(way: str, data: bytes) -> tuple[float, float, str]:
    """Seconds, memory in MB and outcome of a picture in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.pictures.hostile", way]
    try:
        run = subprocess.run(command, input=data, capture_output=True, timeout=LONGEST + 10)
    except subprocess.TimeoutExpired:
        return float(LONGEST), float("nan"), "still at it"
    if run.returncode:
        return float("nan"), float("nan"), f"ended by {run.returncode}"
    seconds, taken, outcome = run.stdout.decode().split(maxsplit=2)
    return float(seconds), float(taken), outcome.strip()


def main() -> None:
    """Measure, print a table and write JSON."""
    rows, figures = [], {}
    for name, make in HOSTILE.items():
        data = make()
        for way in WAYS:
            seconds, taken, outcome = measured(way, data)
            rows.append([f"{name}: {way}", seconds, round(taken) if taken == taken else "", outcome])
            figures[f"{name}: {way}"] = {"seconds": seconds, "megabytes": taken, "outcome": outcome}
    report("hostile_pictures", "hostile pictures", ["", "processor seconds", "MB", "outcome"], rows, {"ways": figures})


if __name__ == "__main__":
    if len(sys.argv) > 1:
        measure(sys.argv[1])
    else:
        main()
