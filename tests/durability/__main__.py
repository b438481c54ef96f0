"""Long campaigns of crashes, as by ``scripts/soak storage --kills 1000 --seed 7``; the suite runs a little of each."""

from __future__ import annotations

import argparse
import secrets
import shutil
import tempfile
import time
from pathlib import Path
from random import Random

from tests.durability.model import Lost
from tests.durability.server import power_cuts as server_power
from tests.durability.server.kills import ServerKills
from tests.durability.server.processes import ServerProcesses
from tests.durability.storage import kill_points
from tests.durability.storage import power_cuts as storage_power
from tests.durability.storage.driver import UNSYNCED
from tests.durability.storage.kill_points import PointTally
from tests.durability.storage.kills import WORKERS, StorageKills
from tests.durability.storage.power_cuts import PowerTally
from tests.durability.storage.processes import StorageProcesses

TOLD_EVERY = 25
OPERATIONS = 100
"""Of one traced run."""


def storage(folder: Path, arguments: argparse.Namespace) -> str:
    """Kill a process that drives the storage layer at random moments."""
    campaign = StorageKills(folder, arguments.seed)
    with StorageProcesses(folder, WORKERS) as processes:
        for kills in range(TOLD_EVERY, arguments.kills + TOLD_EVERY, TOLD_EVERY):
            campaign.run(processes, min(kills, arguments.kills))
            print(campaign.tally, flush=True)
    return f"{campaign.tally}: nothing lost, nothing half done"


def points(folder: Path, arguments: argparse.Namespace) -> str:
    """Kill that process at every call by which it writes, one after the other."""
    tally = PointTally()
    with StorageProcesses(folder) as processes:
        every = kill_points.points(processes, folder, arguments.seed)
        chosen = every if arguments.kills is None else Random(arguments.seed).sample(every, arguments.kills)
        for point in chosen:
            met, begun = kill_points.kill_at(processes, folder, arguments.seed, point)
            tally = PointTally(tally.points + 1, tally.killed + met, tally.operations + begun)
            if tally.points % TOLD_EVERY == 0:
                print(f"{tally} of {len(chosen)}", flush=True)
    return f"{tally}: nothing lost, nothing half done"


def power(folder: Path, arguments: argparse.Namespace) -> str:
    """Trace that process, or the service, and lose all or part of what was not synced."""
    total = PowerTally()
    servers = ServerProcesses(folder) if arguments.server else None
    with StorageProcesses(folder, unsynced=arguments.unsynced) as processes:
        for number in range(arguments.runs):
            work, seed = folder / f"run-{number}", f"{arguments.seed}/{number}"
            work.mkdir()
            if servers is None:
                total += storage_power.power(processes, work, seed, OPERATIONS, arguments.disks)
            else:
                total += server_power.power(servers, processes, work, seed, OPERATIONS, arguments.disks)
            shutil.rmtree(work)
            print(total, flush=True)
    return f"{total}: nothing lost, nothing half done"


def server(folder: Path, arguments: argparse.Namespace) -> str:
    """Kill the whole service at random moments, while several clients use it."""
    campaign, servers = ServerKills(folder, arguments.seed), ServerProcesses(folder)
    with StorageProcesses(folder) as processes:
        for kills in range(1, arguments.kills + 1):
            campaign.run(processes, servers, kills)
            print(campaign.tally, flush=True)
    return f"{campaign.tally}: nothing lost, nothing half done"


def main() -> int:
    """Run one kind of campaign; 1 if anything was lost."""
    parser = argparse.ArgumentParser(prog="scripts/soak", description=__doc__)
    kinds = parser.add_subparsers(dest="kind", required=True)
    for name, kills, run in (("storage", 1000, storage), ("points", None, points), ("server", 100, server)):
        kind = kinds.add_parser(name, help=run.__doc__)
        kind.add_argument("--kills", type=int, default=kills, help="default: %(default)s; None: every point")
        kind.set_defaults(run=run)
    kind = kinds.add_parser("power", help=power.__doc__)
    kind.add_argument("--runs", type=int, default=10, help=f"of {OPERATIONS} operations each (default: %(default)s)")
    kind.add_argument("--disks", type=int, default=200, help="that are compared in each run (default: %(default)s)")
    kind.add_argument("--unsynced", choices=UNSYNCED, help="break the storage layer so: the loss must be found")
    kind.add_argument("--server", action="store_true", help="the whole service, not the storage layer alone")
    kind.set_defaults(run=power)
    for kind in kinds.choices.values():
        kind.add_argument("--seed", default=secrets.token_hex(4), help="printed by an earlier run, to repeat it")
        kind.add_argument("--folder", type=Path, help="where to work; it is kept when something was lost")
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="soak-", dir=arguments.folder))
    print(f"{arguments.kind}: seed {arguments.seed}, in {folder}", flush=True)
    began = time.monotonic()
    try:
        told = arguments.run(folder, arguments)
    except Lost as lost:
        print(f"LOST after {time.monotonic() - began:.0f} s, {folder} is kept:\n{lost}", flush=True)
        return 1
    print(f"{told}; {time.monotonic() - began:.0f} s", flush=True)
    shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
