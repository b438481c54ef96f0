"""Servers for trials, until Ctrl+C; ``scripts/cluster`` runs this.

    python -m tests.servers            # a PostgreSQL
    python -m tests.servers --milvus   # with a Milvus

It prints the settings of a service that uses them, as lines for a shell.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress

from tests.servers.postgres import running_postgres
from tests.servers.process import Missing


@contextmanager
def _servers(with_milvus: bool) -> Iterator[Mapping[str, str]]:
    with ExitStack() as stack:
        settings = {"DATABASE": stack.enter_context(running_postgres()).address}
        if with_milvus:
            from tests.servers.milvus import running_milvus  # needs Milvus's client

            settings["MILVUS"] = stack.enter_context(running_milvus()).address
        yield settings


def main() -> int:
    """Run the servers until Ctrl+C; the exit status is 1 if one is missing or does not start."""
    parser = argparse.ArgumentParser(prog="scripts/cluster", description="Start a PostgreSQL for trials.")
    parser.add_argument("--milvus", action="store_true", help="start a Milvus as well")
    with_milvus = parser.parse_args().milvus
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl+C does, with the servers
    try:
        with _servers(with_milvus) as settings:
            print("Paste these lines where a service starts; Ctrl+C here ends the servers.", file=sys.stderr)
            for name, value in settings.items():
                print(f"export PLACEREC_{name}={shlex.quote(value)}", flush=True)
            with suppress(KeyboardInterrupt):
                signal.pause()
    except (Missing, TimeoutError) as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # while they start
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
