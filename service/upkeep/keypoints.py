"""The job that finds the keypoints of places that have none, in the pictures that the map keeps of them.

Places lack keypoints if they were enrolled while the map did not verify.  A thumbnail serves, too,
if less well than an image.  Each commit stands by itself, so an attempt after a restart goes on with the
places that are still without.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from core.errors import InvalidImage, StorageFailure, UnknownCamera
from core.frames.images import ANY_SIZE, decode
from core.frames.masks import Mask, range_in
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.maps import PicturedPlace
from core.networks.xfeat import packaged_xfeat
from core.store import Map
from service.engine.engine import Engine
from service.jobs.context import JobContext, yield_to_requests

KIND = "keypoints"

PLACES_PER_COMMIT = 32
"""How many places are read and committed together."""

MOST_LISTED = 20
"""How many of the places whose picture cannot be read the result lists at most."""


def fill_keypoints(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Find the keypoints of the places that have none and have a stored picture.

    Returns:
        The result of the job.

    Raises:
        UnknownMap, MapQuarantined, StorageFull, StorageFailure: earlier commits stay.
        JobCancelled, JobInterrupted, JobGivesWay: the job has to stop.
    """
    map_ = context.map(engine.maps)
    done: dict[str, Any] = context.notes.get("told", {"after": 0, "found": 0, "unreadable": 0, "named": []})
    total = map_.count_places()
    while places := map_.without_keypoints(done["after"], PLACES_PER_COMMIT):
        made: list[tuple[PicturedPlace, Keypoints]] = []
        for place in places:
            yield_to_requests(engine, context)
            try:
                made.append((place, _keypoints(map_, place)))
            except (InvalidImage, StorageFailure) as error:
                done["unreadable"] += 1
                done["named"] = [*done["named"], {"id": place.id, "detail": str(error)}][:MOST_LISTED]
        with engine.writing(map_.record.id):
            done["found"] += map_.add_keypoints(made)
        done["after"] = places[-1].number
        context.remember(told=done)
        context.progress(done["found"] + done["unreadable"], total, "finding keypoints")
        context.give_way()
    status, count = map_.storage_status(), map_.count_places()
    assert status.keypoints is not None  # the map is open
    return {
        "map": map_.record.id,
        "places": count,
        "found": done["found"],
        "without": max(0, count - status.keypoints.places),
        "unreadable": {"count": done["unreadable"], "places": done["named"]},
    }


def _keypoints(map_: Map, place: PicturedPlace) -> Keypoints:
    """The keypoints in the picture that a map keeps of a place.

    Raises:
        InvalidImage: the picture cannot be read; it may have been forgotten meanwhile.
        StorageFailure: it is damaged on disk.
    """
    mask: Mask | None = None
    with suppress(UnknownCamera):  # it was forgotten since the place was enrolled
        mask = map_.cameras.mask(place.camera)
    return find_keypoints(packaged_xfeat(), decode(map_.picture(place.id) or b"", ANY_SIZE, range_in(mask)), mask)
