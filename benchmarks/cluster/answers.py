"""Corridor and lip6 queried in a data directory and of PostgreSQL and Milvus: the same answers.

    python -m benchmarks.cluster.answers [--milvus ADDRESS --postgres ADDRESS]

Each traverse's references are encoded once and enrolled in a map of either store, and its queries, encoded once as
well, are located in both by ``core.recognition``.  Recall@1 is the share of the queries whose first match is right; the
area under the precision-recall curve is that of the first matches' scores.
"""

from __future__ import annotations

import hashlib
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.cluster.stores import MilvusAddress, PostgresAddress, both_stores
from benchmarks.report import report, verdict
from core.judgement.curves import auc_pr
from core.store import Map
from core.maps.records import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import PlaceFields
from core.recognition.question import Query
from core.recognition.recognition import Answer, describe, locate
from core.threads import cores, share_cores
from lab.training.map_sizes import corridor_and_lip6

MOST_APART = 0.002
AT_ONCE = 64


def encoded(encoder: Encoder, frames: Sequence[Any]) -> list[Encoding]:
    """Frames, encoded eight at a time."""
    return [one for start in range(0, len(frames), 8) for one in encoder.encode_batch(frames[start : start + 8])]


def fill(map_: Map, frames: Sequence[Any], encodings: Sequence[Encoding]) -> None:
    """Enrol the references, in order; the number of each is in its place's id."""
    described = [
        describe(map_, f"r{number}", PlaceFields(), None, hashlib.sha256(pixels.tobytes()).digest(), pixels, encoding)
        for number, (pixels, encoding) in enumerate(zip(frames, encodings, strict=True))
    ]
    for start in range(0, len(described), AT_ONCE):
        map_.enrol(described[start : start + AT_ONCE])


def figures(answers: Sequence[Answer], truth: NDArray[np.bool_]) -> dict[str, Any]:
    """Of the answers to all queries; truth: bool [Q, R]."""
    first = [int(answer.matches[0][1].id[1:]) for answer in answers]
    right = [bool(truth[query, reference]) for query, reference in enumerate(first)]
    scores = [answer.matches[0][0] for answer in answers]
    return {
        "recall": float(np.mean(right)),
        "auc_pr": auc_pr(scores, right),
        "search_milliseconds": statistics.median(answer.search for answer in answers),
        "first": first,
        "scores": scores,
        "verdicts": [answer.judgement.verdict for answer in answers],
    }


def main(
    milvus: MilvusAddress = "",
    postgres: PostgresAddress = "",
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
) -> None:
    """Measure and report."""
    share_cores(cores())
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    rows, stored, bars = [], {}, []
    with both_stores(milvus, postgres) as stores:
        for name, task in corridor_and_lip6(datasets):
            references, queries = encoded(encoder, task.references), encoded(encoder, task.queries)
            found = {}
            for kind, store in (("embedded", stores.embedded), ("milvus", stores.milvus)):
                settings = MapSettings(keep="none")
                map_ = store.create(
                    f"{name}-answers", encoder.identity, encoder.dimension, settings, encoder.local_shape
                )
                fill(map_, task.references, references)
                answers = [locate(map_, encoder, [Query(query)])[0] for query in queries]
                found[kind] = figures(answers, np.asarray(task.truth))
                store.delete(f"{name}-answers")
            ours, theirs = found["embedded"], found["milvus"]
            same = [one == other for one, other in zip(ours["first"], theirs["first"], strict=True)]
            apart = float(np.abs(np.array(ours["scores"]) - theirs["scores"]).max())
            verdicts = sum(one != other for one, other in zip(ours["verdicts"], theirs["verdicts"], strict=True))
            for kind, of in found.items():
                rows.append(
                    [f"{name}, {kind}", f"{of['recall']:.4f}", f"{of['auc_pr']:.4f}", of["search_milliseconds"]]
                )
            bars += [
                [f"{name}: {what} apart", abs(ours[figure] - theirs[figure])]
                for what, figure in (("recall@1", "recall"), ("AUC-PR", "auc_pr"))
            ]
            stored[name] = {**found, "same_first": sum(same), "queries": len(same), "scores_apart": apart}
            print(
                f"{name}: {sum(same)} of {len(same)} first matches are the same, scores are {apart:.1e} apart at most,"
            )
            print(f"    and {verdicts} verdicts differ")
    columns = ["traverse and store", "recall@1", "AUC-PR", "search, ms"]
    report("cluster_answers", "the same queries in two stores", columns, rows, {"traverses": stored})
    for what, value in bars:
        print(f"{what:<28} {value:.4f}   {verdict(float(value), MOST_APART)}")


if __name__ == "__main__":
    typer.run(main)
