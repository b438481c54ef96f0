"""Sessions in rarer situations: a robot that is carried off, leaves the map, stands, or sees nothing.

    python -m benchmarks.maps.sessions --datasets ../shared/datasets

Runs along lip6_outdoor (by the truth put right) and corridor are cut and spliced: after ``BEFORE`` frames the robot
goes on at another stretch of the map, in the other traverse, or in the half of its own traverse that the map does not
have.
A frame *says so* if its own verdict is unknown, or recognized at a place where the robot cannot have gone.  Counted are
the frames that say so until the session no longer gives the old place; the bar is three.  Nothing of the filter is
fitted to these traverses but one rate (``core.belief.filter.RETURNING``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.maps.sequences import SAME_PLACE
from benchmarks.report import report, verdict
from core.belief import (
    NOTHING,
    Estimate,
    Evidence,
    PlaceGraph,
    Run,
    RunOptions,
    Step,
    View,
    evidence,
    place_graph,
    sighted,
    view_of,
)
from core.frames.preprocessing import Pixels
from core.judgement.reliability import reliability
from core.judgement.verdict import Verdict, judge
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import Whereabouts
from core.recognition.stages import examine, second_stage
from lab.training.map_sizes import APART, corridor_and_lip6
from lab.training.validation import Encodings, describe

Truth = NDArray[np.bool_]

BEFORE, AFTER = 18, 15
"""Frames of a spliced run before and after the cut."""

SPLICED = 40
"""Spliced runs of each kind."""

FAR = 30
"""A robot is carried to a stretch whose places are all more than this number of frames from where it was."""

STANDS = 90
"""Frames of a robot that stands, three seconds at 30 frames a second."""

WITHIN, NOTICED, HALVED = 3, 0.9, 0.5


@dataclass(frozen=True)
class FrameEvidence:
    """One frame: its own verdict, and its evidence for a session.

    best: the reference that it matches best alone; -1: none.
    right: bool [R], the references that show its place.
    """

    best: int
    verdict: Verdict
    seen: Evidence
    view: View
    right: NDArray[np.bool_]


class SequenceMap:
    """A map of references in one sequence, and how frames look in it."""

    def __init__(self, encoder: Encoder, references: Encodings) -> None:
        self.encoder, self.references = encoder, references
        count = len(references.local)
        self.where = Whereabouts.along_sequence(np.arange(count))
        self.graph: PlaceGraph = place_graph(self.where, np.arange(count), count, SAME_PLACE)
        self.alive = np.ones(count, np.bool_)

    def looks(self, pictures: Sequence[Pixels], frames: Encodings, truth: Truth | None = None) -> list[FrameEvidence]:
        """The looks of frames; without a truth, no reference shows their place."""
        shown = np.zeros((len(pictures), len(self.alive)), np.bool_) if truth is None else truth
        return [
            self._look(pixels, frames.at(np.array([row])), right)
            for row, (pixels, right) in enumerate(zip(pictures, shown, strict=True))
        ]

    def _look(self, pixels: Pixels, frame: Encodings, right: NDArray[np.bool_]) -> FrameEvidence:
        if not frame.descriptors.any():
            return FrameEvidence(-1, "unknown", NOTHING, view_of(pixels), right)
        encoder, local = self.encoder, frame.local[0]
        scores = encoder.scores_from_inner_products(self.references.descriptors @ frame.descriptors[0])
        rows = np.argsort(-scores, kind="stable")

        stage = second_stage(encoder, local, lambda positions: self.references.local[rows[positions]])
        found = examine(scores[rows], self.where.take(rows), SAME_PLACE, *stage)
        ranked = rows[found.order]
        known = (self.where.take(ranked), encoder.calibration, SAME_PLACE, found.examined)
        judgement = judge(found.scores, *known)
        return FrameEvidence(
            int(ranked[0]),
            judgement.verdict,
            sighted(evidence(ranked, found.scores, *known), ranked, judgement),
            view_of(pixels),
            right,
        )

    def followed(self, looks: Sequence[FrameEvidence]) -> Iterator[tuple[FrameEvidence, Estimate, Run]]:
        """A session's estimate after each look."""
        run = Run(RunOptions(), self.graph)
        for look in looks:
            run.advance(look.seen, Step(), look.view)
            yield look, run.estimate(2, self.alive), run

    def noticed(self, before: Sequence[FrameEvidence], after: Sequence[FrameEvidence]) -> tuple[int, int] | None:
        """After how many frames that say so, and after how many frames, a session has left the old place.

        None: it did not give the right place at the cut.  (AFTER + 1, AFTER + 1): it has not noticed.
        """
        steps = list(self.followed([*before, *after]))
        look, found, _ = steps[len(before) - 1]
        if found.verdict != "recognized" or not look.right[found.candidates[0].row]:
            return None
        old = np.flatnonzero(before[-1].right)
        low, high = int(old.min()) - SAME_PLACE.frames, int(old.max()) + AFTER + SAME_PLACE.frames
        says = 0
        for number, (look, found, _) in enumerate(steps[len(before) :], start=1):
            elsewhere = look.verdict == "recognized" and not low <= look.best <= high
            says += look.verdict == "unknown" or elsewhere
            believed = found.candidates[0].row if found.verdict == "recognized" else None
            if believed is None or not low <= believed <= high or look.right[believed]:
                return says, number
        return AFTER + 1, AFTER + 1


def spliced(
    looks: Sequence[FrameEvidence], others: Sequence[FrameEvidence] | None, seed: int
) -> Iterator[tuple[list[FrameEvidence], list[FrameEvidence]]]:
    """Stretches before and after a cut; after it, of ``others``, or of the same walk far away."""
    random = np.random.default_rng(seed)
    after = looks if others is None else others
    made = 0
    for _ in range(100 * SPLICED):
        if made == SPLICED:
            return
        start, to = int(random.integers(0, len(looks) - BEFORE)), int(random.integers(0, max(1, len(after) - AFTER)))
        first, second = list(looks[start : start + BEFORE]), list(after[to : to + AFTER])
        old, new = np.flatnonzero(first[-1].right), np.flatnonzero(np.any([one.right for one in second], axis=0))
        if not len(old) or (others is None and (not len(new) or np.abs(old[:, None] - new).min() <= FAR)):
            continue
        made += 1
        yield first, second


def covers() -> dict[str, list[Pixels]]:
    """Pictures of a covered camera, twelve of each kind."""
    random = np.random.default_rng(5)
    shape = (240, 320, 3)
    smear = 128 + 1500 * cv2.GaussianBlur(random.normal(0, 1, shape), (0, 0), 12)
    kinds: dict[str, tuple[Any, float]] = {
        "black": (0, 0),
        "dark, noisy": (15, 8),
        "grey, noisy": (128, 2),
        "nothing but noise": (128, 30),
        "a blurred picture that stays": (smear, 2),
    }
    return {
        name: [
            np.clip(level + random.normal(0, spread, shape) if spread else np.zeros(shape), 0, 255).astype(np.uint8)
            for _ in range(12)
        ]
        for name, (level, spread) in kinds.items()
    }


def standing(pixels: Pixels, random: np.random.Generator) -> list[Pixels]:
    """One view again and again: with the noise of a camera, a little more or less light, and compression."""
    frames = []
    for _ in range(STANDS):
        noisy = np.clip(pixels * random.uniform(0.95, 1.05) + random.normal(0, 3, pixels.shape), 0, 255)
        _, data = cv2.imencode(".jpg", noisy.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 80])
        frames.append(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8))
    return frames


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
) -> None:
    """Print the table and keep the figures."""
    chosen = EncoderCatalogue().get(encoder)
    tasks = dict(corridor_and_lip6(datasets))
    encoded = {
        name: (describe(chosen, task.queries), describe(chosen, task.references)) for name, task in tasks.items()
    }
    blinds = {kind: (pictures, describe(chosen, pictures)) for kind, pictures in covers().items()}
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {"encoder": chosen.identity}
    for name, task in tasks.items():
        stored = figures[name] = {}
        frames, references = encoded[name]
        walk = SequenceMap(chosen, references)
        looks = walk.looks(task.queries, frames, task.truth)
        steps = list(walk.followed(looks))

        # A run that is not spliced
        single = sum(not look.right[look.best] for look in looks)
        wrong = sum(not look.right[found.candidates[0].row] for look, found, _ in steps)
        believed = [(look, found) for look, found, _ in steps if found.verdict == "recognized"]
        stored["errors"] = {"queries": len(looks), "single": single, "session": wrong}
        stored["recognized"] = {
            "single": float(np.mean([look.verdict == "recognized" for look in looks])),
            "session": len(believed) / len(steps),
            "right": float(np.mean([look.right[found.candidates[0].row] for look, found in believed])),
        }
        bar = "errors " + verdict(wrong / single, HALVED) if name == "lip6" else ""
        rows.append((f"{name}: wrong places, single frames and session", f"{single}, {wrong} of {len(looks)}", bar))
        shares = stored["recognized"]
        rows.append(
            (f"{name}: recognized, single frames and session", "{single:.3f}, {session:.3f}".format(**shares), "")
        )
        rows.append((f"{name}: of these, right", f"{shares['right']:.3f}", ""))

        # Spliced ones
        stated = [
            (found.candidates[0].probability, bool(look.right[found.candidates[0].row])) for look, found, _ in steps
        ]
        other = next(one for one in tasks if one != name)
        strangers = walk.looks(tasks[other].queries, encoded[other][0])
        half_walk, half_looks, left_out = halved(chosen, task.queries, frames, references, task.truth)
        for kind, (map_, before, after) in {
            "carried off in the map": (walk, looks, None),
            "to another environment": (walk, looks, strangers),
            "to what the map does not have": (half_walk, half_looks, left_out),
        }.items():
            results = []
            for first, second in spliced(before, after, 1):
                if (result := map_.noticed(first, second)) is not None:
                    results.append(result)
                if map_ is walk:
                    for look, found, _ in list(map_.followed([*first, *second])):
                        best = found.candidates[0]
                        stated.append((best.probability, bool(look.right[best.row])))
            says = np.array([one for one, _ in results])
            stored[kind] = {"runs": len(says), "frames that say so": np.bincount(says).tolist()}
            share = float((says <= WITHIN).mean())
            spread = "/".join(f"{np.percentile(says, q):.0f}" for q in (50, 90, 100))
            rows.append(
                (
                    f"{name}: {kind}, noticed within 3",
                    f"{share:.2f} of {len(says)}; {spread}",
                    verdict(share, NOTICED, at_least=True),
                )
            )

        # Covered cameras, before whom the robot was recognized
        for kind, (pictures, descriptions) in blinds.items():
            blind = walk.looks(pictures, descriptions)
            frames_until, sights = [], set()
            for first, _ in spliced(looks, None, 2):
                covered_steps = list(walk.followed([*first, *blind]))
                if covered_steps[BEFORE - 1][1].verdict != "recognized":
                    continue
                verdicts = [found.verdict for _, found, _ in covered_steps[BEFORE:]]
                last = max((n for n, one in enumerate(verdicts, 1) if one != "unknown"), default=0)
                frames_until.append(last + 1)
                sights.add(covered_steps[-1][2].sight)
            stored[f"covered: {kind}"] = {
                "unknown from frame": np.bincount(frames_until).tolist(),
                "view": sorted(map(str, sights)),
            }
            when = f"frame {np.median(frames_until):.0f}, latest {max(frames_until)}"
            text = f"{when}; view {', '.join(sorted(map(str, sights)))}"
            rows.append((f"{name}: {kind}, unknown from", text, ""))

        # Standing robots
        random = np.random.default_rng(3)
        gained = []
        for row in random.choice(np.arange(BEFORE, len(looks)), 5, replace=False).tolist():
            pictures = standing(task.queries[row], random)
            still = walk.looks(pictures, describe(chosen, pictures))
            whole = list(walk.followed([*looks[row - 5 : row + 1], *still]))
            gained.append(abs(whole[-1][1].candidates[0].probability - whole[5][1].candidates[0].probability))
        stored["standing"] = {"change of probability": gained}
        rows.append(
            (f"{name}: {STANDS} frames of a robot that stands change its probability by", f"{max(gained):.4f}", "")
        )

        probabilities, right = zip(*stated, strict=True)
        calibrated = reliability(probabilities, right)
        stored["reliability"] = calibrated.model_dump()
        rows.append((f"{name}: calibration error, whole and spliced runs", f"{calibrated.ece:.3f}", ""))
    report("sessions", chosen.name, ["", "", ""], rows, figures)


def halved(
    encoder: Encoder, pictures: Sequence[Pixels], frames: Encodings, references: Encodings, truth: Truth
) -> tuple[SequenceMap, list[FrameEvidence], list[FrameEvidence]]:
    """A map of the middle half of the references: the looks of frames that it has, and of frames far from all of it."""
    count = truth.shape[1]
    stored = np.arange(count // 4, count - count // 4)
    wide = np.zeros(count, np.bool_)
    wide[max(0, stored[0] - APART) : stored[-1] + APART + 1] = True
    walk = SequenceMap(encoder, references.at(stored))
    there = np.flatnonzero(truth[:, stored].any(axis=1))
    apart = np.flatnonzero(~truth[:, wide].any(axis=1) & truth.any(axis=1))
    known = walk.looks([pictures[row] for row in there.tolist()], frames.at(there), truth[np.ix_(there, stored)])
    return walk, known, walk.looks([pictures[row] for row in apart.tolist()], frames.at(apart))


if __name__ == "__main__":
    typer.run(main)
