"""The surface of a version: all names that programs and people rely on, and what of an earlier one is missing today."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from collections.abc import Iterator
from typing import Any, get_args

import typer.main

from placerec_ros.parameters import PARAMETERS
from service.commands.application import application
from service.errors.problems import INTERNAL, INVALID_REQUEST, KINDS, MALFORMED_BODY
from service.events.schemas import EventKind
from service.settings import Settings
from tests.project.sources import NODE, ROOT

_TOPIC = re.compile(r'create_(?:lifecycle_)?(?:publisher|subscription|service)\(\s*(\w+), (?:f?"([^"]+)")')


def surface(metrics: str) -> dict[str, list[str]]:
    """All names by kind.

    Args:
        metrics: the text of /metrics of a service that has answered.
    """
    known = [*KINDS.values(), INTERNAL, INVALID_REQUEST, MALFORMED_BODY]
    source = "".join(path.read_text() for path in sorted((NODE / "placerec_ros").glob("*.py")))
    found = {
        "settings": Settings.model_fields,
        "commands": _commands(typer.main.get_command(application), "placerec"),
        "problems": {kind.slug for kind in known},
        "events": get_args(EventKind),
        "metrics": re.findall(r"^# TYPE (placerec_\w+)", metrics, re.MULTILINE),
        "client": _client(),
        "ros parameters": {one.name for one in PARAMETERS},
        "ros topics": {f"{topic} {kind}" for kind, topic in _TOPIC.findall(source)},
    }
    return {kind: sorted(set(names)) for kind, names in found.items()}


def _commands(command: Any, path: str) -> Iterator[str]:
    """Commands with their options, arguments without."""
    for name in getattr(command, "commands", ()):
        yield from _commands(command.get_command(None, name), f"{path} {name}")
    if not hasattr(command, "commands"):
        yield path
        yield from (f"{path} {name}" for one in command.params for name in one.opts if name.startswith("-"))


def _client() -> Iterator[str]:
    """Public names of the client, the methods of its classes, and their parameters."""
    package = importlib.import_module("placerec_client")
    for name in package.__all__:
        yield name
        made = getattr(package, name)
        if not inspect.isclass(made):
            continue
        for method, function in inspect.getmembers(made, callable):
            if not method.startswith("_") and getattr(function, "__module__", "").startswith("placerec_client"):
                yield f"{name}.{method}"
                parameters = inspect.signature(function).parameters.values()
                yield from (f"{name}.{method}({one.name})" for one in parameters if one.name != "self")


def missing(then: dict[str, list[str]], now: dict[str, list[str]]) -> list[str]:
    """The names of an earlier surface that today's does not have."""
    return [f"{kind}: {name}" for kind, names in then.items() for name in names if name not in now.get(kind, ())]


def interface() -> dict[str, Any]:
    """Today's openapi.json."""
    found: dict[str, Any] = json.loads((ROOT / "openapi.json").read_text())
    return found


def broken(then: dict[str, Any], now: dict[str, Any]) -> Iterator[str]:
    """What a client of an earlier interface misses in today's: a sentence each."""
    for path, operations in then["paths"].items():
        for method, operation in operations.items():
            said = f"{method.upper()} {path}"
            today = now["paths"].get(path, {}).get(method)
            if today is None:
                yield f"{said} is gone"
            else:
                yield from (f"{said}: {sentence}" for sentence in _operation(operation, today))
    asked, answered = _reached(then, "requestBody"), _reached(then, "responses")
    for name, schema in then["components"]["schemas"].items():
        today = now["components"]["schemas"].get(name)
        if today is None:
            yield f"the schema {name} is gone"
            continue
        gone = set(schema.get("properties", ())) - set(today.get("properties", ()))
        yield from (f"{name} has no {field}" for field in sorted(gone))
        was, needs = set(schema.get("required", ())), set(today.get("required", ()))
        if name in asked:
            yield from (f"{name} must have {field}" for field in sorted(needs - was))
        if name in answered:
            yield from (f"{name} may lack {field}" for field in sorted(was - needs))


def _operation(then: dict[str, Any], now: dict[str, Any]) -> Iterator[str]:
    was, has = ({(one["in"], one["name"]): one for one in each.get("parameters", ())} for each in (then, now))
    yield from (f"the parameter {name} is gone" for _, name in was.keys() - has.keys())
    needed = [name for name, one in has.items() if one.get("required") and not was.get(name, {}).get("required")]
    yield from (f"the parameter {name} must be given" for _, name in needed)
    bodies = [set(each.get("requestBody", {}).get("content", ())) for each in (then, now)]
    yield from (f"a body of {media} is refused" for media in bodies[0] - bodies[1])
    for status, answer in then["responses"].items():
        if status not in now["responses"]:
            yield f"the status {status} is gone"
        else:
            gone = set(answer.get("content", ())) - set(now["responses"][status].get("content", ()))
            yield from (f"{status} has no {media}" for media in gone)
    if then["operationId"] != now["operationId"]:
        yield f"its id is {now['operationId']} in place of {then['operationId']}"


def _reached(document: dict[str, Any], part: str) -> set[str]:
    """The schemas that requests or answers are made of."""
    operations = [one for each in document["paths"].values() for one in each.values()]
    waiting = [name for one in operations for name in _named(one.get(part, {}))]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += _named(document["components"]["schemas"].get(name, {}))
    return found


def _named(value: Any) -> list[str]:
    return re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(value))
