"""Results that other tools have saved, and our own in the same form.

A results file has the four columns of the thesis's authors: query, retrieved, score, matched.  A similarity file is a
matrix such as VPR-Bench's.
"""

from __future__ import annotations

import csv
import math
import re
import tokenize
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidResults
from core.judgement.curves import auc_pr
from lab.evaluation.protocol.figures import ALL_RIGHT, DEPTHS, NONE_RIGHT, STAGES, Evaluation, one_class
from lab.evaluation.protocol.outcomes import Outcome

COLUMNS = ("query", "retrieved", "score", "matched")
MATCHED = {"0": False, "0.0": False, "1": True, "1.0": True}
"""The authors wrote both forms."""

NOT_IN_FILE = "a file of results does not say which queries have a true reference, nor what ranks second."


@dataclass(frozen=True)
class Results:
    """The rows of a file, in their order.

    query, retrieved: int64 [Q], as numbered in the file.
    scores: float64 [Q].
    matched: bool [Q], whether the retrieved reference is right.
    """

    query: NDArray[np.int64]
    retrieved: NDArray[np.int64]
    scores: NDArray[np.float64]
    matched: NDArray[np.bool_]


def results_csv(outcomes: Sequence[Outcome]) -> str:
    """One CSV row per query: ``query,retrieved,score,matched`` (matched is 1 or 0)."""
    rows = [",".join(COLUMNS)]
    for query, outcome in enumerate(outcomes):
        rows.append(f"{query},{outcome.retrieved},{_digits(outcome.score)},{int(outcome.matched)}")
    return "\n".join(rows) + "\n"


def _digits(score: float) -> str:
    """A score with the digits that distinguish it from its neighbours: nine of a float32, more of a float64."""
    with np.errstate(over="ignore"):
        single = float(np.float32(score)) == score
    return f"{score:.9g}" if single else repr(score)


def read_results(path: Path) -> Results:
    """The rows of a results file, with or without its header; queries in any order, each once.

    Raises:
        InvalidResults: the file cannot be read, a row is malformed, a query stands twice, or there is no row.
    """
    rows = list(_rows(path))
    if not rows:
        raise InvalidResults(f"{path.name} holds no row of results.")
    query, retrieved, scores, matched = zip(*rows, strict=True)
    if len(set(query)) < len(query):
        twice = next(number for number in query if query.count(number) > 1)
        raise InvalidResults(f"{path.name} has more than one row of query {twice}: a row is a query's best match.")
    return Results(np.array(query), np.array(retrieved), np.array(scores, np.float64), np.array(matched, np.bool_))


def summarize_results(name: str, results: Results) -> Evaluation:
    """The figures that follow from a file of results.

    Args:
        name: stands where an encoder's identity would.
    """
    one = one_class(results.matched)
    notes = dict.fromkeys(("auc_roc", "recall_at", "recall_at_full_precision", "extended_precision"), NOT_IN_FILE)
    if one is not None:
        notes["auc_pr"] = ALL_RIGHT if one == "all right" else NONE_RIGHT
    return Evaluation(
        encoder=name,
        auc_pr=auc_pr(results.scores, results.matched),
        one_class=one,
        auc_roc=None,
        recall_at={str(depth): None for depth in DEPTHS},
        recall_at_full_precision=None,
        extended_precision=None,
        right=int(results.matched.sum()),
        queries=len(results.scores),
        negatives=None,
        references=None,
        thresholds=[],
        milliseconds=dict.fromkeys(STAGES),
        notes=notes,
    )


def read_similarity(path: Path, transposed: bool = False) -> NDArray[np.float64]:
    """Scores of a ``.npy`` file, float64 [Q, R] so that none is rounded, higher is more alike.

    Args:
        path: a plain numeric array with a row for each query and a column for each reference.
        transposed: a row is a reference instead.  A square matrix does not show which it is.

    Raises:
        InvalidResults: it is no such file; a pickled one is never read, for reading it could run code.
    """
    try:
        matrix = np.load(path, allow_pickle=False)
    except OSError as error:
        raise InvalidResults(f"{path} cannot be read: {error.strerror or 'it is no .npy file'}.") from error
    except (ValueError, EOFError, SyntaxError, tokenize.TokenError) as error:
        raise InvalidResults(
            f"{path.name} is not a plain .npy array; save the matrix alone: np.save(file, matrix.astype('float32'))."
        ) from error
    if not isinstance(matrix, np.ndarray) or matrix.ndim != 2 or 0 in matrix.shape:
        raise InvalidResults(f"{path.name} holds no matrix of similarities, queries by references.")
    if not np.issubdtype(matrix.dtype, np.number) or np.iscomplexobj(matrix):
        raise InvalidResults(f"{path.name} holds {matrix.dtype} values, not similarities.")
    scores = np.ascontiguousarray(matrix.T if transposed else matrix, np.float64)
    if not np.isfinite(scores).all():
        raise InvalidResults(f"{path.name} holds similarities that are not finite numbers.")
    return scores


def _rows(path: Path) -> Iterator[tuple[int, int, float, bool]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            for cells in reader:
                row = [cell.strip() for cell in cells]
                if not any(row) or (reader.line_num == 1 and tuple(cell.lower() for cell in row) == COLUMNS):
                    continue
                yield _row(row, f"{path.name}, line {reader.line_num}")
    except OSError as error:
        raise InvalidResults(f"{path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidResults(f"{path} is not a CSV file in UTF-8: {error}.") from error


def _row(row: list[str], where: str) -> tuple[int, int, float, bool]:
    if len(row) != len(COLUMNS):
        raise InvalidResults(f"{where}: a row is '{','.join(COLUMNS)}', not {len(row)} columns.")
    if row[3] not in MATCHED:
        raise InvalidResults(f"{where}: matched is 1 or 0, not {row[3][:80]!r}.")
    return _index(row[0], "query", where), _index(row[1], "reference", where), _score(row[2], where), MATCHED[row[3]]


def _index(text: str, what: str, where: str) -> int:
    if not re.fullmatch(r"[0-9]{1,18}", text):
        raise InvalidResults(f"{where}: {text[:80]!r} is not the index of a {what}.")
    return int(text)


def _score(text: str, where: str) -> float:
    try:
        score = float(text)
    except ValueError:
        score = math.nan
    if not math.isfinite(score):
        raise InvalidResults(f"{where}: {text[:80]!r} is not a score.")
    return score
