"""The parts of the project by its lock files: a bill of materials, and a comparison with known advisories.

    python3 scripts/inventory.py sbom [PROFILE]  # service (default), bags, lab, replica, development, ros, cluster
    python3 scripts/inventory.py advisories [PROFILE] [--source URL]

Only the standard library is used, so that both work where nothing is installed.  The bill is CycloneDX 1.5 in JSON; the
same lock files give the same bytes.  Advisories are looked up in a database that speaks OSV's protocol.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
import urllib.error
import urllib.request
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

ROOT = Path(__file__).parents[1]
PROFILES = ("service", "bags", "lab", "replica", "development", "ros", "cluster")
WITHOUT_TORCH = ("ros", "cluster")

SOURCE = "https://api.osv.dev"
"""The database of advisories that is asked unless another one is named."""

SECONDS = 30.0
AT_ONCE = 500

FOUND, NOT_COMPARED = 1, 2
"""Exit statuses: something is known of a locked version; nothing, or not all, could be compared."""


@dataclass(frozen=True)
class Component:
    """A package of a lock file, or of the files that are kept with the sources.

    hashes: of its files, in hexadecimal digits; torch, whose builds differ, has none.
    marker: the environments that need it; empty for all.
    ecosystem: as advisories name it.
    """

    name: str
    version: str
    hashes: tuple[str, ...] = ()
    marker: str = ""
    ecosystem: str = "PyPI"

    @property
    def address(self) -> str:
        """Its package URL."""
        return f"pkg:{self.ecosystem.lower()}/{quote(self.name, safe='/')}@{self.version}"

    def described(self) -> dict[str, Any]:
        """It as an entry of a bill of materials."""
        entry: dict[str, Any] = {"type": "library", "bom-ref": self.address, "name": self.name}
        entry |= {"version": self.version, "purl": self.address}
        if self.hashes:
            algorithms = {64: "SHA-256", 128: "SHA-512"}
            entry["hashes"] = [{"alg": algorithms[len(digest)], "content": digest} for digest in self.hashes]
        if self.marker:
            entry["properties"] = [{"name": "placerec:marker", "value": self.marker}]
        return entry


def components_of(profile: str, root: Path = ROOT) -> list[Component]:
    """The packages of a profile by name, and the libraries of the console that are kept with the sources.

    Raises:
        OSError: the lock file is missing.
        ValueError: an entry is not one exact version.
    """
    texts = [(root / "requirements" / f"{profile}.lock").read_text()]
    if profile not in WITHOUT_TORCH:
        texts.append((root / "requirements/torch.lock").read_text())
    blocks = [block for text in texts for block in re.split(r"\n(?=\S)", text) if block and not block.startswith("#")]
    found = [_component(block) for block in blocks]
    if profile not in WITHOUT_TORCH:
        kept = json.loads((root / "service/console/vendor/lock.json").read_text())
        found += [Component(one["name"], one["version"], (one["sha512"],), ecosystem="npm") for one in kept]
    return sorted(found, key=lambda one: one.name)


def _component(block: str) -> Component:
    head, *hashes = re.sub(r"\\\n|\n +#.*", "", block).split("--hash=sha256:")
    requirement, _, marker = head.strip().partition(";")
    found = re.fullmatch(r"([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^\s*,]+)", requirement.strip())
    if found is None:
        raise ValueError(f"not one exact version: {head.strip()[:100]}")
    name = re.sub(r"[-_.]+", "-", found[1]).lower()
    return Component(name, found[2], tuple(sorted(text.strip() for text in hashes)), marker.strip())


def bill_of(profile: str, root: Path = ROOT) -> dict[str, Any]:
    """The bill of materials of a profile, as CycloneDX describes it."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    components = components_of(profile, root)
    own = {"type": "application", "bom-ref": "placerec", "name": "placerec", "version": project["version"]}
    made = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own, "properties": [{"name": "placerec:profile", "value": profile}]},
        "components": [one.described() for one in components],
        "dependencies": [{"ref": "placerec", "dependsOn": [one.address for one in components]}],
    }
    content = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(made, sort_keys=True))
    return {**made, "serialNumber": f"urn:uuid:{content}"}


class NotReached(Exception):
    """The database of advisories could not be asked, or gave no answer of its protocol."""


def advisories_on(components: list[Component], source: str) -> dict[Component, list[str]]:
    """The ids of the advisories on each component that has some.

    Raises:
        NotReached: not all could be compared.
    """
    found: dict[Component, list[str]] = {}
    for first in range(0, len(components), AT_ONCE):
        some = components[first : first + AT_ONCE]
        waiting = dict.fromkeys(some, "")
        while waiting:  # an answer may have further pages for some of them
            asked = list(waiting)
            queries = [_query(one, waiting[one]) for one in asked]
            answered = _ask(f"{source.rstrip('/')}/v1/querybatch", {"queries": queries}).get("results")
            if not isinstance(answered, list) or len(answered) != len(asked):
                raise NotReached(f"{source} gave no answer for each package")
            waiting = {}
            for one, result in zip(asked, answered, strict=True):
                ids = [str(known["id"]) for known in (result or {}).get("vulns", [])]
                if ids:
                    found.setdefault(one, []).extend(ids)
                if token := (result or {}).get("next_page_token"):
                    waiting[one] = str(token)
    return found


def _query(one: Component, token: str) -> dict[str, Any]:
    query: dict[str, Any] = {"package": {"name": one.name, "ecosystem": one.ecosystem}, "version": one.version}
    return query | ({"page_token": token} if token else {})


def _ask(address: str, body: dict[str, Any]) -> dict[str, Any]:
    request = urllib.request.Request(address, json.dumps(body).encode(), {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=SECONDS) as response:
            found = json.load(response)
    except (OSError, ValueError, urllib.error.URLError) as error:
        raise NotReached(f"{address} could not be asked: {error}") from error
    if not isinstance(found, dict):
        raise NotReached(f"{address} gave no answer of OSV's protocol")
    return found


def scan(profile: str, source: str) -> int:
    """Compare the locked versions with the advisories of a database, and say what came of it; the exit status."""
    components = components_of(profile)
    try:
        found = advisories_on(components, source)
    except NotReached as error:
        print(f"NOT COMPARED: {error}.", file=sys.stderr)
        print(f"Nothing is known of the {len(components)} packages of the profile {profile}.", file=sys.stderr)
        return NOT_COMPARED
    for one, ids in found.items():
        print(f"{one.name} {one.version}: {', '.join(sorted(set(ids)))}")
    print(f"{len(components)} packages of the profile {profile} were compared with {source}: {len(found)} are named.")
    return FOUND if found else 0


def main() -> int:
    parser = argparse.ArgumentParser(description="The parts of the project by its lock files.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("sbom", "advisories"):
        command = commands.add_parser(name)
        command.add_argument("profile", nargs="?", choices=PROFILES, default="service")
        if name == "advisories":
            command.add_argument("--source", default=SOURCE, help="a database that speaks OSV's protocol")
    options = parser.parse_args()
    if options.command == "advisories":
        return scan(options.profile, options.source)
    json.dump(bill_of(options.profile), sys.stdout, indent=2)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
