"""A map through a year: it answers every run, and learns from it or not, in one of three ways."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.learning.living_map import EncodedPicture, LivingMap, Recognized
from benchmarks.learning.worlds import RobotWorld
from benchmarks.learning.year import RunMoment, RunPlan
from core.belief import PlaceGraph, Run, RunOptions, Step, View
from core.learning import (
    Lesson,
    LookStatistics,
    PendingProposal,
    RunFrame,
    Trail,
    Witness,
    cohort_of,
    corroborated,
    kept,
    least_score,
    lesson_of,
    services,
)
from core.learning.anchors import place_of
from core.learning.proposals import Refusal

Mode = Literal["off", "propose", "auto"]
"""The map stays; a perfect reviewer takes every right proposal; or what independent evidence agrees on is taken."""

FIRST_DAY = datetime(2026, 1, 1, tzinfo=UTC)

REMEMBERED = 8
"""Proposals wait for this many runs for a witness."""


@dataclass(frozen=True)
class EncodedRun:
    """A run with its encoded frames, which all ways of learning share."""

    plan: RunPlan
    moments: Sequence[RunMoment]
    frames: Sequence[EncodedPicture]
    views: Sequence[View]


@dataclass
class RunTally:
    """The figures of one run, or of several.

    frames: those in the map; right, wrong: recognized ones, wrong also of frames from elsewhere.
    proposed, proposed_wrong, taken, taken_wrong, withdrawn: looks.
    attackers: looks that were taken of the attacker's frames.
    rows: of the map, living ones.
    milliseconds: for the answer to a frame, without its encoding.
    contradiction, refused: as of :class:`core.learning.Lesson`.
    """

    frames: int = 0
    right: int = 0
    wrong: int = 0
    proposed: int = 0
    proposed_wrong: int = 0
    taken: int = 0
    taken_wrong: int = 0
    attackers: int = 0
    withdrawn: int = 0
    rows: int = 0
    milliseconds: float = 0.0
    contradiction: str | None = None
    refused: Mapping[Refusal, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Waiting:
    """A proposal that waits, with its frame and the truth about it."""

    pending: PendingProposal
    frame: EncodedPicture
    believable: float
    least: float
    place: int
    right: bool
    attacker: bool

    @property
    def key(self) -> tuple[str, int]:
        """The run and the number of the frame in it."""
        return self.pending.run, self.pending.proposal.frame


@dataclass
class _Learnt:
    """A learnt look: its frame, how it has served, and the truth about it."""

    frame: EncodedPicture
    place: int
    right: bool
    attacker: bool
    believable: float
    served: LookStatistics = field(default_factory=LookStatistics)


class Learner:
    """One world's map in one mode."""

    def __init__(
        self, world: RobotWorld, map_: LivingMap, first: Sequence[EncodedPicture], mode: Mode, any_score: bool = False
    ) -> None:
        """``any_score``: looks are believed from any score on."""
        self.any_score = any_score
        self.world, self.map, self.mode, self.first = world, map_, mode, first
        self.base = len(map_)
        self.waiting: list[_Waiting] = []
        self.learnt: dict[int, _Learnt] = {}
        self.runs = 0
        self._between: dict[tuple[tuple[str, int], tuple[str, int]], float] = {}

    def live(self, run: EncodedRun) -> RunTally:
        """Answer a run, then learn from it."""
        tally = RunTally()
        began = time.perf_counter()
        answers = self.map.recognize(run.frames)
        tally.milliseconds = 1e3 * (time.perf_counter() - began) / len(answers)
        self._count(run, answers, tally)
        if self.mode != "off":
            graph = self.map.graph()
            frames = run_frames(run, answers, graph)
            lesson = lesson_of(frames, graph)
            tally.contradiction, tally.refused = lesson.contradiction, lesson.refused
            self._observe(lesson, frames, graph, tally)
            self._propose(lesson, run, answers, Trail.of(frames), graph, tally)
            self._take(graph, tally)
            self._rehearse(lesson, run, tally)
        self.runs += 1
        tally.rows = len(self.map)
        return tally

    def examine(self, run: EncodedRun) -> RunTally:
        """Answer a run and learn nothing."""
        tally = RunTally()
        self._count(run, self.map.recognize(run.frames), tally)
        return tally

    def left(self) -> dict[str, int]:
        """The numbers of its rows, learnt looks, those of wrong places, and those of an attacker's frames."""
        looks = self.learnt.values()
        wrong, attackers = sum(not one.right for one in looks), sum(one.attacker for one in looks)
        return {"rows": len(self.map), "looks": len(looks), "wrong": wrong, "attackers": attackers}

    def _count(self, run: EncodedRun, answers: Sequence[Recognized], tally: RunTally) -> None:
        for moment, answer in zip(run.moments, answers, strict=True):
            tally.frames += moment.at is not None
            if answer.judgement.verdict == "recognized":
                right = self._shows(moment, self.map.place[answer.row])
                tally.right += right
                tally.wrong += not right

    def _shows(self, moment: RunMoment, place: int) -> bool:
        return moment.at is not None and bool(self.world.right[moment.at, place])

    def _observe(self, lesson: Lesson, frames: Sequence[RunFrame], graph: PlaceGraph, tally: RunTally) -> None:
        """Count how the learnt looks have served, and withdraw those that mislead."""
        looks: dict[int, list[int]] = {}
        for row, one in self.learnt.items():
            looks.setdefault(place_of(graph, one.place), []).append(row)
        for row, served in services(lesson, frames, graph, looks).items():
            if row in self.learnt:
                self.learnt[row].served += served
        self._withdraw([row for row, one in self.learnt.items() if one.served.misleads or one.served.idle], tally)

    def _withdraw(self, rows: Sequence[int], tally: RunTally) -> None:
        for row in rows:
            self.map.withdraw_look(row)
            del self.learnt[row]
            tally.withdrawn += 1

    def _propose(
        self,
        lesson: Lesson,
        run: EncodedRun,
        answers: Sequence[Recognized],
        trail: Trail,
        graph: PlaceGraph,
        tally: RunTally,
    ) -> None:
        for proposal in lesson.proposals:
            moment, place = run.moments[proposal.frame], self.map.place[proposal.row]
            right, name = self._shows(moment, place), str(run.plan.number)
            source = Witness(run.plan.robot, FIRST_DAY + timedelta(days=run.plan.number))  # a run a day
            believable = answers[proposal.frame].believable
            frame = run.frames[proposal.frame]
            cohort = cohort_of(trail, proposal.frame, graph)
            beside, far = (
                self.map.scores_between(frame, [run.frames[one] for one in part.tolist()])
                for part in (cohort.beside, cohort.far)
            )
            least = least_score(beside, far, self.map.encoder.calibration)
            if least is None:
                continue
            tally.proposed += 1
            tally.proposed_wrong += not right
            pending = PendingProposal(proposal, name, source)
            stranger = run.plan.robot == "stranger"
            self.waiting.append(_Waiting(pending, frame, believable, least, place, right, stranger))

    def _take(self, graph: PlaceGraph, tally: RunTally) -> None:
        """Take the proposals that this mode takes; the others wait for a while."""
        if self.mode == "propose":
            chosen = {number for number, one in enumerate(self.waiting) if one.right}
            left: list[_Waiting] = []
        else:

            def scores(number: int, others: Sequence[int]) -> NDArray[np.float32]:
                one = self.waiting[number]
                new = [at for at in others if (one.key, self.waiting[at].key) not in self._between]
                found = self.map.scores_between(one.frame, [self.waiting[at].frame for at in new])
                for at, score in zip(new, found.tolist(), strict=True):
                    self._between[one.key, self.waiting[at].key] = score
                return np.array([self._between[one.key, self.waiting[at].key] for at in others], np.float32)

            pending = [one.pending for one in self.waiting]
            chosen = set(corroborated(pending, graph, self.map.encoder.calibration, scores))
            recent = [str(number) for number in range(self.runs - REMEMBERED, self.runs + 1)]
            left = [one for at, one in enumerate(self.waiting) if at not in chosen and one.pending.run in recent]
        for number in sorted(chosen):
            self._add(self.waiting[number], tally)
        self.waiting = left

    def _add(self, one: _Waiting, tally: RunTally) -> None:
        """Add a look to a place if it keeps it; another may go instead."""
        rows = [row for row, learnt in self.learnt.items() if learnt.place == one.place]
        looks = [self.first[one.place], *(self.learnt[row].frame for row in rows), one.frame]
        table = np.stack([self.map.scores_between(look, looks) for look in looks])
        served = [LookStatistics(), *(self.learnt[row].served for row in rows), LookStatistics()]
        staying = set(kept(table, one.believable, services=served).tolist())
        for at, row in enumerate(rows, start=1):
            if at not in staying:
                self.map.withdraw_look(row)
                del self.learnt[row]
        if len(looks) - 1 in staying:
            row = self.map.add_look(one.place, one.frame, -np.inf if self.any_score else one.least)
            self.learnt[row] = _Learnt(one.frame, one.place, one.right, one.attacker, one.believable)
            tally.taken += 1
            tally.taken_wrong += not one.right
            tally.attackers += one.attacker

    def _rehearse(self, lesson: Lesson, run: EncodedRun, tally: RunTally) -> None:
        """Ask the run again, and withdraw new looks that win frames which the run is certain to be elsewhere."""
        if not tally.taken:
            return
        graph, answers = self.map.graph(), self.map.recognize(run.frames)
        frames = run_frames(run, answers, graph)
        found = services(lesson, frames, graph)
        self._withdraw([row for row, one in found.items() if row in self.learnt and one.wrong > one.right], tally)


def run_frames(run: EncodedRun, answers: Sequence[Recognized], graph: PlaceGraph) -> list[RunFrame]:
    """The frames of a run as a session sees them: covered and constant views are found by the session itself."""
    session, trail = Run(RunOptions(), graph), []
    for moment, frame, view, answer in zip(run.moments, run.frames, run.views, answers, strict=True):
        motion = session.moved_to(moment.pose, None, None) if session.pose is not None else None
        session.advance(answer.seen, Step(odometry=motion), view, moment.pose)
        judgement = answer.judgement
        trail.append(
            RunFrame(
                answer.seen,
                judgement.verdict,
                judgement.probability,
                answer.row,
                moment.pose,
                session.sight,
                frame.keypoints,
            )
        )
    return trail
