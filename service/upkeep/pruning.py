"""Leaving places out that their neighbours stand in for, and what that costs in recall."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownSequence
from core.judgement.reliability import wilson
from core.recognition.self_queries import TOGETHER, SelfQueries, spread_order
from core.upkeep.hubness import NONE
from core.upkeep.redundancy import Thinning, Trial, best_thinning, neighbour_pairs, steps, thinned
from service.engine.engine import Engine
from service.errors.faults import NothingToMeasure
from service.jobs.context import JobContext, yield_to_requests

KIND = "prune"

DEPTH = 64
"""So many of the best places of each query are kept in mind: what is left of them after pruning decides."""

STEPS = 12
"""Thresholds that are tried, from the gentlest on."""

PAIRS_TOGETHER = 256

NAMED = 100
"""Places that go are counted, and so many named."""


def prune(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Do what the job says: find what can go, measure what it costs and, unless ``dry_run``, forget it.

    What is to go is written down before it goes, and goes in one COMMIT: an attempt after a kill finds that it went,
    or lets it go, and never thins what was thinned.

    Raises:
        UnknownMap, UnknownSequence, NothingToMeasure, EncoderNotInstalled, StorageFull, StorageFailure.
    """
    map_ = context.map(engine.atlas)
    if (planned := context.notes.get("report")) is None:
        planned, going = _plan(engine, context)
        if context.arguments["dry_run"]:
            return planned
        context.remember(report=planned, going=going)
    digests = {place: bytes.fromhex(digest) for place, digest in context.notes["going"].items()}
    if any(digests.get(place.id) == place.digest for place in map_.transfer.outline()):  # not done by an attempt before
        context.check_cancelled()
    context.progress(0, len(digests), "forgets the places")
    with engine.writing(map_.record.id):
        map_.transfer.forget(digests)
    context.progress(len(digests), len(digests))
    return dict(planned) | {"places_after": map_.count_places()}


def _plan(engine: Engine, context: JobContext) -> tuple[dict[str, Any], dict[str, str]]:
    """The report, and the digests of the places that go, by their ids."""
    wanted = context.arguments
    map_ = context.map(engine.atlas)
    own = SelfQueries(map_, engine.load_encoder(map_))
    names = np.array([place.sequence or "" for place in own.places], np.str_)
    asking = _named(names, wanted["queries"])
    references = ~asking if wanted["queries"] is not None else np.ones(len(own), np.bool_)
    trial = _try(engine, context, own, asking if wanted["queries"] is not None else references, references, wanted)
    pairs = neighbour_pairs(own.where, own.neighborhood)
    free = references & (_named(names, wanted["sequence"]) if wanted["sequence"] is not None else True)
    pairs = pairs[references[pairs].all(axis=1)]
    similarity = _similarities(engine, context, own, pairs)
    choices = steps(similarity, STEPS) if wanted["similarity"] is None else [wanted["similarity"]]
    before = trial.found(references)
    tried: list[Thinning] = []
    for least in choices:
        context.check_cancelled()
        # Places that must stay may stand in for others, but not the other way round.
        kept = thinned(len(own), pairs, similarity, least, free)
        tried.append(Thinning(least, kept, before, trial.found(kept & references)))
    most_loss = 1.0 if wanted["similarity"] is not None else wanted["max_recall_loss"]
    chosen = best_thinning(tried, most_loss)
    going = (
        {} if chosen is None else {own.places[i].id: own.places[i].digest.hex() for i in np.flatnonzero(~chosen.kept)}
    )
    after = before if chosen is None else chosen.after
    report = {
        "places": len(own),
        "removed": len(going),
        "similarity": None if chosen is None else chosen.least,
        "measured_on": "leave-one-out" if wanted["queries"] is None else wanted["queries"],
        "queries": len(before),
        "recall_before": _share(before),
        "recall_after": _share(after),
        "recall_loss": float(before.mean() - after.mean()),
        "tried": [
            {"similarity": one.least, "removed": int((~one.kept).sum()), "recall": float(one.after.mean())}
            for one in tried
        ],
        "named": list(going)[:NAMED],
    }  # fmt: skip
    return report, going


def _named(names: NDArray[np.str_], sequence: str | None) -> NDArray[np.bool_]:
    chosen = np.zeros(len(names), np.bool_) if sequence is None else names == sequence
    if sequence is not None and not chosen.any():
        raise UnknownSequence(f"The map has no sequence {sequence[:128]!r}.")
    return chosen


def _share(right: NDArray[np.bool_]) -> dict[str, Any]:
    return wilson(int(right.sum()), len(right)).model_dump()


def _similarities(
    engine: Engine, context: JobContext, own: SelfQueries, pairs: NDArray[np.int64]
) -> NDArray[np.float32]:
    found = [np.empty(0, np.float32)]
    for first in range(0, len(pairs), PAIRS_TOGETHER):
        yield_to_requests(engine, context)
        found.append(own.first_stage_scores(pairs[first : first + PAIRS_TOGETHER]))
        context.progress(min(first + PAIRS_TOGETHER, len(pairs)), len(pairs), "compares neighbours")
    return np.concatenate(found)


def _try(
    engine: Engine,
    context: JobContext,
    own: SelfQueries,
    asking: NDArray[np.bool_],
    references: NDArray[np.bool_],
    wanted: Mapping[str, Any],
) -> Trial:
    """Hold the frames that ask against the others, each without itself."""
    candidates = np.flatnonzero(asking)
    chosen = candidates[spread_order(len(candidates))[: wanted["sample"]]]
    depth, stage = min(DEPTH, max(1, len(own))), own.encoder.candidates
    found: list[tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]] = []
    everything = np.flatnonzero(references)
    for first in range(0, len(chosen), TOGETHER):
        yield_to_requests(engine, context)
        some = chosen[first : first + TOGETHER].tolist()
        for position, others, scores in own.search(some, references):
            if not own.near(position, everything[everything != position]).any():
                continue  # nothing could be right
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
        context.progress(first + len(some), len(chosen), "asks")
    if not found:
        raise NothingToMeasure(
            "No frame of the map has another one of the same place to be recognized by: there is nothing to prune, "
            "or poses and sequences do not say which places are the same."
        )
    positions, scores, gains, right = (np.stack(column) for column in zip(*found, strict=True))
    return Trial(positions, scores, gains, right, stage)
