"""What the files of bags have in common: their topics, where each message is, and its bytes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from core.recordings.messages import Coding

Key = tuple[int, ...]
"""Where a message is in its file; each kind of file has keys of its own."""

MOST_UNPACKED = 1 << 30
"""Bytes to which a chunk or a message is unpacked; more is not believed, since a few bytes can stand for any number."""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    kind: the type of its messages, as ROS 2 writes it.
    messages: how many there are.
    coding: how they are written; None if neither by ROS 1 nor by ROS 2.
    """

    kind: str
    messages: int
    coding: Coding | None


class Entry(NamedTuple):
    """A message: when it was received and taken, nanoseconds (0: not stamped), and where it is."""

    received: int
    stamp: int
    key: Key


class Storage(Protocol):
    """One file of a bag, opened.

    topics: by name, in the order of the file.
    problem: what is wrong with the file, in words, once it was read; None if it is whole.
    """

    topics: dict[str, Topic]
    problem: str | None

    def entries(self, topic: str) -> Iterator[Entry]:
        """The messages of a topic in the order of the file; those behind a damage are left out."""

    def read(self, key: Key) -> bytes:
        """The bytes of a message.

        Raises:
            OSError, InvalidRecording: they cannot be read any more.
        """

    def close(self) -> None:
        """Close the file."""
