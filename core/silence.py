"""Switches that stop dependencies from reporting about this machine: variables that they read when they are imported.

ONNX Runtime counts its runs, writes an identity of the machine and looks up the host that collects them; FastAPI sends
what OpenTelemetry's variables ask for.  Nothing leaves the machine but answers, so all of it is off in every process,
whatever the environment says: SECURITY.md promises it.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping

SWITCHES = {
    "ORT_DISABLE_TELEMETRY": "1",
    "FASTAPI_OTEL_AUTO_CONFIGURE": "false",
}
"""Variables and the values that switch reports off.  ``docker/Dockerfile`` sets the same."""


def keep_silent(environment: MutableMapping[str, str] = os.environ) -> None:
    """Switch reports off here and in the processes started from here; call this before anything else is imported."""
    environment.update(SWITCHES)
