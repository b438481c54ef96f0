"""Place recognition as an algorithm: from a picture to an answer, and from a picture to a place of a map.

    answer = recognize(map_, picture, encoder)          # decode, encode, search, agree, verify, judge
    place = enrol(map_, "p7", picture, encoder)         # decode, encode, store

The service takes the same steps.  It decodes and encodes the frames of several requests together, and then calls
:func:`locate` and :func:`describe`.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from core.errors import NoRegions
from core.frames.framing import SAME_VIEW, Framing
from core.frames.images import decode, encode_thumbnail
from core.frames.masks import Mask, range_in
from core.frames.preprocessing import Pixels
from core.frames.value_ranges import ValueRange, few_values, told
from core.geometry.detection import ScaledFrame, find_keypoints
from core.geometry.keypoints import Keypoints
from core.geometry.pose import RelativeView, SharedPoints
from core.judgement.position import PoseEstimate, estimate_pose
from core.judgement.priors import decision_slope
from core.judgement.verdict import Calibration, Judgement, judge
from core.maps import Enrolment
from core.maps.moment import one_look
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import packaged_xfeat
from core.places import NO_POSE, Place, PlaceFields
from core.recognition.framings import FramedView, FrameReframing, doubted, framed, keypoints_in_frame
from core.recognition.pose_survey import place_errors, turned_note
from core.recognition.question import Query, Question
from core.recognition.stages import (
    Candidates,
    Positions,
    calibration_of,
    likeness,
    neighborhood_of,
    no_candidates,
    rank_places,
)
from core.recognition.verification import NOT_VERIFIED, ThirdStage, relative_views, sightings, third_stage
from core.store import Map
from core.threads import begun

ATTEMPTS = 3
"""How often a query is searched for if places that it finds are deleted in the meantime."""

THUMBNAIL_SIDE = 320
"""The longer side of a thumbnail, in pixels."""


@dataclass(frozen=True)
class RivalPlaces:
    """Rivals of the best match, as ``core.judgement.verdict.Rivals``.

    places: ids, best first.
    score: of the first.
    same_place: whether they show the place of the best match; else they are one place that looks like the query.
    """

    places: tuple[str, ...]
    score: float
    same_place: bool


OTHER_VIEW = 1.25
"""The factor between what a frame and a place show across from which on an answer says so."""


@dataclass(frozen=True)
class Answer:
    """The answer to one query.

    judgement: the verdict, with the values that it rests on.
    matches: score and place of the best matches, best first, each place once; at most k.
    weights: the prior weight of each match, in (0, 1]; None if the query had no prior.
    calibration: the calibration by which the query was judged.
    search: milliseconds spent on the first two stages of the search, the judgement and the look-up of the places; for
        several queries that were searched for together, the mean; 0 for a blank frame.
    pose: the estimated pose of the query, from the poses of the best match and its neighbours, and from the geometry
        where they were verified; None if they have none.
    note: why the camera's intrinsics were not used for the pose; None if they were, or if there are none.
    lens: that the frame shows more or less than the best match does, if it does; else None.
    encoding: the encoded query.
    candidates: the best places of the ranking; the matches are the first of them, less further looks of these places.
    third_stage: whether the candidates were verified geometrically.
    rivals: the groups of places that make an answer ambiguous, the places of each group best first.
    """

    judgement: Judgement
    matches: list[tuple[float, Place]]
    weights: list[float] | None
    calibration: Calibration
    search: float
    pose: PoseEstimate | None
    encoding: Encoding
    candidates: Candidates
    third_stage: ThirdStage = NOT_VERIFIED
    rivals: tuple[RivalPlaces, ...] = ()
    note: str | None = None
    lens: str | None = None

    @property
    def blank(self) -> bool:
        """Whether the frame has no region of interest, so that it could not be searched for."""
        return len(self.encoding.regions) == 0

    @property
    def place(self) -> Place | None:
        """The place that the query shows if the verdict is ``recognized``, else None."""
        return self.matches[0][1] if self.judgement.verdict == "recognized" else None

    @property
    def probability(self) -> float | None:
        """The probability that the best match is right; None if there is no match or the calibration has no curve."""
        return self.judgement.probability


def recognize(map_: Map, picture: bytes, encoder: Encoder, question: Question | None = None) -> Answer:
    """Find where a picture was taken.

    Args:
        picture: the bytes of a JPEG, PNG or WebP file.
        encoder: the map's encoder (``EncoderCatalogue().get(map_.record.encoder)``).
        question: None: five matches, anywhere in the map, verified where the scores leave doubt.

    Raises:
        InvalidImage: the picture cannot be decoded.
        UnknownCamera: the map has no such camera.
        StorageFailure: the map's files cannot be read.
    """
    question = question or Question()
    mask = _mask(map_, question.camera)
    pixels = decode(picture, value_range=range_in(mask))  # uint8 [H, W, 3]

    def find() -> Keypoints:
        return find_keypoints(packaged_xfeat(), pixels, mask)

    wanted = begun(find) if needs_keypoints(map_, question) else find  # while the frame is encoded and searched for
    encoding = encoder.encode(pixels, mask)  # descriptor float32 [D], local descriptors int8 [C, L]
    if len(encoding.regions) == 0:
        return answer_to_blank(map_, encoder, encoding)
    query = Query(encoding, question, wanted, FrameReframing(encoder, lambda: ScaledFrame.of(pixels, mask)))
    (answer,) = locate(map_, encoder, [query])
    return answer


def needs_keypoints(map_: Map, question: Question) -> bool:
    """Whether the keypoints of a frame will be needed to answer a question, whatever its scores are."""
    return question.verify == "always" and map_.record.verification


def enrol(
    map_: Map,
    place_id: str,
    picture: bytes,
    encoder: Encoder,
    fields: PlaceFields | None = None,
) -> Place:
    """Store a picture as a place of a map.  When this returns, the place is on disk and every later search finds it.

    Args:
        place_id: the id of the place; an existing place of this id is replaced.
        picture: the bytes of a JPEG, PNG or WebP file.
        encoder: the map's encoder.
        fields: pose, time, sequence, camera and metadata of the place.

    Raises:
        InvalidImage: the picture cannot be decoded.
        NoRegions: the picture is blank, or nearly so.
        UnknownCamera: the map has no such camera.
        StorageFull, StorageFailure: the disk is full or refuses; nothing was stored.
    """
    fields = fields or PlaceFields()
    mask = _mask(map_, fields.camera)
    pixels = decode(picture, value_range=range_in(mask))
    encoding = encoder.encode(pixels, mask)
    digest = frame_digest(hashlib.sha256(picture).digest(), mask)
    keypoints = find_keypoints(packaged_xfeat(), pixels, mask) if map_.record.verification else None
    few = few_values(picture) if len(encoding.regions) == 0 and range_in(mask) is None else None
    described = describe(map_, place_id, fields, picture, digest, pixels, encoding, keypoints=keypoints, few=few)
    ((place, _change),) = map_.enrol([described])
    return place


def _mask(map_: Map, camera: str | None) -> Mask | None:
    return None if camera is None else map_.cameras.mask(camera)


def frame_digest(sha256: bytes, mask: Mask | None) -> bytes:
    """The digest by which a map recognizes a frame that it has already encoded: of its file and, if any, its mask.

    Args:
        sha256: the digest of the file, 32 bytes.

    Returns:
        32 bytes.
    """
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
    keypoints: Keypoints | None = None,
    few: ValueRange | None = None,
) -> Enrolment:
    """The record that a map stores of an encoded frame: its descriptors, fields, and the picture if the map stores it.

    Args:
        picture: the bytes of the file; only needed if the map stores images.
        digest: the frame's ``frame_digest``.
        pixels: uint8 [H, W, 3], BGR.
        thumbnail_side: the longer side of the thumbnail, in pixels.
        keypoints: of the frame; None: the place has none to be verified by.
        few: the lowest and highest value of a frame without regions, if it has 16 bits and uses few of them.

    Raises:
        NoRegions: the frame is blank, or nearly so.
    """
    if len(encoding.regions) == 0:
        raise no_regions(few)
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
        keypoints=keypoints,
    )


def no_regions(few: ValueRange | None = None) -> NoRegions:
    """Why a frame without regions has no descriptor.

    Args:
        few: its lowest and highest value, if it has 16 bits and uses few of them.
    """
    if few is None:
        return NoRegions("The frame has no region of interest: it is blank, or nearly so.")
    return NoRegions(
        f"The frame has no region of interest in the upper 8 of its 16 bits: its values {told(few)}. Give its camera "
        "in the map the range of its values (value_range, or --depth-bits of 'placerec maps cameras put'), and name "
        "that camera."
    )


def answer_to_blank(map_: Map, encoder: Encoder, encoding: Encoding) -> Answer:
    """The answer to a frame without regions, which cannot be searched for: ``unknown``, without a match."""
    judgement = Judgement("unknown", None, None, None, None)
    return Answer(judgement, [], None, calibration_of(map_, encoder), 0.0, None, encoding, no_candidates(map_))


def locate(map_: Map, encoder: Encoder, queries: Sequence[Query]) -> list[Answer]:
    """Search a map for queries that are encoded already, and judge each.

    Args:
        encoder: the map's encoder.
        queries: at least one; their questions have the same selection.

    Returns:
        One answer for each query, in order.

    Raises:
        StorageFailure: the map's files cannot be read.
        InvalidModel: the network of keypoints cannot be loaded.
    """
    began = time.perf_counter()
    selection = queries[0].question.selection
    with one_look():
        ranked = rank_places(map_, encoder, [query.encoding for query in queries], selection)  # both stages
        answers = [_answer(map_, encoder, query, candidates) for query, candidates in zip(queries, ranked, strict=True)]
    verifying = sum(answer.third_stage.milliseconds for answer in answers)
    milliseconds = (1e3 * (time.perf_counter() - began) - verifying) / len(queries)
    return [replace(answer, search=milliseconds) for answer in answers]


def judgement_of(map_: Map, encoder: Encoder, candidates: Candidates) -> Judgement:
    """The judgement of the candidates of one query."""
    return judge(
        candidates.ordered,
        candidates.whereabouts,
        calibration_of(map_, encoder),
        neighborhood_of(map_),
        candidates.examined,
        lambda positions: likeness(map_, encoder, candidates, positions),
        candidates.geometry,
        candidates.weights,
        candidates.scores,
    )


def _answer(map_: Map, encoder: Encoder, query: Query, candidates: Candidates) -> Answer:
    """Verify and judge the candidates, and look up the best places; again if one was deleted since the search."""

    k, judged = query.question.k, partial(judgement_of, map_, encoder)
    best, views = framed(map_, encoder, query, candidates, judged)
    ranked, judgement, stage = third_stage(map_, encoder, best.candidates, judged, best.query)
    attempt = 1
    while None in (places := places_of(map_, ranked.rows, k)) and attempt < ATTEMPTS:
        (candidates,) = rank_places(map_, encoder, [best.query.encoding], query.question.selection)
        best = replace(best, candidates=candidates)
        ranked, judgement, stage = third_stage(map_, encoder, candidates, judged, best.query)
        attempt += 1
    judgement = doubted(judgement, ranked, best, views, neighborhood_of(map_))
    known = map_.cameras.intrinsics(query.question.camera) is not None  # they are those of the frame as it is
    if known and best.framing != SAME_VIEW and stage.keypoints is not None and query.reframing is not None:
        stage = replace(stage, keypoints=keypoints_in_frame(stage.keypoints, best.framing, *query.reframing.size()))
    if None in places:  # places are being deleted all the time: go on without those that are gone
        present = np.ones(len(ranked.rows), np.bool_)
        present[: len(places)] = [place is not None for place in places]
        ranked = ranked.take(np.flatnonzero(present))
        judgement = judged(ranked)
    found = [place for place in places if place is not None]
    return _put_together(map_, encoder, best, ranked, found, judgement, stage)


def places_of(map_: Map, rows: Positions, k: int) -> list[Place | None]:
    """The places of the first of some rows, int64 [n], until they are ``k`` different ones; None for one that is gone.

    Of a place that has looks further rows may be among them.
    """
    found: list[Place | None] = []
    while len(found) < len(rows) and _different(found) < k:
        found += map_.places_at(rows[len(found) : len(found) + k].tolist())
    while found and _different(found[:-1]) >= k:
        found.pop()
    return found


def _different(places: Sequence[Place | None]) -> int:
    """How many places there are if looks of one count once."""
    return len({place.id for place in places if place is not None}) + sum(place is None for place in places)


def first_looks(places: Sequence[Place | None]) -> list[int]:
    """The positions at which a place is for the first time."""
    first: dict[str, int] = {}
    for position, place in enumerate(places):
        if place is not None:
            first.setdefault(place.id, position)
    return list(first.values())


def _put_together(
    map_: Map,
    encoder: Encoder,
    view: FramedView,
    candidates: Candidates,
    places: list[Place],
    judgement: Judgement,
    stage: ThirdStage,
) -> Answer:
    """The answer by the judged candidates of a view of the frame, of which ``places`` are the best."""
    query = view.query
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    listed = first_looks(places)
    matches = [(float(candidates.final_scores[position]), places[position]) for position in listed]
    if matches:
        judgement = replace(judgement, score=matches[0][0])
    log_odds = decision_slope(calibration) * candidates.values.astype(np.float64)
    views: list[RelativeView | None] = []
    shared: list[SharedPoints | None] = []
    note = None
    if judgement.verdict == "recognized" and candidates.whereabouts.kind[0] != NO_POSE:
        views, note = relative_views(map_, candidates, stage, query.verifier)
        shared = sightings(map_, candidates, stage, query.verifier)
    level = candidates.whereabouts.on_level_of(0, neighborhood.height)
    seen = any(view is not None and view.source == "intrinsics" for view in views)
    errors = place_errors(map_, candidates.rows.tolist(), level, surveyed=seen)
    pose = estimate_pose(level, log_odds, neighborhood.radius, views=views, sightings=shared, errors=errors)
    if note is None and pose is not None and pose.source != "intrinsics":
        note = _why_without_intrinsics(map_, query.question.camera, places[0], stage)
    if errors.turned[:1].any():
        note = turned_note(map_, int(level.sequence[0])) or note
    rivals = rival_places(map_, candidates, judgement)
    if len(listed) < len(places):
        candidates = candidates.take(np.append(listed, np.arange(len(places), len(candidates.rows))))
    weights = None if candidates.weights is None else np.exp(candidates.weights[: len(matches)]).tolist()
    framing = SAME_VIEW if judgement.verdict == "unknown" else view.framing  # a place that it does not show tells none
    lens = other_view(map_, query.question.camera, places[0].camera, framing) if places else None
    return Answer(
        judgement, matches, weights, calibration, 0.0, pose, query.encoding, candidates, stage, rivals, note, lens
    )


def other_view(map_: Map, camera: str | None, other: str | None, framing: Framing) -> str | None:
    """Say, in a sentence, that a frame shows much more or less than a place does; else None.

    Args:
        camera, other: the names of the camera of the query and of that of the place; None where they are not known.
        framing: of the query in the view of the place.
    """
    ours, theirs = map_.cameras.intrinsics(camera), map_.cameras.intrinsics(other)
    if known := camera != other and ours is not None and theirs is not None:
        factor = ours.across / theirs.across
    else:
        factor = min(framing.across, framing.down)
    if not max(factor, 1 / factor) >= OTHER_VIEW:
        return None
    found = f"the frame shows a {'narrower' if factor < 1 else 'wider'} view than the map"
    if not known:
        return found
    return (
        f"{found}: the camera {camera!r} sees {factor:.2g} times the angle that the camera {other!r} of the place sees"
    )


def _why_without_intrinsics(map_: Map, camera: str | None, best: Place, stage: ThirdStage) -> str | None:
    """Why the intrinsics of a frame's camera did not serve the pose; None if it has none."""
    if map_.cameras.intrinsics(camera) is None:
        return None
    if stage.state != "verified":
        return "No keypoints of the frame were compared with those of the place."
    if best.pose is None or best.pose.heading is None:
        return f"The place {best.id!r} has no heading."
    if map_.cameras.intrinsics(best.camera) is None:
        return f"The intrinsics of the camera of the place {best.id!r} are not known."
    return f"Too few keypoints of the frame fit those of the place {best.id!r}."


def rival_places(map_: Map, candidates: Candidates, judgement: Judgement) -> tuple[RivalPlaces, ...]:
    """The rivals by id; places that were deleted since the search are left out."""
    groups = []
    for group in judgement.rivals:
        places = map_.places_at(candidates.rows[list(group.positions)].tolist())
        ids = tuple(dict.fromkeys(place.id for place in places if place is not None))
        if ids:
            groups.append(RivalPlaces(ids, float(candidates.final_scores[group.positions[0]]), group.same_place))
    return tuple(groups)
