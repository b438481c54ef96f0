"""The whole service under random requests of several clients, killed again and again, compared each time."""

from __future__ import annotations

import shutil
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import httpx

from tests.durability.model import Lost, World, changed, differences, settled
from tests.durability.server import operations as requests
from tests.durability.server.operations import JOBS, apply, chosen, pruned
from tests.durability.server.processes import ServerProcess, ServerProcesses
from tests.durability.storage.operations import Operation
from tests.durability.storage.processes import ProcessEnded, StorageProcesses
from tests.service.encoders import COARSE, install_coarse_encoder

CLIENTS = 3
MOST_OPERATIONS = 36
"""Requests of all clients together before a kill, at most."""

SETTINGS: dict[str, object] = {"encoder": COARSE, "log_level": "warning", "job_workers": 2}
PATIENCE = 60.0


@dataclass
class Client:
    """Sends requests about maps of its own; they follow from the seed and the answers.

    candidates: the worlds that may be found.
    session: the run that is open, with its map, id and last frame; ``begun``: a frame that may have been taken in.
    job: the operation whose job is not known to have ended.
    single: only requests whose effect is complete when they are answered.
    """

    seed: object
    number: int
    candidates: list[World] = field(default_factory=lambda: [{}])
    done: int = 0
    last: list[Operation] = field(default_factory=list)
    session: dict[str, Any] | None = None
    job: Operation | None = None
    single: bool = False

    @property
    def prefix(self) -> str:
        """How the ids of its maps begin."""
        return f"c{self.number}-"

    def next(self) -> Operation:
        """Choose a request, which from now on may have happened."""
        (world,) = self.candidates
        random = Random(f"{self.seed}/{self.number}/{self.done}")
        operation = chosen(random, world, self.prefix, self.session, self.single)
        self.done += 1
        self.last = [*self.last[-4:], operation]
        after, self._wanted = changed(world, lambda given: apply(given, operation))
        self.candidates = [world, after]
        if operation["do"] in JOBS:
            self.job = operation
        if operation["do"] == "frame" and self.session is not None:
            self.session["begun"] = operation["frame"]
        return operation

    def acknowledge(self, operation: Operation, answer: dict[str, Any]) -> None:
        """Compare the answer to a request, which has now happened.

        Raises:
            Lost: the answer is wrong.
        """
        found, wanted = answer["answer"], self._wanted
        if isinstance(wanted, dict) and "among" in wanted:
            right = found["first"] in wanted["among"] if wanted["among"] else True
        else:
            right = not differences(wanted, found)
        if not right:
            raise Lost(f"the answer to {str(operation)[:500]}: {wanted} expected, {str(answer)[:500]}")
        world = self.candidates[-1]
        if "places" in answer:
            world[operation["map"]].told(answer["places"])
        self.candidates = [world]
        self._follow_session(operation, answer)

    def _follow_session(self, operation: Operation, answer: dict[str, Any]) -> None:
        if operation["do"] == "session":
            self.session = {"map": operation["map"], "id": answer["session"], "last": 0, "begun": 0}
        elif operation["do"] == "frame" and self.session is not None:
            self.session["last"] = operation["frame"]
        elif operation["do"] == "end-session" or (
            operation["do"] == "delete" and self.session is not None and self.session["map"] == operation["map"]
        ):
            self.session = None

    # After a start

    def end_job(self, client: httpx.Client, job: dict[str, Any] | None) -> None:
        """Wait for the end of the job that was asked for, and note what it has done.

        Args:
            job: as it is listed; None if the service never took it.

        Raises:
            Lost: it failed.
        """
        assert self.job is not None
        operation, self.job = self.job, None
        if job is None:
            self.candidates = self.candidates[:1]
            return
        until = time.monotonic() + PATIENCE
        while job["state"] not in ("succeeded", "failed", "cancelled"):
            if time.monotonic() > until:
                raise Lost(f"a job does not end: {job}")
            job = client.get(f"/v1/jobs/{job['id']}?wait=5").raise_for_status().json()
        if job["state"] != "succeeded":
            slug = str((job["problem"] or {}).get("type")).rsplit(":", 1)[-1]
            if operation["do"] == "prune" and slug == "nothing-to-measure":
                self.candidates = self.candidates[:1]
                return
            raise Lost(f"{operation}: the job has {job['state']}: {job['problem']}")
        if operation["do"] == "prune":
            self.candidates = [pruned(self.candidates[0], operation["map"], job["result"])]
        else:
            self.candidates = self.candidates[-1:]

    def check_session(self, client: httpx.Client) -> None:
        """Compare the frame at which the open session stands.

        Raises:
            Lost: it is not the one sent last.
        """
        if self.session is None:
            return
        (world,) = self.candidates
        response = client.get(f"/v1/maps/{self.session['map']}/sessions/{self.session['id']}")
        ended = self.last[-1]["do"] in ("end-session", "delete") and self.last[-1]["map"] == self.session["map"]
        if response.status_code in (404, 410) and (ended or self.session["map"] not in world):
            self.session = None
            return
        if response.status_code != 200:
            raise Lost(f"the session {self.session}: {response.text}")
        found = response.json()["last_frame"] or 0
        if found not in (self.session["last"], self.session["begun"]):
            raise Lost(f"the session {self.session} is at frame {found}")
        self.session["last"] = found


@dataclass
class Tally:
    """Counts of a campaign."""

    kills: int = 0
    operations: int = 0
    jobs: int = 0
    jobs_cut: int = 0  # jobs that were under way at a kill


class ServerKills:
    """A campaign in a folder of its own."""

    def __init__(self, folder: Path, seed: object) -> None:
        self.folder, self.seed, self.tally = folder, seed, Tally()
        self.settings = {**SETTINGS, "data_dir": folder / "data", "models_dir": folder / "models"}
        self.clients = [Client(seed, number) for number in range(CLIENTS)]
        self._known_jobs: set[str] = set()
        install_coarse_encoder(folder / "models")

    def run(self, processes: StorageProcesses, servers: ServerProcesses, kills: int) -> Tally:
        """Kill ``kills`` servers one after the other.

        Raises:
            Lost: with what was found instead, the seed, and the last operations of each client.
        """
        try:
            while self.tally.kills < kills:
                self._run_until_killed(processes, servers, Random(f"{self.seed}/life/{self.tally.kills}"))
        except (Lost, AssertionError, httpx.HTTPError) as lost:
            last = "\n".join(
                f"client {one.number}, operation {one.done}: {str(one.last)[-1500:]}" for one in self.clients
            )
            why = f"seed {self.seed}, after kill {self.tally.kills}: {type(lost).__name__}: {lost}"
            raise Lost(f"{why}\n{last}") from lost
        return self.tally

    def _run_until_killed(self, processes: StorageProcesses, servers: ServerProcesses, random: Random) -> None:
        server = servers.begin(self.settings)
        try:
            server.wait()
            self._settle(server)
            self._work(server, random)
        finally:
            server.close()
        self.tally.kills += 1
        self.compare(processes)

    def _settle(self, server: ServerProcess) -> None:
        """Wait for the jobs that were cut, compare the sessions, and verify every map."""
        for client in self.clients:
            if client.job is not None:
                listed = server.client.get(f"/v1/jobs?map={client.job['map']}&limit=50").raise_for_status().json()
                new = [job for job in listed["items"] if job["id"] not in self._known_jobs]
                self.tally.jobs_cut += bool(new)
                client.end_job(server.client, new[0] if new else None)
                self._known_jobs |= {job["id"] for job in new}
            if len(client.candidates) == 1:
                client.check_session(server.client)
        report = {name for client in self.clients for name in client.candidates[0]}
        for name in sorted(report):
            verified = server.client.post(f"/v1/maps/{name}/verify").raise_for_status().json()
            if not verified["ok"]:
                raise Lost(f"map {name}: {verified}")

    def _work(self, server: ServerProcess, random: Random) -> None:
        last, delay = random.randrange(5, MOST_OPERATIONS), random.random() ** 2 * 0.2
        killed, counting, failures = threading.Event(), threading.Lock(), list[Exception]()
        done = 0

        def kill() -> None:
            time.sleep(delay)
            killed.set()
            server.kill()

        killer = threading.Thread(target=kill)

        def work(client: Client) -> None:
            nonlocal done
            try:
                with httpx.Client(base_url=server.client.base_url, timeout=PATIENCE) as own:
                    while True:
                        operation = client.next()
                        with counting:
                            done += 1
                            if done == last:
                                killer.start()
                        self._do(own, client, operation)
            except (httpx.TransportError, ProcessEnded) as error:
                if not killed.is_set():
                    failures.append(Lost(f"the service does not answer: {error!r}"))
            except Exception as error:
                failures.append(error)
                killed.set()
                server.kill()

        threads = [threading.Thread(target=work, args=(client,)) for client in self.clients]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if killer.ident is not None:
            killer.join()
        self.tally.operations += done
        if failures:
            raise failures[0]

    def _do(self, own: httpx.Client, client: Client, operation: Operation) -> None:
        answer = requests.send(own, operation)
        if "job" not in answer:
            if client.job is not None:
                raise Lost(f"{operation} was refused: {answer}")
            client.acknowledge(operation, answer)
            return
        # From here on the job must come to its end, however often the service is killed.
        job = own.get(f"/v1/jobs/{answer['job']}?wait={requests.JOB_SECONDS}").raise_for_status().json()
        if job["state"] not in ("queued", "running"):
            client.end_job(own, job)
            self._known_jobs.add(answer["job"])
            self.tally.jobs += 1

    def compare(self, processes: StorageProcesses) -> None:
        """Compare a copy of what the dead server left; maps of a job that was cut are compared later.

        Raises:
            Lost: something is missing.
        """
        copied = self.folder / "copy"
        shutil.rmtree(copied, ignore_errors=True)
        shutil.copytree(self.folder / "data", copied)
        process = processes.begin(copied)
        try:
            found = process.connections[0].ask({"do": "contents"})["answer"]
        except ProcessEnded as ended:
            raise Lost(f"the copy does not open: {self.folder / 'log'}") from ended
        finally:
            process.kill()
            process.close()
        for client in self.clients:
            own = {name: one for name, one in found.items() if name.startswith(client.prefix)}
            if client.job is None:
                client.candidates = [settled(client.candidates, own)[0]]
            else:
                busy = {client.job["map"], client.job.get("to")}
                before = {name: one for name, one in client.candidates[0].items() if name not in busy}
                settled([before], {name: one for name, one in own.items() if name not in busy})
