"""The gain of geometric verification: which places are looked at, how much each stage says, and what doubt remains.

    python -m benchmarks.geometry.verification

The first table orders the places of each task (``benchmarks.geometry.tasks``) in several ways: by two stages; by the
share of inliers beside the score of ten places of two stages, as versions before 1.0 did; and as the third stage does,
with each of its sources of candidates left out, and with all candidates verified.  ``auto`` stands beside ``always``,
with the share of frames that it verifies.  Of all weights on a grid those are printed that have the highest recall@1 on
the tasks to fit on, in which each kind of change counts alike.

The second table asks whether the best match is right: of every task one half of the references is left out, then the
other.  It compares the probability of three stages with plain measures of doubt, by the area under their precision and
recall.  The third fits how much a lead over rivals says (``benchmarks.geometry.leads``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.geometry.leads import lead_figures
from benchmarks.geometry.tasks import PictureEncoder, Task, tasks
from benchmarks.report import report
from core.geometry.matching import GLANCED, count_matches, glance_at
from core.geometry.pairs import Pairs
from core.judgement import geometry
from core.judgement.background import TOP_PLACES
from core.judgement.curves import auc_pr, auc_roc
from core.judgement.reliability import reliability
from core.judgement.trials import Trial, Trials, gathered
from core.judgement.verdict import Judgement, judge
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import Neighborhood, Whereabouts
from core.recognition import verification
from core.recognition.question import Verifier, Verify
from core.recognition.stages import Candidates, examine, second_stage
from core.recognition.verification import verify_candidates
from core.threads import cores, share_cores

Array = NDArray[np.float64]
Weights = tuple[float, float, float]
"""Of similarity, agreement and the share of inliers in the order of three stages."""

QUERIES = 150
"""Of a task, about this many are asked."""
BEFORE = (1.0, 1.0, 0.7)
SHIPPED = (1 + geometry.SIMILARITY, 1 - geometry.AGREEMENT, geometry.INLIERS)
GRID = ((1.0, 1.5, 2.0, 3.0, 4.0), (0.25, 0.5, 0.75, 1.0), (0.35, 0.5, 0.75, 1.0, 1.5))
"""Weights that are tried; the order does not change if all grow alike."""


@dataclass(frozen=True)
class Ranked:
    """The candidates of one query, [n] each, best of two stages first.

    by_similarity, by_glance: their rank in the first stage, and by matches at a glance among the best hundred.
    share: of inliers; NaN of a place that is no candidate of anybody.
    true: whether they show the query's place.
    """

    similarity: Array
    agreement: Array
    by_similarity: Array
    by_glance: Array
    share: Array
    true: NDArray[np.bool_]

    def chosen(self, of_two: int, of_first: int, of_glances: int) -> NDArray[np.bool_]:
        """The candidates that are the best of two stages, of the first, and at a glance of those that are neither."""
        chosen = (np.arange(len(self.share)) < of_two) | (self.by_similarity < of_first)
        others = np.flatnonzero(~chosen)
        chosen[others[np.argsort(self.by_glance[others], kind="stable")[:of_glances]]] = True
        return chosen

    def is_right(self, weights: Weights, chosen: NDArray[np.bool_]) -> bool:
        """Whether the place is right that some weights put first among some candidates."""
        similarity, agreement, inliers = weights
        values = similarity * self.similarity + agreement * self.agreement + inliers * np.nan_to_num(self.share)
        return bool(self.true[np.where(chosen, values, -np.inf).argmax()])


OURS = (verification.OF_TWO_STAGES, verification.OF_THE_FIRST, verification.OF_GLANCES)
WAYS: dict[str, tuple[Weights, tuple[int, int, int]]] = {
    "two stages": ((1.0, 1.0, 0.0), (1, 0, 0)),
    "score + 0.7 share, of ten": (BEFORE, (10, 0, 0)),
    "the same, chosen by three": (BEFORE, OURS),
    "three stages": (SHIPPED, OURS),
    "without a glance": (SHIPPED, (10, 2, 0)),
    "without the first stage's best": (SHIPPED, (8, 0, 4)),
    "of ten of two stages": (SHIPPED, (10, 0, 0)),
}


class Asked:
    """A task, whose queries are asked as the service asks them."""

    def __init__(self, encoder: Encoder, task: Task) -> None:
        self.encoder, self.task = encoder, task
        self.pairs = Pairs(task.queries.keypoints, task.references.keypoints)
        ours, theirs = task.queries.encodings, task.references.encodings
        self.first = encoder.scores_from_inner_products(ours.descriptors @ theirs.descriptors.T)
        self.queries = range(0, len(task.queries), max(1, len(task.queries) // QUERIES))
        self.neighborhood = Neighborhood(MapSettings().same_place_radius, task.frames)

    def agreements(self, query: int, references: Sequence[int]) -> NDArray[np.float32]:
        """The gains of the second stage, float32 [n]."""
        cells = self.task.queries.encodings.local[query]
        return self.encoder.agreement(cells, self.task.references.encodings.local[list(references)])

    def candidates(self, query: int, retained: NDArray[np.int64]) -> Candidates:
        """After two stages, in a map of the references ``retained``, int64 [n]."""
        order = retained[np.argsort(-self.first[query, retained], kind="stable")]
        places = Whereabouts.along_sequence(order)
        local = self.task.references.encodings.local
        stage = second_stage(self.encoder, self.task.queries.encodings.local[query], lambda at: local[order[at]])
        seen = examine(self.first[query, order], places, self.neighborhood, *stage)
        rows = order[seen.order]
        return Candidates(
            rows, seen.scores, self.first[query, rows], places.take(seen.order), seen.examined, None, seen.scores,
            len(rows),
        )  # fmt: skip

    def judged(
        self, query: int, retained: NDArray[np.int64], verify: Verify = "always"
    ) -> tuple[Candidates, Judgement]:
        """The final candidates in a map of some references, and the judgement of them."""

        def judgement_of(candidates: Candidates) -> Judgement:
            parts = candidates.ordered, candidates.whereabouts, self.encoder.calibration, self.neighborhood
            return judge(*parts, candidates.examined, geometry=candidates.geometry)

        comparison = self.pairs.comparison(query, lambda rows: self.agreements(query, rows))
        verifier = Verifier(verify, lambda: self.pairs.queries[query])
        candidates = self.candidates(query, retained)
        found, judgement, _ = verify_candidates(
            candidates, judgement_of, verifier, self.encoder.calibration, comparison
        )
        return found, judgement

    def ranked(self, query: int) -> Ranked:
        """The candidates of every way in a map of all references, verified."""
        candidates = self.candidates(query, np.arange(len(self.task.references)))
        head = np.arange(min(verification.GLANCES, len(candidates.rows)))
        rows = candidates.rows[head]
        assert candidates.first is not None
        similarity = candidates.first[head].astype(np.float64)
        glances = np.stack([glance_at(self.pairs.references[row]) for row in rows.tolist()])
        matches = count_matches(self.pairs.queries[query], glances) / GLANCED
        share = np.full(len(head), np.nan)
        blank = Ranked(similarity, share, _ranks(similarity), _ranks(matches), share, self.task.truth[query, rows])
        wanted = np.flatnonzero(np.logical_or.reduce([blank.chosen(*counts) for _, counts in WAYS.values()]))
        agreement = candidates.scores[head] - similarity
        late = wanted[~candidates.examined[wanted]]
        agreement[late] = self.agreements(query, rows[late].tolist())
        share[wanted] = [one.inlier_share for one in self.pairs.verified(query, rows[wanted].tolist())]
        return Ranked(similarity, agreement, blank.by_similarity, blank.by_glance, share, blank.true)

    def halves(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Two maps, each of one half of the references; of places that stand alone, every second one."""
        numbers = np.arange(len(self.task.references))
        first = numbers < len(numbers) // 2 if self.task.frames else numbers % 2 == 0
        return numbers[first], numbers[~first]


def _ranks(values: Array) -> Array:
    """The ranks of values, float64 [n], the highest first."""
    ranks = np.empty(len(values))
    ranks[np.argsort(-values, kind="stable")] = np.arange(len(values))
    return ranks


def recall(ranked: Sequence[Ranked], weights: Weights, counts: tuple[int, int, int]) -> float:
    """recall@1 of queries that some weights order, among candidates of three sources."""
    return float(np.mean([one.is_right(weights, one.chosen(*counts)) for one in ranked]))


def best_weights(found: Sequence[tuple[Task, Sequence[Ranked]]]) -> tuple[Weights, float, float]:
    """Of all weights on the grid those with the highest recall@1 on the tasks to fit on; and ours beside it.

    Each kind of task counts alike.
    """
    fitted = [(task, ranked) for task, ranked in found if task.fitted]
    kinds = sorted({task.kind for task, _ in fitted})

    def mean(weights: Weights) -> float:
        recalls = [(task.kind, recall(ranked, weights, OURS)) for task, ranked in fitted]
        return float(np.mean([np.mean([value for kind, value in recalls if kind == one]) for one in kinds]))

    tried = {weights: mean(weights) for weights in product(*GRID)}
    best = max(tried, key=lambda weights: tried[weights])
    return best, tried[best], mean(SHIPPED)


# Doubt

MEASURES: dict[str, Callable[[Candidates, Judgement, Neighborhood], float]] = {
    "probability": lambda _, judgement, __: judgement.probability or 0.0,
    "score of two stages": lambda candidates, _, __: float(candidates.scores[0]),
    "ratio to the second place": lambda candidates, _, neighborhood: _over_second(candidates, neighborhood),
    "lead over it": lambda _, judgement, __: judgement.lead,
    "inliers": lambda candidates, _, __: float(_inliers(candidates)),
    "evidence": lambda _, judgement, __: judgement.evidence or 0.0,
    "spread of the best five": lambda candidates, _, __: -_spread(candidates),
}


def _over_second(candidates: Candidates, neighborhood: Neighborhood) -> float:
    """The ratio of the best score to that of the best other place."""
    others = np.flatnonzero(candidates.whereabouts.others(0, neighborhood))
    return float(candidates.values[0] / max(1e-3, candidates.values[others].max())) if len(others) else 1.0


def _inliers(candidates: Candidates) -> int:
    one = candidates.verifications[0] if candidates.verifications else None
    return 0 if one is None else one.inlier_count


def _spread(candidates: Candidates) -> float:
    """The deviation of the places of the best five by two stages, weighted by their scores (Zaffar et al., 2024)."""
    order = np.argsort(-candidates.scores, kind="stable")[:TOP_PLACES]
    weights = np.maximum(candidates.scores[order], 1e-6)
    where = candidates.rows[order].astype(np.float64)
    return float(np.sqrt(np.average((where - np.average(where, weights=weights)) ** 2, weights=weights)))


def doubts(asked: Asked) -> tuple[dict[str, float], Trials]:
    """The figures of one task, with halves of its references left out, and its answers."""
    measured: dict[str, list[float]] = {name: [] for name in MEASURES}
    answers: list[Trial] = []
    by_auto: list[tuple[float, bool]] = []
    for retained in asked.halves():
        for query in asked.queries:
            candidates, judgement = asked.judged(query, retained)
            for name, measure in MEASURES.items():
                measured[name].append(measure(candidates, judgement, asked.neighborhood))
            known, right = asked.task.truth[query, retained].any(), asked.task.truth[query, candidates.rows[0]]
            answers.append(Trial(judgement, bool(known), bool(right), query))
            automatic, doubted = asked.judged(query, retained, "auto")
            by_auto.append((doubted.probability or 0.0, bool(asked.task.truth[query, automatic.rows[0]])))
    trials = gathered(answers)
    hits, there, believed = trials.right, trials.known, trials.recognized(asked.encoder.calibration)
    areas = {name: auc_pr(np.array(values), hits) for name, values in measured.items()}
    probability = np.array(measured["probability"])
    stated, found = (np.array(column) for column in zip(*by_auto, strict=True))
    figures = areas | {
        "AUC-ROC": auc_roc(probability, hits) or 0.0,
        "AUC-ROC of auto": auc_roc(stated, found.astype(np.bool_)) or 0.0,
        "calibration error": reliability(probability, hits).ece,
        "recognized that are right": float(hits[believed].mean()) if believed.any() else 0.0,
        "right that are recognized": float(believed[hits].mean()) if hits.any() else 0.0,
        "strangers recognized": float(believed[~there].mean()) if (~there).any() else 0.0,
    }
    return figures, trials


def main(
    datasets: Annotated[Path, typer.Option(help="The folder with train and eval.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
) -> None:
    """Three tables: orders, measures of doubt, and how much a lead says."""
    share_cores(cores())
    chosen = EncoderCatalogue().get(encoder)
    found: list[tuple[Task, list[Ranked]]] = []
    orders: dict[str, dict[str, float]] = {}
    doubt: dict[str, dict[str, float]] = {}
    answered: dict[str, list[Trials]] = {}
    for number, task in enumerate(tasks(PictureEncoder(chosen), datasets)):
        asked = Asked(chosen, task)
        known = [query for query in asked.queries if task.truth[query].any()]
        ranked = [asked.ranked(query) for query in known]
        found.append((task, ranked))
        name = f"{number + 1} {task.name}" + (" (fitted)" if task.fitted else "")
        orders[name] = {way: recall(ranked, *how) for way, how in WAYS.items()}
        everything = np.arange(len(task.references))
        finals = [asked.judged(query, everything)[0] for query in known]
        automatic = [asked.judged(query, everything, "auto")[0] for query in known]
        for way, answers in (("always", finals), ("auto", automatic)):
            hits = [task.truth[query, one.rows[0]] for query, one in zip(known, answers, strict=True)]
            orders[name][way] = float(np.mean(hits))
        orders[name]["verified by auto"] = float(np.mean([bool(one.verifications) for one in automatic]))
        orders[name]["candidates verified"] = float(
            np.mean([sum(one is not None for one in final.verifications) for final in finals])
        )
        doubt[name], trials = doubts(asked)
        if task.fitted:
            answered.setdefault(task.kind, []).append(trials)
        print(name, {key: round(value, 3) for key, value in (orders[name] | doubt[name]).items()}, flush=True)
    leads = lead_figures(answered, chosen.calibration)
    for label, title, figures in (
        ("geometry_verification", "recall@1, and how many candidates are verified", orders),
        ("geometry_doubt", "is the best match right? area under precision and recall; the probability", doubt),
        ("geometry_leads", "how much a lead says, fitted to kinds of tasks, enough from", leads),
    ):
        columns = list(next(iter(figures.values())))
        rows = [(name, *(f"{values[column]:.3f}" for column in columns)) for name, values in figures.items()]
        report(label, title, ["", *columns], rows, {"encoder": chosen.identity, "figures": figures})
    best, reached, ours = best_weights(found)
    lost = [one["always"] - one["auto"] for name, one in orders.items() if name.endswith("(fitted)")]
    print(f"auto has {np.mean(lost):.4f} less recall@1 than always on the fitted tasks, {max(lost):.4f} at most.")
    print(f"Weights of similarity, agreement and inliers: {best} have {reached:.4f} on the fitted tasks, "
          f"{SHIPPED} have {ours:.4f}.")  # fmt: skip


if __name__ == "__main__":
    typer.run(main)
