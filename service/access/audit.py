"""The audit trail: a line for each change of a map, with the name of the key behind it.

The lines go to the logger ``placerec.audit``, whatever level the other logs have, and to a file of their own if one is
set.  No line holds a key, a frame, or metadata.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from logging.handlers import WatchedFileHandler
from pathlib import Path
from typing import Any

from core.errors import StorageFailure
from service.access.principals import ASKER, Asker, Principal
from service.telemetry.requests import JsonLines

LOGGER = "placerec.audit"
REPEAT_SECONDS = 60.0
"""A refusal that repeats is told so often, with how often it came."""

MOST_REFUSALS = 1024
"""Refusals that are told apart."""

PARTS = {"map": "map", "place": "place", "sequence": "sequence", "camera": "camera", "job": "job"}
"""Names in a path that say what was changed."""

log = logging.getLogger(LOGGER)


def asker_of(principal: Principal, operation: str, state: Mapping[str, Any], client: str | None) -> Asker:
    """Who asks for a change.

    Args:
        state: of the request; its ids are in it.
        client: the address that it came from.
    """
    return Asker(principal.name, principal.key_id, operation, state.get("request_id"), state.get("trace_id"), client)


def told(asker: Asker) -> dict[str, Any]:
    """What a line says of who asked; what is not known is left out."""
    return {name: value for name, value in asdict(asker).items() if value is not None}


def note_change(asker: Asker, path: Mapping[str, str], noted: Mapping[str, Any], status: int) -> None:
    """Tell of a request to change a map, when it has been answered.

    Args:
        path: the parts of its path.
        noted: what its operation noted of it, such as the map's id or a count; ``"change": None`` says that
            nothing was changed.
        status: 0 if there was no answer, which leaves open whether the change was made.
    """
    if noted.get("change", "") is None and status < 400:
        return
    named = {name: path[name] for name in PARTS if name in path}
    log.info("change", extra={**named, **noted, **told(asker), "status": status})


def note_job(
    event: str,
    job: Mapping[str, Any],
    arguments: Mapping[str, Any],
    problem: Mapping[str, Any] | None,
    asker: Mapping[str, Any],
) -> None:
    """Write that a job begins to change a map, or how it has ended.

    Args:
        event: "running", or the state in which the job has ended.
        job: the fields that tell which job it is, such as its id and its map.
        arguments: what the job was asked to do; the line names other maps and ``dry_run`` if they are among them.
        problem: the problem object of a job that has failed.
        asker: who asked for the job, as :func:`now_asking` gave it.
    """
    line = dict(job)
    for name in ("from", "to"):
        if isinstance(arguments.get(name), str):
            line[name] = arguments[name]
    if isinstance(arguments.get("dry_run"), bool):
        line["dry_run"] = arguments["dry_run"]
    if problem is not None:
        line["problem"] = problem.get("type")
    log.info("job %s", event, extra={**line, **dict(asker)})


def now_asking() -> dict[str, Any]:
    """Who asks for what is being done now, for a job to keep."""
    return told(ASKER.get())


@contextmanager
def kept_in(path: Path | None) -> Iterator[None]:
    """Append the trail to a file, too, one JSON object a line; one that is moved away is made anew.

    Raises:
        StorageFailure: it cannot be opened.
    """
    if path is None:
        yield
        return
    try:
        handler = WatchedFileHandler(path, encoding="utf-8")
    except OSError as error:
        raise StorageFailure(f"The audit file {path} cannot be opened: {error.strerror}.") from error
    handler.setFormatter(JsonLines())
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        handler.close()


class Refusals:
    """Lines about requests that were not let in; one that repeats is told now and then, so that nobody fills a disk."""

    def __init__(self) -> None:
        self._told: OrderedDict[tuple[str | None, ...], tuple[float, int]] = OrderedDict()

    def note(self, asker: Asker, path: Mapping[str, str], status: int, problem: str) -> None:
        """Tell that a request was refused."""
        kind = (asker.client, asker.key, asker.operation, problem)
        now = time.monotonic()
        told_at, silent = self._told.get(kind, (-REPEAT_SECONDS, 0))
        if now - told_at < REPEAT_SECONDS:
            self._told[kind] = (told_at, silent + 1)
            return
        self._told[kind] = (now, 0)
        self._told.move_to_end(kind)
        if len(self._told) > MOST_REFUSALS:
            self._told.popitem(last=False)
        named = {name: path[name] for name in PARTS if name in path}
        repeated = {"before": silent} if silent else {}
        log.info("refused", extra={**named, **told(asker), "status": status, "problem": problem, **repeated})
