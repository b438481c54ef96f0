"""Compare two images that were written as folders (``buildah push IMAGE dir:FOLDER``), layer by layer.

    python3 scripts/layers.py FOLDER OTHER

Prints the size of each layer and the files that differ.  Caches that numba and Python compile (``.nbi``, ``.nbc``,
``.pyc``) are counted, and are no difference.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tarfile
from pathlib import Path

CACHES = (".nbi", ".nbc", ".pyc")
MOST_SHOWN = 20


def layers_of(folder: Path) -> list[Path]:
    """The files of an image's layers, from the lowest on.

    Raises:
        OSError, KeyError, ValueError: it is no image.
    """
    manifest = json.loads((folder / "manifest.json").read_text())
    return [folder / layer["digest"].partition(":")[2] for layer in manifest["layers"]]


def entries_of(layer: Path) -> dict[str, tuple[object, ...]]:
    """The entries of a layer by path: kind, rights, owner, time, target, size, and the hash of the content."""
    found: dict[str, tuple[object, ...]] = {}
    with tarfile.open(layer) as archive:
        for member in archive:
            content = archive.extractfile(member) if member.isreg() else None
            digest = hashlib.sha256(content.read()).hexdigest() if content is not None else ""
            about = (member.type, member.mode, member.uid, member.gid, member.mtime, member.linkname, member.size)
            found[member.name] = (*about, digest)
    return found


def differences(one: Path, other: Path) -> list[str]:
    """The paths under which two layers have something else, or only one has anything."""
    if one.name == other.name:
        return []
    ours, theirs = entries_of(one), entries_of(other)
    return sorted(path for path in ours.keys() | theirs.keys() if ours.get(path) != theirs.get(path))


def compare(one: Path, other: Path) -> int:
    """Print what differs; 1 if anything but a cache does."""
    pairs = list(zip(layers_of(one), layers_of(other), strict=False))
    unlike = len(layers_of(one)) != len(layers_of(other))
    if unlike:
        print("The images have different numbers of layers.")
    total = 0
    for number, (ours, theirs) in enumerate(pairs):
        size = ours.stat().st_size
        total += size
        paths = differences(ours, theirs)
        cached = [path for path in paths if path.endswith(CACHES)]
        rest = [path for path in paths if not path.endswith(CACHES)]
        said = "alike" if ours.name == theirs.name else f"{len(rest)} files differ, and {len(cached)} caches"
        print(f"layer {number}, {size / 1e6:.1f} MB: {said}")
        for path in rest[:MOST_SHOWN]:
            print(f"    {path}")
        unlike |= bool(rest)
    print(f"{total / 1e9:.3f} GB in all")
    return int(unlike)


if __name__ == "__main__":
    sys.exit(compare(Path(sys.argv[1]), Path(sys.argv[2])))
