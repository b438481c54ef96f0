"""The belief of a moving robot: a hidden Markov model over the places of a map, and whether the robot sees the map.

Given that the robot sees the map, its place follows the forward algorithm (Rabiner, A tutorial on hidden Markov
models, Proceedings of the IEEE 77(2), 1989, section III.A) in its scaled form, which is causal: a frame only changes
the belief about the present.  The robot may be carried to any place at any time (JUMP).  With a lag, the backward pass
over the later frames gives the place of the robot that many frames ago.

Whether the robot sees the map is a second chain of two states (LEAVING, RETURNING), which compares the likelihood of
each frame under the first chain with that of a frame from outside.  A robot whose view was blocked is therefore looked
for where it must have got to by then: its views meanwhile, however few, still count among the places.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from core.belief.evidence import Evidence
from core.belief.graph import PlaceGraph
from core.belief.motion import AcrossTraverses, Masses, Transition
from core.belief.speeds import TRACKED, UNKNOWN, Speeds, forward

START_UNKNOWN = 0.5
"""The probability before the first frame that the robot does not see the map."""

JUMP = 0.005
"""Probability, at each look, that the robot was carried to any place."""

CARRIED = 0.5
"""The same at a look before which the robot's clock or counter has jumped: it may only have been set, or the robot may
have been switched off and carried away, or a recording may be played again."""

LEAVING = 0.08
"""Probability, at each look, that a robot that saw the map no longer does.

These three and the strengths of evidence were chosen together on spliced runs of four stretches of nordland_tiny and of
the sequences of train/camvid (their queries cropped and changed in light): among those with which at least 95 % of the
kidnappings are noticed within three frames that say so, in the map and out of it, the ones with the fewest wrong places
on runs that are not spliced.  Rare events are likelier here than in a robot's life, because a frame is often worse
evidence than its scores say."""

RETURNING = 0.15
"""Probability, at each look, that a robot that did not see the map does again.  With twice as much, robots that stay
outside of a map of 56 places of corridor are believed in it in every fourth frame; corridor had that say in it."""

ALIKE = 1.02
"""Places with at most this times the floor are not moved one by one, as nearly all places have about as much."""

MANY = 1000
"""In maps with fewer places than this, every place is moved: it takes little time there, and the error would count."""

MOST_MOVED = 1024
"""In maps with at least this number of places, the likeliest are moved one by one."""

FAINT = 2.0
"""At an unknown speed, places with at most this times the floor are not moved one by one."""

SLIGHT = 0.25
"""The mass of one speed at a place is not moved if it is at most this times the floor."""

VANISHING = 1e-30
"""A likelihood below this counts as impossible."""


@dataclass(frozen=True, eq=False)
class Belief:
    """The belief about the present.

    given: float32 [n], the probabilities of the places, in the order of their graph, if the robot sees the map; their
        sum is 1, or 0 if there is no place.
    unknown: the probability that the robot does not see the map; 1 in an empty map.
    floor: the probability of a place without any evidence, as most places are.
    speeds: how fast the robot goes, by where it is; as before the first frame where motion was known.
    """

    given: Masses
    unknown: float
    floor: float = 0.0
    speeds: Speeds = UNKNOWN

    @property
    def places(self) -> Masses:
        """float32 [n], the probability of each place; with ``unknown`` they sum to 1."""
        return self.given * np.float32(1 - self.unknown)


def uninformed(places: int) -> Belief:
    """The belief before the first frame, over n places."""
    if not places:
        return Belief(np.zeros(0, np.float32), 1.0)
    return Belief(np.full(places, 1 / places, np.float32), START_UNKNOWN, 1 / places)


def predicted(belief: Belief, transition: Transition, share: float = 1.0, carried: float = JUMP) -> Belief:
    """The belief after a motion and before the frame (the sum in Rabiner's equation 20).

    Args:
        share: the part of a whole look that the frame counts as, from 0 to 1: what is rare is rarer between two frames
            that show nearly the same.
        carried: the probability, at a whole look, that the robot was carried to any place.
    """
    n = len(belief.given)
    if not n:
        return belief
    moved, spread, gone = transition.forward(belief.given, ALIKE * belief.floor if n >= MANY else 0.0)
    jump = share * carried
    anywhere = ((1 - jump) * (spread + gone) + jump) / n
    moved *= np.float32(1 - jump)
    moved += np.float32(anywhere)
    speeds = UNKNOWN if transition.moves or transition.jumps else belief.speeds
    return Belief(moved, _out_of_sight(belief.unknown, share, gone), anywhere, speeds)


def predicted_by_speed(
    belief: Belief, graph: PlaceGraph, frames: int = 1, constant: int = 0, share: float = 1.0
) -> Belief:
    """The belief after a motion along the sequences at a speed that is not known, and before the frame.

    Args:
        frames, constant: as of :func:`core.belief.speeds.displacement_of`.
        share: as of :func:`predicted`.
    """
    n = len(belief.given)
    if not n:
        return belief
    least = 0.0
    if n >= MANY:
        least = FAINT * belief.floor
        if np.count_nonzero(belief.given > least) > MOST_MOVED:
            least = float(np.partition(belief.given, n - MOST_MOVED)[n - MOST_MOVED])
    places, moved, spread = forward(belief.given, belief.speeds, graph, least, frames, constant, SLIGHT * belief.floor)
    jump = share * JUMP
    anywhere = ((1 - jump) * spread + jump) / n
    moved *= np.float32(1 - jump)
    elsewhere = belief.speeds.expected(belief.given)
    moved += np.float32(anywhere) * elsewhere
    given = np.full(n, anywhere, np.float32)
    given[places] = sums = moved.sum(axis=1)
    speeds = Speeds(places, moved / sums[:, np.newaxis], elsewhere)
    if n >= MANY:
        speeds = speeds.likeliest(given, TRACKED)
    if len(graph.stations):
        given = Transition((AcrossTraverses(graph),)).forward(given, 0.0)[0]
    return Belief(given, _out_of_sight(belief.unknown, share), anywhere, speeds)


def _out_of_sight(unknown: float, share: float, gone: float = 0.0) -> float:
    """The probability that the robot does not see the map after a look, and after a share ``gone`` has left it."""
    left = 1 - (1 - share * LEAVING) * (1 - gone)
    return (1 - share * RETURNING) * unknown + left * (1 - unknown)


def fits(belief: Belief, seen: Evidence, graph: PlaceGraph) -> bool:
    """Whether a frame is likelier where the belief has the robot, if it sees the map, than outside of the map."""
    if not len(belief.given):
        return False
    likely, scale = _weighted(belief.given, seen, graph)
    return float(likely.sum(dtype=np.float64)) >= float(np.exp(seen.unknown - scale))


def observed(belief: Belief, seen: Evidence, graph: PlaceGraph) -> Belief:
    """The belief after a frame (the product with its likelihoods in Rabiner's equation 20, scaled)."""
    n = len(belief.given)
    if not n:
        return belief
    likely, scale = _weighted(belief.given, seen, graph)
    inside = float(likely.sum(dtype=np.float64))
    outside = belief.unknown * float(np.exp(seen.unknown - scale))
    known = (1 - belief.unknown) * inside
    if inside < VANISHING or known + outside < VANISHING:  # the frame contradicts everything that was believed
        return uninformed(n)
    floor = belief.floor * float(np.exp(-scale)) / inside
    return Belief(likely / np.float32(inside), outside / (known + outside), floor, belief.speeds)


def contradicted(belief: Belief, factors: Masses) -> Belief:
    """The belief after something that is as likely at each speed as ``factors`` say, float32 [S], wherever it is."""
    if not len(belief.given):
        return belief
    speeds, own, rest = belief.speeds.contradicted(factors)
    given = belief.given * np.float32(rest)
    given[speeds.places] = belief.given[speeds.places] * own
    total = float(given.sum(dtype=np.float64))
    return Belief(given / np.float32(total), belief.unknown, belief.floor * rest / total, speeds)


def observed_by_speed(belief: Belief, seen: Evidence, graph: PlaceGraph, weights: Masses) -> Belief:
    """The belief after a frame that counts by how fast the robot goes: at each speed with a weight, float32 [S]."""
    overall = float(belief.speeds.overall(belief.given) @ weights)
    places, gains = graph.evidence_at(seen)
    speeds, factors = belief.speeds.weighed(places, np.exp(gains[:, np.newaxis] * weights))
    with np.errstate(divide="ignore"):
        evidence = Evidence(graph.rows[places], np.log(factors), seen.unknown * overall)
    return observed(replace(belief, speeds=speeds), evidence, graph)


def _weighted(values: Masses, seen: Evidence, graph: PlaceGraph) -> tuple[Masses, float]:
    """Values times the likelihoods of a frame, divided by exp(scale) so that nothing overflows; and the scale."""
    places, gains = graph.evidence_at(seen)
    scale = max(0.0, seen.unknown, float(gains.max(initial=0)))
    weighted = values * np.float32(np.exp(-scale))
    weighted[places] = values[places] * np.exp(gains - np.float32(scale))
    return weighted, scale


@dataclass(frozen=True, eq=False)
class _Moment:
    """One past frame, for smoothing: the belief after it, the transition into it, its evidence and share."""

    belief: Belief
    transition: Transition
    seen: Evidence
    share: float


class Smoother:
    """Stores the last frames of a run and estimates the place of ``lag`` frames ago from all frames since."""

    def __init__(self, lag: int) -> None:
        self.lag = lag
        self._moments: deque[_Moment] = deque(maxlen=lag + 1)

    def clear(self) -> None:
        """Forget the frames; needed when the places have changed."""
        self._moments.clear()

    def append(self, belief: Belief, transition: Transition, seen: Evidence, share: float = 1.0) -> None:
        """Add one frame, with the share of a look that it counts as."""
        self._moments.append(_Moment(belief, transition, seen, share))

    def smoothed(self, graph: PlaceGraph) -> Belief | None:
        """The belief of ``lag`` frames ago (Rabiner's equations 25 and 27, scaled); None while there are fewer frames.

        The later frames change the probabilities of the places; ``unknown`` stays what it was.
        """
        n = len(graph)
        if len(self._moments) <= self.lag or not n:
            return None
        later = np.ones(n, np.float32)  # how likely all later frames are, by where the robot was
        for moment in reversed(list(self._moments)[1:]):
            likely, _ = _weighted(later, moment.seen, graph)
            mean = float(likely.mean(dtype=np.float64))
            jump = moment.share * JUMP
            later = moment.transition.backward(likely, mean) * np.float32(1 - jump) + np.float32(jump * mean)
            later /= later.max()
        then = self._moments[0].belief
        given = then.given * later
        total = float(given.sum(dtype=np.float64))
        return Belief(given / np.float32(total), then.unknown) if total > VANISHING else then


def reindexed(belief: Belief, old: PlaceGraph, new: PlaceGraph) -> Belief:
    """Carry a belief over, row by row, to a graph in which places were added, removed or moved.

    New places start with the least probability of the others.  The probability of places without a frame left is
    added to ``unknown``: the robot is where the map no longer has a place.
    """
    n = len(new)
    if not len(old) or not n:
        return uninformed(n)
    places, shares = old.counterparts(new)
    lost = min(1.0, float(np.delete(belief.given, places[:, 0]).sum(dtype=np.float64)))
    least = max(float(belief.given.min()), VANISHING)
    given = np.bincount(places[:, 1], belief.given[places[:, 0]] * shares, n).astype(np.float32)
    given[given == 0] = least
    given /= np.float32(given.sum(dtype=np.float64))
    return Belief(given, belief.unknown + (1 - belief.unknown) * lost, speeds=belief.speeds.carried(places))
