"""Write the OpenAPI document of the application to a file: ``python -m service.app.openapi_document openapi.json``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from service.app.application import create_app
from service.settings import Settings


def document() -> str:
    """The text of the document of an application with default settings."""
    made = create_app(Settings(host="127.0.0.1")).openapi()
    return json.dumps(made, indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(document())
