"""When a proposal may be taken without a person: where evidence agrees that is independent of the run that made it.

Two independent runs (``witnesses.py``) propose the same place with frames that show the same; or keypoints of the frame
fit those of a recognized frame beside it, which shows part of the same.  Two frames show the same if one would be
recognized at the other in a map made of the proposals of that other run alone: frames of one night look alike, so that
they must be told apart from one another, and not from those of the day.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph
from core.judgement.verdict import Calibration, judge
from core.learning.anchors import place_of
from core.learning.proposals import FITTING, Proposal
from core.learning.witnesses import Witness

Scores = Callable[[int, Sequence[int]], NDArray[np.float32]]
"""Returns the scores of both stages of a proposal against others, by their numbers; float32 [k]."""

Grounds = Literal["runs", "geometry"]
"""Why a proposal may be taken: two runs agree, or keypoints do."""


@dataclass(frozen=True)
class PendingProposal:
    """A proposal that waits.

    run: a name for the run that made it.
    source: the robot of the run, and when the run began.
    """

    proposal: Proposal
    run: str
    source: Witness


def corroborated(
    pending: Sequence[PendingProposal], graph: PlaceGraph, calibration: Calibration, scores: Scores
) -> dict[int, Grounds]:
    """The numbers of the proposals that may be taken, and why.

    Args:
        pending: all proposals that wait, of a map.
        graph: of the map's places.
        calibration: by which the map's queries are judged.
        scores: see :data:`Scores`.
    """
    places = np.array([place_of(graph, one.proposal.row) for one in pending], np.int64)
    found: dict[int, Grounds] = {}
    for number, one in enumerate(pending):
        if places[number] < 0:
            continue
        if one.proposal.geometry is not None and one.proposal.geometry >= FITTING:
            found[number] = "geometry"
        elif any(
            _agrees(number, others, places, graph, calibration, scores)
            for others in _witnesses(number, pending, places, graph)
        ):
            found[number] = "runs"
    return found


def _witnesses(
    number: int, pending: Sequence[PendingProposal], places: NDArray[np.int64], graph: PlaceGraph
) -> list[NDArray[np.int64]]:
    """The proposals of each independent run that proposes a proposal's place, too; int64 [k] each."""
    own = pending[number]
    same = graph.same_place(int(places[number]))
    runs: dict[str, list[int]] = {}
    for other, one in enumerate(pending):
        if one.run != own.run and one.source.independent_of(own.source) and places[other] >= 0:
            runs.setdefault(one.run, []).append(other)
    return [np.array(run, np.int64) for run in runs.values() if np.isin(places[run], same).any()]


def _agrees(
    number: int,
    others: NDArray[np.int64],
    places: NDArray[np.int64],
    graph: PlaceGraph,
    calibration: Calibration,
    scores: Scores,
) -> bool:
    """Whether a proposal is recognized at its place among the proposals of another run."""
    found = scores(number, others.tolist())
    order = np.argsort(-found, kind="stable")
    ranked = others[order]
    if places[ranked[0]] not in graph.same_place(int(places[number])):
        return False
    where = graph.whereabouts.take(places[ranked])
    judgement = judge(found[order], where, calibration, graph.neighborhood, np.ones(len(order), np.bool_))
    return judgement.verdict == "recognized"
