"""Random operations on the storage layer: each a JSON object that follows from the seed and the world before it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from random import Random
from typing import Any

import numpy as np

from core.maps import Enrolment, MapSettings
from core.maps.forms import pack_descriptors, pack_local, unpack_descriptors, unpack_local
from core.maps.records import Precision
from core.places import PlaceFields, look_address
from tests.core.store.frames import DIMENSION, LOCAL_SHAPE, descriptor_of, digest_of, keypoints_of, local_of
from tests.durability.contents import sha
from tests.durability.model import MapModel, Refused, Shown, World

Operation = dict[str, Any]

SEQUENCES = (None, None, "monday", "tuesday", "wednesday")
PICTURES = 400
LARGEST_MAP = 32
MAPS = 3
MASKS = (None, {"polygons": [[[0, 0], [1, 0], [1, 0.2]]]}, {"polygons": [[[0, 0.8], [1, 0.8], [1, 1], [0, 1]]]})

DEFAULTS = MapSettings().model_dump(mode="json")


def image_of(picture: str) -> bytes:
    """The bytes of a picture: a few to some tens of thousands, depending on its name."""
    length = 1 << (digest_of(picture)[0] % 16)
    return (f"image of {picture} ".encode() * (1 + length // 12))[:length] + picture.encode()


def thumbnail_of(picture: str) -> bytes:
    """The bytes of its thumbnail."""
    return f"thumbnail of {picture}".encode()


@lru_cache(maxsize=4096)
def shown(picture: str) -> Shown:
    """What must be found of a place with this picture."""
    real = descriptor_of(picture)[np.newaxis]
    kept: tuple[Precision, ...] = ("half", "compressed")
    stored = {name: unpack_descriptors(pack_descriptors(real, name), name, DIMENSION) for name in kept}
    cells = local_of(picture)[np.newaxis]
    local = {name: unpack_local(pack_local(cells, name), name, LOCAL_SHAPE) for name in kept}
    return Shown(
        digest=hashlib.sha256(image_of(picture)).hexdigest(),
        regions=len(picture),
        thumbnail=sha(thumbnail_of(picture)),
        image=sha(image_of(picture)),
        descriptor={name: sha(vector[0].tobytes()) for name, vector in stored.items()},
        local={name: sha(found[0].tobytes()) for name, found in local.items()},
        keypoints=sha(keypoints_of(picture).record()),
    )


def look_enrolment(
    place: str, picture: str, seen: Any, camera: str | None, run: str | None, least: float | None, keypoints: bool
) -> Enrolment:
    """A picture as it is added to the looks of a place."""
    item = enrolment(place, picture, {"timestamp": seen, "camera": camera}, keypoints)
    return replace(item, id=look_address(place, item.digest.hex()[:16]), run=run, least=least)


def enrolment(id: str, picture: str, fields: dict[str, Any], keypoints: bool) -> Enrolment:
    """A picture as it is enrolled, with or without keypoints; ``"blank"`` has no region."""
    descriptor = np.zeros(DIMENSION, np.float32) if picture == "blank" else descriptor_of(picture)
    return Enrolment(
        id,
        PlaceFields.model_validate(fields),
        descriptor,
        len(picture),
        hashlib.sha256(image_of(picture)).digest(),
        local_of(picture),
        thumbnail_of(picture),
        image_of(picture),
        keypoints_of(picture) if keypoints else None,
    )


@lru_cache(maxsize=4096)
def traces_of(picture: str) -> list[bytes]:
    """Bytes that a file has only if it has something of a picture, in any form in which a map stores it."""
    kept: tuple[Precision, ...] = ("half", "compressed")
    found = [
        keypoints_of(picture).record(),
        *(pack_descriptors(descriptor_of(picture)[np.newaxis], name).tobytes() for name in kept),
    ]
    image = image_of(picture)
    return [*found, image[:128]] if len(image) >= 256 else found  # shorter ones may be the beginning of another's


@lru_cache(maxsize=1)
def pictures() -> dict[bytes, str]:
    """The names of all pictures by the SHA-256 of their bytes."""
    names = [f"picture {number}" for number in range(PICTURES)]
    return {hashlib.sha256(image_of(name)).digest(): name for name in names}


# The model's side


def apply(world: World, operation: Operation) -> Any:
    """Change the world as the operation must; returns what its answer must be.

    Raises:
        Refused: it must be refused.
    """
    return _APPLIED[operation["do"]](world, operation)


def _map(world: World, name: str) -> MapModel:
    if name not in world or not world[name].listed:
        raise Refused("UnknownMap")
    return world[name]


def _create(world: World, operation: Operation) -> None:
    if operation["map"] in world:
        raise Refused("MapExists")
    settings = {**DEFAULTS, **operation["settings"]}
    world[operation["map"]] = MapModel(settings, operation["precision"], not operation["unlisted"])


def _enrol(world: World, operation: Operation) -> list[str]:
    map_ = _map(world, operation["map"])
    if any(item["picture"] == "blank" for item in operation["items"]):
        raise Refused("NoRegions")
    found = [(item, shown(item["picture"])) for item in operation["items"]]
    return [
        map_.enrol(item["id"], of, item["fields"], keypoints=of.keypoints if item["keypoints"] else None)
        for item, of in found
    ]


def _looks(world: World, operation: Operation) -> list[str]:
    map_ = _map(world, operation["map"])
    return [
        map_.add_look(item["place"], of := shown(item["picture"]), item["seen"], item["camera"], item["run"],
                      item["least"], of.keypoints if item["keypoints"] else None)
        for item in operation["items"]
    ]  # fmt: skip


def _adopt(world: World, operation: Operation) -> None:
    source, target = _map(world, operation["from"]), world[operation["map"]]
    for place_id, ordinal in operation["places"]:
        target.adopt(place_id, source.places[place_id], ordinal)


def _camera(world: World, operation: Operation) -> bool:
    cameras = _map(world, operation["map"]).cameras
    is_new = operation["name"] not in cameras
    cameras[operation["name"]] = operation["mask"]
    return is_new


def _forget_camera(world: World, operation: Operation) -> None:
    cameras = _map(world, operation["map"]).cameras
    if operation["name"] not in cameras:
        raise Refused("UnknownCamera")
    del cameras[operation["name"]]


def _forget_many(world: World, operation: Operation) -> int:
    map_ = _map(world, operation["map"])
    for place_id in operation["ids"]:
        map_.forget(place_id)
    return len(operation["ids"])


def _counterparts(world: World, operation: Operation) -> None:
    _map(world, operation["map"]).store_counterparts(operation["stations"], operation["poses"])


def _import(world: World, operation: Operation) -> None:
    source = _map(world, operation["map"])
    if operation["to"] in world:
        raise Refused("MapExists")
    world[operation["to"]] = source.imported()


def _review(world: World, operation: Operation) -> bool:
    digest = hashlib.sha256(image_of(operation["picture"])).hexdigest()
    return _map(world, operation["map"]).keep_for_review(digest, operation["answer"], operation["most"])


def _label(world: World, operation: Operation) -> None:
    _map(world, operation["map"]).review[operation["at"]][2] = operation["label"]


def _discard(world: World, operation: Operation) -> None:
    del _map(world, operation["map"]).review[operation["at"]]


def _delete(world: World, operation: Operation) -> None:
    _map(world, operation["map"])
    del world[operation["map"]]


def _publish(world: World, operation: Operation) -> None:
    if operation["map"] not in world or world[operation["map"]].listed:
        raise Refused("UnknownMap")
    world[operation["map"]].listed = True


def _abandon(world: World, operation: Operation) -> None:
    if operation["map"] in world and not world[operation["map"]].listed:
        del world[operation["map"]]


_APPLIED: dict[str, Callable[[World, Operation], Any]] = {
    "create": _create,
    "enrol": _enrol,
    "set": lambda world, o: _map(world, o["map"]).set_fields(o["id"], o["fields"]),
    "patch": lambda world, o: (_map(world, o["map"]).patch(o["id"], o["changes"]), None)[1],
    "forget": lambda world, o: _map(world, o["map"]).forget(o["id"]),
    "forget-sequence": lambda world, o: _map(world, o["map"]).forget_sequence(o["name"]),
    "forget-many": _forget_many,
    "looks": _looks,
    "forget-look": lambda world, o: _map(world, o["map"]).forget_look(o["id"], o["look"]),
    "forget-learnt": lambda world, o: _map(world, o["map"]).forget_learnt(o["run"]),
    "edit": lambda world, o: _map(world, o["map"]).edit(o["changes"]),
    "keypoints": lambda world, o: _map(world, o["map"]).fill_in(o["limit"]),
    "counterparts": _counterparts,
    "camera": _camera,
    "forget-camera": _forget_camera,
    "adopt": _adopt,
    "delete": _delete,
    "publish": _publish,
    "abandon": _abandon,
    "erase": lambda world, o: _map(world, o["map"]).erase(),
    "rebuild": lambda world, o: None,
    "import": _import,
    "review": _review,
    "label": _label,
    "discard": _discard,
    "look": lambda world, o: None,
    "reopen": lambda world, o: None,
}


# The choice


def chosen(random: Random, world: World, prefix: str) -> Operation:
    """The next operation of the worker whose maps' ids begin with ``prefix``."""
    names = [f"{prefix}{number}" for number in range(MAPS)]
    listed = [name for name in names if name in world and world[name].listed]
    unlisted = [name for name in names if name in world and not world[name].listed]
    free = [name for name in names if name not in world]
    if free and (not listed or random.random() < 0.04):
        return _new_map(random, random.choice(free), bool(listed) and random.random() < 0.4)
    if unlisted and random.random() < 0.2:
        return _with_unlisted(random, world, random.choice(unlisted), listed)
    if random.random() < 0.01:
        return {"do": "enrol", "map": free[0] if free else f"{prefix}none", "items": [_item(random, "p0")]}
    name = random.choice(listed)
    map_ = world[name]
    if len(map_.places) > LARGEST_MAP and random.random() < 0.5:
        return {"do": "delete", "map": name}
    kinds = ("enrol", "enrol", "enrol", "batch", "batch", "fields", "patch", "forget", "sequence", "many", "edit",
             "looks", "unlook", "keypoints", "counterparts", "camera", "adopt", "delete", "look", "reopen",
             "erase", "rebuild", "import", "review")  # fmt: skip
    weights = (6, 6, 6, 5, 5, 4, 5, 3, 0.7, 1, 2, 8, 2, 2, 3, 2, 3, 0.7, 4, 0.5, 4, 1, 2, 4)
    kind = random.choices(kinds, weights)[0]
    return _CHOSEN[kind](random, world, name, listed) or _batch(random, world, name, listed)


def _new_map(random: Random, name: str, unlisted: bool) -> Operation:
    settings = {
        "keep": random.choice(["none", "thumbnail", "image"]),
        "index": random.choice(["auto", "exact", "compact"]),
    }
    precision = random.choice(["half", "half", "compressed"])
    return {"do": "create", "map": name, "settings": settings, "precision": precision, "unlisted": unlisted}


def _with_unlisted(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    found = random.random()
    if found < 0.6:
        return _adopted(random, world, name, listed) or {"do": "publish", "map": name}
    return {"do": "publish" if found < 0.9 else "abandon", "map": name}


def _fields(random: Random) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    if random.random() < 0.6:
        fields["pose"] = (
            {"x": random.randrange(100), "y": random.random(), "heading": random.randrange(360)}
            if random.random() < 0.7
            else {"latitude": random.uniform(-80, 80), "longitude": random.uniform(-170, 170)}
        )
    if (sequence := random.choice(SEQUENCES)) is not None:
        fields["sequence"] = sequence
    if random.random() < 0.4:
        fields["timestamp"] = f"2026-11-{random.randrange(1, 29):02}T10:00:{random.randrange(60):02}Z"
    if random.random() < 0.2:
        fields["camera"] = random.choice(["front", "rear"])
    if random.random() < 0.5:
        fields["metadata"] = {"floor": random.randrange(9), "note": "ü" * random.choice([0, 3, 20, 3000])}
    return fields


def _item(random: Random, place_id: str) -> dict[str, Any]:
    picture, keypoints = f"picture {random.randrange(PICTURES)}", random.random() < 0.7
    return {"id": place_id, "picture": picture, "fields": _fields(random), "keypoints": keypoints}


def _new_id(random: Random, map_: MapModel) -> str:
    known = list(map_.places)
    return random.choice(known) if known and random.random() < 0.2 else f"p{random.randrange(90)}"


def _one(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    return {"do": "enrol", "map": name, "items": [_item(random, _new_id(random, world[name]))]}


def _batch(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    items = [_item(random, _new_id(random, world[name])) for _ in range(random.randrange(2, 12))]
    if random.random() < 0.05:
        items.append({"id": "p0", "picture": "blank", "fields": {}, "keypoints": False})
    return {"do": "enrol", "map": name, "items": items}


def _any_id(random: Random, map_: MapModel) -> str:
    return "nobody" if not map_.places or random.random() < 0.03 else random.choice(list(map_.places))


def _fields_of(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    return {"do": "set", "map": name, "id": _any_id(random, world[name]), "fields": _fields(random)}


def _patched(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    changes: dict[str, Any] = random.choice([
        {"sequence": random.choice(["monday", "tuesday", None])},
        {"pose": {"x": random.randrange(50), "y": 1, "latitude": None, "longitude": None}},
        {"pose": None},
        {"metadata": {"floor": None, "door": random.random() < 0.5}},
        {"metadata": {"long": "x" * random.randrange(12_000)}},
        {"timestamp": None, "metadata": None},
    ])  # fmt: skip
    return {"do": "patch", "map": name, "id": _any_id(random, world[name]), "changes": changes}


def _forgotten(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    return {"do": "forget", "map": name, "id": _any_id(random, world[name])}


def _sequence(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    return {"do": "forget-sequence", "map": name, "name": random.choice([one for one in SEQUENCES if one])}


def _many(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    known = list(world[name].places)
    return {"do": "forget-many", "map": name, "ids": random.sample(known, min(len(known), random.randrange(1, 6)))}


def _added_looks(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    items = [
        {
            "place": _any_id(random, world[name]),
            "picture": f"picture {random.randrange(PICTURES)}",
            "seen": random.choice([None, "2026-12-01T22:00:00Z"]),
            "camera": random.choice([None, None, "front"]),
            "run": random.choice([None, "monday night", "tuesday night"]),
            "least": random.choice([None, 0.0, 0.1, random.random()]),
            "keypoints": random.random() < 0.7,
        }
        for _ in range(random.randrange(1, 4))
    ]
    return {"do": "looks", "map": name, "items": items}


def _removed_looks(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    there = [(place_id, look) for place_id, place in world[name].places.items() for look in place.looks]
    if not there or random.random() < 0.3:
        return {"do": "forget-learnt", "map": name, "run": random.choice(["monday night", "tuesday night", "never"])}
    place_id, look = random.choice(there)
    return {"do": "forget-look", "map": name, "id": place_id, "look": look}


def _edited(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    changes: dict[str, Any] = random.choice([
        {"description": f"number {random.randrange(1000)}"},
        {"keep": random.choice(["none", "thumbnail", "image"])},
        {"same_place_radius": float(random.randrange(9)), "same_place_frames": random.randrange(9)},
        {"index": random.choice(["exact", "compact", "auto"])},
        {"index": random.choice(["exact", "compact"])},
        {"verification": random.random() < 0.7},
    ])  # fmt: skip
    return {"do": "edit", "map": name, "changes": changes}


def _cameras(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    camera = random.choice(["front", "rear", "side"])
    if random.random() < 0.3:
        return {"do": "forget-camera", "map": name, "name": camera}
    return {"do": "camera", "map": name, "name": camera, "mask": random.choice(MASKS)}


def _filled_in(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    return {"do": "keypoints", "map": name, "limit": random.randrange(1, 9)}


def _counterpart(random: Random, world: World, name: str, listed: list[str]) -> Operation | None:
    """Some places come to the stations of others, and some get the poses of others."""
    places = world[name].places
    tracked = [place_id for place_id, place in places.items() if place.station is not None]
    posed = [place_id for place_id, place in places.items() if place.fields.get("pose") is not None]
    some = random.sample(list(places), min(len(places), 4))
    stations = [[place_id, random.choice(tracked)] for place_id in some] if tracked else []
    poses = [[place_id, random.choice(posed)] for place_id in some[:2]] if posed else []
    return {"do": "counterparts", "map": name, "stations": stations, "poses": poses} if stations or poses else None


def _adopted(random: Random, world: World, name: str, listed: list[str]) -> Operation | None:
    """Places of another map with the same precision, so that descriptors are taken over unchanged."""
    precision = world[name].precision
    sources = [one for one in listed if one != name and world[one].precision == precision and world[one].places]
    if not sources or precision == "compressed":
        return None
    source = random.choice(sources)
    known = list(world[source].places)
    some = random.sample(known, min(len(known), random.randrange(1, 9)))
    places = [[place_id, random.choice([None, random.randrange(200)])] for place_id in some]
    return {"do": "adopt", "map": name, "from": source, "places": places}


def _imported(random: Random, world: World, name: str, listed: list[str]) -> Operation | None:
    """A copy of a map by way of an export file, perhaps under an id that is taken."""
    prefix, _, _ = name.partition("-")
    return {"do": "import", "map": name, "to": f"{prefix}-{random.randrange(MAPS)}"}


def _reviewed(random: Random, world: World, name: str, listed: list[str]) -> Operation:
    there = world[name].review
    if not there or random.random() < 0.6:
        picture, answer = f"picture {random.randrange(PICTURES)}", {"verdict": "unknown", "score": random.random()}
        return {"do": "review", "map": name, "picture": picture, "answer": answer, "most": random.choice([2, 4, 8])}
    at = random.randrange(len(there))
    if random.random() < 0.4:
        return {"do": "discard", "map": name, "at": at}
    shows = random.choice([{"place": "p1"}, {"new": "p2"}, {"stranger": True}])
    label = {"label": shows, "at": "2026-12-01T22:00:00+00:00", "by": random.choice([None, "somebody"])}
    return {"do": "label", "map": name, "at": at, "label": label}


_Chosen = Callable[[Random, World, str, list[str]], Operation | None]
_CHOSEN: dict[str, _Chosen] = {
    "enrol": _one,
    "batch": _batch,
    "fields": _fields_of,
    "patch": _patched,
    "forget": _forgotten,
    "sequence": _sequence,
    "many": _many,
    "looks": _added_looks,
    "unlook": _removed_looks,
    "edit": _edited,
    "keypoints": _filled_in,
    "counterparts": _counterpart,
    "camera": _cameras,
    "adopt": _adopted,
    "delete": lambda random, world, name, listed: {"do": "delete", "map": name},
    "look": lambda random, world, name, listed: {"do": "look", "map": name},
    "reopen": lambda random, world, name, listed: {"do": "reopen"},
    "erase": lambda random, world, name, listed: {"do": "erase", "map": name},
    "rebuild": lambda random, world, name, listed: {"do": "rebuild", "map": name},
    "import": _imported,
    "review": _reviewed,
}
