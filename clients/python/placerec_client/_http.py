"""httpx, without what would make it slow here.

httpx imports its command line if it can, and with it rich, click and pygments, which take longer than all else that
this package imports.  A process that has imported httpx before is left as it is.

httpcore, on which httpx rests, tries to import sniffio several times in each asynchronous request; where that is not
installed, looking for it takes longer than the rest of the request.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec

_COMMAND_LINE = "httpx._main"

if "httpx" in sys.modules:
    import httpx
else:
    sys.modules[_COMMAND_LINE] = None  # type: ignore[assignment] # httpx takes it for not installed
    try:
        import httpx
    finally:
        del sys.modules[_COMMAND_LINE]

if "sniffio" not in sys.modules and find_spec("sniffio") is None:
    sys.modules["sniffio"] = None  # type: ignore[assignment] # so an import fails at once

__all__ = ["httpx"]
