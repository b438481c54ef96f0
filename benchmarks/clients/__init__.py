"""The cost of clients of the service beside plain HTTP."""

import sys
from pathlib import Path

sys.path.append(
    str(Path(__file__).parents[2] / "clients" / "ros2")
)  # the node's package is installed in .venv-ros alone
