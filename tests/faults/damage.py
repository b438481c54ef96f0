"""Ways in which a file on a disk can be damaged."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from pathlib import Path

PAGE = 4096


def flip(path: Path, offset: int, bit: int = 0) -> None:
    """Flip one bit."""
    content = bytearray(path.read_bytes())
    content[offset] ^= 1 << bit
    path.write_bytes(content)


def flip_anywhere(path: Path, chosen: random.Random) -> None:
    size = path.stat().st_size
    flip(path, chosen.randrange(size), chosen.randrange(8))


def flip_header(path: Path, chosen: random.Random) -> None:
    flip(path, chosen.randrange(min(100, path.stat().st_size)), chosen.randrange(8))


def flip_last_page(path: Path, chosen: random.Random) -> None:
    size = path.stat().st_size
    flip(path, size - 1 - chosen.randrange(min(PAGE, size)), chosen.randrange(8))


def flip_used(path: Path, chosen: random.Random) -> None:
    """Flip a bit of a byte that is not zero, because such bytes are in use."""
    used = [offset for offset, byte in enumerate(path.read_bytes()) if byte]
    flip(path, chosen.choice(used), chosen.randrange(8))


def cut(path: Path, chosen: random.Random) -> None:
    """Cut the file at a length that means something, or at any."""
    size = path.stat().st_size
    lengths = {0, 1, 31, 32, 99, 100, PAGE - 1, PAGE, PAGE + 1, size // 2, size - 1, size - PAGE}
    lengths.add(chosen.randrange(size))
    length = chosen.choice(sorted(length for length in lengths if 0 <= length < size))
    with path.open("r+b") as file:
        file.truncate(length)


def zero_tail(path: Path, chosen: random.Random) -> None:
    size = path.stat().st_size
    length = chosen.choice([size // 2, max(0, size - PAGE), max(0, size - 512), chosen.randrange(size)])
    path.write_bytes(path.read_bytes()[:length].ljust(size, b"\x00"))


def zero_sector(path: Path, chosen: random.Random) -> None:
    content = bytearray(path.read_bytes())
    start = 512 * chosen.randrange(-(-len(content) // 512))
    content[start : start + 512] = bytes(len(content[start : start + 512]))
    path.write_bytes(content)


def append_garbage(path: Path, chosen: random.Random) -> None:
    with path.open("ab") as file:
        file.write(chosen.randbytes(chosen.choice([1, 24, PAGE])))


def remove(path: Path, chosen: random.Random) -> None:
    path.unlink()


def make_folder(path: Path, chosen: random.Random) -> None:
    path.unlink()
    path.mkdir()


def link_to_nothing(path: Path, chosen: random.Random) -> None:
    path.unlink()
    path.symlink_to(path.with_name("nothing"))


def link_in_circles(path: Path, chosen: random.Random) -> None:
    path.unlink()
    path.symlink_to(path.name)


def take_of_another(path: Path, chosen: random.Random) -> None:
    """Replace a file by the one of the same name of another map, or by another file of this map."""
    other = path.parents[1] / "hall" / path.name
    others = sorted(one for one in path.parent.iterdir() if one.is_file() and one != path)
    shutil.copyfile(other if other.exists() else chosen.choice(others), path)


Damage = Callable[[Path, random.Random], None]

DAMAGES: tuple[Damage, ...] = (
    flip_anywhere, flip_header, flip_last_page, flip_used, cut, zero_tail, zero_sector, append_garbage, remove,
    make_folder, link_to_nothing, link_in_circles, take_of_another,
)  # fmt: skip
