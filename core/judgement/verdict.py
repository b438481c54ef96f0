"""The verdict on a query, recognized, ambiguous or unknown, from its scores against a map.

Scores of different maps and conditions cannot be compared, so the best score is compared with the others of the same
map.  The decision value is the geometric mean of the best score s and of its lead over the best other places that were
examined as closely,

    d = √(s · (s - mean of the five best other places)).

Neither factor is enough alone: in a map whose places all look alike, unknown places score high, too, and where nothing
looks alike a low score leads.  Only the top of the ranking is needed, so that the value is the same whether all of a
map was scored or a shortlist.  As a map of a few places says little about others, imagined places are added to it
(``background.py``).

The calibration's curve turns a decision value into a probability (``probability.py``).  Of two places that score alike
at most one is right, so that

    P = curve(d), or ½ curve(d) where m < m₀,

with the lead m over the best rival and the margin m₀ under which an answer is ambiguous.  In log odds a margin is a
tenth, so that within it either is about as likely as the other.  So an answer that a rival makes ambiguous is no
likelier than a half, and a recognized one no less likely than the threshold demands.

Rivals can be the reason why nothing stands out: a second traverse of the same places, or another place that looks the
same.  They are left out of the background one after the other.  If the best match stands out of what is left, the
verdict is ``ambiguous`` and names them; it would be wrong to call such a frame unknown and to enrol it once more.

Where candidates were verified geometrically, the evidence of the best match and its lead join the decision value in one
probability (``geometry.py``), which takes the threshold's place, and the lead is that in the final order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field

from core.judgement.background import FULL, GUARD_FACTOR, TOP_PLACES, Background, Environment, background, unrelated
from core.judgement.geometry import Geometry, GeometryTerms, share_of_lead
from core.judgement.probability import Curve, sigmoid
from core.places import Neighborhood, Whereabouts

__all__ = ["TOP_PLACES", "Calibration", "Environment", "Judgement", "Rivals", "Verdict", "judge", "worth_verifying"]

Verdict = Literal["recognized", "ambiguous", "unknown"]
Positions = NDArray[np.int64]
Values = NDArray[np.float64]
Likeness = Callable[[Positions], NDArray[np.float32]]
"""Returns what the best match scores, as if it were the query, at positions in a ranking; int64 [k] to float32 [k]."""

ALIKE = 2.5
"""A place shows the same as the best match if the decision value of its score against it is this multiple of the
threshold.  On corridor and lip6 enrolled twice, and without sequences, 1.5 to 3 change no share of the verdicts by more
than 0.05."""

MOST_RIVALS = 8
"""The largest number of rivals, the best ones, that are examined, each with its neighbours."""

CLEAR_STOREY = 2 / 3
"""A match is recognized if it is twice as probable as any place on another storey that the query may as well show, as
in a session.  Without a prior none is, and one with a trust of 0.5 is enough; it was chosen on nothing else."""

HALFWAY = 0.5
"""A query that has less than this share of the lead over a twin which shows the best match alone may show either.  It
is the middle.  On corridor as two storeys, the upper one copies with noise, 0.25 and 0.75 change nothing for frames of
the other traverse, or of this one in other light (1 of 37 and 0 on the wrong storey); of further copies with noise 12,
4 and 1 of 37 are recognized with 0.25, 0.5 and 0.75, all rightly.  Cut into three storeys that differ, corridor has the
same verdicts with each of them as without storeys."""

EVEN = 0.5
"""The most that is left of a probability where another place is about as likely."""

MOSTLY_IMAGINED = 0.5
"""Imagined share of the background above which a map counts as one of few places."""

DOUBT = (0.02, 0.65)
"""Between these probabilities an answer is in doubt, or up to that of the threshold, if that is stricter.  On tasks of
training photographs ``auto`` has 0.003 less recall@1 than ``always``; up to 0.5 it had 0.007 less, with 0.1 to 0.5 it
had 0.027 less.  The upper end was chosen on corridor and lip6, of whose frames, queried in the whole other traverse,
two stages leave 0.16 and 0.28 there.  Up to 0.5 it was 0.06 and 0.25, but the AUC-ROC in halved maps of corridor 0.977
in place of 0.980 (``always`` has 0.985); up to 0.7 it would be 0.23 and 0.29, and 0.984."""


class Calibration(BaseModel):
    """When to believe a match; measured on frames held out of training.

    ``threshold`` is on the decision value, ``margin`` on the difference of
    two scores.  ``background_mean`` and ``background_deviation`` describe the score of unrelated
    frames, in units of the score.  ``curve`` gives the probability that a decision value is right; a calibration on
    frames that are all alike has none.  ``decision`` names the kind of decision value.
    ``environment`` describes the scores of other places of one environment, which stand for those that a small map does
    not have yet; it is measured of the packaged encoders alone, and without it these score as unrelated frames do.
    ``geometry`` says how geometric evidence joins the probability; without it, or without a curve, evidence changes the
    order of the candidates only.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str = Field(min_length=1, examples=["encoder-default"])
    threshold: float = Field(allow_inf_nan=False)
    margin: float = Field(ge=0, allow_inf_nan=False)
    background_mean: float = Field(allow_inf_nan=False)
    background_deviation: float = Field(gt=0, allow_inf_nan=False)
    curve: Curve | None = None
    decision: Literal["leading"] = "leading"
    frames: int | None = Field(default=None, ge=1, description="Held-out or labelled frames it rests on, if known.")
    environment: Environment | None = Field(
        default=None,
        exclude_if=lambda environment: environment is None,
        description="Scores of other places within one environment; null: not measured.",
    )
    geometry: GeometryTerms | None = Field(
        default=None,
        exclude_if=lambda terms: terms is None,
        description="How geometric evidence joins the probability; null: it does not.",
    )

    def background(
        self, scores: NDArray[np.floating], others: int, apart: NDArray[np.floating] | None = None
    ) -> Background:
        """The background of a query: the scores of other places, and of imagined ones in a small map.

        Args:
            scores: float [n], n >= 0, best first: of other places that were examined as closely as the best match.
            others: how many other places the map has, at least n.
            apart: float [m], the scores of those of them that cannot overlap with the best match; None: all.
        """
        if self.environment is None:
            return unrelated(scores, self.background_mean, self.background_deviation)
        return background(scores, scores if apart is None else apart, others, self.environment)


@dataclass(frozen=True)
class Rivals:
    """Places that score nearly as well as the best match, or show the same, and so explain a low lead.

    positions: in the ranking, best first; of each place and its neighbours the best.
    same_place: whether they show what the best match shows; else they are one place that looks like the query.
    """

    positions: tuple[int, ...]
    same_place: bool


@dataclass(frozen=True)
class Judgement:
    """A verdict and the values that it rests on; None for values that do not exist.

    score: of the best match.
    decision: the decision value.
    margin: the lead over the best rival, in the scores of all stages.
    rival: the position of the best rival in the ranking.
    probability: that the best match is right; None for an empty map, and for a calibration without a curve.
    imagined: the share of the background that was imagined, from 0 to 1.
    rivals: the places that make the query ambiguous; empty for other verdicts.
    evidence: of verification for the best match, -ln of the number of false alarms; None if it was not verified.
    twins: positions of places on other storeys that the query may as well show, best first.
    """

    verdict: Verdict
    score: float | None
    decision: float | None
    margin: float | None
    rival: int | None
    probability: float | None = None
    imagined: float = 0.0
    rivals: tuple[Rivals, ...] = ()
    evidence: float | None = None
    twins: tuple[int, ...] = ()

    @property
    def lead(self) -> float:
        """The margin, or infinity without a rival."""
        return float("inf") if self.margin is None else self.margin


def log_odds_of(
    decision: ArrayLike,
    margin: ArrayLike,
    calibration: Calibration,
    imagined: ArrayLike = 0.0,
    evidence: ArrayLike | None = None,
) -> Values | None:
    """The log odds that best matches are right, before rivals under the margin take from them; float64 of any shape.

    Args:
        decision: the decision values.
        margin: as of :func:`share_of_leads`; it counts where a best match was verified.
        imagined: the shares of the background that were imagined.
        evidence: of the best matches; NaN for one that was not verified, None: none was.

    Returns:
        None if the calibration has no curve.
    """
    if calibration.curve is None:
        return None
    two_stages = calibration.curve.log_odds(decision, imagined)
    if evidence is None or calibration.geometry is None:
        return two_stages
    found = np.asarray(evidence, np.float64)
    three_stages = calibration.geometry.log_odds(two_stages, found, share_of_lead(margin, imagined))
    return np.where(np.isnan(found), two_stages, three_stages)


def share_of_leads(margin: ArrayLike, calibration: Calibration) -> Values:
    """The part of a probability that the lead over the best rival leaves, ½ under the margin, float64 of any shape.

    Args:
        margin: the leads, at least 0; infinite without a rival.
    """
    leads = np.maximum(0.0, np.asarray(margin, np.float64))
    return np.where((leads >= calibration.margin) & (leads > 0), 1.0, EVEN)


def probability_of(
    decision: ArrayLike,
    margin: ArrayLike,
    calibration: Calibration,
    imagined: ArrayLike = 0.0,
    evidence: ArrayLike | None = None,
) -> Values | None:
    """The probabilities that best matches are right, by the calibration's curve and the leads over the best rivals.

    Args:
        decision, margin, imagined, evidence: as of :func:`log_odds_of`.

    Returns:
        Float64 of any shape, each in (0, 1); None if the calibration has no curve.
    """
    odds = log_odds_of(decision, margin, calibration, imagined, evidence)
    return None if odds is None else np.asarray(sigmoid(odds) * share_of_leads(margin, calibration), np.float64)


def stands_out(
    decision: ArrayLike,
    margin: ArrayLike,
    calibration: Calibration,
    imagined: ArrayLike = 0.0,
    evidence: ArrayLike | None = None,
) -> NDArray[np.bool_]:
    """Whether best matches are believed if their leads are large enough, bool of any shape.

    By the decision value; or, where one was verified, by the probability of three stages, which has to be a half at
    least and that of two stages at the threshold.  The arguments are those of :func:`log_odds_of`.
    """
    believed = np.asarray(decision, np.float64) >= calibration.threshold
    odds = log_odds_of(decision, margin, calibration, imagined, evidence)
    if odds is None or evidence is None or calibration.geometry is None or calibration.curve is None:
        return np.asarray(believed)
    surely = odds >= max(0.0, float(calibration.curve.log_odds(calibration.threshold)))
    return np.where(np.isnan(np.asarray(evidence, np.float64)), believed, surely)


def least_probability(judgement: Judgement, calibration: Calibration) -> float:
    """The least probability with which an answer is recognized; 0 by a calibration without a curve."""
    if calibration.curve is None:
        return 0.0
    least = calibration.curve.probability(calibration.threshold)
    return least if judgement.evidence is None else max(EVEN, least)


def most_doubtful(calibration: Calibration) -> float:
    """The probability from which on an answer leaves no doubt: a half, or that of a strict calibration's threshold."""
    if calibration.curve is None:
        return DOUBT[1]
    return max(DOUBT[1], calibration.curve.probability(calibration.threshold))


def worth_verifying(judgement: Judgement, calibration: Calibration) -> bool:
    """Whether ``verify=auto`` verifies candidates after this judgement, because it leaves doubt.

    It is called after two stages, and again where their best match alone was verified, for the sake of the pose.  In a
    map of a few places two stages always leave doubt.

    Args:
        judgement: of two stages; or of three, after the best match was verified.
        calibration: by which it was judged.

    Returns:
        False for an empty map, and for a calibration that cannot weigh evidence.
    """
    if calibration.geometry is None or judgement.probability is None:
        return False
    doubtful = DOUBT[0] < judgement.probability < most_doubtful(calibration)
    if judgement.evidence is not None:
        return doubtful
    return doubtful or judgement.verdict == "ambiguous" or judgement.imagined > MOSTLY_IMAGINED


def judge(
    scores: NDArray[np.float32],
    whereabouts: Whereabouts,
    calibration: Calibration,
    neighborhood: Neighborhood,
    examined: int | NDArray[np.bool_] = 0,
    likeness: Likeness | None = None,
    geometry: Geometry | None = None,
    prior: Values | None = None,
    alone: NDArray[np.float32] | None = None,
) -> Judgement:
    """Judge one query.

    Args:
        scores: float32 [n], best first: of the query against all places of the map, or against the best of them.  With
            ``geometry``, they are the scores of two stages in the final order of three (``geometry.final_order``).
        whereabouts: of the same n places in the same order.
        calibration: of the map or of the encoder.
        neighborhood: which places are the same place and so no rivals of each other.
        examined: which of the places the encoder's second stage has examined, bool [n], or how many of the first;
            0: it has no second stage.
        likeness: compares the best match with its rivals; it is called at most twice, and only where rivals matter.
            None: which rivals show the same place is not known, and they explain nothing.
        geometry: the results of verification for the n places, in the same order; None: none was verified.
        prior: float64 [n], the log weights of the places; None: there is no prior.
        alone: float32 [n], the scores without it.

    Returns:
        ``unknown`` for an empty map, and for a best match that does not stand out, which rivals do not explain;
        ``ambiguous`` where they do, and for a lead over the best rival under the margin; else ``recognized``.  A best
        match stands out by its decision value, or by the probability of three stages if it was verified.  Where a place
        on another storey may as well be shown, it is ``ambiguous`` whatever the lead.
    """
    if len(scores) == 0:
        return Judgement("unknown", None, None, None, None)
    ranking = _Ranking.of(scores, whereabouts, calibration, neighborhood, examined, geometry)
    best, others, evidence = float(scores[0]), ranking.others, ranking.evidence
    behind = ranking.background()
    decision = behind.decision(best)
    leads = ranking.leads(others)
    rival, lead = int(others[leads.argmin()]) if len(others) else None, float(leads.min(initial=np.inf))
    margin = None if rival is None else lead
    verdict: Verdict = "recognized"
    rivals: tuple[Rivals, ...] = ()
    if not stands_out(decision, lead, calibration, behind.imagined, evidence):
        rivals = ranking.explaining_rivals(likeness)
        verdict = "ambiguous" if rivals else "unknown"
    twins = (ranking if alone is None else replace(ranking, scores=alone)).twins(likeness)
    left = ranking.share_beside(twins, prior)
    if verdict == "recognized" and (lead < calibration.margin or left < CLEAR_STOREY):
        heads = ranking.heads()
        rivals = ranking.grouped(heads, ranking.alike(heads, likeness))
        verdict = "ambiguous"
    stated = probability_of(decision, lead, calibration, behind.imagined, evidence)
    probability = None if stated is None else min(float(stated), left)
    return Judgement(
        verdict, best, decision, margin, rival, probability, behind.imagined, rivals, evidence, tuple(twins.tolist())
    )


@dataclass(frozen=True)
class _Ranking:
    """A ranking, and which of its places are other than the best match.

    others: int64 [m], positions of the other places, of frames of one view only the first.
    compared: int64 [k], those of them whose scores are compared with the best, one for each station.
    apart: bool [n], the places that cannot overlap with the best match.
    geometry: the results of verification for the n places; None if none was verified.
    """

    scores: NDArray[np.float32]
    whereabouts: Whereabouts
    calibration: Calibration
    neighborhood: Neighborhood
    others: Positions
    compared: Positions
    apart: NDArray[np.bool_]
    geometry: Geometry | None

    @classmethod
    def of(
        cls,
        scores: NDArray[np.float32],
        whereabouts: Whereabouts,
        calibration: Calibration,
        neighborhood: Neighborhood,
        examined: int | NDArray[np.bool_],
        geometry: Geometry | None,
    ) -> _Ranking:
        """The arguments are those of :func:`judge`."""
        others = np.flatnonzero(whereabouts.others(0, neighborhood, across=False))
        closely = others[others < examined] if isinstance(examined, int) else others[examined[others]]
        compared = closely if np.any(examined) else others
        compared = compared[whereabouts.others(0, neighborhood)[compared]]
        apart = np.ones(len(scores), np.bool_)
        if len(others) < FULL:  # nothing is estimated otherwise
            apart = ~whereabouts.near(0, neighborhood.times(GUARD_FACTOR))
        return cls(scores, whereabouts, calibration, neighborhood, others, compared, apart, geometry)

    @property
    def evidence(self) -> float | None:
        """Of the best match; None if it was not verified."""
        return None if self.geometry is None else self.geometry.best

    def leads(self, places: Positions) -> NDArray[np.float64]:
        """By how much the best match is ahead of some places, int64 [k]; float64 [k].

        They are compared by the scores of all stages.
        """
        values = self.scores.astype(np.float64)
        if self.geometry is not None:
            values = values + self.geometry.gain
        return np.asarray(values[0] - values[places], np.float64)

    def stands_out_without(self, left_out: NDArray[np.bool_]) -> bool:
        """Whether the best match would stand out if the map did not have some of the other places, bool [n]."""
        behind, best = self.background(left_out), float(self.scores[0])
        lead = self.leads(self.others[~left_out[self.others]]).min(initial=np.inf)
        decision = behind.decision(best)
        return bool(stands_out(decision, lead, self.calibration, behind.imagined, self.evidence))

    def background(self, left_out: NDArray[np.bool_] | None = None) -> Background:
        """The background without some places, bool [n]."""
        compared, others = self.compared, len(self.others)
        if left_out is not None:
            compared, others = compared[~left_out[compared]], int((~left_out[self.others]).sum())
        apart = compared[self.apart[compared]]
        falling = np.sort(self.scores[compared])[::-1]  # verification may have changed the order
        return self.calibration.background(falling, others, self.scores[apart])

    @property
    def best_few(self) -> NDArray[np.bool_]:
        """The best few of the other places, among which the rivals are, bool [n]."""
        few = np.zeros(len(self.scores), np.bool_)
        few[self.compared[:MOST_RIVALS]] = True
        return few

    def twins(self, likeness: Likeness | None) -> Positions:
        """The places on other storeys that the query may as well show, best first; int64 [k].

        A twin stands out beside the best match as well, and the lead over it is small: under the margin; or less than
        half of s · (1 - likeness), the lead of a query that shares with the twin what the best match shares with it; or
        of any size where the two are more alike than the query is like the best match, for then it differs from both by
        more than they do from each other.
        """
        heads = self.heads()
        heads = heads[self.whereabouts.on_other_levels(heads, 0, self.neighborhood.height)]
        if not len(heads):
            return heads
        leads = self.leads(heads)
        small = leads < self.calibration.margin
        if likeness is not None:
            alike, score = likeness(heads).astype(np.float64), float(self.scores[0])
            small |= (leads < HALFWAY * score * (1 - alike)) | (alike >= score)
        behind = self.background(
            np.logical_or.reduce([self.whereabouts.near(head, self.neighborhood) for head in heads.tolist()])
        )
        found = np.array([behind.decision(float(self.scores[head])) for head in heads.tolist()])
        return heads[small & (found >= self.calibration.threshold)]

    def share_beside(self, twins: Positions, prior: Values | None) -> float:
        """The probability that is left to the best match by its likeliest twin; only a prior tells it from them."""
        odds = np.zeros(len(twins)) if prior is None else prior[twins] - prior[0]
        odds[self.leads(twins) < self.calibration.margin] = 0.0
        return 1 / (1 + float(np.exp(odds).max(initial=0.0)))

    def explaining_rivals(self, likeness: Likeness | None) -> tuple[Rivals, ...]:
        """The rivals without which the best match would stand out; empty if it would not."""
        if likeness is None or not self.stands_out_without(self.best_few):
            return ()  # whoever its rivals are
        heads = self.heads()
        alike = self.alike(heads, likeness)
        if not alike.any():
            return ()
        near = [self.whereabouts.near(head, self.neighborhood) for head in heads[alike].tolist()]
        return self.grouped(heads, alike) if self.stands_out_without(np.logical_or.reduce(near)) else ()

    def heads(self) -> Positions:
        """The best few of the other places, without neighbours of a better one; int64 [k]."""
        heads: list[int] = []
        left = self.compared
        while len(left) and len(heads) < MOST_RIVALS:
            heads.append(int(left[0]))
            left = left[~self.whereabouts.near(heads[-1], self.neighborhood)[left]]
        return np.array(heads, np.int64)

    def alike(self, heads: Positions, likeness: Likeness | None) -> NDArray[np.bool_]:
        """Which of the rivals show what the best match shows; bool [k]."""
        if likeness is None or not len(heads):
            return np.zeros(len(heads), np.bool_)
        calm, wanted = self.background(self.best_few), ALIKE * self.calibration.threshold
        return np.array([calm.decision(float(score)) >= wanted for score in likeness(heads)], np.bool_)

    def grouped(self, heads: Positions, alike: NDArray[np.bool_]) -> tuple[Rivals, ...]:
        """The rivals that show the same place as the best match, and each other one that scores nearly as well."""
        near = self.leads(heads) < self.calibration.margin
        same = (Rivals(tuple(heads[alike].tolist()), True),) if alike.any() else ()
        return same + tuple(Rivals((head,), False) for head in heads[near & ~alike].tolist())
