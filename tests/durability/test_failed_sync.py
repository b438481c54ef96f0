"""A log that cannot be synced for a while: what was refused does not come true, though others need its descriptors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.durability.storage.power_cuts import trace
from tests.durability.storage.processes import StorageProcess, StorageProcesses
from tests.syscalls import strace

pytestmark = pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")


def ask(process: StorageProcess, do: str, name: str, **values: Any) -> Any:
    """The answer to an operation on a map; of a look, the ids of its places."""
    answer = process.connections[0].ask({"do": do, "map": name, **values})
    return [place["id"] for place in answer["found"]["places"]] if "found" in answer else answer["answer"]


def enrol(process: StorageProcess, name: str, place: str) -> Any:
    item = {"id": place, "picture": f"picture {place}", "fields": {}, "keypoints": False}
    return ask(process, "enrol", name, items=[item])


def test_a_write_whose_sync_failed_stays_undone(tmp_path: Path) -> None:
    others = ("b", "c", "d")  # more than there are files open at a time
    with StorageProcesses(tmp_path / "processes") as processes:
        process = processes.begin(tmp_path / "data")
        for name in ("a", *others):
            ask(process, "create", name, settings={}, precision="half", unlisted=False)
            assert enrol(process, name, "p1") == ["created"]
        assert enrol(process, "a", "p0") == ["created"]
        there = {name: ["p1", "p0"] if name == "a" else ["p1"] for name in ("a", *others)}
        log = tmp_path / "data/maps/a/map.sqlite-wal"
        calls = ["-P", str(log), "-e", "trace=fdatasync", "-e", "inject=fdatasync:error=EIO"]
        tracer = trace(process, [strace() or "strace", "-f", *calls, "-o", str(tmp_path / "trace")], tmp_path / "log")
        assert enrol(process, "a", "p2") == {"error": "StorageFailure"}
        for name in others:
            assert ask(process, "look", name) == there[name], name
        assert enrol(process, "a", "p3") == {"error": "StorageFailure"}
        assert "INJECTED" in (tmp_path / "trace").read_text()
        tracer.terminate()
        tracer.wait(60)
        for name in ("a", *others, "a"):
            assert ask(process, "look", name) == there[name], name
        assert enrol(process, "a", "p4") == ["created"]
        process.kill()
        process.close()
        process = processes.begin(tmp_path / "data")
        assert ask(process, "look", "a") == ["p1", "p0", "p4"]
        process.close()
