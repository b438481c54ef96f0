"""The job that re-encodes a map: it makes a new map for another encoder from the images that the old map keeps.

The old map serves meanwhile.  The new map is not listed until one rename publishes it, at a time when it contains
exactly the places of the old map.  After a restart the job continues with the places that are missing: each place is in
the new map with everything that is stored of it, or not at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from core.errors import InvalidImage, MapExists, NoRegions, PlacerecError, UnknownCamera, UnknownMap
from core.frames.masks import Mask
from core.geometry.keypoints import Keypoints
from core.maps import Enrolment, History
from core.maps.records import Outline
from core.places import place_and_look
from core.store import Map
from service.engine.engine import Engine
from service.errors.faults import ImagesMissing
from service.jobs.context import JobContext, JobInterrupted, creation_time, encode_after_requests

KIND = "re-encode"

PLACES_PER_COMMIT = 16
"""How many frames are read, encoded and committed together; a restart loses at most one such chunk."""

ROUNDS = 8
"""How often the job catches up with changes of the old map before it blocks further changes until it has finished."""

MOST_LISTED = 20
"""How many of the places that could not be encoded the result lists at most."""


def check_images(map_: Map) -> None:
    """Check that a map keeps the image of each of its places.

    Raises:
        ImagesMissing: some images are missing.
    """
    if missing := map_.transfer.count_without_image():
        raise ImagesMissing(
            f"{missing} frames of the {map_.count_places()} places of the map {map_.record.id} and of their looks are "
            "not kept as images, so they cannot be encoded again: enrol them again while the map keeps images, or "
            "delete these places and looks."
        )


def reencode(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Re-encode, or continue to re-encode, the job's map.

    The job's arguments are ``to``, the id of the new map, and ``encoder``, the identity of its encoder.

    Raises:
        UnknownMap, MapExists, ImagesMissing, UnknownEncoder, StorageFull, StorageFailure, JobCancelled: nothing of
            the new map is left.
        JobInterrupted: the next attempt continues.
    """
    target, identity = context.arguments["to"], context.arguments["encoder"]
    if (published := context.notes.get("result")) is not None and _is_published(engine, target, context.notes["made"]):
        return dict(published)  # the process was killed after the rename
    if not context.notes:
        if target in engine.maps.unlisted():
            raise MapExists(f"A map {target!r} is being made.")
        context.remember(began=True)
    try:
        return _Reencoding(engine, context, target, identity).run()
    except JobInterrupted:
        raise
    except BaseException:
        with suppress(PlacerecError):  # the next start removes it
            engine.maps.abandon(target)
        raise


def _is_published(engine: Engine, target: str, made: str) -> bool:
    try:
        return creation_time(engine.maps.find(target)) == made
    except UnknownMap:
        return False


class _Reencoding:
    """One attempt of the job: ``source`` is the old map, ``made`` the new one."""

    def __init__(self, engine: Engine, context: JobContext, target: str, identity: str) -> None:
        self.engine, self.context, self.target, self.identity = engine, context, target, identity
        self.source = context.map(engine.maps)
        self.made = engine.maps.unlisted().get(target) or self._create()
        self.left_out: dict[str, tuple[Outline, str]] = {}
        """By id, the places whose frames the new encoder cannot encode, and why."""

    def _create(self) -> Map:
        encoder = self.engine.catalogue.summary(self.identity)
        record = self.source.record
        return self.engine.maps.create(
            self.target,
            self.identity,
            encoder.dimension,
            record.settings(),
            encoder.local_shape,
            unlisted=True,
            precision=record.precision,
        )

    def run(self) -> Mapping[str, Any]:
        """Copy until the maps are alike, and publish the new map; returns the result of the job."""
        for _ in range(ROUNDS):
            self._catch_up()
            with self.source.transfer.paused_writes():
                if self._is_up_to_date():
                    return self._publish()
        with self.source.transfer.paused_writes():  # the old map changes faster than it can be encoded
            self._catch_up()
            if not self._is_up_to_date():
                raise RuntimeError("the new map differs from the old map, although nobody could change either")
            return self._publish()

    def _differences(self) -> tuple[list[Outline], dict[str, Outline], dict[str, bytes]]:
        """The places to copy, the places of the new map by id, and the digests of those to remove by id.

        What is to be encoded again is both: a place with another frame or camera now, which takes its looks along.
        """
        listed, theirs = self.source.transfer.outline(looks=True), self._outline_of_made()
        ours = {place.id: place for place in listed}
        self.left_out = {
            name: (place, why)
            for name, (place, why) in self.left_out.items()
            if name in ours and place.same_frame(ours[name])
        }
        changed = {place.id for place in listed if place.id in theirs and not place.same_frame(theirs[place.id])}
        stale = {place.id for place in listed if place.id in theirs and (place.id in changed or _of(place) in changed)}
        due = [
            place
            for place in listed
            if not self._is_left_out(place) and (place.id in stale or not _is_same(place, theirs.get(place.id)))
        ]
        gone = {place.id: place.digest for place in theirs.values() if place.id in stale or place.id not in ours}
        self.context.progress(len(listed) - len(due), len(listed))
        return due, theirs, gone

    def _outline_of_made(self) -> dict[str, Outline]:
        return {place.id: place for place in self.made.transfer.outline(looks=True)}

    def _is_left_out(self, place: Outline) -> bool:
        """Whether the place was left out with the frame that it has, or it is a look of a place that was."""
        return place.id in self.left_out or _of(place) in self.left_out

    def _is_up_to_date(self) -> bool:
        due, _, gone = self._differences()
        return not due and not gone

    def _catch_up(self) -> None:
        """Copy to the new map what differs in the old map now."""
        due, theirs, gone = self._differences()
        if missing := sum(place.picture != "image" for place in due):
            map_id = self.source.record.id
            raise ImagesMissing(f"{missing} places and looks of the map {map_id} no longer keep an image.")
        self.made.transfer.forget(gone)
        total = len(theirs) + len(due)
        for first in range(0, len(due), PLACES_PER_COMMIT):
            self.context.check_cancelled()
            chunk = [place for place in due[first : first + PLACES_PER_COMMIT] if not self._is_left_out(place)]
            known = [place for place in chunk if place.id in theirs and place.id not in gone]
            self._copy([place for place in chunk if place not in known], known)
            self.context.progress(min(total - len(due) + first + PLACES_PER_COMMIT, total), total)

    def _copy(self, new: Sequence[Outline], known: Sequence[Outline]) -> None:
        """Copy places in one commit: encode the frames of new ones, update the fields and order of known ones.

        A look whose place is not in the new map, as it was changed since it was listed, is left to the next round.
        """
        images = {place.id: self.source.picture(place.id) for place in new}
        # This is read after the images: if a place still has its row, its image is that of the same frame.  Places
        # that were changed or forgotten since they were listed are left to the next round.
        fields = self.source.transfer.find([place.id for place in (*new, *known)])
        ready = [place for place in new if place.id in fields and fields[place.id][1] == place.row]
        frames = [images[place.id] or b"" for place in ready]
        keypoints = self.source.keypoints_at([place.row for place in ready])  # they do not depend on the encoder
        masks = [self._mask(place.camera) for place in ready]
        outcomes = encode_after_requests(self.engine, self.context, self.identity, frames, masks) if ready else []
        items: list[tuple[Enrolment, History]] = []
        for place, image, found, outcome in zip(ready, frames, keypoints, outcomes, strict=True):
            if self._is_left_out(place):  # its place was, a moment ago
                continue
            try:
                if isinstance(outcome, Exception):
                    raise outcome
                encoding = outcome.encoding
                if not len(encoding.regions):
                    raise NoRegions("The encoder finds no regions in the frame.")
            except (InvalidImage, NoRegions) as error:
                self.left_out[place.id] = (place, str(error))
                continue
            described = (encoding.descriptor, len(encoding.regions), encoding.local, image, found)
            items.append(self._item(place, fields, *described))
        nothing = np.empty(0, np.float32), 0, np.empty((0, 0), np.int8), None, None
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
        keypoints: Keypoints | None,
    ) -> tuple[Enrolment, History]:
        stored = fields[place.id][0]
        item = Enrolment(
            place.id, stored.fields(), descriptor, regions, place.digest, local, image=image, keypoints=keypoints,
            run=place.run,
            least=place.least,
        )  # fmt: skip
        return item, History("image", place.ordinal, stored.created_at, stored.updated_at)

    def _mask(self, camera: str | None) -> Mask | None:
        try:
            return self.source.cameras.mask(camera)
        except UnknownCamera:  # it was forgotten since the place was enrolled
            return None

    def _publish(self) -> Mapping[str, Any]:
        self.context.check_cancelled()  # from here on it cannot be undone
        copied = {camera.name: camera.settings() for camera in self.made.cameras.all()}
        for camera in self.source.cameras.all():
            if copied.get(camera.name) != camera.settings():
                self.made.cameras.put(camera.name, *camera.settings())
        names = {place.id: place.id for place in self.made.transfer.outline()}
        self.made.counterparts.copy(self.source.counterparts, names)
        named = [{"id": place.id, "detail": why} for place, why in list(self.left_out.values())[:MOST_LISTED]]
        result = {
            "map": self.target,
            "encoder": self.identity,
            "places": self.made.count_places(),
            "left_out": {"count": len(self.left_out), "places": named},
        }
        self.context.remember(result=result, made=creation_time(self.made))
        self.engine.maps.publish(self.target)
        return result


def _of(place: Outline) -> str:
    """The id of a place, or of the place of a look."""
    return place_and_look(place.id)[0]


def _is_same(place: Outline, other: Outline | None) -> bool:
    return other is not None and place.same_as(other)
