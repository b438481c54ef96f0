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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph, evidence_of, place_graph
from core.belief.evidence import believable_score
from core.errors import PlacerecError, RepeatedLook, StorageFailure, TooManyLooks, UnknownFrame, UnknownPlace
from core.judgement.background import GUARD_FACTOR
from core.learning import (
    Lesson,
    LookStatistics,
    PendingProposal,
    Proposal,
    RunFrame,
    corroborated,
    kept,
    services,
)
from core.learning.anchors import place_of
from core.maps import Enrolment, Map, ReviewFrame
from core.method.encoder import Encoder, Encoding
from core.places import Look, PlaceFields, look_address
from core.recognition.question import Query
from core.recognition.recognition import describe, frame_digest, locate
from core.recognition.stages import calibration_of, likeness_of_first, neighborhood_of, rank_places
from service.engine.encoders import Encoded

Encode = Callable[[Sequence[bytes], Sequence[str | None], bool], list[Encoded | Exception]]
"""Encodes files of cameras with their keypoints, after the requests that wait; with their pixels, or without."""

PAGE = 100
"""Frames of review that are read at a time."""


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
        return PendingProposal(proposal, told["run"], told["source"])


def waiting_frames(map_: Map) -> list[WaitingFrame]:
    """The proposals without a label, oldest first."""
    found: list[WaitingFrame] = []
    before: int | None = None
    while page := map_.review.page(before, PAGE, labelled=False).frames:
        found += [one for frame in page if (one := _waiting(frame)) is not None]
        before = page[-1].number
    return found[::-1]


def _waiting(frame: ReviewFrame) -> WaitingFrame | None:
    told = frame.answer.get("proposal")
    return None if told is None else WaitingFrame(frame.number, told["place"], told, frame.answer)


class Adoption:
    """Takes proposals of one map into it, and withdraws looks from it.

    Args:
        encoder: the map's.
        graph: of its places.
        encode: see :data:`Encode`.
        most_looks: of a place, its first included.
    """

    def __init__(self, map_: Map, encoder: Encoder, graph: PlaceGraph, encode: Encode, most_looks: int) -> None:
        self.map, self.encoder, self.graph, self.encode, self.most_looks = map_, encoder, graph, encode, most_looks
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

    def take(self) -> int:
        """Take the proposals on which independent evidence agrees; returns how many became looks."""
        waiting = waiting_frames(self.map)
        rows = self.map.rows_of([one.place for one in waiting])
        there = [(one, row) for one, row in zip(waiting, rows, strict=True) if row is not None]
        pending = [one.pending(row) for one, row in there]

        def scores(number: int, others: Sequence[int]) -> NDArray[np.float32]:
            return self._scores(there[number][0], [there[other][0] for other in others])

        chosen = corroborated(pending, self.graph, calibration_of(self.map, self.encoder), scores)
        taken = 0
        for number in sorted(chosen):
            with suppress(UnknownPlace, UnknownFrame, RepeatedLook, TooManyLooks):
                taken += self._adopt(*there[number], chosen[number])
        return taken

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

    def _adopt(self, one: WaitingFrame, row: int, grounds: str) -> bool:
        """Make a proposal a look of its place, unless the place keeps others instead."""
        try:
            data = self.map.review.picture(one.number)
        except StorageFailure:  # it is damaged, and waits for a person
            return False
        (made,) = self.encode([data], [one.answer.get("camera")], True)
        if isinstance(made, Exception) or not len(made.encoding.regions):
            return False
        staying, rows = self._kept(one.place, row, made.encoding)
        if len(rows) + 1 not in staying or self.map.review.find(one.number).label is not None:
            return False  # it repeats others, or a person was faster
        item = self._enrolment(one, data, made)
        self.map.enrol([item])
        self.map.withdraw([rows[at - 1] for at in range(1, len(rows) + 1) if at not in staying])
        said = {"label": {"place": one.place, "look": item.id.rpartition("/")[2]}, "by": f"learning ({grounds})"}
        self.map.review.label(one.number, {**said, "at": datetime.now(UTC).isoformat()})
        return True

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

    def _kept(self, place: str, row: int, encoding: Encoding) -> tuple[set[int], list[int]]:
        """The looks of a place that stay beside a new one, by number, and the rows of the learnt ones.

        Number 0 is its first look, then come the learnt ones, and the new one last.
        """
        looks = [look for look in self.map.looks(place) if look.run is not None]
        found = zip(self.map.rows_of([look_address(place, look.name) for look in looks]), looks, strict=True)
        learnt = {at: look for at, look in found if at is not None}
        rows, snapshot = list(learnt), self.map.snapshot()
        stored = np.array([row, *rows], np.int64)
        descriptors = np.concatenate([snapshot.descriptors_at(stored), encoding.descriptor[np.newaxis]])
        local = np.concatenate([snapshot.locals_at(stored), encoding.local[np.newaxis]])
        table = np.stack([_scores_of(self.encoder, descriptors, local, at) for at in range(len(stored) + 1)])
        history = [LookStatistics(), *map(served, learnt.values()), LookStatistics()]
        staying = kept(table, self._believable(encoding), self.most_looks, history)
        return set(staying.tolist()), rows

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
