"""A map made anew for another encoder, from the images that it keeps, while the old one serves.

The new map is made unlisted and is published by one rename when it holds exactly what the old one does at that
moment, so that nobody ever meets half of it.  After a kill the job goes on with what is there: a place is in the new
map with all that belongs to it, or not at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from core.errors import InvalidImage, MapExists, NoRegions, PlacerecError, UnknownCamera, UnknownMap
from core.frames.masks import Mask
from core.places import PlaceFields
from core.storage import Enrolment, History, Map
from core.storage.transfer import Outline
from service.engine.engine import Engine
from service.errors.faults import ImagesMissing
from service.jobs.context import JobContext, JobInterrupted, creation_time, encode_after_requests

KIND = "re-encode"

CHUNK = 16
"""Frames that are read, encoded and committed together: what a kill makes the job do again."""

ROUNDS = 8
"""The job catches up with what was changed meanwhile so often; then nobody may change the map for a moment."""

NAMED = 20
"""Places that could not be encoded are counted, and so many named."""


def check_images(map_: Map) -> None:
    """See that every place of a map keeps its image.

    Raises:
        ImagesMissing: some do not; says how many.
    """
    if missing := map_.transfer.count_without_image():
        raise ImagesMissing(
            f"{missing} of the {map_.count_places()} places of the map {map_.record.id} keep no image, so they cannot "
            "be encoded anew: send their frames again while the map keeps images, or forget them."
        )


def reencode(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Do, or go on with, what the job ``context`` says: ``to``, the new map's id, and ``encoder``, its identity.

    Raises:
        UnknownMap, MapExists, ImagesMissing, UnknownEncoder, StorageFull, StorageFailure: nothing of the new map is
            left.
    """
    target, identity = context.arguments["to"], context.arguments["encoder"]
    if (published := context.notes.get("result")) is not None and _is_published(engine, target, context.notes["made"]):
        return dict(published)  # killed between the rename and the end of the job
    if not context.notes:
        if target in engine.atlas.unlisted():
            raise MapExists(f"A map {target!r} is being made.")
        context.remember(began=True)
    try:
        return _Reencoding(engine, context, target, identity).run()
    except JobInterrupted:
        raise
    except BaseException:
        with suppress(PlacerecError):  # it is at the next start
            engine.atlas.abandon(target)
        raise


def _is_published(engine: Engine, target: str, made: str) -> bool:
    try:
        return creation_time(engine.atlas.find(target)) == made
    except UnknownMap:
        return False


class _Reencoding:
    """One attempt."""

    def __init__(self, engine: Engine, context: JobContext, target: str, identity: str) -> None:
        self.engine, self.context, self.target, self.identity = engine, context, target, identity
        self.source = context.map(engine.atlas)
        self.made = engine.atlas.unlisted().get(target) or self._create()
        self.left_out: dict[str, tuple[Outline, str]] = {}
        """Places whose frame gives the new encoder nothing, by id, and why."""

    def _create(self) -> Map:
        shape = next(s for s in self.engine.catalogue.describe() if s.identity == self.identity)
        record = self.source.record
        return self.engine.atlas.create(
            self.target,
            self.identity,
            shape.dimension,
            record.settings(),
            shape.local_shape,
            unlisted=True,
            precision="half" if record.precision == "full" else record.precision,
        )

    def run(self) -> Mapping[str, Any]:
        for _ in range(ROUNDS):
            self._catch_up()
            with self.source.transfer.paused_writes():
                if self._is_level():
                    return self._publish()
        with self.source.transfer.paused_writes():  # it is changed faster than it can be encoded
            self._catch_up()
            if not self._is_level():
                raise RuntimeError("the new map is not what the old one is")
            return self._publish()

    def _differences(self) -> tuple[list[Outline], dict[str, Outline], dict[str, bytes]]:
        """What has to be brought over, what is there already (by id), and what must go (digests by id)."""
        ours, theirs = self.source.transfer.outline(), {place.id: place for place in self.made.transfer.outline()}
        present = {place.id for place in ours}
        due = [place for place in ours if not (self._is_left_out(place) or _is_same(place, theirs.get(place.id)))]
        gone = {place.id: place.digest for place in theirs.values() if place.id not in present}
        self.context.progress(len(ours) - len(due), len(ours))
        return due, theirs, gone

    def _is_left_out(self, place: Outline) -> bool:
        known = self.left_out.get(place.id)
        return known is not None and known[0].same_frame(place)

    def _is_level(self) -> bool:
        due, _, gone = self._differences()
        return not due and not gone

    def _catch_up(self) -> None:
        """Bring the new map to where the old one is, or was when this began."""
        due, theirs, gone = self._differences()
        if bare := sum(place.picture != "image" for place in due):
            raise ImagesMissing(f"{bare} places of the map {self.source.record.id} keep no image by now.")
        # A frame whose camera is another one now, or that shows another picture, is enrolled from the start.
        stale = {p.id: theirs[p.id].digest for p in due if p.id in theirs and not p.same_frame(theirs[p.id])}
        self.made.transfer.forget({**gone, **stale})
        total = self.source.count_places()
        for first in range(0, len(due), CHUNK):
            self.context.check_cancelled()
            chunk = due[first : first + CHUNK]
            known = [place for place in chunk if place.id in theirs and place.id not in stale]
            self._move([place for place in chunk if place not in known], known)
            self.context.progress(total - len(due) + first + len(chunk), total)

    def _move(self, new: Sequence[Outline], known: Sequence[Outline]) -> None:
        """Commit some places: new ones with their frames encoded, known ones with their fields and order as of now."""
        images = {place.id: self.source.picture(place.id) for place in new}
        # Read behind the images: a place that is still in its row shows the frame that was read.  What was changed
        # or forgotten since it was listed is found by the next round.
        fields = self.source.transfer.find([place.id for place in (*new, *known)])
        ready = [place for place in new if place.id in fields and fields[place.id][1] == place.row]
        frames = [images[place.id] or b"" for place in ready]
        masks = [self._mask(place.camera) for place in ready]
        outcomes = encode_after_requests(self.engine, self.context, self.identity, frames, masks) if ready else []
        items: list[tuple[Enrolment, History]] = []
        for place, image, outcome in zip(ready, frames, outcomes, strict=True):
            try:
                if isinstance(outcome, Exception):
                    raise outcome
                encoding = outcome.encoding
                if not len(encoding.regions):
                    raise NoRegions("The frame shows this encoder nothing to remember.")
            except (InvalidImage, NoRegions) as error:
                self.left_out[place.id] = (place, str(error))
                continue
            described = (encoding.descriptor, len(encoding.regions), encoding.local, image)
            items.append(self._item(place, fields, *described))
        nothing = np.empty(0, np.float32), 0, np.empty((0, 0), np.int8), None
        items += [self._item(place, fields, *nothing) for place in known if place.id in fields]
        self.made.transfer.adopt(items)

    def _item(
        self,
        place: Outline,
        fields: Mapping[str, Any],
        descriptor: Any,
        regions: int,
        local: Any,
        image: bytes | None,
    ) -> tuple[Enrolment, History]:
        stored = fields[place.id][0]
        kept = PlaceFields(**{name: getattr(stored, name) for name in PlaceFields.model_fields})
        item = Enrolment(place.id, kept, descriptor, regions, place.digest, local, image=image)
        return item, History("image", place.ordinal, stored.created_at, stored.updated_at)

    def _mask(self, camera: str | None) -> Mask | None:
        try:
            return self.source.cameras.mask(camera)
        except UnknownCamera:  # forgotten since; its places stay as they are
            return None

    def _publish(self) -> Mapping[str, Any]:
        self.context.check_cancelled()  # from here on it cannot be undone
        masks = {camera.name: camera.mask for camera in self.made.cameras.all()}
        for camera in self.source.cameras.all():
            if camera.name not in masks or masks[camera.name] != camera.mask:
                self.made.cameras.put(camera.name, camera.mask)
        named = [{"id": place.id, "detail": why} for place, why in list(self.left_out.values())[:NAMED]]
        result = {
            "map": self.target,
            "encoder": self.identity,
            "places": self.made.count_places(),
            "left_out": {"count": len(self.left_out), "places": named},
        }
        self.context.remember(result=result, made=creation_time(self.made))
        self.engine.atlas.publish(self.target)
        return result


def _is_same(place: Outline, other: Outline | None) -> bool:
    return other is not None and place.same_as(other)
