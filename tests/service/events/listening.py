"""Listening to the events of a real server."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import httpx

from tests.service.server import Server


@dataclass(frozen=True)
class Heard:
    """One event as it arrived."""

    id: str
    name: str
    data: dict[str, Any]


def events_of(lines: Iterable[str]) -> Iterator[Heard]:
    """The events of the lines of a stream."""
    fields: dict[str, str] = {}
    for line in lines:
        if not line:
            if fields:
                yield Heard(fields["id"], fields["event"], json.loads(fields["data"]))
            fields = {}
        elif not line.startswith(":"):
            name, _, value = line.partition(": ")
            assert name in ("id", "event", "data") and name not in fields, line
            fields[name] = value


@dataclass
class Ear:
    """Collects the events of a stream in a thread.

    ended: is set when the service has ended the stream.
    """

    heard: list[Heard] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)

    def wait(self, enough: Callable[[list[Heard]], bool]) -> list[Heard]:
        """What was heard, as soon as it is enough."""
        until = time.monotonic() + 60
        while not enough(self.heard):
            assert time.monotonic() < until, self.heard
            assert not self.ended.is_set() or enough(self.heard), self.heard
            time.sleep(0.01)
        return list(self.heard)

    def some(self, count: int, *names: str) -> list[Heard]:
        """The first ``count`` events of these names; all but ``listening`` if there are none."""

        def found() -> list[Heard]:
            return [one for one in list(self.heard) if (one.name in names if names else one.name != "listening")]

        self.wait(lambda _: len(found()) >= count)
        return found()[:count]

    def names(self) -> list[str]:
        """The names of all events so far."""
        return [one.name for one in list(self.heard)]


@contextmanager
def listening(
    server: Server,
    map_id: str,
    key: str | None = None,
    resumed: str | None = None,
    parameters: Mapping[str, str] | None = None,
) -> Iterator[Ear]:
    """An ear at a map, which hears everything that happens within the block."""
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    headers |= {} if resumed is None else {"Last-Event-ID": resumed}
    ear = Ear()
    with httpx.Client(base_url=server.client.base_url, timeout=60, headers=headers) as client:
        request = client.stream("GET", f"/v1/maps/{map_id}/events", params=dict(parameters or {}))
        with request as response:
            assert response.status_code == 200, response.read()
            assert response.headers["content-type"].startswith("text/event-stream")
            thread = threading.Thread(target=_collect, args=(ear, response), daemon=True)
            thread.start()
            ear.wait(lambda heard: bool(heard))
            yield ear
            closing = response.extensions.get("network_stream")
            if closing is not None and not ear.ended.is_set():
                _hang_up(closing)
            thread.join(60)


def _collect(ear: Ear, response: httpx.Response) -> None:
    try:
        for event in events_of(response.iter_lines()):
            ear.heard.append(event)
    except httpx.HTTPError:
        return  # the test has hung up
    except httpx.StreamError:
        return
    ear.ended.set()


def _hang_up(stream: Any) -> None:
    import socket

    raw = stream.get_extra_info("socket")
    raw.shutdown(socket.SHUT_RDWR)
