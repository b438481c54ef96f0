"""The compiled second stage finds the mutual nearest neighbours, with each kind of words that processors multiply."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from core.kernels.cell_blocks import has_wide_registers, values_of_a_word
from core.kernels.correspondence import squared_sums
from core.method.agreement import RESOLUTION, correspondences, in_one_block

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


def check_all_grids() -> None:
    """Values of any size, few different ones (so that many products are equal), and the lowest of all."""
    random = np.random.default_rng(5)
    for rows, columns, values, reach, count in GRIDS:
        for lowest, highest in ((-127, 128), (-1, 2), (-128, -126), (0, 1)):
            shown = random.integers(lowest, highest, (count + 1, rows * columns, values)).astype(np.int8)
            query, references = shown[0], shown[1:]
            if count > 1:
                references[1] = query
            lying = in_one_block(references)
            found = squared_sums(query, lying.addresses(), columns, *reach, COSINE)
            cosines = [correspondences(query, reference, columns, reach).cosines for reference in references]
            wanted = [float((one.astype(np.float64) ** 2).sum()) for one in cosines]
            # A float32 sum of n squares, none negative, is off by at most about n half spacings.
            np.testing.assert_allclose(found, wanted, (rows * columns + 4) * SPACING, err_msg=str((rows, columns)))


def test_sums_are_those_of_the_correspondences() -> None:
    check_all_grids()


@pytest.mark.parametrize("values", [1, 2])
def test_other_processors_find_the_same(values: int, tmp_path: Path) -> None:
    """Compiled for one without AVX, and with the words that it or a processor of another make would be given."""
    script = (
        "import core.kernels.cell_blocks as blocks\n"
        f"blocks.values_of_a_word = lambda triple, features: {values}\n"
        "import tests.core.kernels.test_correspondence as test\n"
        "test.check_all_grids()\n"
        "from core.kernels.correspondence import values_a_word\nimport numba\n"
        "print(numba.njit(lambda: values_a_word())())"
    )
    settings = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, **settings}, check=False, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.strip()) == (0, str(values)), done.stderr


@pytest.mark.parametrize(
    ("triple", "features", "values", "wide"),
    [
        ("x86_64-unknown-linux-gnu", "+avx2,+avx512f,+avx512vnni", 4, True),
        ("x86_64-unknown-linux-gnu", "+avx512f,-avx512vnni", 2, True),
        ("x86_64-unknown-linux-gnu", "+avx2,-avx512f,-avx512vnni", 2, False),
        ("x86_64-apple-darwin", "", 2, False),
        ("aarch64-unknown-linux-gnu", "+neon,+dotprod", 1, False),
        ("arm64-apple-darwin", "+neon", 1, False),
    ],
)
def test_the_processor_decides_what_a_word_holds(triple: str, features: str, values: int, wide: bool) -> None:
    assert values_of_a_word(triple, features) == values
    assert has_wide_registers(features) == wide
