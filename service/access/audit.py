"""The audit trail: a line for each change of a map, and for who saw its pictures, with the name of the key.

The lines go to the logger ``placerec.audit``, whatever level the other logs have, and are stored by
``service.administration.audit_trail``.  No line contains a key, a frame, or metadata.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from typing import Any

from service.access.rates import network_of
from service.access.roles import Principal

LOGGER = "placerec.audit"
REPEAT_SECONDS = 60.0
"""Repeated events, such as refusals, are logged once in this time, with the number of repetitions."""

MOST_KINDS = 1024
"""Most kinds of refusals, and of disclosures, that are counted apart."""

PARTS = {
    "map": "map",
    "place": "place",
    "sequence": "sequence",
    "camera": "camera",
    "job": "job",
    "recording": "recording",
}
"""Parameters of a path that identify the changed object."""

log = logging.getLogger(LOGGER)


@dataclass(frozen=True)
class Asker:
    """The caller of a change, and the request; a job stores it, so that its end can be logged with it."""

    principal: str
    key: str | None = None
    operation: str | None = None
    request_id: str | None = None
    trace_id: str | None = None
    client: str | None = None

    @property
    def caller(self) -> str:
        """The name under which its work is counted: the key's id or, without a key, the address."""
        return self.key or network_of(self.client)


ASKER: ContextVar[Asker] = ContextVar("asker", default=Asker("owner"))  # noqa: B039 - frozen
"""The caller of the present work; threads that a request starts inherit it."""


def asker_of(principal: Principal, operation: str, state: Mapping[str, Any], client: str | None) -> Asker:
    """Who sends a request.

    Args:
        state: the state of the request, which holds its ids.
        client: the address that it came from.
    """
    return Asker(principal.name, principal.key_id, operation, state.get("request_id"), state.get("trace_id"), client)


def asker_fields(asker: Asker) -> dict[str, Any]:
    """The fields of a line that identify the caller; unknown ones are left out."""
    return {name: value for name, value in asdict(asker).items() if value is not None}


def asker_of_fields(fields: Mapping[str, Any]) -> Asker:
    """The caller from the fields of :func:`asker_fields`; nobody without fields."""
    known = Asker.__dataclass_fields__
    return Asker(**{"principal": "", **{name: value for name, value in fields.items() if name in known}})


def note_change(asker: Asker, path: Mapping[str, str], noted: Mapping[str, Any], status: int) -> None:
    """Log a request that changes a map, once it has been answered.

    Args:
        path: the parameters of its path.
        noted: the notes of its operation, such as the map's id or a count; ``"change": None`` says that nothing was
            changed.
        status: the status of the answer; 0 if there was none, which leaves open whether the change was made.
    """
    if noted.get("change", "") is None and status < 400:
        return
    named = {name: path[name] for name in PARTS if name in path}
    log.info("change", extra={**named, **noted, **asker_fields(asker), "status": status})


def note_job(
    event: str,
    job: Mapping[str, Any],
    arguments: Mapping[str, Any],
    problem: Mapping[str, Any] | None,
    asker: Mapping[str, Any],
) -> None:
    """Log that a job begins to change a map, or how it has ended.

    Args:
        event: "running", or the state in which the job has ended.
        job: the fields that identify the job, such as its id and its map.
        arguments: the arguments of the job; the line names other maps, a recording and ``dry_run`` if they are among
            them.
        problem: the problem object of a job that has failed.
        asker: the caller who started the job, from :func:`now_asking`.
    """
    line = dict(job)
    for name in ("from", "to", "recording"):
        if isinstance(arguments.get(name), str):
            line[name] = arguments[name]
    if isinstance(arguments.get("dry_run"), bool):
        line["dry_run"] = arguments["dry_run"]
    if problem is not None:
        line["problem"] = problem.get("type")
    log.info("job %s", event, extra={**line, **dict(asker)})


def now_asking() -> dict[str, Any]:
    """The fields of the caller of the present work, for a job to store."""
    return asker_fields(ASKER.get())


class Repeats:
    """Logs what may be repeated often: only now and then, so that it does not fill the disk."""

    def __init__(self) -> None:
        self._logged: OrderedDict[tuple[str | None, ...], tuple[float, int]] = OrderedDict()

    def note(self, event: str, kind: tuple[str | None, ...], fields: Mapping[str, Any]) -> None:
        """Note an event; it is not logged if one of its kind was logged a moment ago."""
        now = time.monotonic()
        logged_at, silent = self._logged.get(kind, (-REPEAT_SECONDS, 0))
        if now - logged_at < REPEAT_SECONDS:
            self._logged[kind] = (logged_at, silent + 1)
            return
        self._logged[kind] = (now, 0)
        self._logged.move_to_end(kind)
        if len(self._logged) > MOST_KINDS:
            self._logged.popitem(last=False)
        log.info(event, extra={**fields, **({"before": silent} if silent else {})})


class Refusals:
    """Logs requests that were refused."""

    def __init__(self) -> None:
        self._repeats = Repeats()

    def note(self, asker: Asker, path: Mapping[str, str], status: int, problem: str) -> None:
        """Note that a request was refused."""
        kind = (asker.client, asker.key, asker.operation, problem)
        named = {name: path[name] for name in PARTS if name in path}
        fields = {**named, **asker_fields(asker), "status": status, "problem": problem}
        self._repeats.note("refused", kind, fields)


class Disclosures:
    """Logs requests that were given pictures of a map, or all of it."""

    def __init__(self) -> None:
        self._repeats = Repeats()

    def note(self, asker: Asker, path: Mapping[str, str], status: int) -> None:
        """Note that a request is answered with them."""
        kind = (asker.client, asker.key, asker.operation, path.get("map"))
        named = {name: path[name] for name in PARTS if name in path}
        self._repeats.note("shown", kind, {**named, **asker_fields(asker), "status": status})
