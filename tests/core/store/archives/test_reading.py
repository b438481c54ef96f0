"""Files that are no exports, are not whole any more, or were made to do harm: refused by name, nothing written."""

from __future__ import annotations

import gzip
import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from core.errors import ArchiveTooNew, InvalidArchive
from core.maps.archives.lines import CameraLine, PlaceLine, read_line
from core.maps.archives.manifest import MOST_MANIFEST_BYTES, VERSION, group_names, read_manifest
from core.maps.archives.reading import Archive, check
from core.maps.archives.tar_layout import BLOCK, header
from tests.core.store.archives.files import Parts, grown, named, parts_of, sealed, taped

Made = Callable[[bytes], bytes]
PLACES = "places-000001.jsonl"


def in_place_of(part: str, **fields: Any) -> Made:
    """Another header for a member, of the same length or not."""

    def make(content: bytes) -> bytes:
        at = content.index(part.encode() + b"\0")
        size = int(content[at + 124 : at + 135], 8)
        info = tarfile.TarInfo(part)
        info.size, info.mode = size, 0o644
        for field, value in fields.items():
            setattr(info, field, value)
        block = info.tobuf(tarfile.GNU_FORMAT)
        assert len(block) == BLOCK
        return content[:at] + block + content[at + BLOCK :]

    return make


def before(name: str, inserted: bytes) -> Made:
    """More members before one."""

    def make(content: bytes) -> bytes:
        at = content.index(name.encode() + b"\0")
        return content[:at] + inserted + content[at:]

    return make


def special(name: str, kind: bytes, data: bytes = b"") -> bytes:
    info = tarfile.TarInfo(name)
    info.type, info.size = kind, len(data)
    return info.tobuf(tarfile.USTAR_FORMAT) + data.ljust(-(-len(data) // BLOCK) * BLOCK, b"\0")


def manifest_with(**values: Any) -> Made:
    """Other values at the top of the manifest, sealed."""

    def make(content: bytes) -> bytes:
        manifest, parts = parts_of(content)
        return named(json.dumps({**manifest, **values}).encode(), parts)

    return make


def map_with(**values: Any) -> Made:
    def make(content: bytes) -> bytes:
        manifest, parts = parts_of(content)
        return sealed({**manifest, "map": {**manifest["map"], **values}}, parts)

    return make


def part_with(number: int, **values: Any) -> Made:
    def make(content: bytes) -> bytes:
        manifest, parts = parts_of(content)
        manifest["parts"][number] |= values
        return named(json.dumps(manifest).encode(), parts)

    return make


def text(manifest: bytes) -> Made:
    return lambda content: named(manifest, parts_of(content)[1])


def members(change: Callable[[Parts], Any]) -> Made:
    """Other members under the same manifest."""

    def make(content: bytes) -> bytes:
        manifest, parts = parts_of(content)
        change(parts)
        return named((json.dumps(manifest, indent=1, ensure_ascii=False) + "\n").encode(), parts)

    return make


def repacked(content: bytes) -> bytes:
    """As a tar program of today writes it."""
    with tarfile.open(fileobj=io.BytesIO(content)) as old:
        out = io.BytesIO()
        with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as new:
            for member in old:
                member.mtime = 1.5  # which takes a pax header to say
                new.addfile(member, old.extractfile(member))
    return out.getvalue()


PAX = special("PaxHeaders/x", tarfile.XHDTYPE, b"17 path=../escape\n")
HOSTILE: dict[str, tuple[Made, str]] = {
    "nothing": (lambda _: b"", "ends within"),
    "a word": (lambda _: b"hello", "ends within"),
    "no tar": (lambda _: b"x" * 4096, "does not begin as a tar"),
    "zeros": (lambda _: bytes(8192), "does not begin as a tar"),
    "compressed": (gzip.compress, "does not begin as a tar"),
    "another tar": (lambda _: taped({"readme": b"hello"}), "must come first"),
    "a manifest alone": (lambda c: c[: c.index(b"manifest.sha256\0")], "ends within"),
    "a huge manifest": (lambda _: header("manifest.json", 1 << 32) + bytes(4096), "must come first"),
    "an endless manifest": (lambda _: header("manifest.json", 1 << 20) + b"{" * 4096, "ends within"),
    "repacked": (repacked, "must come first"),
    "cut": (lambda c: c[:-1000], "is cut"),
    "cut by a byte": (lambda c: c[:-1], "is cut"),
    "longer": (lambda c: c + bytes(512), "bytes after its end"),
    "a member more": (lambda c: c[:-1024] + header("more", 3) + b"abc".ljust(512, b"\0") + c[-1024:], "more members"),
    "a member twice": (members(lambda p: p.update({"twice": p[PLACES]})), "more members"),
    "a member less": (lambda c: members(lambda p: p.popitem())(c), "is cut"),
    "two exchanged": (members(lambda p: p.update({PLACES: p.pop(PLACES)})), f"in the place of {PLACES}"),
    "traversal": (in_place_of(PLACES, name="../../etc/passwd"), "in the place of .* is '../../etc/passwd'"),
    "absolute": (in_place_of(PLACES, name="/etc/passwd"), "in the place of .* is '/etc/passwd'"),
    "symbolic link": (in_place_of(PLACES, type=tarfile.SYMTYPE, linkname="/etc/passwd"), "not a plain file"),
    "hard link": (in_place_of(PLACES, type=tarfile.LNKTYPE, linkname="cameras.jsonl"), "not a plain file"),
    "device": (in_place_of(PLACES, type=tarfile.CHRTYPE), "not a plain file"),
    "pipe": (in_place_of(PLACES, type=tarfile.FIFOTYPE), "not a plain file"),
    "folder": (in_place_of(PLACES, type=tarfile.DIRTYPE), "not a plain file"),
    "sparse": (in_place_of(PLACES, type=tarfile.GNUTYPE_SPARSE), "(not a plain file|is damaged)"),
    "another length": (in_place_of(PLACES, size=1 << 40), "is not as it must be"),
    "another owner": (in_place_of(PLACES, uname="root", mode=0o4755), "is not as it must be"),
    "pax header": (before(PLACES, PAX), "more members"),
    "pax header for all": (before(PLACES, special("g", tarfile.XGLTYPE, b"12 size=9999\n")), "more members"),
    "long name": (before(PLACES, special("././@LongLink", tarfile.GNUTYPE_LONGNAME, b"/x")), "more members"),
    "no JSON": (text(b"{"), "is not JSON"),
    "no UTF-8": (text(b'{"format": "\xff"}'), "is not JSON in UTF-8"),
    "not a number": (text(b'{"format": "placerec map", "version": NaN}'), "is not a number of JSON"),
    "a name twice": (text(b'{"format": 1, "format": "placerec map"}'), "the same name twice"),
    "deep": (text(b"[" * 8_000), "nested too deeply"),
    "deeper": (text(b"[" * 200_000), "lists more than"),
    "another format": (manifest_with(format="tar"), "not that of a map"),
    "version as text": (manifest_with(version="1"), "names no version"),
    "version yes": (manifest_with(version=True), "names no version"),
    "version 0": (manifest_with(version=0), "names no version"),
    "a field more": (manifest_with(owner="me"), "owner"),
    "other places": (manifest_with(places=8), "another number of places"),
    "places as text": (manifest_with(places="9"), "places"),
    "no parts": (manifest_with(parts=[]), "not those of a map"),
    "a path as part": (part_with(2, name="../places-000001.jsonl"), "not those of a map"),
    "a part twice": (part_with(3, name=PLACES), "not those of a map"),
    "a bomb": (part_with(2, bytes=1 << 32), "is cut"),
    "a larger bomb": (part_with(2, bytes=1 << 50), "less than"),
    "negative": (part_with(2, bytes=-1), "greater than"),
    "rows that differ": (part_with(2, rows=8), "differ in the number"),
    "no digest": (part_with(2, sha256="0"), "sha256"),
    "another digest": (part_with(2, sha256="0" * 64), "does not match its SHA-256"),
    "id as path": (map_with(id="../lab"), "cannot name a map"),
    "id reserved": (map_with(id="import"), "cannot name a map"),
    "encoder with lines": (map_with(encoder="a\nb"), "encoder"),
    "endless descriptors": (map_with(dimension=1 << 60), "dimension"),
    "dimension as text": (map_with(dimension="16"), "dimension"),
    "no such precision": (map_with(precision="double"), "precision"),
    "a later revision": (map_with(revision=1 << 70), "revision"),
    "no date": (map_with(created_at="yesterday"), "created_at"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused(content: bytes, tmp_path: Path, case: str) -> None:
    make, complaint = HOSTILE[case]
    path = tmp_path / "sent.tar"
    path.write_bytes(make(content))
    with pytest.raises(InvalidArchive, match=complaint), Archive(path) as archive:
        check(archive)


def _manifest(**values: Any) -> bytes:
    return json.dumps({"format": "placerec map", "version": 1, **values}, separators=(",", ":")).encode()


def _names(count: int, digits: int = 1) -> dict[str, int]:
    return {f"{i:0{digits}}": 0 for i in range(count)}


GREEDY: dict[str, Callable[[], bytes]] = {
    "parts without anything": lambda: _manifest(parts=[{}] * (2 << 20)),
    "parts without anything, not too many": lambda: _manifest(parts=[{}] * 4000),
    "parts that are text": lambda: _manifest(parts=["x" * 60] * 60_000),
    "names of a part": lambda: _manifest(parts=[_names(100_000, 25)]),
    "names": lambda: _manifest(**_names(100_000, 25)),
    "names of a curve": lambda: _manifest(map={"calibration": {"curve": _names(100_000, 25)}}),
}
GREEDY_LINES: dict[str, Any] = {
    "names in a line": _names(80_000),
    "names of a pose": {"pose": _names(80_000)},
    "polygons": {"mask": {"polygons": [1] * 400_000}},
    "corners": {"mask": {"polygons": [[1] * 400_000]}},
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", [*GREEDY, *GREEDY_LINES])
def test_what_is_refused_takes_little_memory(case: str) -> None:
    """To name all that is wrong with each of these took hundreds of times the room of its text."""
    manifest = case in GREEDY
    text = GREEDY[case]() if manifest else json.dumps(GREEDY_LINES[case], separators=(",", ":")).encode()
    kind = CameraLine if "mask" in GREEDY_LINES.get(case, ()) else PlaceLine

    def work() -> None:
        with pytest.raises(InvalidArchive) as refused:
            if manifest:
                read_manifest(text)
            else:
                read_line(text, kind, "here")
        assert len(str(refused.value)) < 600

    assert grown(work) < 48 << 20


def test_a_manifest_as_long_as_they_come(content: bytes) -> None:
    """Of two million places: a sixth of what may be, and far from having more values than it may."""
    manifest, _ = parts_of(content)
    names = ["sequences.jsonl", "cameras.jsonl", *(name for group in range(2048) for name in group_names(group))]
    parts = [{"name": name, "rows": 1024, "bytes": 1 << 25, "sha256": "0" * 64} for name in names]
    written = json.dumps({**manifest, "places": 1024 * 2048, "parts": parts}, indent=1).encode()
    assert len(written) <= MOST_MANIFEST_BYTES // 6
    assert read_manifest(written).groups == 2048


def test_a_later_version_is_distinguished_from_damage(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "sent.tar"
    path.write_bytes(manifest_with(version=VERSION + 1, novel={"field": 1})(content))
    with pytest.raises(ArchiveTooNew, match=f"format {VERSION + 1}, this one knows {VERSION}"), Archive(path):
        pass


def test_an_older_version_is_refused_with_what_to_do(content: bytes, tmp_path: Path) -> None:
    manifest, _ = parts_of(content)
    parts = [part for part in manifest["parts"] if not part["name"].startswith("keypoints-")]
    path = tmp_path / "sent.tar"
    path.write_bytes(manifest_with(version=1, parts=parts)(content))
    with pytest.raises(InvalidArchive) as error, Archive(path):
        pass
    assert str(error.value) == (
        "The file was written before the first release of placerec (format 1, this one knows 3): enrol its frames "
        "again."
    )


def test_what_people_make_by_hand_is_good_if_it_is_right(content: bytes, tmp_path: Path) -> None:
    """The cases above are refused for what is wrong with them, not for how they were made."""
    path = tmp_path / "sent.tar"
    for made in (content, sealed(*parts_of(content)), manifest_with()(content), members(lambda _: None)(content)):
        path.write_bytes(made)
        with Archive(path) as archive:
            check(archive)


@pytest.mark.thorough
def test_any_byte_that_is_changed_is_noticed(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "sent.tar"
    path.write_bytes(content)
    missed = []
    with path.open("r+b", buffering=0) as file:
        for at in range(0, len(content), 3):  # each region of the file: headers, zeros, every part, the end
            file.seek(at)
            file.write(bytes([content[at] ^ (1 << at % 8)]))
            try:
                with Archive(path) as archive:
                    check(archive)
                missed.append(at)
            except InvalidArchive:
                pass
            file.seek(at)
            file.write(content[at : at + 1])
    assert missed == []


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_what_is_cut_moved_or_overwritten_is_noticed(content: bytes, tmp_path: Path, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(content)))
    stop = data.draw(st.integers(start, min(len(content), start + 2000)))
    between = data.draw(st.binary(max_size=600) | st.just(content[:600]))
    made = content[:start] + between + content[stop:]
    path = tmp_path / "sent.tar"
    path.write_bytes(made)
    try:
        with Archive(path) as archive:
            check(archive)
    except InvalidArchive:
        assert made != content
    else:
        assert made == content
