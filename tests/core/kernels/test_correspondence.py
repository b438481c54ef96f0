"""The compiled second stage finds the mutual nearest neighbours."""

from __future__ import annotations

import numpy as np

from core.kernels.correspondence import squared_sums
from core.method.agreement import RESOLUTION, correspondences

COSINE = np.float32(1 / RESOLUTION**2)
SPACING = float(np.finfo(np.float32).eps)

GRIDS = [
    # rows, columns, values, reach, references
    (13, 13, 192, (2, 5), 3),
    (13, 13, 8, (12, 12), 2),
    (4, 6, 8, (1, 2), 4),
    (1, 1, 4, (0, 0), 2),
    (6, 5, 4, (0, 1), 3),
    (3, 15, 12, (1, 14), 2),
    (5, 16, 8, (4, 20), 2),
    (2, 46, 4, (1, 3), 3),
    (7, 9, 4, (3, 0), 2),
    (4, 7, 4, (2, 3), 0),
]


def test_sums_are_those_of_the_correspondences() -> None:
    """Values of any size, few different ones (so that many products are equal), and the lowest of all."""
    random = np.random.default_rng(5)
    for rows, columns, values, reach, count in GRIDS:
        for lowest, highest in ((-127, 128), (-1, 2), (-128, -126), (0, 1)):
            shown = random.integers(lowest, highest, (count + 1, rows * columns, values)).astype(np.int8)
            query, references = shown[0], shown[1:]
            if count > 1:
                references[1] = query
            found = squared_sums(query, references, columns, *reach, COSINE)
            cosines = [correspondences(query, reference, columns, reach).cosines for reference in references]
            wanted = [float((one.astype(np.float64) ** 2).sum()) for one in cosines]
            # A float32 sum of n squares, none negative, is off by at most about n half spacings.
            np.testing.assert_allclose(found, wanted, (rows * columns + 4) * SPACING, err_msg=str((rows, columns)))
