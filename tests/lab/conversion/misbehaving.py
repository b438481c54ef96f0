"""A reader for a child process that does what the file says: crash, take memory, run for ever, tell what is wrong."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from core.errors import InvalidModel
from lab.conversion.isolation import Tree, serve


def _read(path: Path) -> tuple[Tree, dict[str, NDArray[np.float64]]]:
    match path.read_text():
        case "crash":
            os.abort()
        case "memory":
            return None, {"much": np.ones(2**29)}
        case "hang":
            while True:
                pass
        case "leave":
            sys.exit(0)
        case "lie":
            raise InvalidModel("The file lies.")
        case "stumble":
            raise ZeroDivisionError("by nothing")
        case text:
            return {"text": text}, {"numbers": np.arange(3.0)}


if __name__ == "__main__":
    serve(_read, save_file)
