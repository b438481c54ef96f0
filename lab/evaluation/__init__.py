"""How well systems recognize one traverse by another: the thesis's protocol, data sets, and report."""

from lab.evaluation.protocol.comparison import ScalePoint, SeverityCurve, SizePoint, SystemComparison, SystemRun
from lab.evaluation.protocol.figures import (
    DEPTHS,
    STAGES,
    Evaluation,
    extended_precision,
    recall_at_full_precision,
    recall_at_k,
    summarize,
)
from lab.evaluation.protocol.outcomes import Outcome, judge, judge_ranking
from lab.evaluation.protocol.results import results_csv

__all__ = [
    "DEPTHS",
    "STAGES",
    "Evaluation",
    "Outcome",
    "ScalePoint",
    "SeverityCurve",
    "SizePoint",
    "SystemComparison",
    "SystemRun",
    "extended_precision",
    "judge",
    "judge_ranking",
    "recall_at_full_precision",
    "recall_at_k",
    "results_csv",
    "summarize",
]
