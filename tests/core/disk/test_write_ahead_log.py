"""SQLite's log after a crash: what a crash leaves is sound, what was damaged since is found."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
from core.storage.database.connections import FILE

from core.disk.files import Damage
from core.disk.write_ahead_log import check_log

FILE = "map.sqlite"
FRAME = 24 + 4096


class Crashing:
    """A database of a table ``t`` that is open, and what a crash would leave of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)
        self.connection = sqlite3.connect(folder / FILE, isolation_level=None)
        for statement in ("journal_mode = WAL", "synchronous = FULL", "wal_autocheckpoint = 0", "cache_size = 10"):
            self.connection.execute(f"PRAGMA {statement}")
        self.connection.execute("CREATE TABLE IF NOT EXISTS t (number INTEGER PRIMARY KEY, text TEXT)")

    @property
    def frames(self) -> int:
        """In the log, those that do not count any more included."""
        return ((self.folder / f"{FILE}-wal").stat().st_size - 32) // FRAME

    def add(self, rows: int, end: str = "COMMIT") -> None:
        """One transaction; a row takes a page."""
        self.connection.execute("BEGIN")
        for _ in range(rows):
            self.connection.execute("INSERT INTO t (text) VALUES (hex(randomblob(1900)))")
        self.connection.execute(end)

    def left(self, folder: Path) -> Path:
        """The log of a copy."""
        shutil.copytree(self.folder, folder)
        (folder / f"{FILE}-shm").unlink()
        return folder / f"{FILE}-wal"


@pytest.fixture
def crashing(tmp_path: Path) -> Iterator[Crashing]:
    made = Crashing(tmp_path / "map")
    yield made
    made.connection.close()


def rows_of(log: Path) -> int:
    """As SQLite finds them after the crash."""
    connection = sqlite3.connect(log.with_name(FILE))
    try:
        return int(connection.execute("SELECT count(*) FROM t").fetchone()[0])
    finally:
        connection.close()


def flip(log: Path, frame: int, offset: int) -> None:
    content = bytearray(log.read_bytes())
    content[32 + frame * FRAME + offset] ^= 1
    log.write_bytes(content)


def test_a_torn_end_before_what_was_taken_back_is_a_crash(crashing: Crashing, tmp_path: Path) -> None:
    """A large transaction is written before its end, and rolled back; the next one is smaller, and torn by a crash."""
    crashing.add(2)
    last = crashing.frames
    crashing.add(60, "ROLLBACK")
    spilled = crashing.frames
    crashing.add(3)
    assert crashing.frames == spilled > last + 10, "behind the last transaction there is more"
    for torn in range(3):
        log = crashing.left(tmp_path / f"left-{torn}")
        flip(log, last + torn, 24 + 1000)
        check_log(log)
        assert rows_of(log) == 2


def test_a_torn_end_before_what_was_refused_is_a_crash(crashing: Crashing, tmp_path: Path) -> None:
    """Frames of transactions whose sync failed lie behind the last one, each with a mark that it was committed."""
    crashing.add(2)
    last, log = crashing.frames, crashing.left(tmp_path / "left")
    contents = []
    for number, rows in enumerate((3, 9, 20)):  # each is written where the others were refused
        shutil.copytree(log.parent, tmp_path / f"again-{number}")
        again = Crashing(tmp_path / f"again-{number}")
        again.add(rows)
        contents.append((again.folder / log.name).read_bytes())
        again.connection.close()
    spliced = contents[0] + contents[1][len(contents[0]) :] + contents[2][len(contents[1]) :]
    assert contents[0][16:24] == contents[2][16:24], "the salts are the same"
    log.write_bytes(spliced)
    flip(log, last, 24 + 1000)
    check_log(log)
    assert rows_of(log) == 2


@pytest.mark.parametrize("leftovers", [0, 60])
def test_damage_before_the_last_commit_is_found(crashing: Crashing, tmp_path: Path, leftovers: int) -> None:
    for rows in (1, 2, 3):
        crashing.add(rows)
    before_last = crashing.frames
    if leftovers:
        crashing.add(leftovers, "ROLLBACK")
    crashing.add(2)
    sound = crashing.left(tmp_path / "left")
    check_log(sound)
    content = sound.read_bytes()
    for frame in range(before_last):
        for offset in (2, 9, 17, 24 + 1000):  # the page's number, a salt, the checksum, the page
            flip(sound, frame, offset)
            with pytest.raises(Damage, match=f"frame {frame + 1} is damaged"):
                check_log(sound)
            sound.write_bytes(content)
    assert rows_of(sound) == 8
