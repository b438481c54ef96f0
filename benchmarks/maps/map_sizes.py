"""Verdicts in maps of 1, 2, 5, 10, 30, 100 and all places, cut from real traverses; known against unknown; twins.

    python -m benchmarks.maps.map_sizes [--encoder NAME] [--cache FOLDER] [--fitted] [--repeats 24] [--verify always]

A map holds a run of neighbouring references, or references drawn at random (``spread``).  Its queries are frames whose
place it holds, and strangers, whose place is more than eight frames from all that it holds.  ``strangers`` is the share
of these that is recognized, and ``ambiguous`` the share that is ambiguous; ``right`` is the share of the other frames
that is recognized and right, and ``best`` that whose best match is right whatever the verdict.  The calibration error
counts known and unknown frames alike.  Judged is by the calibration that the encoder ships; nothing of corridor is in
it, and of lip6 no map of fewer than 300 places.

*Halves*: each half of the references alone is a map; AUC-ROC of the probability, known against unknown, and the best
recall at a precision of 0.98.  *Whole*: all references.  *Twice*: every reference in two sequences without poses.
*Twins*: two places of one picture, without sequence and pose.

All of it without geometric verification, with ``auto`` and with ``always``.  ``verified`` is the share of frames for
which keypoints were needed, and ``candidates`` the mean number of places that were verified, over all frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report, verdict
from core.geometry.keypoints import keypoints_of
from core.geometry.pairs import Pairs
from core.judgement.curves import auc_roc
from core.judgement.reliability import reliability
from core.judgement.verdict import Calibration
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.recognition.question import Verify
from core.threads import share_cores
from lab.evaluation.map_sizes import balanced_error
from lab.training.map_sizes import (
    SMALL,
    Cut,
    Judged,
    ScoredTraverse,
    corridor_and_lip6,
    fitting_traverses,
    keypoints_of_frames,
    scored,
    trials_of_halves,
    trials_of_size,
)
from lab.training.validation import describe

SIZES = (*SMALL, 100)
MOST_STRANGERS, LEAST_RIGHT = 0.05, {"corridor": 0.3, "lip6": 0.7}
LEAST_AREA = {"corridor": 0.95, "lip6": 0.93}
PARTS = ("first", "both", "among", "truth", "promised")
PRECISION, LEAST_RECALL, MOST_ERROR = 0.98, 0.5, 0.06
RECALL = {"corridor": 0.95, "lip6": 0.87}
MODES: tuple[Verify, ...] = ("never", "auto", "always")


def traverses(encoder: Encoder, datasets: Path, cache: Path | None, fitted: bool) -> dict[str, ScoredTraverse]:
    """The traverses by name, from the cache if they are there."""
    stored = None if cache is None else cache / f"{encoder.identity.replace('@', '-')}{'-fitted' if fitted else ''}.npz"
    if stored is not None and stored.is_file():
        with np.load(stored) as read:
            names = sorted({name.rsplit(":", 1)[0] for name in read.files})
            columns = {name: {part: read[f"{name}:{part}"] for part in PARTS} for name in names}
            return {
                name: ScoredTraverse(**columns[name], candidates=encoder.candidates, screened=encoder.screened)
                for name in names
            }
    made = {
        name: scored(encoder, describe(encoder, task.queries), describe(encoder, task.references), task.truth)
        for name, task in corridor_and_lip6(datasets)
    }
    if fitted:
        made.update(fitting_traverses(encoder, datasets))
    if stored is not None:
        stored.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            stored,
            **{f"{name}:{part}": getattr(one, part) for name, one in made.items() for part in PARTS},
        )
    return made


def with_pairs(made: dict[str, ScoredTraverse], datasets: Path, cache: Path | None) -> dict[str, ScoredTraverse]:
    """The traverses that are judged, with keypoints, from the cache if they are there; others as they are."""
    found = dict(made)
    for name, task in corridor_and_lip6(datasets):
        stored = None if cache is None else cache / f"{name}-keypoints.npz"
        if stored is not None and stored.is_file():
            with np.load(stored) as read:
                queries, references = (
                    [keypoints_of(record.tobytes()) for record in np.split(read[side], read[f"{side}_ends"])]
                    for side in ("queries", "references")
                )
                pairs = Pairs(queries, references)
        else:
            pairs = Pairs(keypoints_of_frames(task.queries), keypoints_of_frames(task.references))
        found[name] = replace(made[name], pairs=pairs)
    return found


def keep_pairs(made: dict[str, ScoredTraverse], cache: Path) -> None:
    """Write keypoints."""
    for name, pairs in ((name, traverse.pairs) for name, traverse in made.items()):
        if pairs is not None:
            sides = {"queries": pairs.queries, "references": pairs.references}
            records = {side: [np.frombuffer(one.record(), np.uint8) for one in found] for side, found in sides.items()}
            np.savez(
                cache / f"{name}-keypoints.npz",
                allow_pickle=False,
                **{side: np.concatenate(some) for side, some in records.items()},
                **{f"{side}_ends": np.cumsum([len(one) for one in some])[:-1] for side, some in records.items()},
            )


def effort(judged: Sequence[Judged]) -> dict[str, float]:
    """For which share of the frames something was verified, and how many candidates a frame."""
    numbers = np.array([one.verified for one in judged])
    return {"verified": float((numbers > 0).mean()), "candidates": float(numbers.mean())}


def share(flags: NDArray[np.bool_]) -> float | None:
    """The share of flags that are set; None without any."""
    return float(flags.mean()) if len(flags) else None


def of_size(
    traverse: ScoredTraverse, size: int, how: Cut, calibration: Calibration, repeats: int, verify: Verify
) -> dict[str, Any]:
    """The figures of maps of one size."""
    trials, judged = trials_of_size(traverse, size, how, calibration, repeats, verify=verify)
    recognized, ambiguous = (
        np.array([one.judgement.verdict == name for one in judged], np.bool_) for name in ("recognized", "ambiguous")
    )
    probabilities = trials.probabilities(calibration)
    return {
        "strangers": int((~trials.known).sum()),
        "strangers_recognized": share(recognized[~trials.known]),
        "strangers_ambiguous": share(ambiguous[~trials.known]),
        "strangers_probability": float(probabilities[~trials.known].mean()) if (~trials.known).any() else None,
        "known": int(trials.known.sum()),
        "known_right": share((recognized & trials.right)[trials.known]),
        "known_best": share(trials.right[trials.known]),
        "known_probability": float(probabilities[trials.known].mean()),
        "auc_roc": auc_roc(probabilities, trials.known),
        "calibration_error": balanced_error(probabilities, trials.right, trials.known)
        if 0 < trials.known.sum() < len(trials)
        else None,
        **effort(judged),
    }


def halves(traverse: ScoredTraverse, calibration: Calibration, verify: Verify) -> dict[str, Any]:
    """Known against unknown, with either half of the references left out."""
    trials, judged = trials_of_halves(traverse, calibration, verify)
    probabilities = trials.probabilities(calibration)
    order = np.argsort(-probabilities, kind="stable")
    hits = np.cumsum(trials.right[order])
    precision, recall = hits / np.arange(1, len(hits) + 1), hits / trials.known.sum()
    there, reached = recall >= LEAST_RECALL, precision >= PRECISION
    return {
        "auc_roc": auc_roc(probabilities, trials.known),
        "precision_at_recall": float(precision[there].max()) if there.any() else None,
        "recall_at_precision": float(recall[reached][-1]) if reached.any() else 0.0,
        "calibration_error": reliability(probabilities, trials.right).ece,
        **effort(judged),
    }


def whole(traverse: ScoredTraverse, calibration: Calibration, verify: Verify) -> dict[str, Any]:
    """All references: recall@1, and the verdicts."""
    stored = np.arange(traverse.truth.shape[1])
    queried = np.flatnonzero(traverse.truth.any(axis=1)).tolist()
    found = [traverse.judged(query, stored, calibration, np.zeros(len(stored), np.int64), verify) for query in queried]
    right = np.array([traverse.truth[query, one.best] for query, one in zip(queried, found, strict=True)])
    recognized = np.array([one.judgement.verdict == "recognized" for one in found])
    return {
        "recall_at_1": float(right.mean()),
        "recognized_right": float((recognized & right).mean()),
        "recognized_wrong": float((recognized & ~right).mean()),
        **effort(found),
    }


def verdicts(
    traverse: ScoredTraverse,
    stored: NDArray[np.int64],
    sequence: NDArray[np.int64],
    calibration: Calibration,
    verify: Verify,
) -> Any:
    """The shares of the verdicts on all frames whose place is there."""
    queried = np.flatnonzero(traverse.truth[:, stored].any(axis=1)).tolist()
    found = [traverse.judged(query, stored, calibration, sequence, verify).judgement.verdict for query in queried]
    return {name: found.count(name) / len(found) for name in ("recognized", "ambiguous", "unknown")}


def duplicates(traverse: ScoredTraverse, calibration: Calibration, verify: Verify) -> dict[str, Any]:
    """Each place in one sequence, in two, without any; and two places of one picture."""
    once = np.arange(traverse.truth.shape[1])
    nothing = np.zeros(len(once), np.int64)
    twins: list[str] = []
    for reference in range(0, len(once), 5):
        pair, alone = np.full(2, reference), np.full(2, -1)
        queried = np.flatnonzero(traverse.truth[:, reference]).tolist()
        twins += [traverse.judged(query, pair, calibration, alone, verify).judgement.verdict for query in queried]
    return {
        "once": verdicts(traverse, once, nothing, calibration, verify),
        "twice": verdicts(traverse, np.tile(once, 2), np.repeat([0, 1], len(once)), calibration, verify),
        "without sequences": verdicts(traverse, once, nothing - 1, calibration, verify),
        "twins": {name: twins.count(name) / len(twins) for name in ("recognized", "ambiguous", "unknown")},
    }


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
    cache: Annotated[Path | None, typer.Option(help="Folder where the scores are stored.")] = None,
    fitted: Annotated[bool, typer.Option(help="Show the traverses that are fitted to as well.")] = False,
    repeats: Annotated[int, typer.Option(min=1, help="Maps of each size.")] = 24,
    verify: Annotated[list[str] | None, typer.Option(help="never, auto or always; all if left out.")] = None,
) -> None:
    """Measure and report."""
    share_cores(1)
    loaded = EncoderCatalogue().get(encoder)
    calibration = loaded.calibration
    made = with_pairs(traverses(loaded, datasets, cache, fitted), datasets, cache)
    figures: dict[str, Any] = {"encoder": loaded.identity, "calibration": calibration.model_dump(), "modes": {}}
    for mode in (mode for mode in MODES if verify is None or mode in verify):
        figures["modes"][mode] = {
            name: measured(name, traverse, calibration, repeats, mode)
            for name, traverse in made.items()
            if mode == "never" or traverse.pairs is not None
        }
        if cache is not None:
            keep_pairs(made, cache)
        tables(mode, figures["modes"][mode], encoder, figures)


def measured(
    name: str, traverse: ScoredTraverse, calibration: Calibration, repeats: int, verify: Verify
) -> dict[str, Any]:
    """All figures of one traverse."""
    references = traverse.truth.shape[1]
    made: dict[str, Any] = {}
    for how in ("run", "spread"):
        for size in [size for size in SIZES if size < references] + [references]:
            one = of_size(traverse, size, how, calibration, repeats if size < references else 1, verify)
            made[f"{how} {size}"] = one
    made["halves"], made["whole"] = halves(traverse, calibration, verify), whole(traverse, calibration, verify)
    made["duplicates"] = duplicates(traverse, calibration, verify)
    return made


def missed(name: str, case: str, one: dict[str, Any]) -> str:
    """Which of the bars of a map's size are missed; empty for sizes without bars."""
    how, size = case.split()
    if how != "run" or int(size) not in SMALL or name not in LEAST_RIGHT:
        return ""
    many, few = one["strangers_recognized"] > MOST_STRANGERS, one["known_right"] < LEAST_RIGHT[name]
    return "none" if not (many or few) else " and ".join(["strangers"] * many + ["right"] * few)


def tables(mode: Verify, found: dict[str, dict[str, Any]], encoder: str, figures: dict[str, Any]) -> None:
    """Print and write the tables of one mode."""
    by_size: list[list[str]] = []
    others: list[list[Any]] = []
    names = ("strangers_recognized", "strangers_ambiguous", "known_right", "known_best", "auc_roc", "calibration_error")
    for name, made in found.items():
        for case, one in made.items():
            if case.startswith(("run", "spread")):
                values = [one[key] for key in (*names, "verified", "candidates")]
                cells = ["" if value is None else f"{value:.3f}" for value in values]
                by_size.append([f"{name} {case}", *cells, missed(name, case, one)])
        half, all_places = made["halves"], made["whole"]
        if name in LEAST_AREA:
            precise = half["precision_at_recall"]
            others += [
                [f"{name}, halves, AUC-ROC", half["auc_roc"], verdict(half["auc_roc"], LEAST_AREA[name], True)],
                [
                    f"{name}, halves, precision at a recall of {LEAST_RECALL} or more",
                    precise,
                    verdict(precise, PRECISION, True),
                ],
                [f"{name}, halves, recall at precision {PRECISION}", half["recall_at_precision"], ""],
                [
                    f"{name}, halves, calibration error",
                    half["calibration_error"],
                    verdict(half["calibration_error"], MOST_ERROR),
                ],
                [
                    f"{name}, whole, recall@1",
                    all_places["recall_at_1"],
                    verdict(all_places["recall_at_1"], RECALL[name], True),
                ],
            ]
        for case in ("recognized_right", "recognized_wrong", "verified", "candidates"):
            others.append([f"{name}, whole, {case.replace('_', ' and ')}", all_places[case], ""])
        for case, shares in made["duplicates"].items():
            listed = ", ".join(f"{kind} {value:.2f}" for kind, value in shares.items())
            others.append([f"{name}, {case}", listed, ""])
    measures = ["strangers", "ambiguous", "right", "best", "AUC", "error", "verified", "candidates"]
    report("map-sizes", f"verdicts by size of map, {encoder}, {mode}", ["map", *measures, "missed"], by_size, figures)
    rows = [[name, f"{value:.3f}" if isinstance(value, float) else value, bar] for name, value, bar in others]
    report("map-sizes", f"halves, the whole map and duplicates, {mode}", ["", "measured", "bar"], rows, figures)


if __name__ == "__main__":
    typer.run(main)
