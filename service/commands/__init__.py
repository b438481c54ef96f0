"""The ``placerec`` command: one module a command.

Modules that take a second to load (torch, FAISS, the service itself) are imported within the
commands that need them, so that ``placerec --help`` answers at once; and ``placerec serve``, whose start
others wait for, loads no other command.
"""

import sys

from service.malloc import configure_malloc


def main() -> None:
    """Run the command line of this process; the entry point ``placerec``."""
    configure_malloc()
    try:
        if sys.argv[1:2] == ["serve"]:
            from service.commands.serve import alone as application
        else:
            from service.commands.application import application
        application(prog_name="placerec")
    except KeyboardInterrupt:  # before there is a command, which ends with its own words
        sys.stderr.write("Interrupted.\n")
        sys.exit(130)


__all__ = ["main"]
