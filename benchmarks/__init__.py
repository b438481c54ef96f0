"""What is measured, beside what it is measured against."""

import core as core  # first: it settles how torch's threads wait, before any module here imports torch
