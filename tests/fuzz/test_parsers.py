"""Whatever the bytes of a file or a header, a parser returns a value or raises its own error, and does not hang."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from core.errors import InvalidArchive, InvalidCursor, InvalidImage, InvalidModel, PlacerecError
from core.frames.containers import find_exif
from core.frames.exif import read_orientation, read_pose_and_time
from core.frames.images import decode
from core.maps.archives.manifest import read_manifest
from core.maps.archives.tar_layout import manifest_size
from core.maps.pagination import decode_name, decode_number, encode_cursor
from core.method.catalogue import load_encoder
from core.networks.network import load_network, read_definition
from lab.conversion.checkpoints import read_checkpoint
from service.errors.faults import Fault
from service.http.multipart import FormReader
from service.http.schemas import validated
from service.places.filters import parsed_json
from service.places.parameters import EnrolParameters
from service.queries.parameters import FilterParameters, parse_box
from service.telemetry.requests import read_trace
from tests.fuzz.encoder import NETWORK, SMALL, install_small_encoder

FEW = settings(max_examples=60, deadline=10_000, derandomize=True)


@st.composite
def damaged(draw: st.DrawFn, sound: bytes) -> bytes:
    """A sound file with bytes changed, taken out, put in, or its end cut off."""
    data = bytearray(sound)
    for _ in range(draw(st.integers(1, 5))):
        # Most of what a parser decides on stands at the start and at the end.
        near = st.integers(0, min(len(data), 400)) | st.integers(max(0, len(data) - 300), len(data))
        at = draw(near | st.integers(0, len(data)))
        match draw(st.sampled_from(["change", "change", "cut", "insert", "truncate", "extreme"])):
            case "change":
                data[at : at + 1] = draw(st.binary(min_size=1, max_size=2))
            case "cut":
                del data[at : at + draw(st.integers(1, 40))]
            case "insert":
                data[at:at] = draw(st.binary(min_size=1, max_size=12))
            case "truncate":
                del data[at:]
            case _:
                data[at : at + 8] = draw(st.sampled_from([b"\xff" * 8, b"\0" * 8, b"\x7f" + b"\xff" * 7, b"\x80" * 4]))
    return bytes(data)


def test_damaged_checkpoints_are_read_or_refused(tmp_path: Path) -> None:
    save_file({"conv.weight": torch.arange(24.0).reshape(2, 3, 2, 2), "conv.bias": torch.zeros(2)}, tmp_path / "sound")
    sound = (tmp_path / "sound").read_bytes()
    assert read_checkpoint(tmp_path / "sound")

    @FEW
    @given(damaged(sound))
    def check(data: bytes) -> None:
        path = tmp_path / "damaged"
        path.write_bytes(data)
        try:
            read_checkpoint(path)
        except InvalidModel as error:
            assert str(error)

    check()


def test_damaged_models_are_refused_or_are_themselves() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        install_small_encoder(folder)
        network, encoder = folder / f"{SMALL}.network.safetensors", folder / f"{SMALL}.encoder.safetensors"
        sound = {path: path.read_bytes() for path in (network, encoder)}

        @FEW
        @given(st.sampled_from([network, encoder]).flatmap(lambda path: st.tuples(st.just(path), damaged(sound[path]))))
        def check(given_: tuple[Path, bytes]) -> None:
            path, data = given_
            for each, content in sound.items():
                each.write_bytes(data if each == path else content)
            try:
                assert read_definition(network).name
                load_network(network, ("conv1",))
                load_encoder(encoder, network)
            except InvalidModel as error:
                assert str(error)

        check()
        assert NETWORK.name == SMALL


NESTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@FEW
@given(st.text(max_size=80) | st.binary(max_size=80).map(lambda raw: raw.decode("latin-1")), st.data())
def test_cursors(text: str, data: st.DataObject) -> None:
    sound = encode_cursor(["places", "lab", None], 7)
    for cursor in (text, data.draw(damaged(sound.encode())).decode("latin-1"), "[" * 3000, "W" * 2000):
        for read in (decode_number, decode_name):
            try:
                read(["places", "lab", None], cursor)
            except InvalidCursor as error:
                assert str(error)


@FEW
@given(damaged(b"00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01") | st.binary(max_size=300))
def test_traces(value: bytes) -> None:
    found = read_trace([(b"traceparent", value)])
    assert found is None or (len(found.trace_id) == 32 and len(found.response) == 55)


TURNED = bytes.fromhex("49492a0008000000020012010300010000000600000025880400010000001a000000") + bytes(60)


@FEW
@given(damaged(TURNED))
def test_exif_blocks(block: bytes) -> None:
    assert 1 <= read_orientation(block) <= 8
    read_pose_and_time(b"\xff\xd8\xff\xe1" + (len(block) + 8).to_bytes(2, "big") + b"Exif\0\0" + block + b"\xff\xd9")


@FEW
@given(st.binary(max_size=300))
def test_image_bytes(data: bytes) -> None:
    find_exif(data)
    with pytest.raises(InvalidImage):
        decode(data)


@FEW
@given(st.binary(max_size=600) | damaged(b'{"format": "placerec-map", "version": 1, "parts": []}'))
def test_manifests_and_tapes(text: bytes) -> None:
    for read in (read_manifest, lambda text: manifest_size(text.ljust(512, b"\0"))):
        try:
            read(text)
        except PlacerecError as error:
            assert isinstance(error, InvalidArchive) or type(error).__name__ == "ArchiveTooNew"


@FEW
@given(st.dictionaries(st.sampled_from([*FilterParameters.model_fields]), NESTED, max_size=6), st.text(max_size=40))
def test_parameters_and_filters(given_: dict[str, Any], text: str) -> None:
    def filtered() -> object:
        found = validated(FilterParameters, given_)
        return found.position(), found.selection()

    reads: list[Callable[[], object]] = [
        filtered,
        lambda: validated(EnrolParameters, given_),
        lambda: parse_box(text),
        lambda: parsed_json(text, "it"),
    ]
    for read in reads:
        try:
            read()
        except (Fault, PlacerecError) as error:
            assert str(error)


FORM = (
    b'--b\r\nContent-Disposition: form-data; name="a"; filename="x"\r\nContent-Type: image/png\r\n\r\nxyz\r\n--b--\r\n'
)


@FEW
@given(damaged(FORM), st.text(st.characters(max_codepoint=255), max_size=30), st.integers(1, 50))
def test_forms(body: bytes, boundary: str, size: int) -> None:
    for kind in ("multipart/form-data; boundary=b", f"multipart/form-data; boundary={boundary}"):
        try:
            reader = FormReader(kind, 4, 100)
            for start in range(0, len(body), size):
                reader.feed(body[start : start + size])
            assert len(reader.close()) <= 4
        except Fault as error:
            assert str(error)
