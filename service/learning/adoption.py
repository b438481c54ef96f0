"""The looks that a map takes by itself: what independent evidence agrees on, and no look that later runs contradict.

A map with the setting ``auto`` takes proposals that wait for review once two runs agree on them, or keypoints of the
frames beside them; it gives up looks that repeat others or never help, and withdraws those that win frames which their
runs are certain to be elsewhere.  Every step is one commit, and can be repeated: a job that is killed leaves nothing
half done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph, evidence_of, place_graph
from core.belief.evidence import believable_score
from core.errors import (
    LookNameTaken,
    PlacerecError,
    RepeatedLook,
    StorageFailure,
    TooManyLooks,
    UnknownFrame,
    UnknownPlace,
)
from core.judgement.background import GUARD_FACTOR
from core.learning import (
    Lesson,
    LookStatistics,
    PendingProposal,
    Proposal,
    RunFrame,
    Witness,
    corroborated,
    kept,
    services,
)
from core.learning.anchors import place_of
from core.ledger.maps.review import stored_frames
from core.maps import Enrolment, LearningSetting, ReviewFrame
from core.method.encoder import Encoder, Encoding
from core.places import Look, PlaceFields, look_address, place_and_look
from core.recognition.question import Query
from core.recognition.recognition import describe, frame_digest, locate
from core.recognition.stages import calibration_of, likeness_of_first, neighborhood_of, rank_places
from core.store import Map
from service.engine.encoders import Encoded

Encode = Callable[[Sequence[bytes], Sequence[str | None], bool], list[Encoded | Exception]]
"""Encodes files of cameras with their keypoints, after the requests that wait; with their pixels, or without."""

LEARNING = "learning ("
"""The beginning of who gave a label that a map has given itself; no key has such a name."""


@dataclass(frozen=True)
class WaitingFrame:
    """A proposal that waits for review.

    number: of the frame.
    place: the id of the place that it would be a look of.
    """

    number: int
    place: str
    told: Mapping[str, Any]
    answer: Mapping[str, Any]

    def pending(self, row: int) -> PendingProposal:
        """The proposal, of a place whose frame is in a row now."""
        told = self.told
        proposal = Proposal(
            told["frame"], row, told["certainty"], tuple(told["anchors"]), told["distance"], told["misfit"],
            told["geometry"], told["why"],
        )  # fmt: skip
        return PendingProposal(proposal, told["run"], Witness.of(told["source"]))


def waiting_frames(map_: Map) -> list[WaitingFrame]:
    """The proposals without a label, oldest first."""
    found = [one for frame in stored_frames(map_.review, labelled=False) if (one := _waiting(frame)) is not None]
    return found[::-1]


def _waiting(frame: ReviewFrame) -> WaitingFrame | None:
    told = frame.answer.get("proposal")
    return None if told is None else WaitingFrame(frame.number, told["place"], told, frame.answer)


class Took(NamedTuple):
    """How many proposals became looks, and how many looks went to make room for them."""

    looks: int
    withdrawn: int

    def __add__(self, other: Took) -> Took:  # type: ignore[override]
        return Took(self.looks + other.looks, self.withdrawn + other.withdrawn)


NOTHING = Took(0, 0)


class Adoption:
    """Takes proposals of one map into it, and withdraws looks from it.

    Args:
        encoder: the map's.
        graph: of its places.
        encode: see :data:`Encode`.
        setting: of the map.
    """

    def __init__(
        self, map_: Map, encoder: Encoder, graph: PlaceGraph, encode: Encode, setting: LearningSetting
    ) -> None:
        self.map, self.encoder, self.graph, self.encode, self.setting = map_, encoder, graph, encode, setting
        self._encoded: dict[int, Encoding | None] = {}  # of frames under review, by number

    # How looks have served

    def observe(self, lesson: Lesson, frames: Sequence[RunFrame]) -> int:
        """Count how the learnt looks have served in a run, and withdraw those that mislead or never help."""
        learnt = self.map.learnt_looks()
        looks: dict[int, list[int]] = {}
        for row in learnt:
            if (place := place_of(self.graph, row)) >= 0:
                looks.setdefault(place, []).append(row)
        counts = {row: one for row, one in services(lesson, frames, self.graph, looks).items() if row in learnt}
        self.map.count_served({row: (one.right, one.wrong, one.passed) for row, one in counts.items()})
        after = {row: served(look) + counts.get(row, LookStatistics()) for row, look in learnt.items()}
        return self.map.withdraw([row for row, one in after.items() if one.misleads or one.idle])

    def rehearse(self, lesson: Lesson, frames: Sequence[RunFrame], encoded: Sequence[Encoded | Exception]) -> int:
        """Ask a run again, and withdraw looks that win frames which the run is certain to be elsewhere."""
        judged = list(self._judged(frames, encoded))
        graph, learnt = graph_of(self.map), self.map.learnt_looks()  # with the looks that were taken since
        found = services(lesson, judged, graph)
        return self.map.withdraw([row for row, one in found.items() if row in learnt and one.wrong > one.right])

    def _judged(self, frames: Sequence[RunFrame], encoded: Sequence[Encoded | Exception]) -> Iterator[RunFrame]:
        for frame, one in zip(frames, encoded, strict=True):
            if isinstance(one, Exception) or not len(one.encoding.regions):
                yield frame
                continue
            keypoints = one.keypoints
            find = None if keypoints is None else (lambda keypoints=keypoints: keypoints)
            (answer,) = locate(self.map, self.encoder, [Query(one.encoding, find_keypoints=find)])
            rows, judgement = answer.candidates.rows, answer.judgement
            yield replace(
                frame, seen=evidence_of(answer, neighborhood_of(self.map)), verdict=judgement.verdict,
                probability=judgement.probability, row=int(rows[0]) if len(rows) else None,
            )  # fmt: skip

    # Taking proposals

    def take(self) -> Took:
        """Take the proposals on which independent evidence agrees."""
        waiting = waiting_frames(self.map)
        rows = self.map.rows_of([one.place for one in waiting])
        there = [(one, row) for one, row in zip(waiting, rows, strict=True) if row is not None]
        pending = [one.pending(row) for one, row in there]

        def scores(number: int, others: Sequence[int]) -> NDArray[np.float32]:
            return self._scores(there[number][0], [there[other][0] for other in others])

        chosen = corroborated(pending, self.graph, calibration_of(self.map, self.encoder), scores)
        took = NOTHING
        for number in sorted(chosen):
            with suppress(UnknownPlace, UnknownFrame, RepeatedLook, LookNameTaken, TooManyLooks):
                took += self._adopt(*there[number], chosen[number])
        return took

    def _scores(self, one: WaitingFrame, others: Sequence[WaitingFrame]) -> NDArray[np.float32]:
        """The scores of both stages of a proposal against others; 0 for those that cannot be encoded any more."""
        found = np.zeros(len(others), np.float32)
        encodings = self._encodings([one, *others])
        first, usable = encodings[0], [at for at, other in enumerate(encodings[1:]) if other is not None]
        if first is not None and usable:
            some = [first, *(other for other in encodings[1:] if other is not None)]
            found[usable] = likeness_of_encodings(self.encoder, some)
        return found

    def _encodings(self, frames: Sequence[WaitingFrame]) -> list[Encoding | None]:
        """The encodings of frames under review; None for one that is gone or damaged."""
        missing, data, cameras = [], [], []
        for one in frames:
            if one.number not in self._encoded:
                self._encoded[one.number] = None
                with suppress(PlacerecError):
                    data.append(self.map.review.picture(one.number))
                    missing.append(one.number)
                    cameras.append(one.answer.get("camera"))
        for number, outcome in zip(missing, self.encode(data, cameras, False) if data else [], strict=True):
            if not isinstance(outcome, Exception) and len(outcome.encoding.regions):
                self._encoded[number] = outcome.encoding
        return [self._encoded[one.number] for one in frames]

    def _adopt(self, one: WaitingFrame, row: int, grounds: str) -> Took:
        """Make a proposal a look of its place, unless the place keeps others instead."""
        try:
            data = self.map.review.picture(one.number)
        except StorageFailure:  # it is damaged, and waits for a person
            return NOTHING
        (made,) = self.encode([data], [one.answer.get("camera")], True)
        if isinstance(made, Exception) or not len(made.encoding.regions):
            return NOTHING
        going = self._going(one.place, row, made.encoding)
        if going is None or self.map.review.find(one.number).label is not None:
            return NOTHING  # it repeats others, or a person was faster
        item = self._enrolment(one, data, made)
        with self.map.review.held(one.number):
            change, withdrawn = self.map.learn(item, going, self.setting.most_places)
            if self._claimed(one, item, grounds):
                return Took(1, withdrawn)
        # A person has said otherwise, or thrown the frame away, in the same moment: that counts.
        new = self.map.rows_of([item.id]) if change == "created" else []
        self.map.withdraw([at for at in new if at is not None])
        return Took(0, withdrawn)

    def _claimed(self, one: WaitingFrame, item: Enrolment, grounds: str) -> bool:
        """Label a frame as the look that it has become; false if a person has given it another label."""
        place, name = place_and_look(item.id)
        label, now = {"place": place, "look": name}, datetime.now(UTC).isoformat()
        try:
            if self.map.review.label_first(one.number, {"label": label, "by": f"{LEARNING}{grounds})", "at": now}):
                return True
            return (self.map.review.find(one.number).label or {}).get("label") == label
        except UnknownFrame:
            return False

    def _enrolment(self, one: WaitingFrame, data: bytes, made: Encoded) -> Enrolment:
        told = one.told
        camera = one.answer.get("camera")
        digest = frame_digest(self.map.review.find(one.number).digest, made.mask)
        taken = None if told["taken"] is None else datetime.fromisoformat(told["taken"])
        described = describe(
            self.map, look_address(one.place, digest.hex()[:16]), PlaceFields(timestamp=taken, camera=camera), data,
            digest, made.pixels, made.encoding, keypoints=made.keypoints,
        )  # fmt: skip
        return replace(described, run=told["run"], least=told["least_score"])

    def _going(self, place: str, row: int, encoding: Encoding) -> list[int] | None:
        """The rows of the learnt looks of a place that a new one replaces; None if the place does not keep it.

        The first look stays, and so do those that people added.
        """
        looks = self.map.looks(place)
        found = zip(self.map.rows_of([look_address(place, look.name) for look in looks]), looks, strict=True)
        there = {at: look for at, look in found if at is not None}
        learnt = {at: look for at, look in there.items() if look.run is not None}
        fixed = [row, *(at for at in there if at not in learnt)]
        snapshot = self.map.snapshot()
        stored = np.array([*fixed, *learnt], np.int64)
        descriptors = np.concatenate([snapshot.descriptors_at(stored), encoding.descriptor[np.newaxis]])
        local = np.concatenate([snapshot.locals_at(stored), encoding.local[np.newaxis]])
        table = np.stack([_scores_of(self.encoder, descriptors, local, at) for at in range(len(stored) + 1)])
        history = [*[LookStatistics()] * len(fixed), *map(served, learnt.values()), LookStatistics()]
        believable, most = self._believable(encoding), self.setting.most_looks
        staying = set(kept(table, believable, most, history, len(fixed)).tolist())
        if len(stored) not in staying:
            return None
        return [at for number, at in enumerate(learnt, len(fixed)) if number not in staying]

    def _believable(self, encoding: Encoding) -> float:
        """The score at which a frame would just be recognized in the map."""
        (found,) = rank_places(self.map, self.encoder, [encoding])
        same, where = neighborhood_of(self.map), found.whereabouts
        compared = where.others(0, same) & found.examined
        apart = compared & ~where.near(0, same.times(GUARD_FACTOR))
        falling = np.sort(found.scores[compared].astype(np.float64))[::-1]
        calibration = calibration_of(self.map, self.encoder)
        return believable_score(falling, int(compared.sum()), calibration, found.scores[apart].astype(np.float64))[1]


def graph_of(map_: Map) -> PlaceGraph:
    """The graph of all places that a map has now."""
    snapshot = map_.snapshot()
    return place_graph(snapshot.whereabouts, map_.scope().living_rows(), snapshot.rows, neighborhood_of(map_))


def served(look: Look) -> LookStatistics:
    """How a look has served so far."""
    return LookStatistics(look.right, look.wrong, look.passed)


def likeness_of_encodings(encoder: Encoder, encodings: Sequence[Encoding]) -> NDArray[np.float32]:
    """The scores of both stages of the first of n frames, as if it were the query, at the others; float32 [n - 1]."""
    descriptors, local = (np.stack([getattr(one, name) for one in encodings]) for name in ("descriptor", "local"))
    return likeness_of_first(encoder, descriptors, local)


def _scores_of(
    encoder: Encoder, descriptors: NDArray[np.float32], local: NDArray[np.int8], at: int
) -> NDArray[np.float32]:
    """The scores of one of n frames against all of them, itself included, float32 [n]."""
    order = np.concatenate([[at], np.arange(len(descriptors))])
    return likeness_of_first(encoder, descriptors[order], local[order])
