"""The job that prunes a map: it removes places whose neighbours can stand in for them, and measures what is lost.

Where the robot stood, the first frame stands for the others and always stays.  That the others go is the first thing
that is tried.  The loss is counted without them, for the many frames of a stop would outvote all other places.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownSequence
from core.judgement.reliability import wilson
from core.recognition.self_queries import TOGETHER, SelfQueries, spread_order
from core.upkeep.hubness import NONE
from core.upkeep.redundancy import RemovalTrial, Thinning, best_thinning, first_looks, neighbour_pairs, steps, thinned
from service.engine.engine import Engine
from service.errors.faults import NothingToMeasure
from service.jobs.context import JobContext, yield_to_requests
from service.places.place_events import tell_change

KIND = "prune"

DEPTH = 64
"""How many of the best matches of each query are remembered, so that it need not be searched again for each trial."""

STEPS = 12
"""How many similarity thresholds are tried, the one that removes least first."""

PAIRS_TOGETHER = 256
"""How many pairs of places are compared at a time."""

MOST_LISTED = 100
"""How many of the removed places the report lists at most."""


def prune(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Find the places that can be removed, measure the loss of recall, and remove them unless ``dry_run`` is set.

    The places are noted before they are removed, in one commit.  So an attempt after a restart removes the places
    that were noted, if they are still there, and never plans again for a map that was pruned already.

    Raises:
        UnknownMap, UnknownSequence, NothingToMeasure, EncoderNotInstalled, StorageFull, StorageFailure: the map is
            what it was before.
        JobCancelled, JobInterrupted.
    """
    map_ = context.map(engine.maps)
    if (report := context.notes.get("report")) is None:
        report, going = _plan(engine, context)
        if context.arguments["dry_run"]:
            return report
        context.remember(report=report, going=going)
    digests = {place: bytes.fromhex(digest) for place, digest in context.notes["going"].items()}
    if any(digests.get(place.id) == place.digest for place in map_.transfer.outline()):
        context.check_cancelled()  # no earlier attempt has removed them
    context.progress(0, len(digests), "removing places")
    with engine.writing(map_.record.id):
        count = map_.transfer.forget(digests)
    tell_change(engine, map_, "deleted", count)
    context.progress(len(digests), len(digests))
    return dict(report) | {"places_after": map_.count_places()}


def _plan(engine: Engine, context: JobContext) -> tuple[dict[str, Any], dict[str, str]]:
    """The report, and the SHA-256 of the images of the places to remove, by id."""
    options = context.arguments
    map_ = context.map(engine.maps)
    own = SelfQueries(map_, engine.load_encoder(map_))
    names = np.array([place.sequence or "" for place in own.places], np.str_)
    if options["queries"] is not None:
        queries = _members(names, options["queries"])
        references = ~queries
    else:
        queries = references = np.ones(len(own), np.bool_)
    first = first_looks(own.where, own.neighborhood)
    further = np.flatnonzero(first != np.arange(len(own)))
    views = ~own.members(further)
    trial = _search(engine, context, own, queries & views, references & views, options["sample"])
    looks = np.stack([first[further], further], axis=1)
    pairs = np.flatnonzero(views)[neighbour_pairs(own.where.take(views), own.neighborhood)]
    looks, pairs = (some[references[some].all(axis=1)] for some in (looks, pairs))
    pairs = np.concatenate([looks, pairs])
    removable = references & _members(names, options["sequence"]) if options["sequence"] is not None else references
    removable = removable & ~own.members(looks[:, 0])
    similarity = _similarities(engine, context, own, pairs)
    before = trial.found(references)
    tried: list[Thinning] = []
    for least, scores in _choices(similarity, len(looks), options["similarity"]):
        context.check_cancelled()
        # Places that must stay can stand in for others, but not the other way round.
        retained = thinned(len(own), pairs, scores, least, removable)
        tried.append(Thinning(least, retained, before, trial.found(retained & references)))
    most_loss = 1.0 if options["similarity"] is not None else options["max_recall_loss"]
    chosen = best_thinning(tried, most_loss)
    going = (
        {}
        if chosen is None
        else {own.places[i].id: own.places[i].digest.hex() for i in np.flatnonzero(~chosen.retained)}
    )
    after = before if chosen is None else chosen.after
    report = {
        "places": len(own),
        "removed": len(going),
        "similarity": None if chosen is None else chosen.least,
        "measured_on": "leave-one-out" if options["queries"] is None else options["queries"],
        "queries": len(before),
        "recall_before": _share(before),
        "recall_after": _share(after),
        "recall_loss": float(before.mean() - after.mean()),
        "tried": [
            {"similarity": one.least, "removed": int((~one.retained).sum()), "recall": float(one.after.mean())}
            for one in tried
        ],
        "named": list(going)[:MOST_LISTED],
    }  # fmt: skip
    return report, going


def _choices(
    similarity: NDArray[np.float32], looks: int, least: float | None
) -> Iterator[tuple[float, NDArray[np.float32]]]:
    """Thresholds to try, those that remove less first, and the score of each pair, float32 [pairs], beside them.

    Args:
        similarity: float32 [pairs], of which the first ``looks`` are of further looks where the robot stood.
        least: the one threshold that the caller wants; None: further looks go alone, then with ever more places.
    """
    if least is not None:
        yield least, similarity
        return
    scores = similarity.copy()
    scores[:looks] = np.inf
    if looks:
        yield float(similarity[:looks].min()), np.where(np.arange(len(scores)) < looks, scores, -np.inf)
    for step in steps(similarity[looks:], STEPS):
        yield step, scores


def _members(names: NDArray[np.str_], sequence: str) -> NDArray[np.bool_]:
    """Which places belong to a sequence; raises UnknownSequence if none does."""
    chosen: NDArray[np.bool_] = names == sequence
    if not chosen.any():
        raise UnknownSequence(f"The map has no sequence {sequence[:128]!r}.")
    return chosen


def _share(right: NDArray[np.bool_]) -> dict[str, Any]:
    return wilson(int(right.sum()), len(right)).model_dump()


def _similarities(
    engine: Engine, context: JobContext, own: SelfQueries, pairs: NDArray[np.int64]
) -> NDArray[np.float32]:
    """How alike the two frames of each pair look, by the first stage; float32 [pairs]."""
    found = [np.empty(0, np.float32)]
    for first in range(0, len(pairs), PAIRS_TOGETHER):
        yield_to_requests(engine, context)
        found.append(own.first_stage_scores(pairs[first : first + PAIRS_TOGETHER]))
        context.progress(min(first + PAIRS_TOGETHER, len(pairs)), len(pairs), "comparing neighbours")
    return np.concatenate(found)


def _search(
    engine: Engine,
    context: JobContext,
    own: SelfQueries,
    queries: NDArray[np.bool_],
    references: NDArray[np.bool_],
    sample: int,
) -> RemovalTrial:
    """Search for a sample of the queries among the references, for each query without itself.

    Raises:
        NothingToMeasure: no query has another frame of the same place among the references.
        JobCancelled, JobInterrupted, StorageFailure.
    """
    candidates = np.flatnonzero(queries)
    chosen = candidates[spread_order(len(candidates))[:sample]]
    stage = own.encoder.screened  # the best of them is examined, as good as always
    depth = min(max(DEPTH, stage), max(1, len(own)))
    found: list[tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]] = []
    everything = np.flatnonzero(references)
    for first in range(0, len(chosen), TOGETHER):
        yield_to_requests(engine, context)
        some = chosen[first : first + TOGETHER].tolist()
        for position, others, scores in own.search(some, references):
            if not own.near(position, everything[everything != position]).any():
                continue  # no answer could be right
            best = others[:depth]
            gains = np.zeros(len(best), np.float32)
            if stage:
                gains = own.encoder.agreement(
                    own.local_descriptors(np.array([position]))[0], own.local_descriptors(best)
                )
            right = own.near(position, best)
            padding = (0, depth - len(best))
            found.append((
                np.pad(best, padding, constant_values=NONE),
                np.pad(scores[:depth], padding),
                np.pad(gains, padding),
                np.pad(right, padding),
            ))  # fmt: skip
        context.progress(first + len(some), len(chosen), "searching")
    if not found:
        raise NothingToMeasure(
            "No frame of the map has another frame of the same place by which it could be recognized: there is nothing "
            "to prune, or poses and sequences do not show which places are the same."
        )
    positions, scores, gains, right = (np.stack(column) for column in zip(*found, strict=True))
    return RemovalTrial(positions, scores, gains, right, stage)
