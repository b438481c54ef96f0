"""Sends nonsense over the WebSocket of a session: each message is answered, or the connection closed with a reason."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence

import httpx
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import connect

from tests.fuzz.pictures.mutations import mutant
from tests.fuzz.pictures.originals import Original

PATIENCE = 30.0
VALUES: tuple[object, ...] = (0, -1, 1e308, "x", None, True, [], {}, "2026-11-20T10:00:00Z", 2**63, 0.5)
NAMES = ("frame", "timestamp", "forward", "left", "turn", "deviation", "k", "encoder", "nonsense", "")
TEXTS = ("", "{", "null", "[]", '"x"', "\ud7ff\0", '{"a":' * 3000, "NaN", "{" + '"a":1,' * 500 + '"a":1}')


def message(chance: random.Random, seed: int, index: int, originals: Sequence[Original]) -> str | bytes:
    """A message at random: a damaged or sound picture, or parameters with wrong names or values."""
    kind = chance.random()
    if kind < 0.4:
        return mutant(seed, index, originals).data
    if kind < 0.5:
        return chance.choice(originals).data
    if kind < 0.6:
        return chance.choice(TEXTS)
    return json.dumps({chance.choice(NAMES): chance.choice(VALUES) for _ in range(chance.randrange(4))})


def run(url: str, map_id: str, originals: Sequence[Original], seed: int, count: int) -> list[str]:
    """Send ``count`` messages over as many connections as it takes; what went wrong.

    Args:
        url: of the service.
        map_id: a map with places.
    """
    chance, wrong = random.Random(seed), list[str]()
    with httpx.Client(base_url=url, timeout=PATIENCE) as client:
        sent = 0
        while sent < count and not wrong:
            session = client.post(f"/v1/maps/{map_id}/sessions", json={}).raise_for_status().json()["id"]
            address = f"{url.replace('http', 'ws', 1)}/v1/maps/{map_id}/sessions/{session}/stream"
            try:
                with connect(address, compression=None, max_size=None) as connection:
                    for _ in range(chance.randrange(1, 60)):
                        one = message(chance, seed, sent, originals)
                        sent += 1
                        connection.send(one)
                        if isinstance(one, bytes):  # answered: by the frame's answer, or its parameters' problem
                            wrong += _judged(json.loads(connection.recv(timeout=PATIENCE)))
            except TimeoutError:
                wrong.append(f"no answer in {PATIENCE:.0f} s near message {sent} of seed {seed}")
            except ConnectionClosed as closed:
                if closed.rcvd is not None and closed.rcvd.code in (1006, 1011):
                    wrong.append(f"closed with {closed.rcvd.code} near message {sent} of seed {seed}")
            except (InvalidStatus, WebSocketException) as error:
                wrong.append(f"{error!r} near message {sent} of seed {seed}")
            client.delete(f"/v1/maps/{map_id}/sessions/{session}")
        if client.get("/readyz").status_code != 200:
            wrong.append("the service is not ready afterwards")
    return wrong


def _judged(answer: dict[str, object]) -> list[str]:
    problem = answer.get("problem")
    if isinstance(problem, dict) and problem["status"] >= 500 and problem["status"] not in (503, 507):
        return [f"problem {problem}"]
    return []
