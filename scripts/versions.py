"""The version of everything that is released: service, client, ROS 2 package, chart, image, interface.

    python3 scripts/versions.py           # what stands where
    python3 scripts/versions.py 1.0.0     # sets it everywhere but in openapi.json, which scripts/release makes anew

Where CHANGELOG.md says of the version that it is not released yet, it says today's date instead.

Only the standard library is used.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from datetime import date
from pathlib import Path

ROOT = Path(__file__).parents[1]
NUMBER = r"\d+\.\d+\.\d+"
CHANGES, UNRELEASED = "CHANGELOG.md", "not released yet"


@dataclass(frozen=True)
class Place:
    """A line of a file that has the version between two texts."""

    path: str
    before: str
    after: str = '"'

    def expression(self) -> re.Pattern[str]:
        return re.compile(rf"({re.escape(self.before)})({NUMBER})({re.escape(self.after)})")


SOURCE = Place("pyproject.toml", '\nversion = "')
"""The version that counts where places differ."""

PLACES = (
    SOURCE,
    Place("pyproject.toml", '"placerec-client[stream]=='),
    Place("clients/python/placerec_client/version.py", 'VERSION = "'),
    Place("clients/ros2/package.xml", "<version>", "</version>"),
    Place("clients/ros2/setup.py", 'version="'),
    Place("docker/chart/Chart.yaml", "\nversion: ", "\n"),
    Place("docker/chart/Chart.yaml", 'appVersion: "'),
    Place("docker/Dockerfile", 'org.opencontainers.image.version="'),
)
MADE = (Place("openapi.json", '\n    "version": "'),)
"""Places that are written from the others."""


def found(root: Path = ROOT) -> dict[Place, str]:
    """The version at each place.

    Raises:
        ValueError: a file has none there, or several.
    """
    return {place: _match(place, (root / place.path).read_text())[2] for place in (*PLACES, *MADE)}


def _match(place: Place, text: str) -> re.Match[str]:
    matches = list(place.expression().finditer(text))
    if len(matches) != 1:
        raise ValueError(f"{place.path} has {len(matches)} versions after {place.before.strip()!r}")
    return matches[0]


def put(version: str, root: Path = ROOT, day: date | None = None) -> None:
    """Write a version to all places but those that are made from them, and its day to the changelog.

    Args:
        day: of the release; None: today.

    Raises:
        ValueError: it is no version of three numbers, a place has none, or the changelog says nothing of it; nothing is
            written.
    """
    if not re.fullmatch(NUMBER, version):
        raise ValueError(f"{version} is no version of three numbers")
    changes = (root / CHANGES).read_text()
    if not re.search(rf"^## {re.escape(version)}\b", changes, re.MULTILINE):
        raise ValueError(f"{CHANGES} has no section {version}")
    texts = {place.path: (root / place.path).read_text() for place in PLACES}
    for place in PLACES:
        _match(place, texts[place.path])
        texts[place.path] = place.expression().sub(rf"\g<1>{version}\g<3>", texts[place.path])
    heading = f"\n## {version} – "
    texts[CHANGES] = changes.replace(f"{heading}{UNRELEASED}\n", f"{heading}{day or date.today()}\n")
    for path, text in texts.items():
        (root / path).write_text(text)


def main() -> int:
    try:
        if len(sys.argv) > 1:
            put(sys.argv[1])
        versions = found()
    except ValueError as error:
        print(f"{error}.", file=sys.stderr)
        return 1
    for place, version in versions.items():
        print(f"{version}  {place.path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
