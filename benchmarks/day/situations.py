"""The table of situations: how the robot moves, the view of its camera, and the fate of its messages.

A situation is data. Its stretches follow one another; :func:`moments` makes the frames of a walk of them, with the
truth of each.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from benchmarks.day import pictures
from benchmarks.day.maps import CUT, STOOD, Change
from benchmarks.day.odometry import FAULTS, OdometryFault, StatedOdometry
from benchmarks.day.pictures import UPRIGHT, Look, Random, another_look
from benchmarks.day.walks import PlanarPose, WalkPair, pixels

Fate = Literal["answered", "lost", "unanswered"]
"""Of a frame: its answer comes, it does not reach the service, or the service takes it in and its answer is lost."""

SLIP = 0.02
"""Standard deviation of what wheels measure, as a share of the way."""

SPIN = np.radians(0.3)
"""Standard deviation of the measured turn, in radians for each square root of a metre."""

LONGEST = 150
"""Frames of a situation at most."""


@dataclass(frozen=True)
class SteadyStretch:
    """Some seconds in which nothing changes.

    pace: frames of the walk a second; negative backwards, facing ahead.
    start: where the robot is put at first, as a share of the walk, if it is not where it was: it is carried there.
    aside: metres a second to the left, out of what the map shows and back.
    look: the view as the camera renders it.
    orientation: that the files state.
    own: the pictures are those that the map was made of.
    fate: of every second frame, of all if ``whole``.
    restart: the service is restarted before the first frame.
    again: the frames until the answer is right are counted from here.
    odometry: what is wrong with it; None: nothing.
    """

    seconds: float
    pace: float = 1.0
    start: float | None = None
    aside: float = 0.0
    look: Look | None = None
    orientation: int = UPRIGHT
    own: bool = False
    fate: Fate = "answered"
    whole: bool = True
    restart: bool = False
    again: bool = False
    odometry: OdometryFault | None = None


@dataclass(frozen=True)
class Situation:
    """An ordinary thing that happens to a robot.

    rate: frames a second; the map was made at one.
    start: where the robot begins, as a share of the walk.
    map: how the map differs from one traverse enrolled once.
    camera: of the robot, if the map knows it.
    """

    name: str
    stretches: tuple[SteadyStretch, ...]
    rate: float = 1.0
    start: float = 0.1
    map: Change = "plain"
    camera: str | None = None


@dataclass(frozen=True)
class Moment:
    """One frame of a robot.

    second: when, from the beginning.
    at: where, in frames of the robot's walk.
    aside: metres beside the walk; the map shows nothing of it there.
    pose: the true one, in the map's frame; ``wheels``: that of the odometry, in its own; ``stated``: what it says.
    right: the references whose place the frame shows; none if it shows nothing of the map.
    again: it is the first after a disturbance.
    camera: that took it, if the map knows it.
    """

    second: float
    at: float
    aside: float
    picture: bytes
    pose: PlanarPose
    wheels: PlanarPose
    stated: PlanarPose
    right: frozenset[int]
    fate: Fate
    restart: bool
    again: bool
    camera: str | None = None


def moments(situation: Situation, walk: WalkPair, scale: float = 1.0) -> Iterator[Moment]:
    """The frames of a situation on a walk, the same ones each time.

    Args:
        scale: of the stretches' seconds.
    """
    random = np.random.default_rng([7, zlib.crc32(f"{situation.name} {walk.name}".encode())])
    last = len(walk.frames) - 1
    at, aside, second, sent = situation.start * last, 0.0, 0.0, 0
    at = float(round(at))
    pose = walk.pose(walk.where(at))
    wheels = PlanarPose(0.0, 0.0, 0.0)
    before: tuple[float, float] | None = None
    odometry = StatedOdometry()
    for stretch in situation.stretches:
        carried = stretch.start is not None
        if stretch.start is not None:
            at = float(round(stretch.start * last))
        for number in range(max(1, round(stretch.seconds * scale * situation.rate))):
            if sent == LONGEST or not -1e-9 <= at <= last + 1e-9:
                return
            now = walk.pose(walk.where(at), aside)
            wheels = wheels if carried or before is None else _measured(wheels, pose, now, random)
            pose, carried = now, False
            out = abs(aside) > 1e-9
            shown = _picture(stretch, walk, at, number, aside, before == (at, aside), random)
            hit = stretch.whole or number % 2 == 1
            yield Moment(
                second,
                at,
                aside,
                shown,
                pose,
                wheels,
                odometry.at(wheels, stretch.odometry),
                frozenset() if out else walk.right(at),
                stretch.fate if hit else "answered",
                stretch.restart and number == 0,
                stretch.again and number == 0,
                situation.camera,
            )
            before, sent = (at, aside), sent + 1
            second += 1 / situation.rate
            at += stretch.pace / situation.rate
            aside += stretch.aside / situation.rate


def _picture(
    stretch: SteadyStretch, walk: WalkPair, at: float, number: int, aside: float, same: bool, random: Random
) -> bytes:
    """The camera's picture; a view that is between two frames of the walk, or stays, is drawn anew each time."""
    nearest, out = round(at), abs(aside) > 1e-9
    if out:
        data = walk.strangers[round(aside / walk.spacing) % len(walk.strangers)]
    elif stretch.own:
        data = walk.references[walk.reference(at)]
    else:
        data = walk.frames[nearest]
    between = not out and abs(at - nearest) > 1e-6
    if not (between or same or stretch.look or stretch.orientation != UPRIGHT):
        return data
    view = pixels(data)
    if between or same:
        view = another_look(view, random, at - nearest if between else 0.0)
    if stretch.look is not None:
        view = stretch.look(view, random, number)
    return pictures.file(view, stretch.orientation)


def _measured(wheels: PlanarPose, old: PlanarPose, new: PlanarPose, random: Random) -> PlanarPose:
    """The odometry after a motion: the motion with its errors, on top of what it said before."""
    way = (new.x - old.x) + 1j * (new.y - old.y)
    length = abs(way)
    slipped = way * np.exp(1j * (wheels.heading - old.heading)) * (1 + SLIP * random.normal())
    turn = new.heading - old.heading + SPIN * np.sqrt(length) * random.normal()
    return PlanarPose(wheels.x + float(slipped.real), wheels.y + float(slipped.imag), wheels.heading + float(turn))


def _disturbed(name: str, stretch: SteadyStretch, **options: object) -> Situation:
    """Ten seconds of an undisturbed walk, the stretch, and twelve undisturbed seconds."""
    return replace(Situation(name, (SteadyStretch(10), stretch, SteadyStretch(12, again=True))), **options)  # type: ignore[arg-type]


def _throughout(name: str, look: Look | None, orientation: int = UPRIGHT) -> Situation:
    """A walk on which every picture is changed in one way."""
    return Situation(name, (SteadyStretch(30, look=look, orientation=orientation),))


PACES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.5, 2.0, 3.0, 5.0, 10.0)

SITUATIONS: dict[str, Situation] = {
    one.name: one
    for one in (
        Situation("passing", (SteadyStretch(40),)),
        _disturbed("standing", SteadyStretch(30, pace=0)),
        _disturbed("standing on a mapped view", SteadyStretch(20, pace=0, own=True)),
        Situation(
            "standing where the map stood", (SteadyStretch(20, pace=0), SteadyStretch(12)), start=STOOD, map="stood"
        ),
        Situation("passing where the map stood", (SteadyStretch(30),), start=STOOD - 0.15, map="stood"),
        *(Situation(f"pace {pace:g}", (SteadyStretch(40, pace=pace),)) for pace in PACES),
        Situation("reverse", (SteadyStretch(10), SteadyStretch(16, pace=-1, again=True)), start=0.3),
        Situation(
            "stop and go", tuple(SteadyStretch(5, pace=one % 2, again=one == 1) for one in (1, 0, 1, 0, 1, 0, 1, 0))
        ),
        _disturbed("people passing", SteadyStretch(12, look=pictures.people)),
        _disturbed("people passing while standing", SteadyStretch(25, pace=0, look=pictures.people)),
        _disturbed("hand over the camera", SteadyStretch(8, look=pictures.hand)),
        _disturbed("frames lost", SteadyStretch(8, fate="lost")),
        _disturbed("every second frame lost", SteadyStretch(16, fate="lost", whole=False)),
        _disturbed("answers lost", SteadyStretch(6, fate="unanswered")),
        _disturbed("every second answer lost", SteadyStretch(16, fate="unanswered", whole=False)),
        Situation("restart", (SteadyStretch(12), SteadyStretch(12, restart=True, again=True))),
        Situation("carried off", (SteadyStretch(14), SteadyStretch(20, start=0.7, again=True))),
        Situation(
            "leaving and coming back",
            (
                SteadyStretch(10),
                SteadyStretch(8, 0, aside=2),
                SteadyStretch(8, 0, aside=-2),
                SteadyStretch(12, again=True),
            ),
        ),
        Situation("map enrolled twice", (SteadyStretch(30),), map="twice"),
        Situation("look-alike stretch", (SteadyStretch(40),), start=0.25, map="look-alike"),
        _throughout("on its side", pictures.on_its_side),
        _throughout("on its side, with EXIF", pictures.on_its_side, pictures.ON_ITS_SIDE),
        _throughout("upside down", pictures.upside_down),
        _throughout("upside down, with EXIF", pictures.upside_down, pictures.UPSIDE_DOWN),
        _throughout("half the lens dirty", pictures.dirty),
        _throughout("exposure jumps", pictures.exposure),
        _throughout("longer lens", pictures.narrower),
        _throughout("cut to 60 %", pictures.cut(0.6, 0.6)),
        _throughout("cut to 75 %", pictures.cut(0.75, 0.75)),
        _throughout("cut to portrait", pictures.portrait),
        _throughout("shorter lens", pictures.wider),
        replace(_throughout("cut to 60 %, with intrinsics", pictures.cut(0.6, 0.6)), map="cameras", camera=CUT),
        *(
            Situation(f"odometry {name}", (SteadyStretch(12), SteadyStretch(36, odometry=fault), SteadyStretch(12)))
            for name, fault in FAULTS.items()
        ),
        Situation("5 frames a second", (SteadyStretch(12),), rate=5.0),
        Situation("60 frames a second", (SteadyStretch(2),), rate=60.0),
    )
}
