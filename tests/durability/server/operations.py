"""Random requests to the real service: each a JSON object that follows from the seed and the world before it."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from functools import lru_cache
from random import Random
from typing import Any

import httpx

from tests.durability.contents import sha
from tests.durability.model import ANY, MapModel, Refused, Shown, World
from tests.durability.storage.operations import DEFAULTS, MASKS, Operation
from tests.service.scenes import jpeg
from tests.service.server import text

PICTURES = 24
MAPS = 3
LARGEST_MAP = 24
SEQUENCES = (None, "monday", "tuesday")
JOB_SECONDS = 30.0
JOBS = ("re-encode", "prune", "merge")


@lru_cache(maxsize=PICTURES)
def picture(number: int) -> bytes:
    """One of the frames, as JPEG."""
    return jpeg(number, 160, 120)


@lru_cache(maxsize=PICTURES)
def shown(number: int) -> Shown:
    """What must be found of a place with this frame; thumbnail and descriptor are learnt when they are found."""
    return Shown(sha(picture(number)), ANY, ANY, sha(picture(number)), {}, {})


# The model's side


def apply(world: World, operation: Operation) -> Any:
    """Change the world as the request must; returns what its answer must be.

    Raises:
        Refused: it must be answered with this problem.
    """
    return _APPLIED[operation["do"]](world, operation)


def _map(world: World, operation: Operation) -> MapModel:
    if operation["map"] not in world:
        raise Refused("UnknownMap")
    return world[operation["map"]]


def _create(world: World, operation: Operation) -> None:
    world[operation["map"]] = MapModel({**DEFAULTS, **operation["settings"]})


def _enrol(world: World, operation: Operation) -> str:
    item = operation["item"]
    return _map(world, operation).enrol(item["id"], shown(item["picture"]), item["fields"], keypoints=ANY)


def _batch(world: World, operation: Operation) -> list[str]:
    map_ = _map(world, operation)
    items = operation["items"]
    return [map_.enrol(item["id"], shown(item["picture"]), item["fields"], keypoints=ANY) for item in items]


def _query(world: World, operation: Operation) -> Any:
    digest = shown(operation["picture"]).digest
    places = _map(world, operation).places.items()
    return {"among": [name for name, place in places if place.shown.digest == digest]}


def _camera(world: World, operation: Operation) -> None:
    _map(world, operation).cameras[operation["name"]] = operation["mask"]


def _reencode(world: World, operation: Operation) -> str:
    source = world[operation["map"]]
    target = MapModel(copy.deepcopy(source.settings), source.precision, cameras=copy.deepcopy(source.cameras))
    for place_id, place in source.places.items():
        target.adopt(place_id, place, place.ordinal)
    world[operation["to"]] = target
    return "succeeded"


def _merge(world: World, operation: Operation) -> str:
    target, source = world[operation["map"]], world[operation["from"]]
    ends = dict(target.ends)
    for place_id, place in source.places.items():
        if place_id not in target.places:
            target.adopt(place_id, place, ends.get(place.sequence, 0) + place.ordinal)
            behind = ends.get(place.sequence, 0) + source.ends[place.sequence]
            target.ends[place.sequence] = max(target.ends[place.sequence], behind)
    return "succeeded"


def _delete(world: World, operation: Operation) -> None:
    _map(world, operation)
    del world[operation["map"]]


def _import(world: World, operation: Operation) -> None:
    world[operation["to"]] = _map(world, operation).imported()


_APPLIED: dict[str, Callable[[World, Operation], Any]] = {
    "create": _create,
    "enrol": _enrol,
    "batch": _batch,
    "patch": lambda world, o: (_map(world, o).patch(o["id"], o["changes"]), None)[1],
    "forget": lambda world, o: _map(world, o).forget(o["id"]),
    "forget-sequence": lambda world, o: _map(world, o).forget_sequence(o["name"]),
    "edit": lambda world, o: _map(world, o).edit(o["changes"]),
    "camera": _camera,
    "query": _query,
    "delete": _delete,
    "import": _import,
    "re-encode": _reencode,
    "merge": _merge,
    "prune": lambda world, o: "succeeded",  # what goes is learnt from its report: see `pruned`
    "session": lambda world, o: None,
    "frame": lambda world, o: None,
    "end-session": lambda world, o: None,
}


def pruned(world: World, map_id: str, report: dict[str, Any]) -> World:
    """The world after a job has forgotten what its report names."""
    after = copy.deepcopy(world)
    for place_id in report["named"]:
        after[map_id].forget(place_id)
    return after


# The requests


def send(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    """Send the request; the answer in the model's form, with the places in it."""
    return _SENT[operation["do"]](client, operation)


def _checked(response: httpx.Response) -> dict[str, Any] | None:
    """The answer for a problem; None for success."""
    if response.status_code < 300:
        return None
    problem = response.json()
    slug = problem["type"].rsplit(":", 1)[-1]
    return {"answer": {"error": "".join(word.capitalize() for word in slug.split("-"))}, "problem": problem}


def _simple(method: str, path: str, **content: Any) -> Callable[[httpx.Client, Operation], dict[str, Any]]:
    def sent(client: httpx.Client, operation: Operation) -> dict[str, Any]:
        given = {name: make(operation) for name, make in content.items()}
        return _checked(client.request(method, path.format(**operation), **given)) or {"answer": None}

    return sent


def _send_enrol(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    item = operation["item"]
    fields = dict(item["fields"])
    parameters = text(fields.pop("pose", {}) | fields)
    path = f"/v1/maps/{operation['map']}/places/{item['id']}"
    headers = {"Content-Type": "image/jpeg"}
    response = client.put(path, params=parameters, content=picture(item["picture"]), headers=headers)
    if (problem := _checked(response)) is not None:
        return problem
    told = response.json()
    return {"answer": told["change"], "places": [told]}


def _send_batch(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    places, files = [], {}
    for number, item in enumerate(operation["items"]):
        fields = dict(item["fields"])
        places.append({"id": item["id"], "file": f"f{number}", **fields.pop("pose", {}), **fields})
        files[f"f{number}"] = (f"f{number}", picture(item["picture"]), "image/jpeg")
    path = f"/v1/maps/{operation['map']}/places"
    response = client.post(path, data={"places": json.dumps(places)}, files=files)
    if (problem := _checked(response)) is not None:
        return problem
    items = response.json()["items"]
    told = {item["id"]: item["place"] for item in items if item.get("place")}
    return {"answer": [item.get("change", item["status"]) for item in items], "places": list(told.values())}


def _send_query(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    path = f"/v1/maps/{operation['map']}/query"
    response = client.post(path, content=picture(operation["picture"]), headers={"Content-Type": "image/jpeg"})
    if (problem := _checked(response)) is not None:
        return problem
    matches = response.json()["matches"]
    return {"answer": {"first": matches[0]["place"]["id"] if matches else None}}


def _send_patch(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    path = f"/v1/maps/{operation['map']}/places/{operation['id']}"
    response = client.patch(path, json=operation["changes"])
    return _checked(response) or {"answer": None, "places": [response.json()]}


def _send_edit(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    response = client.patch(f"/v1/maps/{operation['map']}", json=operation["changes"])
    return _checked(response) or {"answer": response.json()["revision"]}


def _send_forget_sequence(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    response = client.delete(f"/v1/maps/{operation['map']}/sequences/{operation['name']}")
    return _checked(response) or {"answer": response.json()["places"]}


def _send_job(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    """Ask for a job and wait for its end."""
    wanted = {
        "re-encode": {"to": operation.get("to"), "encoder": "coarse"},
        "merge": {"from": operation.get("from"), "dry_run": False, "on_conflict": "skip", "sample": 0},
        "prune": {"dry_run": False, "similarity": 0.6},
    }[operation["do"]]
    response = client.post(f"/v1/maps/{operation['map']}/{operation['do']}", json=wanted)
    return _checked(response) or {"job": response.json()["id"]}


def _send_session(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    response = client.post(f"/v1/maps/{operation['map']}/sessions", json={"lag": 0, "expires_after": 3600})
    return _checked(response) or {"answer": None, "session": response.json()["id"]}


def _send_frame(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    path = f"/v1/maps/{operation['map']}/sessions/{operation['session']}/frames?frame={operation['frame']}"
    response = client.post(path, content=picture(operation["picture"]), headers={"Content-Type": "image/jpeg"})
    problem = _checked(response)
    if problem is None:
        assert response.json()["saved"], response.text
    return problem or {"answer": None}


def _send_import(client: httpx.Client, operation: Operation) -> dict[str, Any]:
    exported = client.get(f"/v1/maps/{operation['map']}/export")
    if (problem := _checked(exported)) is not None:
        return problem
    headers = {"Content-Type": exported.headers["content-type"]}
    response = client.post(f"/v1/maps/import?id={operation['to']}", content=exported.content, headers=headers)
    return _checked(response) or {"answer": None}


_SENT: dict[str, Callable[[httpx.Client, Operation], dict[str, Any]]] = {
    "create": _simple("POST", "/v1/maps", json=lambda o: {"id": o["map"], **o["settings"]}),
    "enrol": _send_enrol,
    "batch": _send_batch,
    "patch": _send_patch,
    "forget": _simple("DELETE", "/v1/maps/{map}/places/{id}"),
    "forget-sequence": _send_forget_sequence,
    "edit": _send_edit,
    "camera": _simple("PUT", "/v1/maps/{map}/cameras/{name}", json=lambda o: {"mask": o["mask"]}),
    "query": _send_query,
    "delete": _simple("DELETE", "/v1/maps/{map}"),
    "import": _send_import,
    "session": _send_session,
    "frame": _send_frame,
    "end-session": _simple("DELETE", "/v1/maps/{map}/sessions/{session}"),
    **dict.fromkeys(JOBS, _send_job),
}


# The choice


def chosen(
    random: Random, world: World, prefix: str, session: dict[str, Any] | None, single: bool = False
) -> Operation:
    """The next request of the client whose maps' ids begin with ``prefix``.

    Args:
        session: the one that is open, with its map, id and last frame.
        single: only requests without jobs and uploads, whose effect is complete when they are answered.
    """
    names = [f"{prefix}{number}" for number in range(MAPS)]
    there, free = [name for name in names if name in world], [name for name in names if name not in world]
    if not there or (free and random.random() < 0.05):
        keep = random.choice(["image", "image", "thumbnail", "none"])
        return {"do": "create", "map": free[0], "settings": {"keep": keep, "description": f"{random.random()}"}}
    name = random.choice(there)
    if session is not None and random.random() < 0.25:
        if random.random() < 0.05:
            return {"do": "end-session", "map": session["map"], "session": session["id"]}
        frame, seen = session["last"] + random.randrange(1, 3), random.randrange(PICTURES)
        return {"do": "frame", "map": session["map"], "session": session["id"], "frame": frame, "picture": seen}
    if len(world[name].places) > LARGEST_MAP and random.random() < 0.5:
        return {"do": "delete", "map": name}
    kinds = [kind for kind in _CHOSEN if not (single and kind in (*JOBS, "import"))]
    kind = random.choices(kinds, [_WEIGHTS[kind] for kind in kinds])[0]
    if kind == "session" and session is not None:
        kind = "enrol"
    return _CHOSEN[kind](random, world, name, there, free) or _CHOSEN["enrol"](random, world, name, there, free) or {}


def _fields(random: Random) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    if random.random() < 0.6:
        fields["pose"] = {"x": random.randrange(30), "y": 0.5, "heading": random.randrange(360)}
    if (sequence := random.choice(SEQUENCES)) is not None:
        fields["sequence"] = sequence
    if random.random() < 0.4:
        fields["timestamp"] = f"2026-11-{random.randrange(1, 29):02}T10:00:00Z"
    if random.random() < 0.5:
        fields["metadata"] = {"floor": random.randrange(9), "note": "ü" * random.choice([0, 3, 900])}
    return fields


def _item(random: Random, map_: MapModel) -> dict[str, Any]:
    known = list(map_.places)
    place_id = random.choice(known) if known and random.random() < 0.2 else f"p{random.randrange(60)}"
    return {"id": place_id, "picture": random.randrange(PICTURES), "fields": _fields(random)}


def _any_id(random: Random, map_: MapModel) -> str:
    return "nobody" if not map_.places or random.random() < 0.03 else random.choice(list(map_.places))


_Chosen = Callable[[Random, World, str, list[str], list[str]], Operation | None]


def _choose_patch(random: Random, world: World, name: str, there: list[str], free: list[str]) -> Operation:
    changes: dict[str, Any] = random.choice([
        {"sequence": random.choice(["monday", None])},
        {"pose": {"x": random.randrange(50), "y": 1}},
        {"metadata": {"floor": None, "long": "x" * random.randrange(3000)}},
        {"timestamp": None},
    ])  # fmt: skip
    return {"do": "patch", "map": name, "id": _any_id(random, world[name]), "changes": changes}


def _choose_edit(random: Random, world: World, name: str, there: list[str], free: list[str]) -> Operation:
    changes: dict[str, Any] = random.choice([
        {"description": f"number {random.randrange(1000)}"},
        {"keep": random.choice(["none", "thumbnail", "image"])},
        {"index": random.choice(["exact", "compact", "auto"])},
    ])  # fmt: skip
    return {"do": "edit", "map": name, "changes": changes}


def _choose_batch(random: Random, world: World, name: str, there: list[str], free: list[str]) -> Operation:
    items = {item["id"]: item for item in (_item(random, world[name]) for _ in range(random.randrange(2, 6)))}
    return {"do": "batch", "map": name, "items": list(items.values())}


def _choose_reencode(random: Random, world: World, name: str, there: list[str], free: list[str]) -> Operation | None:
    places = world[name].places.values()
    if not free or not places or any(place.kept != "image" for place in places):
        return None
    return {"do": "re-encode", "map": name, "to": free[0]}


def _choose_merge(random: Random, world: World, name: str, there: list[str], free: list[str]) -> Operation | None:
    others = [one for one in there if one != name]
    return {"do": "merge", "map": name, "from": random.choice(others)} if others else None


def _choose_import(random: Random, world: World, name: str, there: list[str], free: list[str]) -> Operation | None:
    return {"do": "import", "map": name, "to": free[0]} if free else None


_CHOSEN: dict[str, _Chosen] = {
    "enrol": lambda random, world, name, there, free: {"do": "enrol", "map": name, "item": _item(random, world[name])},
    "batch": _choose_batch,
    "patch": _choose_patch,
    "forget": lambda random, world, name, there, free: {
        "do": "forget", "map": name, "id": _any_id(random, world[name])
    },
    "forget-sequence": lambda random, world, name, there, free: {
        "do": "forget-sequence", "map": name, "name": random.choice(["monday", "tuesday"])
    },
    "edit": _choose_edit,
    "camera": lambda random, world, name, there, free: {
        "do": "camera", "map": name, "name": random.choice(["front", "rear"]), "mask": random.choice(MASKS)
    },
    "query": lambda random, world, name, there, free: {
        "do": "query", "map": name, "picture": random.randrange(PICTURES)
    },
    "delete": lambda random, world, name, there, free: {"do": "delete", "map": name},
    "session": lambda random, world, name, there, free: {"do": "session", "map": name},
    "import": _choose_import,
    "re-encode": _choose_reencode,
    "merge": _choose_merge,
    "prune": lambda random, world, name, there, free: {"do": "prune", "map": name},
}  # fmt: skip
_WEIGHTS = {
    "enrol": 14, "batch": 6, "patch": 7, "forget": 4, "forget-sequence": 0.6, "edit": 3, "camera": 2, "query": 6,
    "delete": 0.8, "session": 2, "import": 1, "re-encode": 1.5, "merge": 1.5, "prune": 0.8,
}  # fmt: skip
