"""The speed of a robot along a traverse without odometry: a belief over speeds, learnt as the robot goes.

A speed is the number of the map's frames that go by from one frame of the robot to the next: 1 at the pace of the
traverse, 0.1 for a camera with ten times the frame rate, 0 for a robot that stands, below 0 for one in reverse.  The
chain of places (``filter``) is one of places and speeds here: the mass of a place is shared out among SPEEDS, each
share goes along the sequence by its own speed, and a few robots change their speed at each look.  A frame's evidence is
of places alone, but speeds that lead past what the frames show lose their mass, so that after some frames the right one
has most.  A view that has changed much speaks against slow ones by itself.

Only the likeliest places have shares of their own; all others have PRIOR, so that time and memory hardly grow with the
map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from core.belief.graph import PlaceGraph
from core.kernels.belief import along_by_speed

Masses = NDArray[np.float32]
Kernel = tuple[NDArray[np.int64], NDArray[np.float64]]

FORWARD = {0.0: 0.1, 0.1: 0.1, 0.3: 0.2, 1.0: 0.35, 3.0: 0.1, 10.0: 0.05}
"""How probable each speed is before the first frame, in proportion."""

REVERSE = 0.2
"""How probable a speed in reverse is, of the same speed forwards; chosen in view of corridor and of two stretches of
nordland_tiny, each run forwards and backwards."""

SPEEDS: tuple[float, ...] = tuple(sorted({-speed for speed in FORWARD} | set(FORWARD)))
"""The speeds, ascending."""

_weights = np.array([FORWARD[abs(speed)] * (REVERSE if speed < 0 else 1) for speed in SPEEDS])
PRIOR: Masses = (_weights / _weights.sum()).astype(np.float32)
"""float32 [S], the probability of each speed before the first frame."""

KEEPING = 0.99
"""Probability, at each look, that the speed stays as it is.  Of the rest, half goes to the speeds beside it, half to
any.  Chosen on corridor: with 0.995 a robot that has left the half that is mapped is noticed within three frames in
0.88 of the cases, with 0.99 in 0.925."""

NARROWEST, WIDER = 0.3, 0.2
"""Scale of the two-sided exponential distribution around a displacement, in frames of the map, and what it grows by
with each frame of displacement: speeds between two of SPEEDS have to be followed, too."""

CREEPING = 0.25
"""A robot that goes on by less, in frames of the map, shows less that is new: a share that is the root of it."""

LEAST_NEWS = 0.1
"""One that stands counts as if it went on by so much, as people pass and light changes."""

UNLIKE = 0.4
"""How far below 1 the correlation of two views is taken to be that are a frame of the map apart; nearer ones differ by
the root of it.  The medians are 0.06 on corridor and 0.4 in the winter of nordland_tiny.  Of 0.3, 0.4 and 0.5 the first
follows slow robots through sparse maps worse, and the last gains less at paces of 0.5 and 0.7; lip6_outdoor had that
say in it."""

STILL_SPREAD, SPREAD = 0.06, 0.15
"""Standard deviation of the correlation where the robot stands, and a frame of the map apart."""

HIDDEN, ANY = 0.5, 0.03
"""How probable it is that something hides a part of the view, so that any lower correlation is as likely as another;
and the likelihood that no speed goes below."""

LASTING = 0.9
"""Probability that a robot that is elsewhere than believed has the speed that is believed."""

TRACKED = 1024
"""Number of places with shares of their own, in maps where not all have them."""


@dataclass(frozen=True, eq=False)
class Speeds:
    """The probabilities of the speeds at the likeliest places.

    places: int32 [m], of the graph, in any order.
    shares: float32 [m, S], the probability of each speed if the robot is there; each row sums to 1.
    elsewhere: float32 [S], the same of all other places.
    """

    places: NDArray[np.int32]
    shares: Masses
    elsewhere: Masses

    @property
    def bytes(self) -> int:
        """Memory of its arrays, in bytes."""
        return self.places.nbytes + self.shares.nbytes

    def likeliest(self, masses: Masses, count: int) -> Speeds:
        """The same of the ``count`` places with most mass."""
        if len(self.places) <= count:
            return self
        retained = np.argpartition(-masses[self.places], count)[:count]
        return Speeds(self.places[retained], self.shares[retained], self.elsewhere)

    def overall(self, masses: Masses) -> Masses:
        """The probability of each speed wherever the robot is, float32 [S]."""
        own = masses[self.places]
        rest = max(0.0, float(masses.sum(dtype=np.float64) - own.sum(dtype=np.float64)))
        found: Masses = (own @ self.shares + np.float32(rest) * self.elsewhere).astype(np.float32)
        return found / max(float(found.sum()), 1e-30)

    def expected(self, masses: Masses) -> Masses:
        """The probability of each speed of a robot that is carried to anywhere, float32 [S]."""
        found: Masses = np.float32(LASTING) * self.overall(masses) + np.float32(1 - LASTING) * PRIOR
        return found

    def at(self, places: NDArray[np.int64]) -> Masses:
        """The probabilities of the speeds at some places, int64 [k]; float32 [k, S]."""
        found, own = self._tracked(places)
        shares = np.tile(self.elsewhere, (len(places), 1))
        shares[own] = self.shares[found]
        return shares

    def _tracked(self, places: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Of some places, [k], the rows of those that have shares of their own, int64 [m], and which have, bool [k]."""
        if not len(self.places):
            return np.empty(0, np.int64), np.zeros(len(places), np.bool_)
        order = np.argsort(self.places)
        found = order[np.minimum(np.searchsorted(self.places[order], places), len(order) - 1)]
        own = self.places[found] == places
        return found[own], own

    def weighed(self, places: NDArray[np.int32], likelihoods: Masses) -> tuple[Speeds, Masses]:
        """The speeds after a frame, and the likelihood of it at each place whatever the speed is, float32 [k].

        Args:
            places: int32 [k], those whose likelihood is not 1.
            likelihoods: float32 [k, S], of the frame by place and speed.
        """
        joint = self.at(places.astype(np.int64)) * likelihoods
        factors: Masses = joint.sum(axis=1)
        shares = self.shares.copy()
        found, own = self._tracked(places)
        shares[found] = joint[own] / factors[own, np.newaxis]
        return Speeds(self.places, shares, self.elsewhere), factors

    def contradicted(self, factors: Masses) -> tuple[Speeds, Masses, float]:
        """The speeds after something that is as likely at each speed as ``factors`` say, float32 [S], wherever it is.

        Returns:
            Also how likely it is at the places that have shares of their own, float32 [m], and at all others.
        """
        shares, elsewhere = self.shares * factors, self.elsewhere * factors
        own: Masses = shares.sum(axis=1)
        rest = float(elsewhere.sum())
        return Speeds(self.places, shares / own[:, np.newaxis], elsewhere / np.float32(rest)), own, rest

    def carried(self, places: NDArray[np.int64]) -> Speeds:
        """The same on another graph of the map; ``places``, int64 [m, 2]: their old and new numbers."""
        _, own, at = np.intersect1d(self.places, places[:, 0], return_indices=True)
        new, first = np.unique(places[at, 1], return_index=True)
        return Speeds(new.astype(np.int32), self.shares[own[first]], self.elsewhere)


UNKNOWN = Speeds(np.empty(0, np.int32), np.empty((0, len(SPEEDS)), np.float32), PRIOR)
"""The speeds before the first frame."""


def kernel_of(displacement: float) -> Kernel:
    """Offsets along the sequence, int64 [m], and their probabilities, float64 [m], for one displacement.

    A displacement between two frames falls on both, by how near each is; the distribution around it is two-sided
    exponential.
    """
    scale = NARROWEST + WIDER * abs(displacement)
    reach = math.ceil(3 * scale)
    lower = math.floor(displacement)
    upper_share = displacement - lower
    around = np.exp(-np.abs(np.arange(-reach, reach + 1)) / scale)
    weights = np.zeros(len(around) + 1)
    weights[:-1] += (1 - upper_share) * around
    weights[1:] += upper_share * around
    offsets = np.arange(lower - reach, lower + reach + 2)
    there = weights > 0
    return offsets[there], weights[there] / weights.sum()


def displacement_of(speed: float, frames: int, constant: int) -> float:
    """How far a robot gets at a speed, in frames of the map.

    Args:
        frames: by how much the run's frame number grew since the frame before.
        constant: how many frames before showed the same.  A slow robot has advanced meanwhile, though by less than a
            frame of the map, or the view had changed.
    """
    return math.copysign(max(abs(speed) * frames, min(1.0, abs(speed) * (frames + constant))), speed)


def news(frames: int, constant: int) -> Masses:
    """How much of a frame is new at each speed, float32 [S], from 0 to 1; see :func:`displacement_of`.

    A frame of a robot that stands or creeps shows what the last one has shown, and the mistakes that come of it.
    """
    gone = np.abs([displacement_of(speed, frames, constant) for speed in SPEEDS]).astype(np.float32)
    return np.where(gone < CREEPING, np.sqrt(np.maximum(gone, LEAST_NEWS)), np.float32(1))


def plausible(change: float, frames: int, constant: int) -> Masses:
    """How likely a change of the view is at each speed against the pace of the map, float32 [S], at most 1.

    Only what is too much for a slow robot counts.  A view that has hardly changed speaks for none, as frames of the map
    may be as alike.

    Args:
        change: of ``view.View.change``.
        frames, constant: as of :func:`displacement_of`.
    """
    gone = np.abs([displacement_of(speed, frames, constant) for speed in (*SPEEDS, 1.0)])
    share = np.sqrt(np.minimum(gone, 1))
    expected, spread = 1 - UNLIKE * share, STILL_SPREAD + (SPREAD - STILL_SPREAD) * share
    off = 1 - change**2 / 2 - expected
    density = np.exp(-0.5 * (off / spread) ** 2) / (math.sqrt(2 * math.pi) * spread)
    likely = (1 - HIDDEN) * density + HIDDEN * (off < 0) + ANY
    return np.minimum(1, likely[:-1] / likely[-1]).astype(np.float32)


@lru_cache(maxsize=64)
def _kernels(frames: int, constant: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """The kernels of all speeds behind each other: where each begins, int64 [S + 1], offsets and weights."""
    kernels = [kernel_of(displacement_of(speed, frames, constant)) for speed in SPEEDS]
    starts = np.cumsum([0] + [len(offsets) for offsets, _ in kernels])
    offsets, weights = zip(*kernels, strict=True)
    return starts, np.concatenate(offsets), np.concatenate(weights).astype(np.float32)


def _settled(constant: int) -> int:
    """From this many constant frames on, more make no difference."""
    return min(constant, math.ceil(1 / min(speed for speed in SPEEDS if speed > 0)))


def mixture(speeds: Masses, frames: int = 1, constant: int = 0) -> Kernel:
    """One kernel of all speeds, by the probability of each, float32 [S]."""
    starts, offsets, weights = _kernels(frames, _settled(constant))
    shares = np.repeat(speeds.astype(np.float64), np.diff(starts)) * weights
    reached, at = np.unique(offsets, return_inverse=True)
    return reached, np.bincount(at, shares) / shares.sum()


def forward(
    masses: Masses,
    speeds: Speeds,
    graph: PlaceGraph,
    least: float,
    frames: int = 1,
    constant: int = 0,
    slight: float = 0.0,
) -> tuple[NDArray[np.int32], Masses, float]:
    """Move masses along the sequences, each place's by its own speeds; a few change their speed afterwards.

    Mass that would go beyond an end of its sequence stays at that end.

    Args:
        masses: float32 [n].
        least: masses up to this are not moved; the last result is their sum.
        frames, constant: as of :func:`displacement_of`.
        slight: nor are masses of one speed at a place up to this.

    Returns:
        The places that mass has come to, int32 [m], and how much with each speed, float32 [m, S]; and the mass that was
        not moved.
    """
    starts, offsets, weights = _kernels(frames, _settled(constant))
    places, moved, negligible = along_by_speed(
        masses,
        speeds.places,
        speeds.shares,
        speeds.elsewhere,
        graph.first,
        graph.last,
        starts,
        offsets,
        weights,
        least,
        slight,
    )
    changing = np.float32(1 - KEEPING)
    total = moved.sum(axis=1, keepdims=True)
    beside = np.zeros_like(moved)
    beside[:, 1:] += moved[:, :-1]
    beside[:, :-1] += moved[:, 1:]
    beside[:, 1] += moved[:, 0]  # beside the first and the last there is one, which gets both parts
    beside[:, -2] += moved[:, -1]
    return places, np.float32(KEEPING) * moved + changing * (0.25 * beside + 0.5 * total * PRIOR), negligible
