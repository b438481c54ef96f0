"""What keeping descriptors in fewer bits costs: AUC-PR of both stages, by how a map keeps what it searches.

    python -m benchmarks.precision QUERIES REFERENCES TRUTH.csv [--encoder NAME] [--cache FILE.npz] [--json OUT.json]

Queries are never kept and stay float32; references go through the storage's own packing and back.  ``first`` is
the first stage alone, ``both`` adds the second to every reference, ``changed`` says for how many queries another
reference is the best, and ``deviation`` by how much a first-stage score differs at most.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from core.frames.images import decode
from core.frames.traverses import find_images, read_ground_truth
from core.judgement.curves import auc_pr
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.storage.files.row_formats import Precision, pack_descriptors, pack_local, unpack_descriptors, unpack_local

Side = tuple[NDArray[np.float32], NDArray[np.int8]]
"""Descriptors float32 [n, D] and local descriptors int8 [n, C, L]."""

_BATCH = 8


def encoded(encoder: Encoder, folder: Path) -> Side:
    """All frames of a folder."""
    paths = find_images(folder)
    encodings = []
    for start in range(0, len(paths), _BATCH):
        encodings += encoder.encode_batch([decode(path.read_bytes()) for path in paths[start : start + _BATCH]])
    return np.stack([one.descriptor for one in encodings]), np.stack([one.local for one in encodings])


def sides(encoder: Encoder, queries: Path, references: Path, cache: Path | None) -> tuple[Side, Side]:
    """Queries and references, from ``cache`` if it is there."""
    if cache is not None and cache.is_file():
        with np.load(cache) as kept:
            return (kept["qd"], kept["ql"]), (kept["rd"], kept["rl"])
    asked, known = encoded(encoder, queries), encoded(encoder, references)
    if cache is not None:
        np.savez(cache, qd=asked[0], ql=asked[1], rd=known[0], rl=known[1])
    return asked, known


def at_rest(side: Side, precision: Precision) -> tuple[Side, int]:
    """What comes back of a side that was kept, and bytes a place."""
    descriptors, local = side
    kept, kept_local = pack_descriptors(descriptors, precision), pack_local(local, precision)
    back = (
        unpack_descriptors(kept, precision, descriptors.shape[1]),
        unpack_local(kept_local, precision, local.shape[1:]),
    )
    return back, kept[0].nbytes + kept_local[0].nbytes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("queries", type=Path)
    parser.add_argument("references", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--encoder", default=DEFAULT_ENCODER)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    encoder = EncoderCatalogue().get(options.encoder)
    asked, known = sides(encoder, options.queries, options.references, options.cache)
    truth = read_ground_truth(options.truth, len(asked[0]), len(known[0]))
    figures: dict[str, dict[str, float]] = {}
    exact_first = exact_best = None
    print(f"{'precision':12} {'bytes':>7} {'first':>8} {'both':>8} {'changed':>8} {'deviation':>10}")
    for precision in get_args(Precision):
        back, size = at_rest(known, precision)
        first = encoder.scores_from_inner_products(asked[0] @ back[0].T)
        both = encoder.with_agreement(first, asked[1], back[1])
        areas = []
        for scores in (first, both):
            best = scores.argmax(axis=1)
            right = [int(place) in set(true.tolist()) for place, true in zip(best, truth, strict=True)]
            areas.append(auc_pr(scores.max(axis=1), right))
        if exact_first is None or exact_best is None:
            exact_first, exact_best = first, both.argmax(axis=1)
        figures[precision] = {
            "bytes": size,
            "first": areas[0],
            "both": areas[1],
            "changed": int((both.argmax(axis=1) != exact_best).sum()),
            "deviation": float(np.abs(first - exact_first).max()),
        }
        print(f"{precision:12} {size:7d} {areas[0]:8.4f} {areas[1]:8.4f} ", end="")
        print(f"{figures[precision]['changed']:8d} {figures[precision]['deviation']:10.6f}")
    if options.json is not None:
        options.json.write_text(json.dumps({"encoder": encoder.identity, "precisions": figures}, indent=2) + "\n")


if __name__ == "__main__":
    main()
