"""After an answer: it is counted and sent to the listeners of the map; a doubtful frame is stored for review."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from core.errors import PlacerecError
from core.judgement.verdict import Verdict
from core.store import Map
from core.upkeep.histories import PlacePeriod
from service.engine.engine import Engine
from service.queries.counts import PassedBy
from service.queries.given_answers import GivenAnswer, QueriedFrame
from service.queries.schemas import QueryAnswer
from service.queries.statistics import QueryStatistics, map_key
from service.telemetry.requests import is_trial


def follow_answer(
    engine: Engine,
    statistics: QueryStatistics,
    map_: Map,
    answer: QueryAnswer,
    frame: bytes,
    queried: QueriedFrame,
    file: str | None = None,
    milliseconds: Mapping[str, float] | None = None,
    count: bool = True,
    review: bool = True,
    passed: PassedBy | None = None,
    run: Verdict | None = None,
) -> None:
    """Count an answer, send it to the listeners of its map, if any, and store the frame if the map's settings say so.

    Nobody is waited for.  What a person tries in the console is not counted: it is no robot.

    Args:
        frame: the bytes of the frame's file; listeners see a picture of it only if the map stores pictures.
        queried: the origin of the frame.
        file: the name of the file part that the frame was.
        milliseconds: of the whole request, where the answer does not say it.
        count: whether the answer says something of the map, in whose statistics it is counted.
        review: whether the map may store the frame.
        passed: the place that a run was sure to be at.
        run: the verdict of the run that the frame belongs to, after it; None: it belongs to none.
    """
    record, given, counts = map_.record, GivenAnswer.of(answer, queried, milliseconds, run), not is_trial()
    if counts:
        engine.metrics.observe_answer(record.id, answer.verdict, answer.score)
    if "search" in answer.milliseconds:
        engine.metrics.searches.observe(answer.milliseconds["search"] / 1e3)
    if count and counts:
        _count(engine, statistics, record.id, answer, given, passed)
    is_stored = review and record.review is not None and answer.verdict in record.review.verdicts
    if not is_stored and not engine.events.heard(record.id):
        return
    event = given.event(record.id, file, None if answer.explanation is None else answer.explanation.picture)
    engine.events.publish(event, frame if record.keep != "none" else None)
    if is_stored:
        engine.review_keeper.offer(map_, frame, given.for_review(event))


def _count(
    engine: Engine,
    statistics: QueryStatistics,
    map_id: str,
    answer: QueryAnswer,
    given: GivenAnswer,
    passed: PassedBy | None,
) -> None:
    """Count an answer in the statistics of its map, and store it for a while, if the map still exists."""
    with suppress(PlacerecError):  # the map was deleted in the meantime
        key = map_key(engine.maps.find(map_id))
        statistics.observe(key, given.verdict, given.best, given.score, given.decision, _period(answer), passed)
        statistics.recent.add(key, given)
        statistics.robots.observe(key, given)


def _period(answer: QueryAnswer) -> PlacePeriod | None:
    """The count of an answer for its best match; None without one."""
    if not answer.matches:
        return None
    recognized, parts = answer.verdict == "recognized", answer.matches[0].parts
    inliers = None if parts is None else parts.inliers
    return PlacePeriod(
        best=1,
        recognized=int(recognized),
        probability=answer.probability or 0.0,
        score=0.0 if parts is None or not recognized else parts.similarity + parts.agreement,
        verified=int(inliers is not None),
        inliers=inliers or 0,
    )
