"""Compiled inner loops; the rooms that call them say in plain NumPy what they compute."""

from core.kernels.compiled import use_shipped

use_shipped()  # before anything here imports Numba, which reads its settings when it loads
