"""Damaged files of every kind that is read, each in a fork of its own under limits of memory and time.

A reader returns, or raises a refusal of its own.  Anything else is wrong: another error, a process that ends, more
memory than it may have, or no end.  Libraries that read other people's networks may end their process, for they never
run in that of the user; what did is given to the real reader, which has to refuse it.

The same seed and number always give the same bytes.  Files that once were wrong are in ``corpus``, by kind, and are
originals like those that are written here.
"""

from __future__ import annotations

import importlib
import logging
import os
import random
import resource
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.recordings.damaged_bags import by_recordings
from core.errors import InvalidCursor, InvalidModel, PlacerecError
from core.maps import MapSettings
from core.maps.archives.reading import Archive, check
from core.maps.pagination import decode_name, decode_number, encode_cursor
from core.store import Directory
from lab.conversion.caffemodel import read_caffemodel
from lab.conversion.checkpoints import read_checkpoint
from lab.conversion.isolation import address_space, convert
from lab.conversion.matfiles import read_mat
from lab.conversion.onnx_import import import_onnx
from service.errors.faults import Fault
from service.http.multipart import FormReader
from tests.core.recordings.bags import WRITERS, walk
from tests.core.store.archives.conftest import filled
from tests.core.store.archives.files import changed, exported, imported
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE
from tests.lab.conversion.hostile import damaged
from tests.lab.conversion.onnx_writer import MAPS
from tests.lab.conversion.test_isolation import write_caffemodels, write_checkpoints, write_mats, write_onnx

CORPUS = Path(__file__).with_name("corpus")

SPARE, LONGEST = 1 << 30, 30
"""Bytes of memory, and seconds, that one file may take."""

REFUSALS = (PlacerecError, Fault)


@dataclass(frozen=True)
class Original:
    """A sound file: its name, whose ending a reader may look at, and its bytes."""

    name: str
    data: bytes


Damage = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True)
class Kind:
    """One kind of files.

    write: writes originals into an empty folder.
    read: reads a file, in a fork.
    damage: makes a damaged file of a sound one.
    isolated: reads a file as users have it read, where ``read`` may end the process; None: it may not.
    """

    write: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
    damage: Damage = damaged
    isolated: Callable[[Path], object] | None = None

    def originals(self, name: str, folder: Path) -> list[Original]:
        """The sound files, and those of the corpus."""
        folder.mkdir()
        found = [Original(path.name, path.read_bytes()) for path in self.write(folder)]
        kept = sorted((CORPUS / name).iterdir()) if (CORPUS / name).is_dir() else []
        return found + [Original(path.name, path.read_bytes()) for path in kept]


# Maps


def _write_archive(folder: Path) -> list[Path]:
    atlas = Directory(folder / "data", rows_per_segment=4)
    try:
        made = filled(atlas.create("lab", ENCODER, DIMENSION, MapSettings(), local_shape=LOCAL_SHAPE))
        content = exported(made, folder / "whole")
    finally:
        atlas.close()
    (folder / "map.tar").write_bytes(content)
    return [folder / "map.tar"]


def _damage_archive(sound: bytes, chance: random.Random) -> bytes:
    """Half of the time one part is damaged and the file is sealed anew, so that what it says comes to be read."""
    if chance.random() < 0.5:
        return damaged(sound, chance)

    def change(_manifest: dict[str, Any], parts: dict[str, bytes]) -> None:
        name = chance.choice(sorted(parts))
        parts[name] = damaged(parts[name], chance) if parts[name] else parts[name]

    return changed(sound, change)


def _read_archive(path: Path) -> None:
    """What is taken is a map that is as its checksums say."""
    with TemporaryDirectory(dir=path.parent) as folder:
        with Archive(path) as archive:
            check(archive)
        atlas = Directory(Path(folder))
        try:
            found = imported(atlas, path, "taken")
            report = found.verify()
            assert report.ok or "image" in str(report.problems), report.problems
            found.places(None, 100)
        finally:
            atlas.close()


# Recordings


def _write_bags(folder: Path) -> list[Path]:
    found = []
    for name, write in WRITERS.items():
        (folder / name).mkdir()
        path = write(folder / name, walk(4))
        found += [path] if path.is_file() else sorted(path.glob("*.db3")) + sorted(path.glob("*.mcap"))
    return found


def _read_bag(path: Path) -> None:
    for _ in by_recordings(path):
        pass


# Texts and forms

FORM = (
    b'--b\r\nContent-Disposition: form-data; name="places"\r\nContent-Type: application/json\r\n\r\n[{"id": "p"}]\r\n'
    b'--b\r\nContent-Disposition: form-data; name="a"; filename="x.png"\r\nContent-Type: image/png\r\n\r\n'
    b"xyz\r\n--b--\r\n"
)


def _write_text(texts: dict[str, bytes], folder: Path) -> list[Path]:
    for name, text in texts.items():
        (folder / name).write_bytes(text)
    return [folder / name for name in texts]


def _read_form(path: Path) -> None:
    logging.getLogger("python_multipart").setLevel(logging.CRITICAL)  # it says what it refuses
    body = path.read_bytes()
    for size in (1, 7, len(body) or 1):
        reader = FormReader("multipart/form-data; boundary=b", 4, 1000)
        for start in range(0, len(body), size):
            reader.feed(body[start : start + size])
        assert len(reader.close()) <= 4


def _read_cursor(path: Path) -> None:
    text = path.read_bytes().decode("latin-1")
    refused = 0
    for read in (decode_number, decode_name):
        try:
            read(["places", "lab", None], text)
        except InvalidCursor:
            refused += 1
    if refused == 2:
        raise InvalidCursor("It is refused.")


# Networks


def _convert(module: str, arguments: tuple[str, ...], path: Path) -> None:
    reader = importlib.import_module(module)
    convert(reader._read, reader.save_file, path, path.with_name("contents"), *arguments)


def _network(write: Callable[[Path], list[Path]], read: Callable[[Path], object], module: str, *arguments: str) -> Kind:
    return Kind(write, partial(_convert, f"lab.conversion.{module}", arguments), isolated=read)


KINDS = {
    "archives": Kind(_write_archive, _read_archive, _damage_archive),
    "bags": Kind(_write_bags, _read_bag),
    "onnx": _network(write_onnx, lambda path: import_onnx(path, MAPS), "onnx_import", MAPS.model_dump_json()),
    "checkpoints": _network(write_checkpoints, read_checkpoint, "checkpoints"),
    "matfiles": _network(write_mats, read_mat, "matfiles"),
    "caffemodels": _network(write_caffemodels, read_caffemodel, "caffemodel", "network"),
    "forms": Kind(partial(_write_text, {"form": FORM}), _read_form),
    "cursors": Kind(
        partial(
            _write_text,
            {"number": encode_cursor(["places", "lab", None], 7).encode(), "name": encode_cursor(["x"], "y").encode()},
        ),
        _read_cursor,
    ),
}


@dataclass
class Report:
    """How files ended, and what was wrong with some: their numbers and why."""

    ends: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


def run(name: str, seed: int, numbers: Iterator[int], seconds: float, out: Path) -> Report:
    """Damage files of a kind by number, and have each read, until the numbers or the seconds are over.

    Args:
        out: gets the files that were wrong.
    """
    kind, report, end = KINDS[name], Report(), time.monotonic() + seconds
    with TemporaryDirectory(prefix="placerec-fuzz-") as temporary:
        folder = Path(temporary)
        originals = kind.originals(name, folder / "originals")
        for one in originals:  # what a reader imports only when it reads
            _sound(kind, folder, one)
        for number in numbers:
            if time.monotonic() >= end:
                break
            chance = random.Random(f"{seed}/{number}")
            original = chance.choice(originals)
            path = folder / f"damaged-{original.name}"
            path.write_bytes(kind.damage(original.data, chance))
            ending, why = _ending(kind.read, path)
            if ending == "killed" and kind.isolated is not None:
                ending, why = _refused(kind.isolated, path)
            report.ends[ending] += 1
            if ending in ("killed", "wrong"):
                out.mkdir(parents=True, exist_ok=True)
                (out / f"{name}-{seed}-{number}-{original.name}").write_bytes(path.read_bytes())
                report.wrong.append(f"{name} {seed}/{number} ({original.name}): {why}")
    return report


def _sound(kind: Kind, folder: Path, one: Original) -> None:
    path = folder / f"sound-{one.name}"
    path.write_bytes(one.data)
    with suppress(*REFUSALS):  # of the corpus
        kind.read(path)


def _ending(read: Callable[[Path], object], path: Path) -> tuple[str, str]:
    """How a fork that reads a file ends, and why: "read", "refused", "wrong", or "killed", also for want of memory."""
    said, saying = os.pipe()
    process = os.fork()
    if not process:
        os.close(said)
        status, why = 0, ""
        try:
            limit = address_space() + SPARE
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            signal.alarm(LONGEST)
            read(path)
        except REFUSALS:
            status = 1
        except MemoryError:
            status, why = 3, "it took too much memory"
        except BaseException:
            status, why = 2, traceback.format_exc(limit=-6)
        os.write(saying, why.encode(errors="replace")[-4000:])
        os._exit(status)
    os.close(saying)
    with os.fdopen(said, "rb") as pipe:
        why = pipe.read().decode(errors="replace")
    _, status = os.waitpid(process, 0)
    if os.WIFSIGNALED(status):
        return "killed", f"it ended by signal {os.WTERMSIG(status)}"
    return ("read", "refused", "wrong", "killed")[os.WEXITSTATUS(status)], why


def _refused(read: Callable[[Path], object], path: Path) -> tuple[str, str]:
    """Whether the reader that users have refuses a file that ends the library's process."""
    try:
        read(path)
    except InvalidModel:
        return "refused, for it ends a process", ""
    return "wrong", "a file that ends the library's process was taken"
