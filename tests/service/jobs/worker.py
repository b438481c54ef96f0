"""A service without HTTP that does jobs until it is killed: ``python -m tests.service.jobs.worker ADDRESS DIR``."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.jobs.context import JobContext
from service.jobs.jobs import Jobs
from service.peers.replica import ServiceReplica
from service.shared.database import SharedDatabase

STEPS = 200


def walk(context: JobContext) -> Mapping[str, Any]:
    """Steps of which each is remembered; it goes on from the last one."""
    first = context.notes.get("step", 0)
    for step in range(first, STEPS if context.attempt == 1 else first + 3):
        context.check_cancelled()
        context.remember(step=step + 1)
        time.sleep(0.02)
    return {"from": first, "attempt": context.attempt}


def main() -> None:
    """Do jobs."""
    address, folder = sys.argv[1], Path(sys.argv[2])
    database = SharedDatabase(address)
    replica = ServiceReplica(database, folder)
    jobs = Jobs(database, replica, shared_maps=True)
    jobs.register("walk", walk)
    replica.start()
    jobs.start()
    signal.pause()


if __name__ == "__main__":
    main()
