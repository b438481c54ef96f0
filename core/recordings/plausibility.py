"""The judge of trajectories: which of their samples no vehicle can have driven, and where they begin anew.

Samples are followed in the order of their times, each with the track that it continues.  What a vehicle drove is one
track.  A spike leaves the track, which goes on behind it; several publishers are several tracks at a time; and odometry
that begins anew is a track after another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.places import EARTH_RADIUS, is_no_fix
from core.recordings.frame import NANOSECONDS

MOST_SPEED = 60.0
"""Metres a second, 216 km/h: the default of a setting, for trains and aeroplanes are faster."""
MOST_ACCELERATION = 10.0
"""Metres a second per second; more than tyres can do."""
MOST_TURN, TURN_SLACK = 180.0, 45.0
"""Degrees a second, and degrees by which an orientation may be off at once."""
SLACK, LARGEST_SLACK = 2.0, 25.0
"""Metres by which a position may be off at once: at least, and if it is noisy or of satellites."""
NOISE = 8.0
"""Positions of one place are hardly ever farther apart than this many times their standard deviation."""
MOST_OF_NOISE = 50_000
"""Samples by which the noise is measured."""
JITTER = 0.1
"""Seconds by which stamps may be off, for messages that have queued come at once."""
WHOLE_SECONDS = 1.0
"""Seconds by which stamps may be off that are all whole."""
BASELINE = 0.5
"""Seconds over which the speed before a sample is measured, at least."""

LONGEST_EXCURSION = 5.0
"""Seconds, or ten usual steps, for which a track may be left and is still followed."""
LEAST_PART = 5
"""Samples of a part of a trajectory that is believed beside larger ones."""
BY_FAR = 4
"""A track with so many times the samples of another one is the better one."""
MOST_TRACKS = 8
"""Tracks that are followed at a time."""

LARGEST_COORDINATE = 1e9
"""Metres; no pose of a place may be further away."""
STRAY = 1e5
"""Metres from the middle of all positions that are remarked where no times tell how fast they were reached."""

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


@dataclass(frozen=True)
class Source:
    """Where samples come from, for remarks.

    name: of the topic, file or list.
    unit: what its samples are called, in the plural.
    where: says where a sample is, by its number, such as "in line 7"; None: its time says it.
    """

    name: str
    unit: str = "messages"
    where: Callable[[int], str] | None = None


@dataclass(frozen=True)
class Judgement:
    """What n samples are worth, in the order in which they were given.

    kept: bool [n], whether a sample has a position that can be used.
    turned: bool [n], whether it also has an orientation that can be used.
    part: int64 [n]; nothing is interpolated between samples of different parts.
    segment: int64 [n]; coordinates of different segments have nothing to do with one another.
    remarks: sentences; each names the source, how many samples are meant, and the first of them.
    """

    kept: Booleans
    turned: Booleans
    part: Integers
    segment: Integers
    remarks: list[str] = field(default_factory=list)


def jitter_of(nanoseconds: ArrayLike) -> float:
    """Seconds by which times may be off that somebody has written down: int64 [n], maybe whole seconds."""
    return JITTER if (np.asarray(nanoseconds, np.int64) % NANOSECONDS).any() else WHOLE_SECONDS


def judge(
    nanoseconds: ArrayLike | None,
    positions: ArrayLike,
    turns: ArrayLike | None,
    source: Source,
    geographic: bool = False,
    absolute: bool = False,
    most_speed: float = MOST_SPEED,
    jitter: float = JITTER,
    publishers: ArrayLike | None = None,
) -> Judgement:
    """Judge n samples in any order.

    Args:
        nanoseconds: int64 [n]; None: no times are known, so that samples far from all others are only remarked.
        positions: float64 [n, 3], metres, or latitude and longitude in degrees and a height.
        turns: float64 [n, 4], unit quaternions, NaN where the orientation is not known; None: the source has none.
        geographic: whether positions are in degrees.
        absolute: whether coordinates are those of a map or the Earth, so that a position that jumps is corrected;
            otherwise coordinates begin anew with the jump.
        most_speed: metres a second.
        jitter: seconds by which times may be off.
        publishers: int [n]: samples of different ones are of different tracks.
    """
    places = np.asarray(positions, np.float64).reshape(-1, 3)
    count = len(places)
    quaternions = np.full((count, 4), np.nan) if turns is None else np.asarray(turns, np.float64).reshape(-1, 4)
    times = np.zeros(count, np.int64) if nanoseconds is None else np.asarray(nanoseconds, np.int64)
    words = _Words(source, times, count)
    kept = _usable(places, geographic, words)
    turned = kept & np.isfinite(quaternions).all(axis=1)
    if turns is not None:
        words.without_orientation(kept & ~turned)
    part, segment = np.zeros(count, np.int64), np.zeros(count, np.int64)
    order = np.flatnonzero(kept)
    order = order[np.argsort(times[order], kind="stable")]
    metres = _on_earth(places[order]) if geographic else places[order]
    if nanoseconds is None:
        words.strays(order, metres)
        return Judgement(kept, turned, part, segment, words.remarks)
    seconds = (times[order] - times[order[:1]]) / NANOSECONDS
    published = np.zeros(count, np.int64) if publishers is None else np.asarray(publishers, np.int64)
    way = _Way(seconds, metres, published[order], geographic, most_speed, jitter)
    found = _resolved(way)
    words.leaps(order, way, found, absolute, _ranges(places[order], geographic))
    kept[order], part[order] = found.kept, found.part
    segment[order] = 0 if absolute else found.track

    order = order[found.kept]
    has = turned[order]
    turning = _Turning((times[order[has]] - times[order[:1]]) / NANOSECONDS, quaternions[order[has]], jitter)
    found = _resolved(turning)
    words.leaps(order[has], turning, found, True, lambda members: "")
    turned[:] = False
    turned[order[has]] = found.kept
    turns_over = np.zeros(len(order), np.int64)
    turns_over[has] = found.part
    part[order] += np.maximum.accumulate(turns_over) * count
    return Judgement(kept, turned, part, segment, words.remarks)


def smooth_parts(nanoseconds: Integers, metres: Floats, turns: Floats, most_speed: float = MOST_SPEED) -> Integers:
    """The part of each of n samples, int64 [n], in the order of their times: a new one begins with each leap."""
    seconds = (nanoseconds - nanoseconds[:1]) / NANOSECONDS
    way = _Way(seconds, metres, np.zeros(len(seconds), np.int64), False, most_speed, JITTER)
    begins = np.zeros(len(seconds), np.int64)
    for measure in (way, _Turning(seconds, turns, JITTER)):
        begins[_leaps(measure) + 1] = 1
    return np.cumsum(begins)


def _usable(places: Floats, geographic: bool, words: _Words) -> Booleans:
    """Which samples have a position at all."""
    with np.errstate(invalid="ignore"):
        within = np.abs(places[:, :2]) <= (90, 180) if geographic else np.abs(places) <= LARGEST_COORDINATE
        within = np.column_stack([within, ~(np.abs(places[:, 2]) > LARGEST_COORDINATE)])
    usable: Booleans = np.all(within, axis=1)
    beyond = "that is not on the Earth" if geographic else f"beyond {LARGEST_COORDINATE:g} m"
    words.left_out(~usable, f"have a number that is none, or a position {beyond}")
    if geographic:
        zeros = usable & is_no_fix(places[:, 0], places[:, 1])
        words.left_out(zeros, "are at latitude 0, longitude 0, which is no fix")
        usable &= ~zeros
    return usable


def _on_earth(places: Floats) -> Floats:
    """Positions in degrees as points on the Earth's sphere, metres [n, 3]."""
    phi, theta = np.radians(places[:, 0]), np.radians(places[:, 1])
    return EARTH_RADIUS * np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=1)


# What can follow what


class _Measure(Protocol):
    """How far samples are apart, and how far they can be; n samples in the order of their times."""

    seconds: Floats
    what: str
    unit: str
    among: str
    least: float
    """How far samples may be apart in any case."""

    def prepare(self, samples: Integers) -> None:
        """Get ready to say what is allowed after some samples."""

    def apart(self, one: Integers, other: Integers) -> Floats:
        """How far pairs of samples are apart."""

    def allowed(self, one: Integers, other: Integers) -> Floats:
        """How far the later ones can be."""


class _Way:
    """Positions, in metres."""

    what, unit, among = "", " m", "publishers"

    def __init__(
        self, seconds: Floats, metres: Floats, publishers: Integers, noisy: bool, most_speed: float, jitter: float
    ) -> None:
        self.seconds, self._metres, self._publishers = seconds, metres, publishers
        self._most, self._jitter = most_speed, jitter
        self._speeds = np.full(len(seconds), np.inf)
        self.least = LARGEST_SLACK if noisy else float(np.clip(NOISE * self._noise(), SLACK, LARGEST_SLACK))

    def apart(self, one: Integers, other: Integers) -> Floats:
        found: Floats = np.linalg.norm(self._metres[other] - self._metres[one], axis=-1)
        return found

    def allowed(self, one: Integers, other: Integers) -> Floats:
        seconds = self.seconds[other] - self.seconds[one] + self._jitter
        gone = np.minimum(self._most * seconds, self._speeds[one] * seconds + MOST_ACCELERATION * seconds**2)
        found: Floats = np.where(self._publishers[one] == self._publishers[other], self.least + gone, 0.0)
        return found

    def prepare(self, samples: Integers) -> None:
        """Measure the speed before each: the second smallest of four, so that no spike and no second track counts.

        It is endless for the first samples, of which nothing is known.
        """
        speeds = np.full((4, len(samples)), np.inf)
        latest = np.searchsorted(self.seconds, self.seconds[samples] - BASELINE, side="right") - 1
        for back in range(4):
            known = np.flatnonzero(latest >= back)
            earlier, later = latest[known] - back, samples[known]
            speeds[back, known] = self.apart(earlier, later) / (self.seconds[later] - self.seconds[earlier])
        self._speeds[samples] = np.partition(speeds, 1, axis=0)[1]

    def _noise(self) -> float:
        """The standard deviation of positions: the median of how far two steps differ, in one or several tracks."""
        found, some = [], self._metres[:MOST_OF_NOISE]
        for step in (1, 2, 3):
            if len(some) >= 2 * step + LEAST_PART:
                differences = some[2 * step :] - 2 * some[step:-step] + some[: -2 * step]
                found.append(float(np.median(np.linalg.norm(differences, axis=1)) / np.sqrt(12 * np.log(2))))
        return min(found, default=0.0)


class _Turning:
    """Orientations, in degrees."""

    what, unit, among, least = "The orientation of ", "°", "directions", TURN_SLACK

    def __init__(self, seconds: Floats, turns: Floats, jitter: float) -> None:
        self.seconds, self._turns, self._jitter = seconds, turns, jitter

    def prepare(self, samples: Integers) -> None:
        """There is nothing to do: a turn may begin at once."""

    def apart(self, one: Integers, other: Integers) -> Floats:
        cosines = np.abs((self._turns[one] * self._turns[other]).sum(axis=-1))
        found: Floats = np.degrees(2 * np.arccos(np.minimum(1.0, cosines)))
        return found

    def allowed(self, one: Integers, other: Integers) -> Floats:
        return TURN_SLACK + MOST_TURN * (self.seconds[other] - self.seconds[one] + self._jitter)


# Tracks


class _Pair(NamedTuple):
    """Two tracks at a time, by the numbers of their samples; whether the first one is the better by far."""

    better: Integers
    worse: Integers
    decided: bool


@dataclass(frozen=True)
class _Found:
    """The tracks of n samples in the order of their times: what is kept, of which track, of which part."""

    kept: Booleans
    track: Integers
    part: Integers
    pairs: list[_Pair]


def _leaps(measure: _Measure) -> Integers:
    """The samples between which and the next one no vehicle can have come."""
    every = np.arange(len(measure.seconds))
    steps = np.flatnonzero(measure.apart(every[:-1], every[1:]) > measure.least)
    measure.prepare(steps)
    return steps[measure.apart(steps, steps + 1) > measure.allowed(steps, steps + 1)]


def _followed(measure: _Measure) -> Integers:
    """The track of each sample, int64 [n]."""
    count = len(measure.seconds)
    tracks = np.zeros(count, np.int64)
    breaks = _leaps(measure) + 1
    if not breaks.size:
        return tracks
    patience = max(LONGEST_EXCURSION, 10 * float(np.median(np.diff(measure.seconds))))
    starts, ends = [0, *breaks.tolist()], [*breaks.tolist(), count]
    measure.prepare(np.array(ends) - 1)
    ends_at, sizes, numbers, made = [ends[0] - 1], [ends[0]], [0], 1  # of the tracks that are followed
    for start, end in zip(starts[1:], ends[1:], strict=True):
        last = np.array(ends_at)
        far = measure.apart(last, start) / np.maximum(measure.allowed(last, start), 1e-9)
        far[measure.seconds[start] - measure.seconds[last] > patience] = np.inf
        best = int(np.argmin(far))
        if far[best] > 1:
            if len(numbers) == MOST_TRACKS:
                worst = sizes.index(min(sizes))
                del ends_at[worst], sizes[worst], numbers[worst]
            best, made = len(numbers), made + 1
            ends_at.append(0)
            sizes.append(0)
            numbers.append(made - 1)
        tracks[start:end] = numbers[best]
        ends_at[best] = end - 1
        sizes[best] += end - start
    return tracks


def _resolved(measure: _Measure) -> _Found:
    """Which samples are kept: those of the larger track where one is left for a while, of none where two alternate."""
    tracks = _followed(measure)
    count, seconds = len(tracks), measure.seconds
    if not count or not tracks.any():
        return _Found(np.ones(count, np.bool_), tracks, np.zeros(count, np.int64), [])
    sizes = np.bincount(tracks)
    members = np.split(np.argsort(tracks, kind="stable"), np.cumsum(sizes)[:-1])
    kept, pairs, accepted = np.zeros(count, np.bool_), list[_Pair](), list[Integers]()
    least = min(LEAST_PART, int(sizes.max()))
    for one in np.argsort(-sizes, kind="stable").tolist():
        mine = members[one]
        if len(mine) < least:
            break
        rest = np.ones(len(mine), np.bool_)
        for other in accepted:
            begin, end = max(mine[0], other[0]), min(mine[-1], other[-1])
            if begin > end:
                continue
            begin, end = begin - 1, end + 1  # with the first and the last one of either, which is as dubious
            together = mine[(mine >= begin) & (mine <= end)]
            around = (seconds[other] >= seconds[max(begin, 0)] - LONGEST_EXCURSION) & (
                seconds[other] <= seconds[min(end, count - 1)] + LONGEST_EXCURSION
            )
            turns = len(np.unique(np.searchsorted(other, together)))  # how often one follows the other
            decided = turns == 1 or len(together) * BY_FAR <= int(around.sum())
            theirs = other[around] if decided else other[(other >= begin) & (other <= end)]
            rest &= (mine < begin) | (mine > end)
            if turns > 2 and len(together) * 10 > len(theirs):
                pairs.append(_Pair(theirs, together, decided))
            if not decided:
                kept[theirs] = False
        if rest.sum() >= least:
            kept[mine[rest]] = True
            accepted.append(mine)
    part = np.zeros(count, np.int64)
    held = np.flatnonzero(kept)
    part[held[1:]] = np.cumsum(np.diff(tracks[held]) != 0)
    return _Found(kept, tracks, part, pairs)


# What is to be said of it


def _ranges(places: Floats, geographic: bool) -> Callable[[Integers], str]:
    """Says where some samples are."""
    axes = ("latitude", "longitude") if geographic else ("x", "y")
    digits = 5 if geographic else 1

    def told(members: Integers) -> str:
        low, high = places[members].min(axis=0), places[members].max(axis=0)
        spans = (f"{axis} {low[at]:.{digits}f} to {high[at]:.{digits}f}" for at, axis in enumerate(axes))
        return f" ({', '.join(spans)})"

    return told


class _Words:
    """Makes the remarks."""

    def __init__(self, source: Source, times: Integers, count: int) -> None:
        self.remarks = list[str]()
        self._source, self._times, self._count = source, times, count

    def left_out(self, samples: Booleans, why: str) -> None:
        """Remark samples that are left out for what they are."""
        wrong = np.flatnonzero(samples)
        if wrong.size:
            first = self._at(wrong[np.argmin(self._times[wrong])])
            self.remarks.append(
                f"{wrong.size} of {self._count} {self._source.unit} of {self._source.name} {why} (first {first}): they "
                "are left out."
            )

    def without_orientation(self, samples: Booleans) -> None:
        """Remark samples that have a position and no orientation."""
        wrong = np.flatnonzero(samples)
        if wrong.size:
            first = self._at(wrong[np.argmin(self._times[wrong])])
            self.remarks.append(
                f"{wrong.size} of {self._count} {self._source.unit} of {self._source.name} have no orientation (first "
                f"{first}): they give positions without a heading."
            )

    def strays(self, order: Integers, metres: Floats) -> None:
        """Remark samples without times that are far from all others."""
        if not order.size:
            return
        away = np.linalg.norm(metres - np.median(metres, axis=0), axis=1)
        far = np.flatnonzero(away > STRAY)
        if far.size and far.size * BY_FAR <= order.size:
            self.remarks.append(
                f"{far.size} of {self._count} {self._source.unit} of {self._source.name} are up to "
                f"{_number(float(away[far].max()))} m from the middle of the others (first {self._at(order[far[0]])}): "
                "no times tell whether they can be, so they are taken."
            )

    def leaps(
        self, order: Integers, measure: _Measure, found: _Found, absolute: bool, ranges: Callable[[Integers], str]
    ) -> None:
        """Remark what was found of samples in the order of their times."""
        what, unit = measure.what + self._source.name, self._source.unit
        alternating = np.zeros(len(order), np.bool_)
        for pair in found.pairs:
            alternating[pair.worse] = True
            alternating[pair.better] |= not pair.decided
            told = (
                f"{len(pair.better)} {unit}{ranges(pair.better)} and {len(pair.worse)}{ranges(pair.worse)} from "
                f"{self._at(order[min(pair.better[0], pair.worse[0])]).removeprefix('at ')} to "
                f"{self._at(order[max(pair.better[-1], pair.worse[-1])]).removeprefix('at ')}"
            )
            fate = "the latter are left out" if pair.decided else "nobody can know which are right: all are left out"
            self.remarks.append(f"{what} alternates between two {measure.among}, {told}; {fate}.")
        held, wrong = np.flatnonzero(found.kept), np.flatnonzero(~found.kept & ~alternating)
        if wrong.size:
            begins = wrong[np.flatnonzero(np.diff(wrong, prepend=-2) > 1)]
            before = np.searchsorted(held, begins) - 1
            leaps = [(held[one], begin) for one, begin in zip(before, begins, strict=True) if one >= 0]
            if held.size and (before < 0).any():
                leaps.append((wrong[np.searchsorted(wrong, held[0]) - 1], held[0]))
            elif not held.size:
                leaps.append((0, min(1, len(order) - 1)))
            fate = "those headings are left out" if measure.what else "those poses are left out"
            self.remarks.append(
                f"{self._leaping(what, order, measure, leaps, int(wrong[0]))}: {fate} ({wrong.size} {unit})."
            )
        border = np.flatnonzero(np.diff(found.part[held]))
        if border.size:
            leaps = list(zip(held[border], held[border + 1], strict=True))
            on = "and goes on from there: nothing is interpolated across it"
            if not absolute:
                on = "and goes on from there: it begins anew, in coordinates of its own"
            self.remarks.append(f"{self._leaping(what, order, measure, leaps, int(leaps[0][1]))} {on}.")

    def _leaping(self, what: str, order: Integers, measure: _Measure, leaps: list[tuple[int, int]], begin: int) -> str:
        """A sentence, without its end, on leaps between pairs of samples, of which ``begin`` is the first one meant."""
        one, other = (np.array(side, np.int64) for side in zip(*leaps, strict=True))
        size = measure.apart(one, other)
        largest = int(np.argmax(size))
        seconds = float(measure.seconds[other[largest]] - measure.seconds[one[largest]])
        times = "once" if len(leaps) == 1 else f"{len(leaps)} times"
        by = "by" if len(leaps) == 1 else "by up to"
        first = self._at(order[begin])
        return (
            f"{what} leaps {times}, {by} {_number(float(size[largest]))}{measure.unit} within "
            f"{seconds:.3g} s ({'' if len(leaps) == 1 else 'first '}{first})"
        )

    def _at(self, number: int) -> str:
        if self._source.where is not None:
            return self._source.where(int(number))
        return f"at {self._times[number] / NANOSECONDS:.3f} s"


def _number(size: float) -> str:
    """A size with spaces between its thousands."""
    return f"{size:,.1f}".replace(",", " ") if size < 100 else f"{size:,.0f}".replace(",", " ")
