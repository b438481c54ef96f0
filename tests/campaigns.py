"""What a campaign of kills is told on its command line."""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Collection, Sequence


def read_arguments(
    arguments: Sequence[str],
    name: str,
    description: str | None,
    parts: Collection[str],
    kills: int,
    others: argparse.ArgumentParser | None = None,
) -> argparse.Namespace:
    """The ``kills``, ``seed``, ``minutes`` and ``parts`` of a campaign; its seed, which may be drawn, is printed.

    Args:
        others: reads its other options.
    """
    parents = [] if others is None else [others]
    parser = argparse.ArgumentParser(prog=f"scripts/soak {name}", description=description, parents=parents)
    parser.add_argument("--kills", type=int, default=kills)
    parser.add_argument("--seed", default=None)
    parser.add_argument("--minutes", type=float, default=None, help="begin no further kill after so long")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts), help="which to kill")
    chosen = parser.parse_args(arguments)
    chosen.seed = chosen.seed or secrets.token_hex(4)
    print(f"seed {chosen.seed}", flush=True)
    return chosen
