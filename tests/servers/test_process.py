"""A server stands still, and is killed, with all that it has started."""

from __future__ import annotations

import os
from pathlib import Path

from tests.servers.process import Server, state_of

WITH_ANOTHER_GROUP = ["sh", "-c", "setsid sleep 999 & wait"]


def test_no_process_of_a_server_is_forgotten(tmp_path: Path) -> None:
    server = Server([*WITH_ANOTHER_GROUP], tmp_path, lambda: None)
    server.start()
    groups: set[int] = set()
    while len(groups) < 2:  # the other one may not have been started yet, or not have left the first one's group
        with server.silenced() as processes:
            assert {state_of(process)[0] for process in processes} == {"T"}
            groups = {os.getpgid(process) for process in processes}
    while "T" in {state_of(process)[0] for process in processes}:  # it goes on
        os.sched_yield()
    server.kill()
    assert {state_of(process)[0] for process in processes} <= {"X", "Z"}
