"""The ``placerec`` command: one module a command.

Modules that take a second to load (torch, FAISS, the service itself) are imported within the
commands that need them, so that ``placerec --help`` answers at once.
"""

from service.commands.application import application
from service.commands.malloc import configure_malloc


def main() -> None:
    """Run the command line of this process; the entry point ``placerec``."""
    configure_malloc()
    application(prog_name="placerec")


__all__ = ["application", "main"]
