"""Values of a map between its cells, as torch's bicubic sampling gives them."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import grid_sample

from core.kernels.sampling import interpolated


def test_values_between_cells_and_beyond_the_border_are_those_of_cubic_convolution() -> None:
    random = np.random.default_rng(0)
    maps = random.standard_normal((5, 7, 3), np.float32)
    rows = random.uniform(-1.5, 5.5, 200).astype(np.float32)
    columns = random.uniform(-1.5, 7.5, 200).astype(np.float32)
    # torch counts from -1 to 1 between the outer borders of the outermost cells.
    grid = np.stack([(2 * columns + 1) / 7 - 1, (2 * rows + 1) / 5 - 1], axis=1)
    cells = torch.from_numpy(maps).permute(2, 0, 1)[None]
    wanted = grid_sample(cells, torch.from_numpy(grid)[None, None], mode="bicubic", align_corners=False)
    np.testing.assert_allclose(interpolated(maps, rows, columns), wanted[0, :, 0].T.numpy(), atol=1e-5)


def test_a_cells_centre_has_its_own_value() -> None:
    maps = np.random.default_rng(1).standard_normal((4, 4, 8), np.float32)
    y, x = np.mgrid[0:4, 0:4].reshape(2, -1).astype(np.float32)
    np.testing.assert_array_equal(interpolated(maps, y, x), maps.reshape(16, 8))
