"""A question to a map, and the encoded frame that it is about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

from core.frames.framing import Framing
from core.geometry.keypoints import Keypoints
from core.maps import Selection
from core.method.encoder import Encoding

Verify = Literal["auto", "always", "never"]
"""When a query's candidates are verified; ``auto``: where the scores leave doubt."""


@dataclass(frozen=True)
class Question:
    """A question to a map about a frame.

    k: how many matches to list.
    selection: the prior knowledge of the place; None: nothing.
    verify: when the geometry of the best candidates is verified.
    camera: the name of the map's camera that took the frame, whose mask is applied and whose intrinsics give the pose;
        None: not known.
    """

    k: int = 5
    selection: Selection | None = None
    verify: Verify = "auto"
    camera: str | None = None


class Reframing(Protocol):
    """Makes the query of a frame as it is in another framing (``core.recognition.framings``)."""

    def size(self) -> tuple[int, int]:
        """Width and height of the frame, in pixels."""

    def __call__(self, query: Query, framing: Framing) -> Query | None:
        """The query in a framing; None if it shows too little then."""


@dataclass(frozen=True)
class Query:
    """An encoded frame, and the question about it.

    encoding: with at least one region, by the map's encoder.
    find_keypoints: finds the keypoints of the frame; None: there is no frame any more, and nothing is verified.
    reframing: makes the query of the frame in another framing; None: it is compared as it is.
    """

    encoding: Encoding
    question: Question = field(default_factory=Question)
    find_keypoints: Callable[[], Keypoints] | None = None
    reframing: Reframing | None = None

    @cached_property
    def verifier(self) -> Verifier | None:
        """When to verify the query; None: never."""
        if self.find_keypoints is None or self.question.verify == "never":
            return None
        return Verifier(self.question.verify, self.find_keypoints, self.question.camera)


class Verifier:
    """When to verify a query, and its keypoints, which are found when they are first needed.

    Args:
        when: see :data:`Verify`.
        find: finds the keypoints of the query's frame.
        camera: the name of the map's camera that took it, whose intrinsics give the pose; None: not known.
    """

    def __init__(self, when: Verify, find: Callable[[], Keypoints], camera: str | None = None) -> None:
        self.when, self.camera = when, camera
        self._find = find

    @cached_property
    def keypoints(self) -> Keypoints:
        """The keypoints of the query's frame."""
        return self._find()
