"""Maps of any size, cut from real traverses: the verdicts on frames whose place is there, and on strangers.

A map holds some of a traverse's references, a run of neighbours or frames drawn at random.  Queries are frames whose
place it holds, and strangers: frames whose true references are all more than ``APART`` frames from any that it holds.
The environment's prior (``core.judgement.background``) and what a curve loses in small maps are fitted here to the
traverses of train/ and to nordland_tiny; corridor and lip6 judge the result (``benchmarks.maps.map_sizes``).  The prior
is fitted by moments and then widened until strangers are refused there.

So are the terms of geometric evidence (``core.judgement.geometry``), by camvid alone: it is the one traverse of train/
in which the camera moves on, and frames of 64 x 32 pixels, as those of nordland_tiny, are no pictures to find keypoints
in.  As a program, it fits them again:

    python -m lab.training.map_sizes [--encoder NAME]
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from core.geometry import verification
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.geometry.pairs import Pairs
from core.judgement.background import Environment
from core.judgement.geometry import GeometryTerms
from core.judgement.probability import Curve, sigmoid
from core.judgement.trials import Trial, Trials, gathered
from core.judgement.verdict import Calibration, Judgement, judge
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import load_xfeat
from core.places import NO_POSE, NO_SEQUENCE, Neighborhood, Whereabouts
from core.recognition.question import Verifier, Verify
from core.recognition.stages import Candidates, CellComparison, examine
from core.recognition.verification import verify_candidates
from core.threads import cores, each, share_cores
from lab.training.photographs import find_photographs, read
from lab.training.validation import Encodings, TraverseTask, describe, load_traverses, with_corrected_truth

Array = NDArray[np.float32]
Positions = NDArray[np.int64]
Values = NDArray[np.float64]
Cut = Literal["run", "spread"]

APART = 8
"""A stranger's true references are more than this number of frames from every place of the map."""

SMALL = (1, 2, 5, 10, 30)
"""Sizes of maps for which something is imagined."""

STRANGERS = 0.045
"""The largest share of strangers of small maps that may be recognized, on average over the kinds of
traverses.  The default encoder of 0.1.0 recognized 0.042 with a prior by moments alone; with more, strangers of
corridor are recognized too often."""

NEIGHBORHOOD = Neighborhood(radius=5.0, frames=3)
"""The default of maps."""

STRETCHES = ((300, 700), (2200, 2600))
"""Frames of nordland_tiny that are two environments."""

MOST_QUERIES = 60
"""The largest number of frames of either kind that query a map."""


SUPPORT = 0.5
"""Weight of the log odds of two stages beside evidence.  Camvid does not determine it: evidence alone is nearly always
right there, and the two stages would have 0.13.  Hallways at 160 x 120 pixels would give them 0.4, nordland_tiny 0.9.
With 0.25 to 0.75 the verdicts on corridor and lip6 stay within their bars."""

STATIONARY_EVIDENCE = 1000
"""Two frames of camvid with more evidence than this were taken by a car that stood still, and count as one."""


def _nothing() -> Array:
    return np.zeros((0, 0), np.float32)


class Judged(NamedTuple):
    """The judgement of a query, its best match, and how many candidates were verified for it."""

    judgement: Judgement
    best: int
    verified: int


@dataclass(frozen=True)
class ScoredTraverse:
    """Q queries and R references, scored all against all.

    first, both: float32 [Q, R], the scores of the first stage and of both.
    among: float32 [R, R], of the references with each other, after both stages.
    truth: bool [Q, R].
    candidates: how many the encoder's second stage examines.
    pairs: of the keypoints; None: nothing can be verified.
    promised: float32 [Q, R], the second stage's promised addition to the first's scores.
    screened: among how many places the second stage looks for those that it examines.
    """

    first: Array
    both: Array
    among: Array
    truth: NDArray[np.bool_]
    candidates: int
    pairs: Pairs | None = None
    promised: Array = field(default_factory=_nothing)
    screened: int = 0

    def strangers(self, retained: Positions) -> Positions:
        """The queries whose true references are all more than APART frames from the references ``retained``, int64."""
        near = np.zeros(self.truth.shape[1], np.bool_)
        for place in retained.tolist():
            near[max(0, place - APART) : place + APART + 1] = True
        return np.flatnonzero(~self.truth[:, near].any(axis=1) & self.truth.any(axis=1))

    def judged(
        self, query: int, retained: Positions, calibration: Calibration, sequence: Positions, verify: Verify = "never"
    ) -> Judged:
        """The judgement of a query against a map of the references ``retained``, int64 [n].

        Args:
            sequence: int64 [n], the code of each place's sequence; -1: it has none.
            verify: ``auto`` verifies the best candidate where two stages leave doubt, and the others where that does.
        """
        order = np.argsort(-self.first[query, retained], kind="stable")
        rows = retained[order]
        count = len(rows)
        codes = sequence[order].astype(np.int32)
        # Without a sequence, places of one number would be looks of one place.
        numbers = np.where(codes == NO_SEQUENCE, order, rows)
        places = Whereabouts(np.full(count, NO_POSE, np.int8), np.zeros((count, 3)), codes, numbers)

        def gains(at: Positions) -> Array:
            return np.asarray(self.both[query, rows[at]] - self.first[query, rows[at]])

        def promise(at: Positions) -> Array:
            return np.asarray(self.promised[query, rows[at]])

        stage = CellComparison(self.candidates, gains, self.screened, promise)
        seen = examine(self.first[query, rows], places, NEIGHBORHOOD, *stage)
        ranked, found = rows[seen.order], seen.scores
        candidates = Candidates(
            ranked, found, self.first[query, ranked], places.take(seen.order), seen.examined, None, found, count
        )

        def judged(candidates: Candidates) -> Judgement:
            def likeness(at: Positions) -> Array:
                return np.asarray(self.among[candidates.rows[0], candidates.rows[at]])

            return judge(
                candidates.ordered,
                candidates.whereabouts,
                calibration,
                NEIGHBORHOOD,
                candidates.examined,
                likeness,
                candidates.geometry,
            )

        if self.pairs is None:
            return Judged(judged(candidates), int(ranked[0]), 0)
        pairs = self.pairs

        def agreements(references: Sequence[int]) -> Array:
            return np.asarray(self.both[query, list(references)] - self.first[query, list(references)])

        final, judgement, _ = verify_candidates(
            candidates,
            judged,
            Verifier(verify, lambda: pairs.queries[query]),
            calibration,
            pairs.comparison(query, agreements),
        )
        return Judged(judgement, int(final.rows[0]), sum(one is not None for one in final.verifications))


def scored(
    encoder: Encoder, queries: Encodings, references: Encodings, truth: NDArray[np.bool_], pairs: Pairs | None = None
) -> ScoredTraverse:
    """A traverse with the scores of all its queries and references."""
    first, both = all_scores(encoder, queries, references)
    among, promised = all_scores(encoder, references, references)[1], _nothing()
    if encoder.screened > encoder.candidates:
        promised = np.stack([encoder.promise(cells, references.local) for cells in queries.local])
    return ScoredTraverse(first, both, among, truth, encoder.candidates, pairs, promised, encoder.screened)


def keypoints_of_frames(frames: Sequence[Pixels]) -> list[Keypoints]:
    """The keypoints of frames."""
    network = load_xfeat()
    return each(lambda frame: find_keypoints(network, frame), frames, cores())


def all_scores(encoder: Encoder, queries: Encodings, references: Encodings) -> tuple[Array, Array]:
    """The scores of the first stage and of both for every pair, float32 [Q, R] each."""
    first = encoder.scores_from_inner_products(queries.descriptors @ references.descriptors.T)
    return first, first + np.stack([encoder.agreement(cells, references.local) for cells in queries.local])


def cut(traverse: ScoredTraverse, size: int, how: Cut, generator: np.random.Generator) -> Positions:
    """The references of one map, int64 [size], ascending."""
    count = traverse.truth.shape[1]
    if how == "spread":
        return np.sort(generator.choice(count, size, replace=False))
    start = int(generator.integers(0, count - size + 1))
    return np.arange(start, start + size)


def trials_of_size(
    traverse: ScoredTraverse,
    size: int,
    how: Cut,
    calibration: Calibration,
    repeats: int,
    seed: int = 0,
    verify: Verify = "never",
) -> tuple[Trials, list[Judged]]:
    """Trials against ``repeats`` maps of one size, of frames whose place is there and of strangers."""
    generator = np.random.default_rng((seed, size))
    trials: list[Trial] = []
    judgements: list[Judged] = []
    for _ in range(repeats):
        retained = cut(traverse, size, how, generator)
        sequence = np.zeros(size, np.int64)
        known = np.flatnonzero(traverse.truth[:, retained].any(axis=1))
        for queried, there in ((known, True), (traverse.strangers(retained), False)):
            chosen = generator.choice(queried, MOST_QUERIES, replace=False) if len(queried) > MOST_QUERIES else queried
            for query in chosen.tolist():
                found = traverse.judged(query, retained, calibration, sequence, verify)
                right = there and bool(traverse.truth[query, found.best])
                trials.append(Trial(found.judgement, there, right, len(trials)))
                judgements.append(found)
    return gathered(trials), judgements


def trials_of_halves(
    traverse: ScoredTraverse, calibration: Calibration, verify: Verify = "never"
) -> tuple[Trials, list[Judged]]:
    """Trials of all queries against maps of the first and of the second half of the references."""
    middle, end = traverse.truth.shape[1] // 2, traverse.truth.shape[1]
    trials: list[Trial] = []
    judgements: list[Judged] = []
    for retained in (np.arange(middle), np.arange(middle, end)):
        for query, true in enumerate(traverse.truth):
            found = traverse.judged(query, retained, calibration, np.zeros(len(retained), np.int64), verify)
            trials.append(Trial(found.judgement, bool(true[retained].any()), bool(true[found.best]), query))
            judgements.append(found)
    return gathered(trials), judgements


def corridor_and_lip6(datasets: Path) -> Iterator[tuple[str, TraverseTask]]:
    """The traverses that nothing here is fitted to; lip6 with the truth put right."""
    yield "corridor", load_traverses(datasets / "eval/corridor", "query", "ref")
    yield "lip6", with_corrected_truth(load_traverses(datasets / "eval/lip6_outdoor", "query", "reference"))


def fitting_traverses(encoder: Encoder, datasets: Path) -> Iterator[tuple[str, ScoredTraverse]]:
    """The traverses that are fitted to: two stretches of nordland_tiny, and the sequences of camvid."""
    folder = datasets / "eval/nordland_tiny"
    for start, stop in STRETCHES:
        summer, winter = (find_photographs(folder / season)[start:stop] for season in ("summer", "winter"))
        apart = np.abs(np.arange(stop - start)[:, None] - np.arange(stop - start))
        queries, references = (describe(encoder, [read(path) for path in side]) for side in (winter, summer))
        yield f"nordland {start}", scored(encoder, queries, references, apart <= 2)
    for name, paths in _grouped(find_photographs(datasets / "train/camvid")):
        yield f"camvid {name}", _drive(encoder, [read(path) for path in paths])


def _drive(encoder: Encoder, frames: Sequence[Pixels], keypoints: Sequence[Keypoints] | None = None) -> ScoredTraverse:
    """A traverse of frames that were taken in one drive.

    Every third frame is a reference, and the others are queries that show the place of the reference beside them.
    """
    described = describe(encoder, frames)
    queried = np.flatnonzero(np.arange(len(frames)) % 3)
    retained = np.arange(0, len(frames), 3)
    pairs = None
    if keypoints is not None:
        pairs = Pairs([keypoints[one] for one in queried.tolist()], [keypoints[one] for one in retained.tolist()])
    return scored(
        encoder, described.at(queried), described.at(retained), np.abs(queried[:, None] - retained) <= 2, pairs
    )


def verifiable_traverses(encoder: Encoder, datasets: Path) -> Iterator[tuple[str, ScoredTraverse]]:
    """The sequences of camvid with keypoints, without the frames of a car that stood still.

    These show what the frame before shows, so that strangers would be none.
    """
    for name, paths in _grouped(find_photographs(datasets / "train/camvid")):
        frames = [read(path) for path in paths]
        keypoints = keypoints_of_frames(frames)
        moving = [0]
        for number in range(1, len(frames)):
            (found,) = verification.verify(keypoints[number], [keypoints[moving[-1]]])
            if found.evidence <= STATIONARY_EVIDENCE:
                moving.append(number)
        yield f"camvid {name}", _drive(encoder, [frames[at] for at in moving], [keypoints[at] for at in moving])


def _grouped(paths: Sequence[Path]) -> list[tuple[str, list[Path]]]:
    """The frames of each sequence of camvid, whose name is the first part of a file's."""
    names = sorted({path.stem.split("_")[0] for path in paths})
    return [(name, [path for path in paths if path.stem.split("_")[0] == name]) for name in names]


def fit_environment(encoder: Encoder, datasets: Path, traverses: Sequence[tuple[str, ScoredTraverse]]) -> Environment:
    """The prior of the scores of other places: floors of tower, sequences of camvid, stretches of nordland_tiny.

    Each of the three kinds counts alike.  By moments: μ₀ and σ₀² are the means of the environments' means and
    variances, κ₀ is σ₀² by the variance of the means, and ν₀ is 2 by the squared coefficient of variation of the
    variances, as of a χ² distribution.
    """
    kinds: dict[str, list[Array]] = {}
    for name, traverse in traverses:
        far = ~_within(traverse.truth, APART)
        kinds.setdefault(name.split()[0], []).append(traverse.both[far])
    floors = sorted(path for path in (datasets / "train/tower").iterdir() if path.is_dir())
    for floor in floors:
        frames = describe(encoder, [read(path) for path in find_photographs(floor)])
        index = np.arange(len(frames.local))
        both = all_scores(encoder, frames, frames)[1]
        kinds.setdefault("tower", []).append(both[np.abs(index[:, None] - index) > APART])
    means, variances, shares = [], [], []
    for parts in kinds.values():
        there = [part for part in parts if len(part) > 1]
        means += [float(part.mean()) for part in there]
        variances += [float(part.var()) for part in there]
        shares += [1 / len(there)] * len(there)
    mean, between = _moments(means, shares)
    variance, of_variances = _moments(variances, shares)
    return Environment(
        mean=round(mean, 4),
        deviation=round(float(np.sqrt(variance)), 4),
        mean_weight=round(variance / between, 3),
        deviation_weight=round(2 * variance**2 / of_variances, 2),
    )


def widened(calibration: Calibration, traverses: Sequence[tuple[str, ScoredTraverse]], repeats: int = 3) -> Environment:
    """The calibration's environment with the least deviation, in twentieths more, that refuses strangers of small maps.

    The environments of the training data are few, and the threshold is found in maps for which nothing is imagined.
    So the deviation by moments is raised until at most ``STRANGERS`` of the strangers are recognized in maps of SMALL
    sizes, runs and drawn ones, each kind of traverses counting alike.
    """
    environment = calibration.environment
    assert environment is not None
    steps = [round(environment.deviation * (1 + step / 20), 4) for step in range(21)]

    def refuses(deviation: float) -> bool:
        wider = environment.model_copy(update={"deviation": deviation})
        accepted: dict[str, list[float]] = {}
        for kind, trials in _in_small_maps(calibration.model_copy(update={"environment": wider}), traverses, repeats):
            recognized = trials.recognized(calibration)[~trials.known]
            accepted.setdefault(kind, []).append(float(recognized.mean()))
        return float(np.mean([np.mean(shares) for shares in accepted.values()])) <= STRANGERS

    found = min(bisect_left(steps, True, key=refuses), len(steps) - 1)
    return environment.model_copy(update={"deviation": steps[found]})


def _in_small_maps(
    calibration: Calibration, traverses: Sequence[tuple[str, ScoredTraverse]], repeats: int
) -> Iterator[tuple[str, Trials]]:
    """Trials in maps of each of the SMALL sizes, runs and drawn ones, with the kind of traverse."""
    for name, traverse in traverses:
        for how in ("run", "spread"):
            for size in SMALL:
                trials, _ = trials_of_size(traverse, size, how, calibration, repeats)
                if min(trials.known.sum(), (~trials.known).sum()) >= 5:
                    yield name.split()[0], trials


def _within(truth: NDArray[np.bool_], frames: int) -> NDArray[np.bool_]:
    """Which references are within ``frames`` of a true one; bool [Q, R]."""
    wide = truth.copy()
    for shift in range(1, frames + 1):
        wide[:, shift:] |= truth[:, :-shift]
        wide[:, :-shift] |= truth[:, shift:]
    return wide


def _moments(values: Sequence[float], shares: Sequence[float]) -> tuple[float, float]:
    """Weighted mean and variance."""
    mean = float(np.average(values, weights=shares))
    return mean, float(np.average(np.square(np.array(values) - mean), weights=shares))


def fit_small_maps(
    calibration: Calibration, traverses: Sequence[tuple[str, ScoredTraverse]], repeats: int = 10
) -> Curve:
    """The calibration's curve with what changes where the background is imagined.

    Slope and intercept for full maps stay.  The two other parameters are fitted by maximum likelihood to maps of
    SMALL sizes, runs and drawn ones, in which frames of known and of unknown places count alike, as do the kinds of
    traverses.
    """
    assert calibration.curve is not None
    curve = calibration.curve
    columns: list[list[NDArray[np.float64]]] = [[], [], [], []]
    kinds = [name.split()[0] for name, _ in traverses]
    for kind, trials in _in_small_maps(calibration, traverses, repeats):
        counts = int(trials.known.sum()), int((~trials.known).sum())
        weight = np.where(trials.known, 0.5 / counts[0], 0.5 / counts[1]) / kinds.count(kind)
        for column, values in zip(columns, (trials.decision, trials.imagined, trials.right, weight), strict=True):
            column.append(values.astype(np.float64))
    decision, imagined, right, weights = (np.concatenate(column) for column in columns)
    design = np.stack([imagined * decision, imagined], axis=1)
    found = _newton(design, curve.log_odds(decision), right, weights)
    terms = {"imagined_slope": round(float(found[0]), 3), "imagined_intercept": round(float(found[1]), 4)}
    return Curve.model_validate({**curve.model_dump(), **terms})


def fit_geometry(
    calibration: Calibration, traverses: Sequence[tuple[str, ScoredTraverse]], repeats: int = 10
) -> GeometryTerms:
    """The terms of evidence where a lead says nothing, by maximum likelihood with SUPPORT given.

    Every query runs on maps of SMALL sizes and of 100, runs and drawn ones, and of halves of the references.  Each
    kind and size of map counts alike, and in it frames of known and of unknown places.
    """
    assert calibration.curve is not None
    ordered = calibration.model_copy(update={"geometry": None})  # evidence only orders the candidates
    columns: list[list[Values]] = [[], [], [], []]
    for _, traverse in traverses:
        made = [trials_of_halves(traverse, ordered, "always")[0]]
        for how in ("run", "spread"):
            sizes = [size for size in (*SMALL, 100) if size < traverse.truth.shape[1]]
            made += [trials_of_size(traverse, size, how, ordered, repeats, verify="always")[0] for size in sizes]
        counted = [trials for trials in made if min(trials.known.sum(), (~trials.known).sum()) >= 5]
        for trials in counted:
            share = np.where(trials.known, 0.5 / trials.known.sum(), 0.5 / (~trials.known).sum()) / len(counted)
            support = SUPPORT * calibration.curve.log_odds(trials.decision, trials.imagined)
            for column, values in zip(columns, (support, np.log1p(trials.evidence), trials.right, share), strict=True):
                column.append(values.astype(np.float64))
    support, found, right, weights = (np.concatenate(column) for column in columns)
    terms = _newton(np.stack([found, np.ones_like(found)], axis=1), support, right, weights)
    return GeometryTerms(support=SUPPORT, slope=round(float(terms[0]), 3), intercept=round(float(terms[1]), 3))


def _newton(design: Values, known: Values, right: Values, weights: Values) -> Values:
    """The parameters, float64 [p], under which log odds ``known`` + design · parameters make outcomes most likely.

    Args:
        design: float64 [n, p].
        known, right, weights: float64 [n].
    """
    found = np.zeros(design.shape[1])
    for _ in range(100):
        p = sigmoid(known + design @ found)
        curvature = (design * (weights * p * (1 - p))[:, None]).T @ design + 1e-6 * np.eye(len(found))
        step = np.linalg.solve(curvature, design.T @ (weights * (p - right)))
        found -= np.clip(step, -5, 5)
        if np.abs(step).max() < 1e-9:
            break
    return found


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
    repeats: Annotated[int, typer.Option(min=1, help="Maps of each size.")] = 10,
) -> None:
    """Fit the terms of geometric evidence and print them."""
    share_cores(1)
    loaded = EncoderCatalogue().get(encoder)
    terms = fit_geometry(loaded.calibration, list(verifiable_traverses(loaded, datasets)), repeats)
    typer.echo(terms.model_dump_json())


if __name__ == "__main__":
    typer.run(main)
