"""The health report of a map.

It counts the map's answers by week, searches for the map's own frames in the map to find places that look alike, and
follows each sequence to find gaps.  The frames of a stop count once: the first of them stands for all.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from core.judgement.background import GUARD_FACTOR
from core.method.encoder import Encoder
from core.recognition.pose_survey import PoseSurvey, pose_survey
from core.recognition.self_queries import TOGETHER, SelfQueries, spread_order
from core.store import Map
from core.upkeep import coverage, hubness
from core.upkeep.coverage import Gap, Measure
from core.upkeep.drift import Trend, score_trend, unknown_trend
from core.upkeep.hubness import Alias
from core.upkeep.redundancy import first_looks, stops
from core.upkeep.revisits import Reason, Sign, silent_runs, stretches
from core.upkeep.shared_routes import SharedRoute, shared_routes
from service.queries.counts import Statistics
from service.upkeep.schemas import (
    AliasingView,
    AliasView,
    AnswersView,
    GapView,
    HubView,
    MapHealth,
    PoseHealth,
    SharedRouteView,
    SilentPlaces,
    StopView,
    StretchView,
    TrendsView,
    TrendView,
    WeekView,
)

ALIASING_SHARE = 0.5
"""Share of the time for places that look alike; the rest is for the sequences."""

QUERIES_A_PLACE = 3
"""From this number of queries a place on, a place that never matched means something: by chance one in twenty does."""

STEPS_TOGETHER = 64
"""How many steps of a sequence are compared at a time."""

REASON_OF: dict[Measure, Reason] = {"distance": "distance-gap", "time": "time-gap", "similarity": "similarity-gap"}


@dataclass(frozen=True)
class _Walk:
    """A sequence: the positions of its places in the map, in order, and the gaps between them."""

    name: str
    positions: NDArray[np.int64]
    gaps: list[Gap]


@dataclass(frozen=True)
class _Aliasing:
    """Places that look like other places.

    views: int64 [v], positions of places, of those of a stop the first alone.
    counts: int64 [v], of these, as of :func:`core.upkeep.hubness.occurrences`.
    hubs: positions of places.
    aliases: of places that look like other places, but for those of the routes.
    routes: traverses that seem to follow one route.
    """

    examined: int
    views: NDArray[np.int64]
    neighbours: int
    counts: NDArray[np.int64]
    hubs: NDArray[np.int64]
    aliases: list[Alias]
    routes: list[SharedRoute]


def examine_health(
    map_: Map,
    encoder: Encoder,
    statistics: Statistics,
    trends: TrendsView,
    calibration_doubt: str | None,
    seconds: float,
    limit: int,
) -> MapHealth:
    """Make the health report of a map.

    Args:
        encoder: the map's encoder.
        statistics: the counted answers of the map.
        trends: what the histories of its places tell.
        calibration_doubt: why its own calibration is not to be trusted; None: nothing is known against it.
        seconds: how long to examine the map's frames; of a large map only a part is examined, spread over the map.
        limit: how many places, gaps and stretches are listed at most, each.

    Raises:
        MapQuarantined, StorageFailure, UnknownMap: the map cannot be read.
    """
    began = time.monotonic()
    own = SelfQueries(map_, encoder)
    first = first_looks(own.where, own.neighborhood)
    aliasing = _aliasing(own, first, began + ALIASING_SHARE * seconds)
    walks, all_compared = _walks(own, first, began + seconds)
    enough = _compared(statistics) >= QUERIES_A_PLACE * len(aliasing.views)
    seen = [i for i, place in enumerate(own.places) if place.id in statistics.places]
    silent = np.flatnonzero(~np.isin(first, first[seen])).tolist()
    names = [place.id for place in own.places]
    gaps = [
        GapView(
            sequence=walk.name,
            before=names[walk.positions[gap.before]],
            after=names[walk.positions[gap.before + 1]],
            measure=gap.measure,
            value=gap.value,
            median=gap.median,
            severity=gap.severity,
        )
        for walk in walks
        for gap in walk.gaps
    ]
    gaps.sort(key=lambda gap: -gap.severity)
    again = _retraverse(own, walks, aliasing, set(silent) if enough else None)
    stopped = [
        StopView(
            sequence=own.places[stop.places[0]].sequence or "", place=names[stop.places[0]], frames=len(stop.places)
        )
        for stop in stops(own.where)
    ]
    return MapHealth(
        map=map_.record.id,
        places=len(own),
        complete=all_compared and aliasing.examined == len(aliasing.views),
        calibration_doubt=calibration_doubt,
        answers=_answers(statistics),
        never_matched=_never_matched(own, aliasing.views, statistics, silent, enough, limit),
        aliasing=_aliasing_view(own, first, aliasing, statistics, limit),
        gaps=gaps[:limit],
        gap_count=len(gaps),
        gap_counts={measure: sum(gap.measure == measure for gap in gaps) for measure in get_args(Measure)},
        stops=stopped[:limit],
        stop_count=len(stopped),
        retraverse=again[:limit],
        retraverse_count=len(again),
        trends=trends,
        shared_routes=_shared_routes(own, aliasing),
        poses=_poses(pose_survey(map_)),
    )


def _poses(survey: PoseSurvey) -> list[PoseHealth]:
    ordered = sorted(survey.traverses.values(), key=lambda one: (not one.turned, one.sequence))
    return [PoseHealth(**asdict(one), remark=one.remark) for one in ordered]


def _answers(statistics: Statistics) -> AnswersView:
    weeks = statistics.weeks
    views = [
        WeekView(
            monday=week.monday,
            queries=week.queries,
            recognized=week.recognized,
            ambiguous=week.ambiguous,
            unknown=week.unknown,
            blank=week.blank,
            unknown_rate=week.unknown_rate(),
            mean_score=week.mean_score(),
            mean_decision=week.mean_decision(),
            scores=list(week.bins),
        )
        for week in weeks
    ]
    return AnswersView(
        since=statistics.since,
        queries=sum(week.queries for week in weeks),
        recognized=sum(week.recognized for week in weeks),
        ambiguous=sum(week.ambiguous for week in weeks),
        unknown=sum(week.unknown for week in weeks),
        weeks=views,
        score_trend=_trend_view(score_trend(weeks)),
        unknown_trend=_trend_view(unknown_trend(weeks)),
    )


def _trend_view(found: Trend | None) -> TrendView | None:
    return None if found is None else TrendView(**asdict(found), significant=found.significant)


def _compared(statistics: Statistics) -> int:
    """How many queries were compared with the map's places."""
    return sum(week.compared for week in statistics.weeks)


def _shared_routes(own: SelfQueries, found: _Aliasing) -> list[SharedRouteView]:
    names = {int(code): place.sequence or "" for code, place in zip(own.where.sequence, own.places, strict=True)}
    return [
        SharedRouteView(sequence=names[route.sequences[1]], other=names[route.sequences[0]], frames=len(route.aliases))
        for route in found.routes
    ]


def _never_matched(
    own: SelfQueries, views: NDArray[np.int64], statistics: Statistics, silent: list[int], enough: bool, limit: int
) -> SilentPlaces | None:
    queries = _compared(statistics)
    if not queries or not len(views):
        return None
    places = [own.places[i] for i in np.intersect1d(views, silent).tolist()]
    # Poisson: how many places no query would match if each query matched a place drawn at random.
    by_chance = len(views) * math.exp(-queries / len(views))
    ids = [place.id for place in sorted(places, key=lambda place: place.number)[:limit]]
    wanted = QUERIES_A_PLACE * len(views)
    return SilentPlaces(
        count=len(places), by_chance=by_chance, queries=queries, wanted=wanted, enough=enough, places=ids
    )


def _aliasing(own: SelfQueries, first: NDArray[np.int64], until: float) -> _Aliasing:
    """Find places that are neighbours of many others, and places that look more like another place than their own."""
    views = np.flatnonzero(first == np.arange(len(own)))
    k = min(hubness.NEIGHBOURS, max(1, len(views) // 10))
    order = views[spread_order(len(views))].tolist()
    searched = own.members(views)
    lists: list[NDArray[np.int64]] = [np.empty((0, k), np.int64)]
    aliases: list[Alias] = []
    done = 0
    while done < len(order) and (not done or time.monotonic() < until):
        some = order[done : done + TOGETHER]
        for position, others, scores in own.search(some, searched):
            same = own.near(position, others)
            best, found = hubness.nearest_others(scores, own.near(position, others, GUARD_FACTOR), k)
            lists.append(np.append(others, hubness.NONE)[best][np.newaxis])  # NONE is -1 and picks the appended NONE
            mine = float(scores[same].max()) if same.any() else None
            has_own = same.any() or own.near(position, views[views != position]).any()
            if best[0] != hubness.NONE and has_own and (mine is None or found[0] > mine):
                aliases.append(Alias(position, int(others[best[0]]), float(found[0]), mine))
        done += len(some)
    counts = hubness.occurrences(np.concatenate(lists), len(own))[views]
    routes = shared_routes(own.where, aliases, np.array(order[:done], np.int64))
    along = {(one.place, one.other) for route in routes for one in route.aliases}
    aliases = [alias for alias in aliases if (alias.place, alias.other) not in along]
    aliases.sort(key=lambda alias: -alias.score)
    return _Aliasing(done, views, k, counts, views[hubness.hubs(counts)], aliases, routes)


def _aliasing_view(
    own: SelfQueries, first: NDArray[np.int64], found: _Aliasing, statistics: Statistics, limit: int
) -> AliasingView:
    names = [place.id for place in own.places]
    counted = [statistics.places.get(name) for name in names]
    single = np.array([0 if count is None else count.best - count.recognized for count in counted], np.int64)
    unsure = np.zeros(len(own), np.int64)
    np.add.at(unsure, first, single)
    named = [names[view] for view in found.views.tolist()]
    pairs = list({frozenset((one.place, one.other)): one for one in reversed(found.aliases)}.values())[::-1]
    hubs, doubted = _hubs(named, found.counts), _hubs(named, unsure[found.views])
    return AliasingView(
        examined=found.examined,
        of=len(found.views),
        neighbours=found.neighbours,
        skewness=hubness.skewness(found.counts),
        hubs=hubs[:limit],
        hub_count=len(hubs),
        aliases=[
            AliasView(place=names[one.place], other=names[one.other], score=one.score, own=one.own)
            for one in pairs[:limit]
        ],
        alias_count=len(pairs),
        unsure=doubted[:limit],
        unsure_count=len(doubted),
    )


def _hubs(names: list[str], counts: NDArray[np.int64]) -> list[HubView]:
    expected = float(counts.mean()) if len(counts) else 0.0
    return [HubView(place=names[i], count=int(counts[i]), expected=expected) for i in hubness.hubs(counts).tolist()]


def _walks(own: SelfQueries, first: NDArray[np.int64], until: float) -> tuple[list[_Walk], bool]:
    """Every sequence with its gaps; False if the time was up before the frames of all were compared.

    From one frame of a stop to the next is no step.
    """
    walks, complete = [], True
    for ordered in own.where.walks():
        where = own.where.take(ordered)
        stood = first[ordered[1:]] == first[ordered[:-1]]
        gaps = coverage.long_ways(own.where, ordered, first)
        gaps += coverage.long_steps(np.where(stood, np.nan, coverage.durations(where)), "time")
        similarities, all_seen = _similarities(own, ordered, until)
        gaps += coverage.unlike_steps(np.where(stood, np.nan, similarities))
        complete = complete and all_seen
        walks.append(_Walk(own.places[ordered[0]].sequence or "", ordered, gaps))
    return walks, complete


def _similarities(own: SelfQueries, ordered: NDArray[np.int64], until: float) -> tuple[NDArray[np.float64], bool]:
    """How alike each frame and the next one look, NaN from where the time was up; False if it was up."""
    found = np.full(max(0, len(ordered) - 1), np.nan)
    pairs = np.stack([ordered[:-1], ordered[1:]], axis=1)
    for first in range(0, len(pairs), STEPS_TOGETHER):
        if time.monotonic() > until:
            return found, False
        found[first : first + STEPS_TOGETHER] = own.first_stage_scores(pairs[first : first + STEPS_TOGETHER])
    return found, True


def _retraverse(
    own: SelfQueries, walks: list[_Walk], aliasing: _Aliasing, silent: set[int] | None
) -> list[StretchView]:
    """The stretches of sequences that should be recorded again; those with the most signs come first.

    Args:
        silent: positions of places that never matched; None while there are too few queries to tell.
    """
    aliased, hubs = {alias.place for alias in aliasing.aliases}, set(aliasing.hubs.tolist())
    made = []
    for walk in walks:
        signs = [Sign(gap.before, gap.before + 1, REASON_OF[gap.measure]) for gap in walk.gaps]
        for index, position in enumerate(walk.positions.tolist()):
            signs += [Sign(index, index, "aliased")] if position in aliased else []
            signs += [Sign(index, index, "hub")] if position in hubs else []
        if silent is not None:
            signs += silent_runs(position not in silent for position in walk.positions.tolist())
        made += [
            StretchView(
                sequence=walk.name,
                first=own.places[walk.positions[stretch.first]].id,
                last=own.places[walk.positions[stretch.last]].id,
                reasons=list(stretch.reasons),
                weight=stretch.weight,
            )
            for stretch in stretches(signs)
        ]
    return sorted(made, key=lambda stretch: -stretch.weight)
