"""Importing the client is quick: what a program does not use is not loaded."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.thorough
def test_what_is_not_used_is_not_imported() -> None:
    """That keeps the import short: of httpx's command line, of WebSockets, of the other half, nothing is there."""
    program = "import sys; from placerec_client import Client; print(*sys.modules)"
    loaded = set(
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    )
    assert {"httpx", "pydantic"} <= loaded
    unused = {"rich", "click", "pygments", "numpy", "cv2", "PIL", "asyncio", "anyio", "websockets"}
    assert not loaded & {*unused, "placerec_client._async.client"}


def test_the_package_alone_imports_nothing_of_others() -> None:
    program = "import sys; import placerec_client; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "placerec_client" in loaded
    assert not set(loaded) & {"httpx", "pydantic", "numpy", "cv2", "asyncio", "placerec_client.models"}


def test_every_name_can_be_imported() -> None:
    program = "import placerec_client as c; print([getattr(c, name) for name in c.__all__]); c.no_such_name"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout and "no attribute 'no_such_name'" in done.stderr
