"""The HTTP service and the command line."""

import core as core  # first: it settles how torch's threads wait, before any module here imports torch
