"""A program that damages files and lets a reader's library read each in a fork of its own, under a limit of memory.

``python -m tests.lab.conversion.hostile READER COUNT FOLDER SOUND…`` prints how the forks ended and keeps, in FOLDER,
the first files that ended one or took all its memory.
"""

from __future__ import annotations

import importlib
import json
import os
import random
import resource
import signal
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from core.errors import InvalidModel
from lab.conversion.isolation import address_space, convert, limit

KEPT = 2
"""Files of each kind of bad end."""

SPARE = 2**29
EXTREMES = (b"\xff" * 4, bytes(4), b"\xff\xff\xff\x7f", b"\x00\x00\x00\x7f", b"\x80" * 8)


def damaged(sound: bytes, chance: random.Random) -> bytes:
    """The file with one to six places changed, cut out, put in, or its end cut off."""
    data = bytearray(sound)
    for _ in range(chance.choice((1, 1, 2, 3, 6))):
        # Most of what a reader decides on stands at the start.
        at = chance.randrange(len(data) if chance.random() < 0.5 else min(400, len(data)))
        match chance.choice(("flip", "flip", "flip", "extreme", "cut", "insert", "end")):
            case "flip":
                data[at] ^= 1 << chance.randrange(8)
            case "extreme":
                extreme = chance.choice(EXTREMES)
                data[at : at + len(extreme)] = extreme
            case "cut":
                del data[at + 1 : at + chance.randint(2, 40)]
            case "insert":
                data[at:at] = chance.randbytes(chance.randint(1, 12))
            case _ if chance.random() < 0.3:
                del data[at + 1 :]
    return bytes(data)


def ending(reader: Any, path: Path, target: Path, arguments: list[str]) -> str:
    """How a fork that reads the file ends: "read", "refused", "memory" or "killed"."""
    process = os.fork()
    if not process:
        limit(resource.RLIMIT_AS, address_space() + SPARE)
        signal.alarm(20)
        status = 0
        try:
            convert(reader._read, reader.save_file, path, target, *arguments)
        except InvalidModel:
            status = 1
        except BaseException:
            status = 2
        os._exit(status)
    _, status = os.waitpid(process, 0)
    return "killed" if os.WIFSIGNALED(status) else ("read", "refused", "memory")[os.WEXITSTATUS(status)]


def main() -> None:
    """The program."""
    name, count, folder, *sounds = sys.argv[1:]
    module, *arguments = name.split(":", 1)
    reader = importlib.import_module(module)
    sound = [Path(path).read_bytes() for path in sounds]
    chance, ends = random.Random(7), Counter[str]()
    path, target = Path(folder) / "damaged", Path(folder) / "contents"
    for content in sound:  # what a reader imports only when it reads
        path.write_bytes(content)
        convert(reader._read, reader.save_file, path, target, *arguments)
    for _ in range(int(count)):
        path.write_bytes(damaged(chance.choice(sound), chance))
        end = ending(reader, path, target, arguments)
        if end in ("memory", "killed") and ends[end] < KEPT:
            (Path(folder) / f"{end}-{ends[end]}.bad").write_bytes(path.read_bytes())
        ends[end] += 1
    print(json.dumps(ends))


if __name__ == "__main__":
    main()
