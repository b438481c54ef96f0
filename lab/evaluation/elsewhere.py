"""Systems whose similarities others have computed on the same images: judged here, and marked as not computed here."""

from __future__ import annotations

from pathlib import Path

from core.errors import InvalidResults
from lab.baselines.system import About
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.protocol.comparison import SystemRun
from lab.evaluation.protocol.figures import STAGES, summarize
from lab.evaluation.protocol.outcomes import judge, matched_scores
from lab.evaluation.protocol.results import read_similarity
from lab.evaluation.protocol.trust import trust_figures

MARK = "computed elsewhere"
SHORT_MARK = "elsewhere"
"""In charts, where there is little room."""


def read_others(folder: Path, pair: TraversePair) -> list[SystemRun]:
    """The runs of the matrices ``NAME.npy`` of a folder, with a row a query and a column a reference.

    Their figures are those of any run but for times and memory, which nobody measured here.

    Raises:
        InvalidResults: the folder cannot be read or holds no matrix, or one does not fit the traverses.
    """
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == ".npy")
    except OSError as error:
        raise InvalidResults(f"{folder} cannot be read: {error.strerror}.") from error
    if not paths:
        raise InvalidResults(f"{folder} holds no matrix of similarities: NAME.npy for each system.")
    return [_run(path, pair) for path in paths]


def _run(path: Path, pair: TraversePair) -> SystemRun:
    scores = read_similarity(path)
    expected = (len(pair.queries), len(pair.references))
    if scores.shape != expected:
        raise InvalidResults(
            f"{path.name} has {scores.shape[0]} rows and {scores.shape[1]} columns; {pair.name} has {expected[0]} "
            f"queries and {expected[1]} references."
        )
    scores = scores[:, pair.retained]
    outcomes = judge(scores, pair.retained, pair.truth, pair.excluded)
    evaluation = summarize(f"{path.stem} ({MARK})", outcomes, len(pair.retained), {})
    matched = matched_scores(scores, pair.retained, pair.excluded)
    evaluation = evaluation.model_copy(update=trust_figures(matched, pair.retained, outcomes, evaluation.notes))
    return SystemRun(
        about=About(path.stem, f"{path.stem} ({SHORT_MARK})", "not computed here", {"similarities": path.name}),
        identity=f"{path.stem} ({MARK})",
        evaluation=evaluation,
        outcomes=outcomes,
        scores=scores.astype("float32"),
        bytes_per_place=None,
        milliseconds=dict.fromkeys(STAGES),
        elsewhere=True,
    )
