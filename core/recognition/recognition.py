"""The one way from a picture to an answer, and from a picture to a place; no HTTP.

    answer = recognize(map_, picture, encoder)          # decode, encode, search, agree, judge
    place = enrol(map_, "p7", picture, encoder)         # decode, encode, store

The service does the same steps: it decodes and encodes frames of many callers together, and calls :func:`locate`
and :func:`describe` with what they give.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from core.errors import NoRegions
from core.frames.images import decode, encode_thumbnail
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.judgement.position import PoseEstimate, estimate_pose
from core.judgement.priors import log_odds_per_score
from core.judgement.verdict import Calibration, Judgement, judge
from core.method.encoder import Encoder, Encoding
from core.places import Place, PlaceFields
from core.recognition.selection import EVERYTHING, Selection
from core.recognition.stages import Candidates, agree, calibration_of, neighborhood_of, search
from core.storage import Enrolment, Map

ATTEMPTS = 3
"""Snapshots that are tried while places are deleted during the search."""

THUMBNAIL_SIDE = 320
"""The longer side of a thumbnail, in pixels."""


@dataclass(frozen=True)
class Answer:
    """The answer to one query.

    matches: score and place, best first; at most k.
    weights: of the matches, how much the prior speaks for each, in (0, 1]; None: nothing was known.
    calibration: the calibration by which the query was judged.
    search: milliseconds of search, second stage, judgement and look-up of the places.
    pose: of the query, by the poses of the best match and of its neighbours; None without poses.
    encoding: of the query.
    candidates: the best of the ranking, from which the matches are taken.
    """

    judgement: Judgement
    matches: list[tuple[float, Place]]
    weights: list[float] | None
    calibration: Calibration
    search: float
    pose: PoseEstimate | None
    encoding: Encoding
    candidates: Candidates

    @property
    def place(self) -> Place | None:
        """The place that the query shows; None unless the verdict is ``recognized``."""
        return self.matches[0][1] if self.judgement.verdict == "recognized" else None

    @property
    def probability(self) -> float | None:
        """The probability that the best match is right; None in an empty map or without a calibrated curve."""
        return self.judgement.probability


def recognize(
    map_: Map,
    picture: bytes,
    encoder: Encoder,
    k: int = 5,
    selection: Selection | None = None,
    camera: str | None = None,
) -> Answer:
    """Find where a picture was taken.

    Args:
        picture: the bytes of a JPEG, PNG or WebP file.
        encoder: the map's encoder (``EncoderCatalogue().get(map_.record.encoder)``).
        k: how many matches to list.
        selection: what is known of the place; None: nothing.
        camera: the camera of the map that took the picture, whose mask is applied; None: no mask.

    Raises:
        InvalidImage: the picture cannot be decoded.
        NoRegions: it is blank, or nearly so.
        UnknownCamera: the map has no such camera.
        StorageFailure: the map's files cannot be read.
    """
    pixels = decode(picture)  # H x W x 3
    encoding = encoder.encode(pixels, _mask(map_, camera))  # regions, descriptor [V·K], cells [C, L]
    if len(encoding.regions) == 0:
        raise NoRegions("The picture has no region of interest: it is blank, or nearly so.")
    (answer,) = locate(map_, encoder, [encoding], k, selection)
    return answer


def enrol(
    map_: Map,
    place_id: str,
    picture: bytes,
    encoder: Encoder,
    fields: PlaceFields | None = None,
) -> Place:
    """Make a picture a place of a map; it is on disk, and found by every later search, when this returns.

    Args:
        picture: the bytes of a JPEG, PNG or WebP file.
        encoder: the map's encoder.
        fields: pose, time, sequence, camera and metadata of the place.

    Raises:
        InvalidImage: the picture cannot be decoded.
        NoRegions: it is blank, or nearly so.
        UnknownCamera: the map has no such camera.
        StorageFull, StorageFailure: nothing was stored.
    """
    said = fields or PlaceFields()
    mask = _mask(map_, said.camera)
    pixels = decode(picture)
    encoding = encoder.encode(pixels, mask)
    digest = frame_digest(hashlib.sha256(picture).digest(), mask)
    ((place, _change),) = map_.enrol([describe(map_, place_id, said, picture, digest, pixels, encoding)])
    return place


def _mask(map_: Map, camera: str | None) -> Mask | None:
    return None if camera is None else map_.cameras.mask(camera)


def frame_digest(sha256: bytes, mask: Mask | None) -> bytes:
    """By what a map knows a frame that it has encoded: the digest of its file and, if there is one, of its mask."""
    return sha256 if mask is None else hashlib.sha256(sha256 + mask.digest.encode()).digest()


def describe(
    map_: Map,
    place_id: str,
    fields: PlaceFields,
    picture: bytes | None,
    digest: bytes,
    pixels: Pixels,
    encoding: Encoding,
    thumbnail_side: int = THUMBNAIL_SIDE,
) -> Enrolment:
    """What a map stores of a frame: its descriptors, its fields, and of the picture what the map keeps.

    Raises:
        NoRegions: the frame is blank, or nearly so.
    """
    if len(encoding.regions) == 0:
        raise NoRegions("The frame has no region of interest: it is blank, or nearly so.")
    keep = map_.record.keep
    return Enrolment(
        id=place_id,
        fields=fields,
        descriptor=encoding.descriptor,
        local=encoding.local,
        regions=len(encoding.regions),
        digest=digest,
        thumbnail=encode_thumbnail(pixels, thumbnail_side) if keep == "thumbnail" else None,
        image=picture if keep == "image" else None,
    )


def locate(
    map_: Map, encoder: Encoder, encodings: Sequence[Encoding], k: int, selection: Selection | None = None
) -> list[Answer]:
    """Search a map for queries that are encoded already, and judge each.

    Args:
        encoder: the map's encoder.
        encodings: of the queries, made by it, with regions; at least one.
        k: how many matches to list.
        selection: what is known of the place; None: nothing.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    began = time.perf_counter()
    snapshot = map_.snapshot()
    choice = selection.choice(map_, snapshot) if selection else EVERYTHING
    rankings = search(snapshot, np.stack([encoding.descriptor for encoding in encodings]), choice)
    share = 1e3 * (time.perf_counter() - began) / len(encodings)
    answers = []
    for encoding, ranking in zip(encodings, rankings, strict=True):
        began = time.perf_counter()
        candidates = agree(map_, encoder, snapshot, encoding.local, ranking, choice)
        attempt = 1
        while (answer := judged(map_, encoder, encoding, candidates, k, settle=attempt == ATTEMPTS)) is None:
            candidates, attempt = _searched_again(map_, encoder, encoding, selection), attempt + 1
        answers.append(replace(answer, search=share + 1e3 * (time.perf_counter() - began)))
    return answers


def _searched_again(map_: Map, encoder: Encoder, encoding: Encoding, selection: Selection | None) -> Candidates:
    """Both stages for one query, in the map as it is now."""
    snapshot = map_.snapshot()
    choice = selection.choice(map_, snapshot) if selection else EVERYTHING
    (ranking,) = search(snapshot, encoding.descriptor[np.newaxis], choice)
    return agree(map_, encoder, snapshot, encoding.local, ranking, choice)


def judged(
    map_: Map, encoder: Encoder, encoding: Encoding, candidates: Candidates, k: int, settle: bool
) -> Answer | None:
    """The verdict on a query by its candidates, with the places that match.

    Args:
        settle: leave out places that were deleted since the snapshot; without it there is no answer then, but None.
    """
    places = map_.places_at(candidates.rows[:k].tolist()) if len(candidates.rows) else []
    if None in places:
        if not settle:
            return None
        kept = np.ones(len(candidates.rows), np.bool_)
        kept[: len(places)] = [place is not None for place in places]
        candidates = candidates.take(np.flatnonzero(kept))
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    judgement = judge(
        candidates.ordered,
        candidates.whereabouts,
        calibration,
        neighborhood,
        candidates.examined,
        candidates.is_part,
    )
    present = [place for place in places if place is not None]
    matches = [(float(score), place) for score, place in zip(candidates.scores, present, strict=False)]
    if matches:
        judgement = replace(judgement, score=matches[0][0])
    steepness = log_odds_per_score(calibration, encoder.candidates > 0)
    log_odds = steepness * candidates.ordered.astype(np.float64)
    pose = estimate_pose(candidates.whereabouts, log_odds, neighborhood.radius)
    weights = None if candidates.weights is None else np.exp(candidates.weights[: len(matches)]).tolist()
    return Answer(judgement, matches, weights, calibration, 0.0, pose, encoding, candidates)
