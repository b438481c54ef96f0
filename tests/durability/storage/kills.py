"""The storage layer under random operations, killed again and again, each time compared with the model."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from tests.durability.model import Lost, World, changed, differences, settled
from tests.durability.storage.operations import Operation, apply, chosen, pictures, traces_of
from tests.durability.storage.processes import Connection, ProcessEnded, StorageProcess, StorageProcesses

WORKERS = 2
MOST_OPERATIONS = 24
"""Operations of the first worker before a kill, at most."""

KILLED_WHILE_OPENING = 0.2


@dataclass
class Worker:
    """Writes to maps of its own; its operations follow from the seed and the answers.

    candidates: the worlds that may be found: as acknowledged last, and with what was begun since.
    """

    seed: object
    number: int
    candidates: list[World] = field(default_factory=lambda: [{}])
    done: int = 0
    acknowledged: int = 0
    last: list[Operation] = field(default_factory=list)

    @property
    def prefix(self) -> str:
        """How the ids of its maps begin."""
        return f"w{self.number}-"

    def settle(self, found: dict[str, Any]) -> bool:
        """Compare what was found after a start; whether the operation that was not acknowledged has happened.

        Raises:
            Lost: none of the worlds that may be found was.
        """
        own = {name: one for name, one in found.items() if name.startswith(self.prefix)}
        world, number = settled(self.candidates, own)
        self.candidates = [world]
        return number > 0

    def next(self) -> Operation:
        """Choose an operation, which from now on may have happened."""
        (world,) = self.candidates
        operation = chosen(Random(f"{self.seed}/{self.number}/{self.done}"), world, self.prefix)
        self.done += 1
        self.last = [*self.last[-4:], operation]
        after, self._wanted = changed(world, lambda given: apply(given, operation))
        self.candidates = [world, after]
        return operation

    def acknowledge(self, answer: dict[str, Any]) -> None:
        """Compare the answer to the last operation, which has now happened.

        Raises:
            Lost: the answer is wrong.
        """
        operation, world = self.last[-1], self.candidates[-1]
        if wrong := differences(self._wanted, answer["answer"]):
            raise Lost(f"the answer to {operation}: {wrong[0]}")
        if "places" in answer:
            world[operation["map"]].told(answer["places"])
        if "found" in answer:
            if wrong := differences(world[operation["map"]].expected(), answer["found"]):
                raise Lost("\n  ".join([f"what {operation} found", *wrong[:12]]))
            world[operation["map"]].learn(answer["found"])
        self.candidates = [world]
        self.acknowledged += 1


def expect_erased(directory: Path, *worlds: World) -> None:
    """Search all files of the maps for what was erased, before as well as after the last operation.

    Raises:
        Lost: there is something of it.
    """
    first, *others = worlds
    for name, map_ in first.items():
        erased = map_.erased.intersection(*(world[name].erased if name in world else set() for world in others))
        folder = directory / "maps" / (name if map_.listed else f".unlisted-{name}")
        found = b"\0".join(path.read_bytes() for path in folder.glob("*") if not path.name.endswith("-shm"))
        for digest in erased:
            picture = pictures()[bytes.fromhex(digest)]
            if any(trace in found for trace in traces_of(picture)):
                raise Lost(f"map {name}: its files have something of {picture}, which was erased")


@dataclass
class Tally:
    """Counts of a campaign."""

    kills: int = 0
    operations: int = 0
    starts: int = 0
    between: int = 0  # kills that left an operation begun and not acknowledged
    there: int = 0  # of these, operations that were found done


class StorageKills:
    """A campaign in a folder of its own."""

    def __init__(self, folder: Path, seed: object) -> None:
        self.folder, self.seed, self.tally = folder, seed, Tally()
        self.directory = folder / "data"
        self.workers = [Worker(seed, number) for number in range(WORKERS)]

    def run(self, processes: StorageProcesses, kills: int) -> Tally:
        """Kill ``kills`` processes one after the other, and start a last one.

        Raises:
            Lost: with what was found instead, the seed, and the last operations of each worker.
        """
        try:
            while self.tally.kills < kills:
                self._run_until_killed(processes, Random(f"{self.seed}/life/{self.tally.kills}"))
            self.check(processes)
        except Lost as lost:
            last = "\n".join(
                f"worker {one.number}, operation {one.done}: {str(one.last)[-1500:]}" for one in self.workers
            )
            raise Lost(f"seed {self.seed}, after kill {self.tally.kills}: {lost}\n{last}") from lost
        return self.tally

    def check(self, processes: StorageProcesses) -> None:
        """Start a process, compare what it finds, and end it."""
        process = processes.begin(self.directory)
        try:
            self._settle(process)
        except ProcessEnded as ended:
            raise Lost(f"the process ended by itself: {self.folder / 'log'}") from ended
        finally:
            process.close()

    def _settle(self, process: StorageProcess) -> None:
        found = process.connections[0].ask({"do": "contents"})["answer"]
        for worker in self.workers:
            self.tally.between += len(worker.candidates) > 1
            self.tally.there += worker.settle(found)

    def _run_until_killed(self, processes: StorageProcesses, random: Random) -> None:
        opening = random.random() < KILLED_WHILE_OPENING
        last, delay = random.randrange(1, MOST_OPERATIONS), random.random() ** 2 * (0.06 if opening else 0.01)
        for worker in self.workers:
            expect_erased(self.directory, *worker.candidates)
        process = processes.begin(self.directory)
        killed = threading.Event()

        def kill() -> None:
            time.sleep(delay)
            killed.set()
            process.kill()

        killer = threading.Thread(target=kill)
        failures: list[Exception] = []
        try:
            if opening:
                killer.start()
            self._settle(process)
            self.tally.starts += 1

            def work(worker: Worker, connection: Connection) -> None:
                try:
                    while True:
                        connection.send(worker.next())
                        if worker.number == 0 and worker.done == until and not opening:
                            killer.start()
                        worker.acknowledge(connection.answer())
                        if worker.last[-1]["do"] == "erase":
                            expect_erased(self.directory, *worker.candidates)
                except ProcessEnded:
                    if not killed.is_set():
                        failures.append(Lost(f"the process ended by itself: {self.folder / 'log'}"))
                except Exception as error:
                    failures.append(error)
                    process.kill()

            until = self.workers[0].done + last
            before = sum(worker.done for worker in self.workers)
            threads = [
                threading.Thread(target=work, args=pair) for pair in zip(self.workers, process.connections, strict=True)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            self.tally.operations += sum(worker.done for worker in self.workers) - before
        except ProcessEnded as ended:
            if not killed.is_set():
                raise Lost(f"the process ended by itself: {self.folder / 'log'}") from ended
        finally:
            process.kill()
            if killer.ident is not None:
                killer.join()
            process.close()
        if failures:
            raise failures[0]
        self.tally.kills += 1
