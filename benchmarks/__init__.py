"""Measurements, each beside its comparison."""

import core as core  # first: it settles how torch's threads wait, before any module here imports torch
