"""Damaged, cut and hostile bags: how many frames ``core.recordings`` and the libraries read of them, and at what cost.

    python -m benchmarks.recordings.damaged_bags

Each kind of bag is cut at many places, and in copies of it one bit is turned over.  Of the frames that a reader gives,
those count that are equal to the written ones; *wrong* ones are pictures that nobody wrote.  The readers of rosbags and
mcap are judged by their frames before their first error.  Hostile bags are small files that unpack to 1.5 GB; each is
read in a process of its own, whose peak memory counts.
"""

from __future__ import annotations

import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

import lz4.frame
import numpy as np
import typer
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from rosbags.highlevel import AnyReader

from benchmarks.process import ROOT
from benchmarks.report import report
from core.errors import PlacerecError
from core.recordings import open_recording
from tests.core.recordings.bags import CAMERA, ROS1, ROS2, START, WRITERS, compressed, walk, write_mcap, write_ros1

KINDS = ("sqlite-file-alone", "mcap-zstd", "mcap-lz4", "mcap-plain", "mcap-no-chunks", "ros1", "ros1-bz2", "ros1-lz4")
BOMB = 3 << 29
"""Bytes to which the chunk of a hostile bag unpacks: one record of a kind that nobody knows, of zeros."""

Reader = Callable[[Path], Iterator[bytes]]


def by_recordings(path: Path) -> Iterator[bytes]:
    """The frames that ``core.recordings`` gives; one that cannot be loaded is skipped."""
    with open_recording(path) as recording:
        for frame in recording.frames:
            try:
                yield frame.load()
            except PlacerecError:
                continue


def by_rosbags(path: Path) -> Iterator[bytes]:
    """The frames that rosbags gives before its first error."""
    with AnyReader([path], default_typestore=ROS1 if path.suffix == ".bag" else ROS2) as reader:
        chosen = [one for one in reader.connections if one.topic == CAMERA]
        for connection, _, raw in reader.messages(chosen) if chosen else ():
            message: Any = reader.deserialize(raw, connection.msgtype)
            yield bytes(message.data)


def by_mcap(path: Path) -> Iterator[bytes]:
    """The frames that mcap gives before its first error: by the index, or without one from the beginning."""
    with path.open("rb") as file:
        try:
            make_reader(file).get_summary()
            reader: Any = make_reader(file)
        except Exception:  # of cut or damaged files, mcap raises any error of its parsers
            file.seek(0)
            reader = NonSeekingReader(file)
        for _, _, message in reader.iter_messages(CAMERA, log_time_order=False):
            pictured: Any = ROS2.deserialize_cdr(message.data, "sensor_msgs/msg/CompressedImage")
            yield bytes(pictured.data)


READERS: dict[str, Reader] = {"recordings": by_recordings, "rosbags": by_rosbags, "mcap": by_mcap}


def tried(reader: Reader, path: Path, written: set[bytes]) -> Counter[str]:
    """The outcome of reading a damaged bag."""
    began, given, found = time.perf_counter(), set[bytes](), Counter[str]()
    try:
        for data in reader(path):
            given.add(data)
    except PlacerecError:
        found["refused"] = 1
    except Exception as error:
        found["other errors"] = 1
        if reader is by_recordings:
            print(path.name, repr(error), file=sys.stderr)
    found["frames"] = len(given & written)
    found["wrong"] = len(given - written)
    found["slowest, ms"] = round(1e3 * (time.perf_counter() - began))
    return found


def damaged(whole: bytes, cuts: int, flips: int) -> Iterator[tuple[str, bytes]]:
    """Copies of a file, cut at places a step apart or with one bit turned over, and which of both."""
    for number in range(1, cuts + 1):
        yield "cut", whole[: len(whole) * number // (cuts + 1)]
    random = np.random.default_rng(7)
    for place, bit in zip(random.integers(len(whole), size=flips), random.integers(8, size=flips), strict=True):
        copy = bytearray(whole)
        copy[place] ^= 1 << bit
        yield "bit", bytes(copy)


def hostile(folder: Path, size: int = BOMB) -> dict[str, Path]:
    """Small files whose one chunk unpacks to ``size`` bytes; those of MCAP say that it has a thousand."""
    zeros = b"\x80" + (size - 9).to_bytes(8, "little") + bytes(size - 9)
    said = [compressed(START, bytes(1000))]
    made = {}
    for form, packed in (("zstd", zstandard.compress(zeros)), ("lz4", lz4.frame.compress(zeros))):
        path = write_mcap(folder / f"{form}.mcap", said, CompressionType[form.upper()])
        path.write_bytes(_with_chunk_of_mcap(path.read_bytes(), packed))
        made[f"mcap-{form}"] = path
    path = write_ros1(folder / "lz4.bag", said, "lz4")
    path.write_bytes(_with_chunk_of_ros1(path.read_bytes(), lz4.frame.compress(zeros)))
    return made | {"ros1-lz4": path}


def _with_chunk_of_mcap(whole: bytes, packed: bytes) -> bytes:
    """The file up to its chunk, and another chunk in its place; the index, which would not fit, is left out."""
    stream = BytesIO(whole)
    place = 8
    for record in StreamReader(stream, emit_chunks=True).records:
        if isinstance(record, Chunk):
            builder: Any = RecordBuilder()
            Chunk(record.compression, packed, 0, 0, 0, 1000).write(builder)
            return whole[:place] + bytes(builder.end())
        place = stream.tell()
    raise ValueError("no chunk")


def _with_chunk_of_ros1(whole: bytes, packed: bytes) -> bytes:
    """The file with another chunk after its first header, and its index behind it."""
    start = whole.index(b"\x04\x22\x4d\x18") - 4
    size = int.from_bytes(whole[start : start + 4], "little")
    rest, index = whole[start + 4 + size :], re.search(rb"index_pos=(.{8})", whole, re.DOTALL)
    assert index is not None
    moved = int.from_bytes(index[1], "little") + len(packed) - size
    head = whole[: index.start(1)] + moved.to_bytes(8, "little") + whole[index.end(1) : start]
    return head + len(packed).to_bytes(4, "little") + packed + rest


def peak(reader: str, path: Path) -> str:
    """The most memory of a process that reads a bag, MB, and how that ends."""
    program = (
        "import re, sys; from pathlib import Path; from benchmarks.recordings.damaged_bags import READERS\n"
        "try:\n    end = str(len(list(READERS[sys.argv[1]](Path(sys.argv[2]))))) + ' frames'\n"
        "except Exception as error:\n    end = type(error).__name__\n"
        "most = int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])\n"
        "print(round(1.024e-3 * most), 'MB:', end)"
    )
    done = subprocess.run([sys.executable, "-c", program, reader, str(path)], cwd=ROOT, capture_output=True, text=True)
    return done.stdout.strip() or f"killed ({done.returncode})"


def main(
    frames: Annotated[int, typer.Option(min=4)] = 60,
    cuts: Annotated[int, typer.Option(min=1)] = 40,
    flips: Annotated[int, typer.Option(min=1)] = 200,
) -> None:
    """Sums over the damages of each kind of bag, and peaks over hostile ones."""
    resource.setrlimit(resource.RLIMIT_AS, (16 << 30, resource.getrlimit(resource.RLIMIT_AS)[1]))
    said = walk(frames)
    rows: list[list[Any]] = []
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:
            home = Path(folder) / kind
            home.mkdir()
            path = WRITERS[kind](home, said)
            whole, written = path.read_bytes(), set(by_recordings(path))
            for name, reader in READERS.items():
                if name == "mcap" and path.suffix != ".mcap":
                    continue
                sums: dict[str, Counter[str]] = {}
                for damage, data in damaged(whole, cuts, flips):
                    path.write_bytes(data)
                    found, total = tried(reader, path, written), sums.setdefault(damage, Counter())
                    slowest = max(total.pop("slowest, ms", 0), found.pop("slowest, ms"))
                    total += found
                    sums[damage] = total
                    total["slowest, ms"] = slowest
                for damage, total in sums.items():
                    figures[f"{kind}, {name}, {damage}"] = total
                    most = len(written) * (cuts if damage == "cut" else flips)
                    columns = ("wrong", "refused", "other errors", "slowest, ms")
                    given = f"{total['frames']} / {most}"
                    rows.append([f"{kind}, {damage}", name, given, *(total[column] for column in columns)])
        for kind, path in hostile(Path(folder)).items():
            for name in READERS:
                if name != "mcap" or path.suffix == ".mcap":
                    figures[f"hostile {kind}, {name}"] = end = peak(name, path)
                    rows.append([f"hostile {kind} of {path.stat().st_size} bytes", name, end, "", "", "", ""])
    report(
        "damaged_bags",
        f"Frames of {frames}-frame bags, {cuts} cuts and {flips} turned bits each; of hostile bags the peak in MB",
        ("bag", "reader", "frames", "wrong", "refused", "other errors", "slowest, ms"),
        rows,
        {"frames": frames, "cuts": cuts, "flips": flips, "figures": figures},
    )


if __name__ == "__main__":
    typer.run(main)
