"""Sends a damaged picture to one of the operations, in one of the forms, and judges the answer."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import httpx

from tests.fuzz.pictures.mutations import Mutant

MAP = "fuzzed"
TYPES = {"jpeg": "image/jpeg", "png": "image/png", "webp": "image/webp"}

HANG = 30.0
"""Seconds in which an answer has to be there; the service's own limit for a request."""

ACCEPTED = frozenset({200, 201})
REFUSED = frozenset({400, 409, 413, 415, 422})
OVERLOADED = frozenset({503, 507})


@dataclass(frozen=True)
class Sent:
    """One picture, the operation that it was sent to, and the answer; ``wrong`` is empty or says what is wrong."""

    index: int
    operation: str
    kind: str
    status: int
    problem: str
    seconds: float
    wrong: str


class Sender:
    """Sends pictures from one thread.

    Args:
        url: of the service.
        sound: a picture that is answered with 200, sent beside a damaged one where an operation takes several.
    """

    def __init__(self, url: str, sound: bytes) -> None:
        self.client = httpx.Client(base_url=url, timeout=HANG)
        self._sound = sound
        self._session = ""

    def close(self) -> None:
        """Close its connections."""
        self.client.close()

    def send(self, mutant: Mutant, seed: int) -> Sent:
        """Send one; which way is drawn from the seed and its number."""
        chance = random.Random(f"sending {seed}/{mutant.index}")
        operation = chance.choices([*_WAYS], [share for share, _ in _WAYS.values()])[0]
        began = time.monotonic()
        try:
            response = _WAYS[operation][1](self, mutant, chance)
        except httpx.TimeoutException:
            return self._sent(mutant, operation, 0, "", began, f"no answer in {HANG:.0f} s")
        except httpx.TransportError as error:
            return self._sent(mutant, operation, 0, "", began, f"connection broken: {error!r}")
        problem, wrong = judged(response)
        return self._sent(mutant, operation, response.status_code, problem, began, wrong)

    def _sent(self, mutant: Mutant, operation: str, status: int, problem: str, began: float, wrong: str) -> Sent:
        return Sent(mutant.index, operation, mutant.kind, status, problem, time.monotonic() - began, wrong)

    # The ways

    def _raw(self, method: str, path: str, mutant: Mutant, chance: random.Random, **params: Any) -> httpx.Response:
        kind = TYPES[mutant.format]
        if chance.random() < 0.05:
            kind = chance.choice([*TYPES.values(), "application/octet-stream"])
        return self.client.request(method, path, params=params, content=mutant.data, headers={"Content-Type": kind})

    def _form(self, path: str, files: list[tuple[str, tuple[str, bytes, str]]], **params: Any) -> httpx.Response:
        return self.client.post(path, files=files, params=params)

    def query(self, mutant: Mutant, chance: random.Random) -> httpx.Response:
        """POST query, raw or as a form; now and then explained."""
        if chance.random() < 0.2:
            return self._form(f"/v1/maps/{MAP}/query", [_file("frame", mutant)])
        params = {"explain": "true"} if chance.random() < 0.1 else {}
        return self._raw("POST", f"/v1/maps/{MAP}/query", mutant, chance, k=3, **params)

    def enrol(self, mutant: Mutant, chance: random.Random) -> httpx.Response:
        """PUT a place, and take it away again if it was taken in."""
        path = f"/v1/maps/{MAP}/places/m{mutant.index}"
        response = self._raw("PUT", path, mutant, chance, x=mutant.index, y=0)
        if response.status_code in ACCEPTED:
            self.client.delete(path).raise_for_status()
        return response

    def enrol_many(self, mutant: Mutant, _chance: random.Random) -> httpx.Response:
        """Enrol it among others; the place is taken away again."""
        name = f"b{mutant.index}"
        places = json.dumps([{"id": name, "file": name, "x": 1, "y": 1}]).encode()
        response = self._form(
            f"/v1/maps/{MAP}/places", [("places", ("", places, "application/json")), _file(name, mutant)]
        )
        self.client.delete(f"/v1/maps/{MAP}/places/{name}")
        return response

    def query_batch(self, mutant: Mutant, _chance: random.Random) -> httpx.Response:
        """Ask with it among sound ones, which have to be answered."""
        sound = ("good", ("good.jpg", self._sound, "image/jpeg"))
        return self._form(f"/v1/maps/{MAP}/query:batch", [sound, _file("bad", mutant)])

    def encode(self, mutant: Mutant, chance: random.Random) -> httpx.Response:
        """POST encode."""
        return self._raw("POST", "/v1/encode", mutant, chance)

    def regions(self, mutant: Mutant, chance: random.Random) -> httpx.Response:
        """POST regions, as numbers or as a picture."""
        return self._raw("POST", "/v1/regions", mutant, chance, format=chance.choice(("json", "png")))

    def match(self, mutant: Mutant, chance: random.Random) -> httpx.Response:
        """POST match, with a sound one beside it."""
        sound = ("sound.jpg", self._sound, "image/jpeg")
        names = chance.choice((("a", "b"), ("b", "a")))
        return self._form("/v1/match", [(names[0], sound), _file(names[1], mutant)])

    def send_frame(self, mutant: Mutant, chance: random.Random) -> httpx.Response:
        """A frame of a session; a new one where there is none, or it is over."""
        if not self._session:
            made = self.client.post(f"/v1/maps/{MAP}/sessions", json={})
            made.raise_for_status()
            self._session = made.json()["id"]
        response = self._raw("POST", f"/v1/maps/{MAP}/sessions/{self._session}/frames", mutant, chance)
        if response.status_code in (404, 410):
            self._session = ""
            return self.send_frame(mutant, chance)
        return response

    def query_or_enrol(self, mutant: Mutant, chance: random.Random) -> httpx.Response:
        """POST query:enrol, and take away what it enrolled."""
        response = self._raw("POST", f"/v1/maps/{MAP}/query:enrol", mutant, chance, id=f"q{mutant.index}")
        if response.status_code == 201:
            self.client.delete(f"/v1/maps/{MAP}/places/q{mutant.index}")
        return response


def _file(name: str, mutant: Mutant) -> tuple[str, tuple[str, bytes, str]]:
    return name, (f"{name}.bin", mutant.data, TYPES[mutant.format])


_WAYS: dict[str, tuple[float, Callable[[Sender, Mutant, random.Random], httpx.Response]]] = {
    "query": (30, Sender.query),
    "enrol_place": (20, Sender.enrol),
    "enrol_places": (6, Sender.enrol_many),
    "query_batch": (8, Sender.query_batch),
    "encode": (12, Sender.encode),
    "regions": (8, Sender.regions),
    "match": (6, Sender.match),
    "send_frame": (7, Sender.send_frame),
    "query_or_enrol": (3, Sender.query_or_enrol),
}
"""Operation -> its share in a hundred, and how it is done."""


def judged(response: httpx.Response) -> tuple[str, str]:
    """The kind of problem ("" for none), and what is wrong with an answer ("" for nothing)."""
    status = response.status_code
    if status in ACCEPTED:
        return _judged_items(response)
    if status not in REFUSED | OVERLOADED:
        return "", f"status {status}"
    if response.headers.get("content-type") != "application/problem+json":
        return "", f"a {response.headers.get('content-type')} with {status}"
    problem = response.json()
    slug = str(problem.get("type", "")).rpartition(":")[2]
    if problem.get("status") != status or not problem.get("detail") or not slug:
        return slug, "the problem does not say what it is"
    return slug, ""


def _judged_items(response: httpx.Response) -> tuple[str, str]:
    """Of many frames each has its own status: those of a batch are held to the same."""
    if response.headers.get("content-type") != "application/json":
        return "", ""
    slug = ""
    for item in response.json().get("items", []):
        status = item["status"]
        if status not in ACCEPTED:
            slug = str(item.get("problem", {}).get("type", "")).rpartition(":")[2]
            if status not in REFUSED | OVERLOADED or not slug:
                return slug, f"an item with status {status}"
    return slug, ""
