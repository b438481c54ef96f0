"""The manifest of an export file: its first part, by which all others are checked.

The file is a plain tar (ustar).  Its members, in this order:

    manifest.json               format, version, the map's record, and size and SHA-256 of each part
    manifest.sha256             its SHA-256, as sha256sum writes it
    sequences.jsonl             a line per sequence: its name and the ordinal that its next place gets
    cameras.jsonl               a line per camera, with its mask
    labels.jsonl                a line per labelled frame of the review; this and the next part are left out without any
    labels.bin                  the files of these frames
    places-000001.jsonl         a line per place, in the order of enrolment
    descriptors-000001.bin      of the same places: descriptor and local descriptors as the map stores them,
                                without anything between them
    pictures-000001.bin         of the same places: the stored pictures of their frames
    keypoints-000001.bin        of the same places: the records of their keypoints (:mod:`core.geometry.keypoints`)
    places-000002.jsonl …       and so on

The bytes of a file follow from its manifest and its parts, so the SHA-256 of the manifest identifies the whole file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError

from core.errors import ArchiveTooNew, InvalidArchive, InvalidIdentifier
from core.judgement.probability import Curve
from core.judgement.verdict import Calibration
from core.maps.records import MapRecord, validation_message
from core.names import TEXT
from core.places import check_map_id

FORMAT = "placerec map"
VERSION = 3
WITHOUT_LABELS = 2
"""The version of a file without labelled frames, which earlier versions of placerec read as well."""

MANIFEST, SEAL = "manifest.json", "manifest.sha256"
SEQUENCES, CAMERAS = "sequences.jsonl", "cameras.jsonl"
LABELS, LABELLED = "labels.jsonl", "labels.bin"
GROUP_KINDS = (("places", "jsonl"), ("descriptors", "bin"), ("pictures", "bin"), ("keypoints", "bin"))
"""The parts of a group."""

MOST_MANIFEST_BYTES = 8 << 20
"""A part takes some 165 bytes, so this is enough for 12 million places or 3 TB of pictures."""

MOST_PART_BYTES = 8 << 30
"""The size of a part is less than this, so that a tar header can hold it."""

Count = Annotated[int, Field(ge=0, strict=True)]


class ArchivePart(BaseModel):
    """One part of the file.  rows: how many lines it has, or of how many places it holds descriptors or pictures."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    rows: Count
    bytes: Annotated[int, Field(ge=0, lt=MOST_PART_BYTES, strict=True)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class ArchivedRecord(MapRecord):
    """A map's record in an export file; unknown fields are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    encoder: Annotated[str, Field(pattern=f"^{TEXT}$", max_length=1024)]
    dimension: Annotated[int, Field(gt=0, le=1 << 24, strict=True)]
    local_cells: Annotated[int, Field(ge=0, le=1 << 20, strict=True)] = 0
    local_values: Annotated[int, Field(ge=0, le=1 << 16, strict=True)] = 0
    revision: Annotated[int, Field(ge=1, le=2**62, strict=True)]


class Manifest(BaseModel):
    """The content of the manifest."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: str
    version: int
    map: ArchivedRecord
    places: Count
    parts: Annotated[list[ArchivePart], FailFast()]

    @property
    def labels(self) -> Sequence[ArchivePart]:
        """The lines and the files of labelled frames; none where there are no such frames."""
        return self.parts[2:4] if self.version > WITHOUT_LABELS else []

    @property
    def groups(self) -> int:
        """How many groups of places, descriptors, pictures and keypoints there are."""
        return (len(self.parts) - 2 - len(self.labels)) // len(GROUP_KINDS)

    def group(self, number: int) -> Sequence[ArchivePart]:
        """Places, descriptors, pictures and keypoints of group ``number``, counted from 0."""
        first = 2 + len(self.labels) + number * len(GROUP_KINDS)
        return self.parts[first : first + len(GROUP_KINDS)]


def group_names(number: int) -> list[str]:
    """The names of the parts of group ``number``, counted from 0."""
    return [f"{kind}-{number + 1:06d}.{suffix}" for kind, suffix in GROUP_KINDS]


def written(manifest: Manifest) -> bytes:
    """The manifest as bytes; equal manifests are always the same bytes."""
    content = manifest.model_dump(mode="json", exclude={"map": {"review"}} if manifest.map.review is None else None)
    return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()


def tag_of(text: bytes) -> str:
    """The tag of a file: the SHA-256 of its manifest's bytes in hexadecimal."""
    return hashlib.sha256(text).hexdigest()


def seal_of(text: bytes) -> bytes:
    """The content of manifest.sha256, which follows the manifest."""
    return f"{tag_of(text)}  {MANIFEST}\n".encode()


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a number of JSON")


def _no_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) != len(pairs):
        raise ValueError("an object has the same name twice")
    return made


def strict_json(text: bytes, what: str) -> Any:
    """Parse JSON strictly: no NaN or infinity, and no name twice in an object.

    Raises:
        InvalidArchive.
    """
    try:
        return json.loads(text.decode("utf-8"), parse_constant=_no_constant, object_pairs_hook=_no_repeats)
    except RecursionError:
        raise InvalidArchive(f"{what} is nested too deeply.") from None
    except ValueError as error:
        raise InvalidArchive(f"{what} is not JSON in UTF-8: {str(error)[:200]}.") from None


def expect_names(value: Any, kind: type[BaseModel], what: str) -> None:
    """Refuse an object with a field that ``kind`` does not have, before pydantic makes an error of each.

    Raises:
        InvalidArchive: it has one; the text names it.
    """
    if isinstance(value, dict):
        for name in value:
            if name not in kind.model_fields:
                raise InvalidArchive(f"{what}: there is no field {name[:80]!r}.")


def _expect_few(text: bytes) -> None:
    """Refuse a text with more values than a manifest can have; parsed, each takes many times the memory of its text."""
    if sum(map(text.count, (b"{", b"[", b","))) > 8192 + len(text) // 16:
        raise InvalidArchive(f"{MANIFEST} lists more than the parts of a map.")


def read_manifest(text: bytes) -> Manifest:
    """Read the manifest of a file.

    Raises:
        ArchiveTooNew: a later version of placerec wrote the file.
        InvalidArchive: it is not a manifest of placerec, its content is invalid, or it was written before the first
            release.
    """
    _expect_few(text)
    value = strict_json(text, MANIFEST)
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise InvalidArchive(f"{MANIFEST} is not that of a map of placerec.")
    version = value.get("version")
    if type(version) is not int or version < 1:
        raise InvalidArchive(f"{MANIFEST} names no version.")
    if version > VERSION:
        raise ArchiveTooNew(
            f"The file was written by a later version of placerec (format {version}, this one knows {VERSION})."
        )
    if version < WITHOUT_LABELS:
        raise InvalidArchive(
            f"The file was written before the first release of placerec (format {version}, this one knows {VERSION}): "
            "enrol its frames again."
        )
    inner: Any = value
    for name, kind in (("map", ArchivedRecord), ("calibration", Calibration), ("curve", Curve)):
        inner = inner.get(name) if isinstance(inner, dict) else None
        expect_names(inner, kind, f"{MANIFEST}: {name}")
    expect_names(value, Manifest, MANIFEST)
    parts = value.get("parts")
    for part in parts if isinstance(parts, list) else ():
        expect_names(part, ArchivePart, f"{MANIFEST}: parts")
    try:
        manifest = Manifest.model_validate(value)
    except (ValidationError, RecursionError) as error:
        why = validation_message(error) if isinstance(error, ValueError) else "it is nested too deeply"
        raise InvalidArchive(f"{MANIFEST}: {why[:400]}.") from None
    try:
        check_map_id(manifest.map.id)
    except InvalidIdentifier as error:
        raise InvalidArchive(f"{MANIFEST}: {error}") from None
    names = [SEQUENCES, CAMERAS, *([LABELS, LABELLED] if version > WITHOUT_LABELS else [])]
    for number in range(max(0, manifest.groups)):
        names += group_names(number)
    if [part.name for part in manifest.parts] != names:
        raise InvalidArchive(f"{MANIFEST}: the parts are not those of a map, in their order.")
    if len({part.rows for part in manifest.labels}) > 1:
        raise InvalidArchive(f"{MANIFEST}: {LABELS} and {LABELLED} differ in the number of frames.")
    for number in range(manifest.groups):
        if len({part.rows for part in manifest.group(number)}) != 1:
            raise InvalidArchive(f"{MANIFEST}: the parts of group {number + 1} differ in the number of places.")
    if sum(part.rows for part in manifest.parts if part.name.startswith("places-")) != manifest.places:
        raise InvalidArchive(f"{MANIFEST}: the parts hold another number of places than it names.")
    return manifest
