"""How far two maps of one encoder show the same places."""

from __future__ import annotations

from statistics import median
from typing import Any

import numpy as np

from core.method.encoder import Encoding
from core.method.regions import Regions
from core.recognition.recognition import locate
from core.recognition.self_queries import TOGETHER, spread
from core.storage import Map
from service.engine.engine import Engine
from service.jobs.background import stand_back
from service.jobs.jobs import JobContext

NAMED = 20

_NO_REGIONS = Regions(
    np.empty((0, 4), np.int32),
    np.empty(0, np.float32),
    np.empty(0, np.int32),
    np.empty(0, np.int32),
    np.empty((0, 0), np.float32),
)
"""What was found in a frame that is not at hand any more; a search does not look at it."""


def overlap(engine: Engine, context: JobContext, map_: Map, other: Map) -> dict[str, Any]:
    """How many of the other map's places this one recognizes, by a sample of them spread over it."""
    encoder = engine.load_encoder(map_)
    outline, snapshot = other.transfer.outline(), other.snapshot()
    outline = [place for place in outline if place.row < snapshot.rows]  # not what is being written in this very moment
    chosen = [outline[i] for i in spread(len(outline))[: context.arguments["sample"]]]
    verdicts = {"recognized": 0, "ambiguous": 0, "unknown": 0}
    pairs: list[dict[str, Any]] = []
    apart: list[float] = []
    for first in range(0, len(chosen), TOGETHER):
        stand_back(engine, context)
        some = chosen[first : first + TOGETHER]
        rows = np.array([place.row for place in some], np.int64)
        descriptors, local = snapshot.descriptors_at(rows), snapshot.locals_at(rows)
        encodings = [Encoding(d, cells, _NO_REGIONS, {}) for d, cells in zip(descriptors, local, strict=True)]
        there = other.transfer.find([place.id for place in some])
        for place, located in zip(some, locate(map_, encoder, encodings, 1), strict=True):
            verdicts[located.judgement.verdict] += 1
            if located.judgement.verdict != "recognized" or place.id not in there:
                continue
            score, match = located.matches[0]
            pairs.append({"place": place.id, "match": match.id, "score": float(score)})
            ours, theirs = match.pose, there[place.id][0].pose
            if ours is not None and theirs is not None and ours.kind() == theirs.kind():
                apart.append(float(np.linalg.norm(ours.position() - theirs.position())))
        context.progress(first + len(some), len(chosen), "compares the maps")
    pairs.sort(key=lambda pair: -pair["score"])
    return {
        "examined": len(chosen),
        "of": len(outline),
        **verdicts,
        "metres_apart": median(apart) if apart else None,
        "pairs": pairs[:NAMED],
    }
