"""A caller's knowledge of the place that a query shows: filters and priors.  A store says which places they leave."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

from core.judgement.priors import Constraint, Disc, GeographicBox, OnLevels
from core.maps.place_filter import Scalar
from core.places import PoseKind, check_coordinates, level_code

TRUST = 0.9
"""The probability that a prior is right, if the caller states none."""


@dataclass(frozen=True)
class RecentFrames:
    """The robot's own last frames, which a query leaves out.

    sequence: the sequence to which the robot adds its frames.
    frames: the number of last places of the sequence that are left out.
    moment: the time of the query, microseconds since 1970 UTC.
    seconds: places of the sequence less than this time from ``moment`` are left out.
    """

    sequence: str
    frames: int = 0
    moment: int | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Conditions:
    """Conditions on a place; all of them have to hold.

    geometry: conditions on pose and time.
    sequences: the place belongs to one of these; None: to any.
    metadata: the place's metadata has these values.
    """

    geometry: tuple[Constraint, ...] = ()
    sequences: tuple[str, ...] | None = None
    metadata: Mapping[str, Scalar] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.geometry or self.sequences is not None or self.metadata)


@dataclass(frozen=True)
class Selection:
    """The known facts about the place that a query shows.

    filters: conditions that have to hold; other places are not searched.
    prior: conditions that hold with the probability ``trust``; other places lose odds.
    recent: the robot's own last frames, which are left out.
    excluded: the id of a place that is left out.
    """

    filters: Conditions = Conditions()
    prior: Conditions = Conditions()
    trust: float = TRUST
    recent: RecentFrames | None = None
    excluded: str | None = None

    def __bool__(self) -> bool:
        return bool(self.filters or self.prior or self.recent or self.excluded)

    def at_level(self, level: str) -> Selection:
        """The same with the statement that the query shows a place on a storey, as a prior."""
        on = OnLevels((level_code(level),))
        return replace(self, prior=replace(self.prior, geometry=(*self.prior.geometry, on)))

    def check_coordinates(self, known: Callable[[PoseKind], Collection[PoseKind]]) -> None:
        """Check that areas are given in coordinates that the places of a map have.

        Args:
            known: the kinds of their poses, of which it has to tell a given one.

        Raises:
            MixedCoordinates: an area is given in the other kind.
        """
        for constraint in (*self.filters.geometry, *self.prior.geometry):
            if isinstance(constraint, Disc | GeographicBox):
                kind = constraint.centre.kind() if isinstance(constraint, Disc) else "geographic"
                check_coordinates(known(kind), kind, "The area of the query")
