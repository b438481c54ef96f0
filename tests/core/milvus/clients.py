"""Clients of the store that do what a load asks: in this process, and in one of their own that may be killed.

python -m tests.core.milvus.clients MILVUS POSTGRES BUCKET   # a line of JSON for each request, and one for each answer
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from core.errors import StorageFailure, UnknownPlace
from core.milvus import Bucket, open_store
from core.milvus.store import MilvusStore
from tests.core.storage.frames import descriptor_of, frame

ROOT = Path(__file__).parents[3]


class Client:
    """Writes to and asks the map ``lab``."""

    def __init__(self, store: MilvusStore) -> None:
        self._store = store

    def enrol(self, names: list[str], picture: str) -> None:
        """Places of these names, all with one picture, in one batch."""
        self._store.get("lab").enrol([frame(name, picture) for name in names])

    def forget(self, name: str) -> None:
        """Delete a place."""
        self._store.get("lab").forget(name)

    def first(self, picture: str) -> list[str]:
        """The places that a query with a picture finds first and second."""
        lab = self._store.get("lab")
        ((rows, _),) = lab.scope().search(descriptor_of(picture)[np.newaxis])
        return [place.id for place in lab.places_at(rows[:2].tolist()) if place is not None]

    def picture(self, name: str) -> str:
        """What is kept of a place's frame."""
        return (self._store.get("lab").picture(name) or b"").decode()

    def close(self) -> None:
        """Leave the store to whoever opened it."""


class ProcessClient:
    """The same in a process of its own, which is started when it is asked and not there.  One call at a time."""

    def __init__(self, milvus: str, postgres: str, bucket: Bucket) -> None:
        where = [milvus, postgres, json.dumps(asdict(bucket))]
        self._command = [sys.executable, "-W", "ignore", "-m", "tests.core.milvus.clients", *where]
        self._process: subprocess.Popen[str] | None = None
        self._starting = threading.Lock()

    def enrol(self, names: list[str], picture: str) -> None:
        self._call("enrol", names, picture)

    def forget(self, name: str) -> None:
        self._call("forget", name)

    def first(self, picture: str) -> list[str]:
        found: list[str] = self._call("first", picture)
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
        return answer


def main(milvus: str, postgres: str, bucket: str) -> None:
    """Serve until there are no more requests."""
    logging.disable(logging.CRITICAL)  # that parts are away is no news here
    client: Client | None = None
    for line in sys.stdin:
        method, *arguments = json.loads(line)
        try:
            client = client or Client(open_store(milvus, postgres, bucket=Bucket(**json.loads(bucket))))
            answer = ["done", getattr(client, method)(*arguments)]
        except UnknownPlace as error:
            answer = ["unknown", str(error)]
        except StorageFailure as error:
            answer = ["refused", str(error)]
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
