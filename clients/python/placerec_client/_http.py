"""httpx, imported without the packages of its own command line.

httpx imports that command line if it can, and with it rich, click and pygments, which take longer than all else that
this package imports.  A process that has imported httpx before is left as it is.
"""

from __future__ import annotations

import sys

_COMMAND_LINE = "httpx._main"

if "httpx" in sys.modules:
    import httpx
else:
    sys.modules[_COMMAND_LINE] = None  # type: ignore[assignment] # httpx takes it for not installed
    try:
        import httpx
    finally:
        del sys.modules[_COMMAND_LINE]

__all__ = ["httpx"]
