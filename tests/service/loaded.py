"""What a process from which servers are forked does last: it has loaded the compiled loops and made the routes.

Numba takes most of a second to load a first loop. It starts no thread here, which a child would lack.
"""

from __future__ import annotations

import gc

import numpy as np

from core.method.regions import extract_regions, projected_box_sums
from service.app.application import create_app
from service.settings import Settings

_layer = np.ones((2, 2, 3), np.float32)
_regions = extract_regions([_layer], [0.5], 1)
projected_box_sums(_layer, _layer, _regions.boxes, _layer[0, 0], np.empty((len(_regions), 3), np.float32))
create_app(Settings.model_construct(), as_owner=True)  # opens nothing
gc.collect()
gc.freeze()  # a child's garbage collector would copy every page to look at them
