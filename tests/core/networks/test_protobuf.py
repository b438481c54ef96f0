"""The protobuf wire format, held to the examples of its documentation and to what must not happen."""

from __future__ import annotations

import time
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.errors import InvalidModel
from core.networks.protobuf import MAX_FIELDS, Message


def message(content: bytes) -> Message:
    return Message(memoryview(content))


def test_the_examples_of_the_documentation() -> None:
    assert message(b"\x08\x96\x01").integers(1) == [150]
    assert message(b"\x12\x07testing").text(2) == "testing"
    assert message(b"\x1a\x03\x08\x96\x01").message(3).integer(1) == 150
    assert message(b"\x32\x06\x03\x8e\x02\x9e\xa7\x05").integers(6) == [3, 270, 86942]
    assert message(b"\x08" + b"\xfe" + b"\xff" * 8 + b"\x01").integer(1) == 2**64 - 2


def test_absent_fields() -> None:
    empty = Message()
    assert 1 not in empty
    assert empty.integers(1) == []
    assert empty.integer(1, 7) == 7
    assert empty.float(1, 0.5) == 0.5
    assert empty.text(1) == ""
    assert empty.messages(1) == []
    assert 1 not in empty.message(1)
    assert len(empty.floats(1)) == len(empty.doubles(1)) == 0


def test_the_last_value_of_a_single_field_counts_and_messages_in_parts_are_one() -> None:
    assert message(b"\x08\x01\x08\x02").integer(1) == 2
    assert message(b"\x0a\x01a\x0a\x01b").text(1) == "b"
    parts = message(b"\x0a\x02\x08\x01\x0a\x02\x10\x05").message(1)
    assert (parts.integer(1), parts.integer(2)) == (1, 5)


VALUES = np.random.default_rng(0).standard_normal(1000)


@pytest.mark.parametrize(("kind", "dtype"), [(5, np.float32), (1, np.float64)])
@pytest.mark.parametrize("number", [1, 15, 16, 3000])
@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 9, 1000])
def test_packed_and_unpacked_numbers_are_the_same(kind: int, dtype: Any, number: int, count: int) -> None:
    values = VALUES[:count].astype(dtype)

    def tag(wire: int) -> bytes:
        whole = number << 3 | wire
        groups = [whole >> shift & 0x7F for shift in range(0, max(whole.bit_length(), 1), 7)]
        return bytes([group | 0x80 for group in groups[:-1]] + groups[-1:])

    size = values.nbytes
    length = bytes([size]) if size < 128 else bytes([size & 0x7F | 0x80, size >> 7])
    packed = tag(2) + length + values.tobytes()
    unpacked = b"".join(tag(kind) + value.tobytes() for value in values)
    other = b"\xf8\xff\x01\x05"  # field 4095, a whole number
    for content in (packed, unpacked, unpacked + other, other + packed + unpacked):
        read = message(content)
        found = read.floats(number) if dtype is np.float32 else read.doubles(number)
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, np.tile(values, 2) if content.startswith(other) else values)


@pytest.mark.parametrize(
    "content",
    [
        b"\x08",  # a number that does not come
        b"\x08" + b"\xff" * 11,  # one that does not end
        b"\x0a\x05abc",  # text that is cut
        b"\x0a\xff\xff\xff\xff\x7f",  # text of 32 GB
        b"\x0d\0\0",  # a float that is cut
        b"\x0b\x0c",  # a group
        b"\x0f",  # wire type 7
        b"\0\0",  # field 0
    ],
)
def test_damaged_messages_are_refused(content: bytes) -> None:
    with pytest.raises(InvalidModel):
        message(content)


def test_values_of_another_kind_are_refused() -> None:
    for read in (message(b"\x08\x01").text, message(b"\x0d\0\0\x80\x3f").integers, message(b"\x0a\x01\xff").text):
        with pytest.raises(InvalidModel):
            read(1)
    for content in (b"\x0a\x03abc", b"\x08\x01", b"\x09" + bytes(8)):
        with pytest.raises(InvalidModel):
            message(content).floats(1)


@pytest.mark.parametrize(
    "content", [b"\x08\x01" * 2_000_000, (b"\x0d" + bytes(4) + b"\x15" + bytes(4)) * 500_000, b"\x0a\0" * 2_000_000]
)
def test_a_message_of_millions_of_fields_is_refused_soon(content: bytes) -> None:
    assert len(content) // 5 > MAX_FIELDS
    began = time.process_time()
    with pytest.raises(InvalidModel, match="fields"):
        message(content)
    assert time.process_time() - began < 5


def test_millions_of_unpacked_numbers_take_little_more_memory_than_they_are() -> None:
    content = (b"\x2d" + bytes(4)) * 2_000_000
    tracemalloc.start()
    found = message(content).floats(5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found) == 2_000_000
    assert peak < 40_000_000


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused_or_read(content: bytes) -> None:
    try:
        read = message(content)
        for number in range(1, 32):
            read.integers(number)
    except InvalidModel:
        return
    assert isinstance(read, Message)
