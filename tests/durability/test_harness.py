"""The harness itself: it sees a loss, and after a power cut its disk holds what was synced, and all else by chance."""

from __future__ import annotations

import copy
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

from tests.durability.model import ANY, Lost, MapModel, Shown, World, settled
from tests.durability.storage.kills import expect_erased
from tests.durability.storage.operations import shown, traces_of
from tests.durability.traced_disk import CERTAIN, Disk, Variant, arguments
from tests.syscalls import strace

SHOWN = Shown("digest", 5, "thumbnail", "image", {"half": "descriptor"}, {"half": "local"})


def world() -> World:
    """One map of two places."""
    lab = MapModel({"keep": "thumbnail"})
    lab.enrol("a", SHOWN, {"sequence": "monday"})
    lab.enrol("b", SHOWN, {})
    return {"lab": lab}


@pytest.mark.parametrize("part", ["places", "ends", "cameras", "review", "revision"])
def test_any_difference_is_a_loss(part: str) -> None:
    before = world()
    after = copy.deepcopy(before)
    after["lab"].forget("a")
    found = {"lab": copy.deepcopy(before["lab"].expected())}
    assert settled([before, after], found)[1] == 0
    assert settled([before, after], {"lab": after["lab"].expected()})[1] == 1
    found["lab"][part] = {
        "places": found["lab"]["places"][:1],
        "ends": [],
        "cameras": {"front": None},
        "review": [["digest"]],
    }.get(part, 7)
    with pytest.raises(Lost, match=part):
        settled([before, after], found)
    with pytest.raises(Lost):
        settled([before, after], {})


@pytest.mark.parametrize("part", ["descriptor", "keypoints", "track", "pose_of"])
def test_half_of_a_place_is_lost(part: str) -> None:
    before = world()
    found = {"lab": copy.deepcopy(before["lab"].expected())}
    found["lab"]["places"][1][part] = "another"
    with pytest.raises(Lost, match=part):
        settled([before], found)


def test_what_was_never_acknowledged_is_learnt_once() -> None:
    before = world()
    assert before["lab"].places["a"].created is ANY
    found = {"lab": copy.deepcopy(before["lab"].expected())}
    for place in found["lab"]["places"]:
        place |= {"created_at": "then", "updated_at": "then"}
    learnt, _ = settled([before], found)
    found["lab"]["places"][0]["created_at"] = "another time"
    with pytest.raises(Lost, match="created_at"):
        settled([learnt], found)


def test_what_was_erased_is_found_in_any_file(tmp_path: Path) -> None:
    lab = MapModel({"keep": "image"})
    for number in range(3):
        lab.enrol("a", shown(f"picture {number}"), {})
    lab.erase()
    assert lab.erased == {shown(f"picture {number}").digest for number in (0, 1)}
    folder = tmp_path / "maps/lab"
    folder.mkdir(parents=True)
    (folder / "map.sqlite").write_bytes(b"".join(traces_of("picture 2")))
    expect_erased(tmp_path, {"lab": lab})
    for trace in traces_of("picture 1"):
        (folder / "map.sqlite-wal").write_bytes(b"before" + trace + b"behind")
        with pytest.raises(Lost, match="something of picture 1, which was erased"):
            expect_erased(tmp_path, {"lab": lab})
    after = copy.deepcopy(lab)
    after.enrol("b", shown("picture 1"), {})
    expect_erased(tmp_path, {"lab": lab}, {"lab": after})  # it may have been begun


SCRIPT = """
import os, sys
root = sys.argv[1]
def put(name, data, sync, offset=0):
    file = os.open(f"{root}/{name}", os.O_RDWR | os.O_CREAT)
    os.pwrite(file, data, offset)
    if sync:
        os.fsync(file)
    os.close(file)
def sync_folder():
    folder = os.open(root, os.O_RDONLY)
    os.fsync(folder)
    os.close(folder)
os.mkdir(root)
put("whole", b"x" * 1500, True)
put("empty", b"content", False)
put("old", b"old", True)
put("moved", b"moved", True)
put("gone", b"gone", True)
sync_folder()
put("nameless", b"content", True)
put("old", b"new!", False)
put("cut", b"123456", True)
os.truncate(os.open(f"{root}/whole", os.O_RDWR), 600)
os.rename(f"{root}/moved", f"{root}/there")
os.unlink(f"{root}/gone")
os.write(1, b"ack\\n")
"""


def contents(folder: Path) -> dict[str, bytes]:
    """Of all files."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")
def test_a_disk_without_power(tmp_path: Path) -> None:
    root, trace = tmp_path / "root", tmp_path / "trace"
    command = [*arguments(trace), sys.executable, "-S", "-c", SCRIPT, str(root)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    disk = Disk(root)
    with trace.open() as lines:
        told = [what for what in disk.replay(lines, lambda sent: "ack" if sent == b"ack\n" else None) if what]
    assert told == ["ack"]

    disk.image(tmp_path / "certain", CERTAIN, Random(0))
    synced = {"whole": b"x" * 1500, "empty": b"", "old": b"old", "moved": b"moved", "gone": b"gone"}
    assert contents(tmp_path / "certain") == synced
    disk.image(tmp_path / "all", Variant(1, 1), Random(0))
    assert contents(tmp_path / "all") == contents(root)
    assert set(contents(root)) == {"whole", "empty", "old", "nameless", "cut", "there"}
    found = set()
    for seed in range(40):
        disk.image(tmp_path / f"torn-{seed}", Variant(0.5, 0.5, True), Random(seed))
        found.add(frozenset(contents(tmp_path / f"torn-{seed}").items()))
    assert len(found) > 5
