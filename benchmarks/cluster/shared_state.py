"""The cost of state shared by services in PostgreSQL, beside the files of a data directory.

    python -m benchmarks.cluster.shared_state [--rounds 200]

starts a PostgreSQL of its own (that of the system) and prints medians over the rounds, in milliseconds.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from service.access.keys import Keys
from service.access.rates import Buckets
from service.jobs.jobs import Jobs
from service.peers.replica import ServiceReplica
from service.queries.count_tables import statistics_file
from service.queries.given_answers import GivenAnswer, QueriedFrame
from service.queries.schemas import QueryAnswer
from service.queries.statistics import QueryStatistics
from service.sessions.table import SessionRecord, SessionTable, session_file
from service.shared.database import SharedDatabase
from tests.servers.postgres import running_postgres

BELIEF_BYTES = 8 << 10
ANSWERS = 400
KEY = ("lab", "2026-11-20T09:00:00+00:00")
ANSWER = QueryAnswer(
    verdict="unknown", place=None, probability=None, pose=None, score=None, margin=None, decision=None, threshold=0.1,
    reason="empty-map", matches=[], revision=1, encoder="e", milliseconds={},
)  # fmt: skip


def median(rounds: int, work: Callable[[int], object]) -> float:
    """The median duration of some work, in milliseconds, after three rounds that do not count."""
    taken = []
    for number in range(rounds + 3):
        began = time.perf_counter()
        work(number)
        taken.append(1e3 * (time.perf_counter() - began))
    return statistics.median(taken[3:])


def _renew(table: SessionTable, session: SessionRecord, number: int) -> None:
    table.renew(replace(session, revision=number))


def _head(table: SessionTable, _number: int) -> None:
    table.head("s-1")


def of_sessions(folder: Path, database: SharedDatabase, rounds: int) -> None:
    """A frame of a session: the look before it and the write after it."""
    file = session_file(folder)
    session = SessionRecord(
        "s-1", "lab", "2026", "{}", 900.0, number=7, moment=3.5, request="robot", lost=0, state=bytes(BELIEF_BYTES),
        answer='{"frame": 7}' + " " * 4000,
    )  # fmt: skip
    read, saved = [], []
    for ledger in (file, database):
        table = SessionTable(ledger)
        table.add(session, 100)
        saved.append(median(rounds, partial(_renew, table, session)))
        read.append(median(rounds, partial(_head, table)))
    print(f"session, looked at before a frame {'':>7}  {read[1]:8.2f}")
    print(f"session, saved after a frame     {saved[0]:8.2f}  {saved[1]:8.2f}")
    file.close()


def of_jobs(folder: Path, database: SharedDatabase, rounds: int) -> None:
    """A job that does nothing, from its submission to its end."""
    replica = ServiceReplica(database, folder)
    shared = Jobs(database, replica, shared_maps=True)
    found = []
    for jobs in (Jobs.of_directory(folder), shared):
        jobs.register("nothing", lambda _: {})
        if jobs is shared:
            replica.start()
        jobs.start()

        def done(_: int, jobs: Jobs = jobs) -> None:
            job = jobs.submit("nothing", None, arguments={})
            while not jobs.get(job.id).ended:
                time.sleep(0.0002)

        found.append(median(rounds // 4, done))
        jobs.close()
    replica.close()
    print(f"job, submitted, taken and ended  {found[0]:8.2f}  {found[1]:8.2f}")


def _token(buckets: Buckets, number: int) -> None:
    buckets.take(f"k{number % 100}")


def of_rates(database: SharedDatabase, rounds: int) -> None:
    """A token, and an exchange for a hundred keys."""
    alone, shared = Buckets(1e6, 1000), Buckets(1e6, 1000, kind="request")
    taken = [median(rounds, partial(_token, buckets)) for buckets in (alone, shared)]
    print(f"rate, a token                    {taken[0]:8.4f}  {taken[1]:8.4f}")

    def exchange(_: int) -> None:
        for number in range(100):
            shared.take(f"k{number}")
        shared.exchange(database)

    print(f"rate, an exchange of 100 keys    {'':>8}  {median(rounds, exchange):8.2f}")


def _look(keys: Keys, _: int) -> None:
    keys.place.version(expected=True)


def _read(keys: Keys, _: int) -> None:
    keys.all()


def of_keys(folder: Path, database: SharedDatabase, rounds: int) -> None:
    """Looking whether a key has changed, and reading all keys."""
    both = Keys.of(folder), Keys.of(folder, database)
    for keys in both:
        for number in range(100):
            keys.create(f"robot-{number}", "query")
    looks = [median(rounds, partial(_look, keys)) for keys in both]
    reads = [median(rounds, partial(_read, keys)) for keys in both]
    print(f"keys, whether they changed       {looks[0]:8.2f}  {looks[1]:8.2f}")
    print(f"keys, reading 100 of them        {reads[0]:8.2f}  {reads[1]:8.2f}")
    both[0].place.close()


def of_statistics(folder: Path, database: SharedDatabase, rounds: int) -> None:
    """Adding the counts of some answers, and the answers themselves."""
    sizes, present = {KEY: ANSWERS}, {f"p{n}" for n in range(ANSWERS)}
    embedded = QueryStatistics(statistics_file(folder), 3600, lambda: sizes, lambda _: present)
    shared = QueryStatistics(database, 3600, lambda: sizes, lambda _: present, shared=True)
    found = []
    for counted in (embedded, shared):

        def flush(_: int, counted: QueryStatistics = counted) -> None:
            for number in range(ANSWERS):
                counted.observe(KEY, "recognized", f"p{number}", 0.5, 2.0)
                counted.recent.add(KEY, GivenAnswer.of(ANSWER, QueriedFrame()))
            counted.flush()

        found.append(median(rounds // 10, flush))
    print(f"statistics, {ANSWERS} answers         {found[0]:8.2f}  {found[1]:8.2f}")
    embedded.close()


def of_notices(folders: list[Path], address: str, rounds: int) -> None:
    """From what one service says until another one hears it."""
    databases = [SharedDatabase(address) for _ in folders]
    one, other = (ServiceReplica(database, folder) for database, folder in zip(databases, folders, strict=True))
    heard = threading.Event()
    other.hear("test", lambda _: heard.set())
    one.start()
    other.start()
    time.sleep(1)

    def notice(_: int) -> None:
        heard.clear()
        one.say("test")
        assert heard.wait(5)

    print(f"a notice, said and heard         {'':>8}  {median(rounds, notice):8.2f}")
    for replica, database in zip((one, other), databases, strict=True):
        replica.close()
        database.close()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=200)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as name, running_postgres() as postgres:
        folders = [Path(name) / each for each in "abcd"]
        for folder in folders:
            folder.mkdir()
        database = SharedDatabase(postgres.address)
        print(f"{'milliseconds':<33}{'files':>8}  {'PostgreSQL':>8}")
        of_sessions(folders[0], database, rounds)
        of_jobs(folders[1], database, rounds)
        of_rates(database, rounds)
        of_statistics(folders[0], database, rounds)
        of_keys(folders[0], database, rounds)
        of_notices(folders[2:], postgres.address, rounds)
        database.close()


if __name__ == "__main__":
    main()
