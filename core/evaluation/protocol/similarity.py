"""Similarity matrices that other tools have saved, such as VPR-Bench's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidResults


def read_similarity(path: Path, transposed: bool = False) -> NDArray[np.float64]:
    """Scores of a ``.npy`` file, float64 [Q, R] so that none is rounded, higher is more alike.

    Args:
        path: a plain numeric array with a row for each query and a column for each reference.
        transposed: a row is a reference instead.  A square matrix does not tell which it is.

    Raises:
        InvalidResults: it is no such file; a pickled one is never read, for reading it could run code.
    """
    try:
        matrix = np.load(path, allow_pickle=False)
    except OSError as error:
        raise InvalidResults(f"{path} cannot be read: {error.strerror or 'it is no .npy file'}.") from error
    except (ValueError, EOFError) as error:
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
