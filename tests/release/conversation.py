"""A conversation of the Python client with a service: recorded once, and held again with a later service.

A recorded request is sent as it was, byte by byte; only ids that the service chooses (of jobs, sessions, keys) are
replaced by those that it has chosen this time.  An answer is as recorded if it has the same status, every field with a
value of the same kind, and in the fields of ``FIXED`` the same value.  It may have more fields.
"""

from __future__ import annotations

import base64
import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import httpx

FIXED = {
    *("verdict", "change", "enrolment", "type", "state", "kind", "role", "sequence", "metadata", "description", "keep"),
    *(
        "precision",
        "encoder",
        "x",
        "y",
        "heading",
        "rank",
        "places",
        "columns",
        "done",
        "total",
        "ok",
        "stored",
        "title",
    ),
    *("source", "same_place_radius", "learning", "verification", "index", "missing", "discarded", "origin", "alone"),
}
"""Fields that say what happened, or what was stored; all others depend on machines and moments."""

OPEN = {"places": ".pose", "state": ".index", "rank": ".items["}
"""Fixed fields that are not in some objects: how many places tell a pose, how far an index in the background is, and at
which ranks a place was among the matches of earlier queries."""

CHOSEN = ("id", "job", "session", "key", "next_cursor", "picture", "frame")
"""Fields with what the service chooses and requests repeat."""

SENT = ("accept", "content-type", "if-match", "idempotency-key", "authorization")
LONGEST = 200
"""Letters of a text in an answer that is recorded whole."""

SECONDS = 60.0
"""In which a job is to reach the state that it had, and frames are to be stored."""


@dataclass
class Exchange:
    """A request and its answer.

    content: of the request, in base64.
    answer: the JSON; None if it is none.
    media: the media type of an answer that is no JSON; empty for none.
    """

    method: str
    target: str
    headers: dict[str, str]
    content: str
    status: int
    answer: Any = None
    media: str = ""

    def waits(self) -> bool:
        """Whether it asks how far a job is."""
        return self.method == "GET" and self.target.startswith("/v1/jobs/") and "events" not in self.target

    def is_over(self, answer: Any) -> bool:
        """Whether what goes on behind answers is as far as it was: the job, or the frames stored for review."""
        if self.waits():
            return answer["state"] in (self.answer["state"], "failed", "cancelled")
        if self.method == "GET" and self.target.partition("?")[0].endswith("/review"):
            return [one["id"] for one in answer["items"]] == [one["id"] for one in self.answer["items"]]
        return True


class Recorder(httpx.HTTPTransport):
    """The way to the service, which notes what goes to and fro."""

    def __init__(self) -> None:
        super().__init__()
        self.exchanges: list[Exchange] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        sent = request.read()
        response = super().handle_request(request)
        response.read()
        headers = {name: request.headers[name] for name in SENT if name in request.headers}
        target = request.url.raw_path.decode()
        made = Exchange(request.method, target, headers, base64.b64encode(sent).decode(), response.status_code)
        _note_answer(made, response)
        if made.waits() and self.exchanges and self.exchanges[-1].target == target:
            self.exchanges.pop()  # only the last word on a job counts
        self.exchanges.append(made)
        return response


def _note_answer(made: Exchange, response: httpx.Response) -> None:
    media = response.headers.get("content-type", "").partition(";")[0]
    if not response.content:
        return
    if media == "application/x-ndjson":
        made.answer = [_short(json.loads(line)) for line in response.text.splitlines()]
    elif media == "application/json" or media.endswith("+json"):
        made.answer = _short(response.json())
    else:
        made.media = media


def _short(value: Any) -> Any:
    """A value without what long texts say, such as pictures in base64."""
    if isinstance(value, Mapping):
        return {name: _short(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_short(one) for one in value]
    return f"{value[:20]}…" if isinstance(value, str) and len(value) > LONGEST else value


def text_of(exchanges: list[Exchange]) -> str:
    """The exchanges as JSON, one a line; each content that was sent stands there once."""
    digests = {one.content: hashlib.sha256(one.content.encode()).hexdigest()[:16] for one in exchanges}
    contents = [f"{json.dumps(digest)}: {json.dumps(content)}" for content, digest in digests.items()]
    lines = [json.dumps(asdict(replace(one, content=digests[one.content]))) for one in exchanges]
    return f'{{"contents": {{\n{_lines(contents)}\n}},\n"exchanges": [\n{_lines(lines)}\n]}}\n'


def _lines(of: list[str]) -> str:
    return ",\n".join(of)


def read(text: str) -> list[Exchange]:
    """The exchanges of a text of :func:`text_of`."""
    found = json.loads(text)
    return [Exchange(**{**one, "content": found["contents"][one["content"]]}) for one in found["exchanges"]]


@dataclass
class Replay:
    """The recorded requests, sent to a service of today.

    names: what it chose this time by what was chosen then.
    """

    client: httpx.Client
    names: dict[str, str] = field(default_factory=dict)

    def differences(self, exchanges: list[Exchange]) -> Iterator[str]:
        """What is not as recorded, a sentence each."""
        for number, one in enumerate(exchanges):
            found = self._ask(one)
            said = f"{number}: {one.method} {one.target}"
            if found.status != one.status:
                yield f"{said}: status {found.status} in place of {one.status}: {json.dumps(found.answer)[:300]}"
                continue
            if found.media != one.media:
                yield f"{said}: {found.media!r} in place of {one.media!r}"
            for difference in self.unlike(one.answer, found.answer):
                yield f"{said}: {difference}"

    def _ask(self, one: Exchange) -> Exchange:
        until = time.monotonic() + SECONDS
        while True:
            found = self._send(one)
            if found.status != 200 or one.is_over(found.answer) or time.monotonic() > until:
                return found
            time.sleep(0.02)

    def _send(self, one: Exchange) -> Exchange:
        headers = {name: self._renamed(value) for name, value in one.headers.items()}
        content = base64.b64decode(one.content)
        if one.headers.get("content-type", "").endswith("json"):
            content = self._renamed(content.decode()).encode()
        response = self.client.request(one.method, self._renamed(one.target), headers=headers, content=content)
        found = Exchange(one.method, one.target, headers, "", response.status_code)
        _note_answer(found, response)
        return found

    def _renamed(self, text: str) -> str:
        for then, now in self.names.items():
            text = text.replace(then, now)
        return text

    def unlike(self, then: Any, now: Any, path: str = "answer") -> Iterator[str]:
        """What of a recorded value is missing from today's, or of another kind."""
        if isinstance(then, Mapping):
            if not isinstance(now, Mapping):
                yield f"{path} is no object"
                return
            for name, value in then.items():
                if name not in now:
                    yield f"{path} has no {name}"
                    continue
                self._learn(name, value, now[name])
                if name == "matches":
                    value = _promised(value, then.get("verdict") == "recognized")
                if _is_fixed(name, path) and not isinstance(value, dict | list | float) and now[name] != value:
                    yield f"{path}.{name} is {now[name]!r} in place of {value!r}"
                yield from self.unlike(value, now[name], f"{path}.{name}")
        elif isinstance(then, list):
            if not isinstance(now, list) or bool(then) != bool(now):
                yield f"{path} is {json.dumps(now)[:80]} in place of a list of {len(then)}"
                return
            for index, (one, other) in enumerate(zip(then, now, strict=False)):
                yield from self.unlike(one, other, f"{path}[{index}]")
        elif then is not None and _kind(then) != _kind(now):
            yield f"{path} is {now!r} in place of {then!r}"

    def _learn(self, name: str, then: Any, now: Any) -> None:
        if name in CHOSEN and isinstance(then, str) and isinstance(now, str) and then != now and len(then) > 7:
            self.names[then] = now


def _is_fixed(name: str, path: str) -> bool:
    """Whether a field of an object has the value that was recorded."""
    return name in FIXED and not (name in OPEN and OPEN[name] in path)


def _promised(matches: Any, recognized: bool) -> Any:
    """Matches without their places, but for the recognized one: a later version may order the others otherwise."""
    if not isinstance(matches, list):
        return matches
    return [
        {name: value for name, value in one.items() if name != "place" or (recognized and not index)}
        for index, one in enumerate(matches)
    ]


def _kind(value: Any) -> str:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return type(value).__name__
    return "number" if isinstance(value, int | float) else type(value).__name__
