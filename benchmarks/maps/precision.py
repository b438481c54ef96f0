"""The cost of storing descriptors in fewer bits: AUC-PR of both stages, by the stored form that a map searches.

    python -m benchmarks.maps.precision QUERIES REFERENCES TRUTH.csv [--encoder NAME] [--cache FILE.npz]

Queries are never stored and stay float32; references go through the storage's own packing and back.  ``first`` is
the first stage alone, ``both`` adds the second to every reference, ``changed`` says for how many queries another
reference is the best, and ``deviation`` by how much a first-stage score differs at most.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.frames import encode_folder
from benchmarks.report import report
from core.frames.traverses import Truth, read_ground_truth
from core.judgement.curves import auc_pr
from core.maps.records import Precision
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.recognition.stages import score_matrix
from core.storage.files.row_formats import pack_descriptors, pack_local, unpack_descriptors, unpack_local

Side = tuple[NDArray[np.float32], NDArray[np.int8]]
"""Descriptors float32 [n, D] and local descriptors int8 [n, C, L]."""


def encoded(encoder: Encoder, folder: Path) -> Side:
    """All frames of a folder."""
    encodings = encode_folder(encoder, folder)
    return np.stack([one.descriptor for one in encodings]), np.stack([one.local for one in encodings])


def sides(encoder: Encoder, queries: Path, references: Path, cache: Path | None) -> tuple[Side, Side]:
    """Queries and references, from ``cache`` if it is there."""
    if cache is not None and cache.is_file():
        with np.load(cache) as kept:
            return (kept["qd"], kept["ql"]), (kept["rd"], kept["rl"])
    queried, known = encoded(encoder, queries), encoded(encoder, references)
    if cache is not None:
        np.savez(cache, qd=queried[0], ql=queried[1], rd=known[0], rl=known[1])
    return queried, known


def at_rest(side: Side, precision: Precision | Literal["float32"]) -> tuple[Side, int]:
    """A side as it is read back from its stored form, or itself for float32, and bytes a place."""
    descriptors, local = side
    if precision == "float32":
        return side, descriptors[0].nbytes + local[0].nbytes
    kept, kept_local = pack_descriptors(descriptors, precision), pack_local(local, precision)
    back = (
        unpack_descriptors(kept, precision, descriptors.shape[1]),
        unpack_local(kept_local, precision, local.shape[1:]),
    )
    return back, kept[0].nbytes + kept_local[0].nbytes


def main(
    queries: Path,
    references: Path,
    truth_file: Annotated[Path, typer.Argument(metavar="TRUTH.csv")],
    encoder: str = DEFAULT_ENCODER,
    cache: Annotated[Path | None, typer.Option(help="Where encoded frames are stored, .npz.")] = None,
) -> None:
    """Measure, print a table and write JSON."""
    chosen = EncoderCatalogue().get(encoder)
    queried, known = sides(chosen, queries, references, cache)
    truth = read_ground_truth(truth_file, len(queried[0]), len(known[0]))
    figures: dict[str, dict[str, float]] = {}
    exact_first = exact_best = None
    for precision in ("float32", *get_args(Precision)):
        back, size = at_rest(known, precision)
        products = queried[0] @ back[0].T
        first = chosen.scores_from_inner_products(products)
        both = score_matrix(chosen, products, queried[1], back[1])
        if exact_first is None or exact_best is None:
            exact_first, exact_best = first, both.argmax(axis=1)
        figures[precision] = {
            "bytes": size,
            "first": area(first, truth),
            "both": area(both, truth),
            "changed": int((both.argmax(axis=1) != exact_best).sum()),
            "deviation": float(np.abs(first - exact_first).max()),
        }
    rows = [
        (name, one["bytes"], f"{one['first']:.4f}", f"{one['both']:.4f}", one["changed"], f"{one['deviation']:.6f}")
        for name, one in figures.items()
    ]
    columns = ["precision", "bytes a place", "first, AUC-PR", "both, AUC-PR", "changed", "deviation"]
    more = {"encoder": chosen.identity, "precisions": figures}
    report("precision", f"{len(queried[0])} queries, {len(known[0])} references", columns, rows, more)


def area(scores: NDArray[np.float32], truth: Truth) -> float:
    """AUC-PR of the best matches; scores [Q, R]."""
    right = [bool(np.isin(place, true)) for place, true in zip(scores.argmax(axis=1), truth, strict=True)]
    return auc_pr(scores.max(axis=1), right)


if __name__ == "__main__":
    typer.run(main)
