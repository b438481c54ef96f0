"""Clients of a store that do what a load asks: in this process, and in one of their own that may be killed.

python -m tests.core.cluster.clients ADDRESS   # a line of JSON for each request, and one for each answer
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from core.errors import StorageFailure, UnknownPlace
from core.store import Map, Store, open_cluster
from tests.core.store.frames import descriptor_of, frame

ROOT = Path(__file__).parents[3]


class StoreClient:
    """Writes to and asks the map ``lab``."""

    def __init__(self, store: Store) -> None:
        self._store = store

    @property
    def _lab(self) -> Map:
        return self._store.get("lab")

    def enrol(self, names: list[str], picture: str) -> None:
        """Places of these names, all with one picture, in one batch."""
        self._lab.enrol([frame(name, picture) for name in names])

    def forget(self, name: str) -> None:
        """Delete a place."""
        self._lab.forget(name)

    def first(self, picture: str) -> list[str]:
        """The places that a query with a picture finds first and second."""
        lab = self._lab
        ((rows, _),) = lab.scope().search(descriptor_of(picture)[np.newaxis])
        return [place.id for place in lab.places_at(rows[:2].tolist()) if place is not None]

    def digests(self) -> dict[str, str]:
        """The digest of each place's picture, all at one moment."""
        return {place.id: place.digest.hex() for place in self._lab.transfer.outline()}

    def picture(self, name: str) -> str:
        """The picture that is kept of a place, as text."""
        return (self._lab.picture(name) or b"").decode()


class ProcessClient:
    """The same in a process of its own, which is started when it is asked and not there.  One call at a time."""

    def __init__(self, address: str) -> None:
        program = ["-m", "tests.core.cluster.clients", address]
        self._command = [sys.executable, "-W", "ignore", *program]
        self._process: subprocess.Popen[str] | None = None
        self._starting = threading.Lock()

    def enrol(self, names: list[str], picture: str) -> None:
        self._call("enrol", names, picture)

    def forget(self, name: str) -> None:
        self._call("forget", name)

    def first(self, picture: str) -> list[str]:
        found: list[str] = self._call("first", picture)
        return found

    def digests(self) -> dict[str, str]:
        found: dict[str, str] = self._call("digests")
        return found

    def picture(self, name: str) -> str:
        found: str = self._call("picture", name)
        return found

    def kill(self) -> None:
        """End the process by SIGKILL."""
        if (process := self._process) is not None:
            process.kill()
            process.wait()

    def start(self) -> None:
        """Start it, if it is not there."""
        with self._starting:
            if self._process is None or self._process.poll() is not None:
                self.close()
                pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
                self._process = subprocess.Popen(self._command, cwd=ROOT, **pipes)

    def close(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()

    def _call(self, method: str, *arguments: object) -> Any:
        self.start()
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps([method, *arguments]) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except (OSError, ValueError) as error:
            raise StorageFailure("the client is gone") from error
        if not line:
            raise StorageFailure("the client was killed")
        kind, answer = json.loads(line)
        if kind == "unknown":
            raise UnknownPlace(answer)
        if kind == "refused":
            raise StorageFailure(answer)
        assert kind == "done", answer
        return answer


def main(address: str) -> None:
    """Serve until there are no more requests."""
    logging.disable(logging.CRITICAL)  # that parts are away is no news here
    client: StoreClient | None = None
    for line in sys.stdin:
        method, *arguments = json.loads(line)
        try:
            client = client or StoreClient(open_cluster(address))
            answer = ["done", getattr(client, method)(*arguments)]
        except UnknownPlace as error:
            answer = ["unknown", str(error)]
        except StorageFailure as error:
            answer = ["refused", str(error)]
        except Exception:  # a defect, which must not look like a kill
            answer = ["failed", traceback.format_exc()]
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
