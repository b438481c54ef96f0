"""The form reader, whatever the chunks in which a form arrives."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors.faults import BodyTooLarge, MalformedBody
from service.http.multipart import FormPart, FormReader

BOUNDARY = "seam"
TYPE = f'multipart/form-data; boundary="{BOUNDARY}"'


def form(*parts: tuple[str, bytes]) -> bytes:
    """Headers (one line each, joined by a semicolon-free newline) and contents, as a form."""
    pieces = [b"--%s\r\n%s\r\n\r\n%s\r\n" % (BOUNDARY.encode(), head.encode(), data) for head, data in parts]
    return b"".join(pieces) + b"--%s--\r\n" % BOUNDARY.encode()


def read(body: bytes, size: int = 1 << 16, max_parts: int = 8, max_part_bytes: int = 1000) -> list[FormPart]:
    reader = FormReader(TYPE, max_parts, max_part_bytes)
    for start in range(0, len(body), size):
        reader.feed(body[start : start + size])
    return reader.close()


def disposition(name: str, filename: str | None = None) -> str:
    return f'Content-Disposition: form-data; name="{name}"' + (f'; filename="{filename}"' if filename else "")


@given(
    contents=st.lists(
        st.one_of(st.binary(max_size=200), st.sampled_from([b"\r\n--sea", b"--seam", b"\r\n", b"\r\n--seam-"])),
        max_size=5,
    ),
    size=st.integers(1, 64),
)
def test_any_chunking_gives_the_same_parts(contents: list[bytes], size: int) -> None:
    # What holds the whole separator cannot be sent under it.
    contents = [data for data in contents if b"\r\n--seam" not in b"\r\n" + data]
    body = form(*((disposition(f"part{i}"), data) for i, data in enumerate(contents)))
    parts = read(body, size)
    assert [(part.name, part.data) for part in parts] == [(f"part{i}", data) for i, data in enumerate(contents)]


def test_headers_of_a_part() -> None:
    head = disposition("bild", "flur 7 – süd.jpg") + "\r\nContent-Type: Image/JPEG; x=y\r\nX-Other: 1"
    (part,) = read(form((head, b"data")))
    assert part == FormPart("bild", "flur 7 – süd.jpg", "image/jpeg", b"data", False)


def test_a_part_over_the_limit_is_marked_and_not_kept() -> None:
    parts = read(form((disposition("a"), b"x" * 5000), (disposition("b"), b"y" * 1000)), size=100)
    assert [(part.oversized, len(part.data)) for part in parts] == [(True, 0), (False, 1000)]


def test_too_many_parts() -> None:
    body = form(*((disposition(f"p{i}"), b"") for i in range(9)))
    with pytest.raises(BodyTooLarge, match="more than 8 parts"):
        read(body)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"not a form",
        form((disposition("a"), b"data"))[:-6],
        form((disposition("a"), b"data"))[:30],
        form(("X-Nothing: 1", b"data")),
        form((disposition(""), b"data")),
        form((disposition("a") + "\r\nX-Long: " + "y" * 10_000, b"")),
        b"--seam\r\n" + b'Content-Disposition: form-data; name="\xff\xfe"\r\n\r\nx\r\n--seam--\r\n',
    ],
)
def test_what_is_no_form(body: bytes) -> None:
    with pytest.raises(MalformedBody):
        read(body)


@pytest.mark.parametrize("content_type", ["multipart/form-data", "multipart/form-data; boundary=" + "b" * 300])
def test_a_boundary_is_needed(content_type: str) -> None:
    with pytest.raises(MalformedBody):
        FormReader(content_type, 1, 1)


@pytest.mark.parametrize("head", ["X-Long: " + "x" * 20_000, "\r\n".join(f"X-{n}: 1" for n in range(40)), "x" * 9_000])
def test_the_headers_of_a_part_are_bounded(head: str) -> None:
    with pytest.raises(MalformedBody, match=r"[Hh]eader"):
        read(form((f"{disposition('a')}\r\n{head}", b"data")), size=1000)
    with pytest.raises(MalformedBody):
        FormReader(TYPE, 8, 1000).feed(f"--{BOUNDARY}\r\nX-Endless: ".encode() + b"x" * 1_000_000)
