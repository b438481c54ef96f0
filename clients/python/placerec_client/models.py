"""Models of the answers of the service: one for each schema of its interface, under the same name.

Written from openapi.json by scripts/client.  Do not edit.
"""

from datetime import date, datetime
from typing import Any, Literal

from pydantic import Field

from placerec_client.model import Known, Model


class AddedLook(Model):
    """A look after a POST."""

    name: str
    timestamp: datetime | None = None
    camera: str | None = None
    run: str | None = None
    least_score: float | None = None
    right: int
    wrong: int
    passed: int
    regions: int
    picture: Known[Literal["none", "thumbnail", "image"]]
    created_at: datetime
    place: str
    change: Known[Literal["created", "unchanged", "updated", "replaced"]]
    encoder: str
    milliseconds: dict[str, float]


class AgreementDefinition(Model):
    """The second stage of an encoder. ``layers`` share one grid; ``values`` of each are retained, and its cosine
    counts by its ``weights``. ``reach`` is how far a cell may have moved, in rows and columns. ``candidates`` are
    examined; the mean squared cosine over all cells makes up ``share`` of their score, the first stage's score the
    rest. They are the first of the ranking or, if more places are ``screened``, the most promising of these.
    ``centred`` is the share of its mean over the frame that each value of a cell loses before it is divided by its
    deviation over the frame; None: cells stay as they are. Cells that are ``taught`` have projections of their own,
    others those of the regions. Encoders of other people's networks have none of the three.
    """

    layers: list[str]
    values: int
    weights: list[float]
    reach: tuple[int, int]
    candidates: int
    share: float
    centred: float | None = None
    screened: int | None = None
    taught: bool | None = None


class AlarmSetting(Model):
    """From which numbers on the trends of a map raise an alarm; null: never."""

    worse_places: int | None = None
    changed_places: int | None = None
    quiet_stretches: int | None = None


class AliasView(Model):
    """A place that looks more like another place than like its own neighbours; each pair is listed once."""

    place: str
    other: str
    score: float
    own: float | None = None


class HubView(Model):
    """A place that is a match unusually often."""

    place: str
    count: int
    expected: float


class AliasingView(Model):
    """Places that look like other places."""

    examined: int
    of: int
    neighbours: int
    skewness: float
    hubs: list[HubView]
    hub_count: int
    aliases: list[AliasView]
    alias_count: int
    unsure: list[HubView]
    unsure_count: int


class TrendView(Model):
    """A straight line fitted to the weeks."""

    per_week: float
    error: float
    weeks: int
    significant: bool


class WeekView(Model):
    """The answers of one week."""

    monday: date
    queries: int
    recognized: int
    ambiguous: int
    unknown: int
    blank: int
    unknown_rate: float | None = None
    mean_score: float | None = None
    mean_decision: float | None = None
    scores: list[int]


class AnswersView(Model):
    """The map's answers since the counting began."""

    since: datetime | None = None
    queries: int
    recognized: int
    ambiguous: int
    unknown: int
    weeks: list[WeekView]
    score_trend: TrendView | None = None
    unknown_trend: TrendView | None = None


class AuditEntry(Model, extra="allow"):
    """One line of the audit trail, with whatever else it says, such as `place`, `change` or `problem`."""

    time: str
    event: str
    operation: str | None = None
    status: int | None = None
    principal: str | None = None
    key: str | None = None
    client: str | None = None
    request_id: str | None = None
    map: str | None = None
    job: str | None = None


class AuditPage(Model):
    """A part of the audit trail, the latest line first."""

    items: list[AuditEntry]
    next_cursor: str | None = None
    source: Known[Literal["database", "file", "memory"]]


class BackupSchedule(Model):
    """How often all maps are saved, and how many backups are kept."""

    hours: float | None = 24
    keep: int = 7


class BackupView(Model):
    """A backup of all maps."""

    id: str
    at: datetime
    maps: int
    places: int
    bytes: int


class BackupList(Model):
    """The backups that the service makes, the newest first, and when it makes the next one."""

    enabled: bool
    schedule: BackupSchedule | None = None
    next_at: datetime | None = None
    running: str | None = None
    problem: str | None = None
    items: list[BackupView]
    next_cursor: None = None


class Problem(Model, extra="allow"):
    """A problem, for a program (``type``, ``status``) and for a person (``title``, ``detail``)."""

    type: str
    title: str
    status: int
    detail: str
    instance: str | None = None
    request_id: str | None = None


class ChangeView(Model):
    """Whether a frame shows the map as it is, as it was, or something that the map does not have."""

    verdict: Known[Literal["known", "changed", "new"]]
    known: float
    changed: float
    new: float


class EstimatedPose(Model):
    """Where the frame was taken, from the poses of the best match and of the matches within its `same_place_radius`,
    and from how the camera stood to theirs where places were verified.
    """

    x: float | None = None
    y: float | None = None
    z: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    heading: float | None = None
    spread: float
    heading_spread: float | None = None
    places: int
    heading_offset: float | None = None
    offset_spread: float | None = None
    source: Known[Literal["places", "intrinsics", "field-of-view"]] = "places"
    note: str | None = None
    covariance: list[float]


class Pose(Model):
    """Where a frame was taken: metres in the map's frame, or degrees on the Earth (WGS 84). ``z`` is in metres: in
    the map's frame beside x and y, above the ellipsoid of WGS 84 beside latitude and longitude. It tells storeys
    apart; distances are those along the ground. ``heading`` is in degrees: counter-clockwise from +x beside x and y,
    clockwise from north beside latitude and longitude. It is normalized to [0, 360).
    """

    x: float | None = None
    y: float | None = None
    z: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    heading: float | None = None


class PoseAccuracy(Model):
    """Standard deviations of a pose, as whoever states it knows them. metres: of each coordinate along the ground.
    degrees: of the heading; None: not stated.
    """

    metres: float
    degrees: float | None = None


class PlaceView(Model):
    """One enrolled place."""

    id: str
    pose: Pose | None = None
    pose_of: str | None = None
    timestamp: datetime | None = None
    sequence: str | None = None
    camera: str | None = None
    level: str | None = None
    pose_accuracy: PoseAccuracy | None = None
    metadata: dict[str, Any]
    regions: int
    picture: Known[Literal["none", "thumbnail", "image"]]
    look: str | None = None
    looks: int = 0
    created_at: datetime
    updated_at: datetime


class ScoreParts(Model):
    """The parts of a match's score: it is the sum of `similarity`, `agreement` and, if not null, `geometry`."""

    similarity: float
    agreement: float
    geometry: float | None = None
    inliers: int | None = None
    keypoints: int | None = None
    evidence: float | None = None


class Match(Model):
    """One of the best places."""

    rank: int
    score: float
    parts: ScoreParts | None = None
    weight: float | None = None
    place: PlaceView


class CellPair(Model):
    """Two cells that are each other's best match: row and column of each in `grid`."""

    query: tuple[int, int]
    match: tuple[int, int]
    gain: float


class RelativeBox(Model):
    """A box in shares of the upright frame's width and height."""

    left: float
    top: float
    right: float
    bottom: float


class ExplainedRegion(Model):
    """A region of interest and its share in the score."""

    layer: str
    word: int
    box: RelativeBox
    loss: float


class KeypointPair(Model):
    """Two keypoints that match and fit one rigid scene: (x, y) of each in shares of its frame's width and height."""

    query: tuple[float, float]
    match: tuple[float, float]


class RegionPair(Model):
    """Two regions of one word that are each other's nearest neighbours: their positions in the two lists."""

    query: int
    match: int


class MatchExplanation(Model):
    """Why a query's best match scores as it does."""

    score: float
    words: list[float]
    query_regions: list[ExplainedRegion]
    match_regions: list[ExplainedRegion] | None = None
    regions: list[RegionPair]
    cells: list[CellPair]
    grid: tuple[int, int]
    place: str
    inliers: list[KeypointPair] = Field(default_factory=list)
    match_picture: str
    picture: str | None = None


class RivalGroup(Model):
    """Places that prevent the recognition of an answer, as one."""

    places: list[str]
    score: float
    same_place: bool


class VerificationView(Model):
    """Whether the geometry of the best candidates was verified."""

    state: Known[Literal["verified", "not-needed", "no-keypoints", "never"]]
    candidates: int
    keypoints: int | None = None


class QueryAnswer(Model):
    """Where a frame was taken, or that this is not known."""

    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    place: PlaceView | None = None
    probability: float | None = None
    change: ChangeView | None = None
    pose: EstimatedPose | None = None
    score: float | None = None
    margin: float | None = None
    decision: float | None = None
    threshold: float
    reason: Known[Literal["no-regions", "few-values", "empty-map", "no-place-allowed"]] | None = None
    note: str | None = None
    matches: list[Match]
    rivals: list[RivalGroup] = Field(default_factory=list)
    verification: VerificationView | None = None
    revision: int | None = None
    explanation: MatchExplanation | None = None
    encoder: str
    milliseconds: dict[str, float]


class BatchAnswer(Model):
    """The answer to one frame of a batch: ``answer`` on success, else ``problem``."""

    file: str
    status: int
    answer: QueryAnswer | None = None
    problem: Problem | None = None


class BatchAnswers(Model):
    """One answer for each file part, in their order."""

    items: list[BatchAnswer]
    encoder: str
    milliseconds: dict[str, float]


class BatchResult(Model):
    """The result for one place of a batch: ``place`` on success, else ``problem``."""

    id: str | None = None
    status: int
    change: Known[Literal["created", "unchanged", "updated", "replaced"]] | None = None
    place: PlaceView | None = None
    problem: Problem | None = None


class BatchResults(Model):
    """One result for each entry of ``places``, in its order."""

    items: list[BatchResult]
    encoder: str


class BelievedPlace(Model):
    """One place where the robot may be."""

    rank: int
    probability: float
    place: PlaceView


class BeliefView(Model):
    """The belief about where a robot is."""

    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    place: PlaceView | None = None
    probability: float | None = None
    unknown: float
    lost: bool
    candidates: list[BelievedPlace]


class Share(Model):
    """A share that was counted, with Wilson's interval: how far it may lie from the one that would be found in the
    long run.
    """

    value: float | None = None
    low: float
    high: float
    count: int
    of: int


class Bin(Model):
    """Answers whose probability lies between ``low`` and ``high``: the promised share, and the outcome."""

    low: float
    high: float
    probability: float
    right: Share


class Box(Model):
    """A box in pixels of the upright frame, over which the cells of the layer are spread."""

    left: float
    top: float
    right: float
    bottom: float


class Curve(Model):
    """P(right | d) = 1 / (1 + exp(-(slope · d + intercept))), d a decision value."""

    slope: float
    intercept: float
    imagined_slope: float = 0.0
    imagined_intercept: float = 0.0


class Environment(Model):
    """The prior of the scores of other places of one environment, in units of the score (see the module). ``mean``
    and ``deviation`` are μ₀ and σ₀; ``mean_weight`` and ``deviation_weight`` are κ₀ and ν₀, the number of scores
    that the prior counts as.
    """

    mean: float
    deviation: float
    mean_weight: float
    deviation_weight: float


class GeometryTerms(Model):
    """How evidence joins the log odds of the first two stages (see the module)."""

    support: float
    slope: float
    lead: float = 0.0
    intercept: float


class Calibration(Model):
    """When to believe a match; measured on frames held out of training. ``threshold`` is on the decision value,
    ``margin`` on the difference of two scores. ``background_mean`` and ``background_deviation`` describe the score
    of unrelated frames, in units of the score. ``curve`` gives the probability that a decision value is right; a
    calibration on frames that are all alike has none. ``decision`` names the kind of decision value. ``environment``
    describes the scores of other places of one environment, which stand for those that a small map does not have
    yet; it is measured of the packaged encoders alone, and without it these score as unrelated frames do.
    ``geometry`` says how geometric evidence joins the probability; without it, or without a curve, evidence changes
    the order of the candidates only.
    """

    source: str
    threshold: float
    margin: float
    background_mean: float
    background_deviation: float
    curve: Curve | None = None
    decision: str = "leading"
    frames: int | None = None
    environment: Environment | None = None
    geometry: GeometryTerms | None = None


class Stated(Model):
    """The probabilities that a calibration states for some answers."""

    probability: float
    error: float


class KindChange(Model):
    """The probabilities of one kind of answers, before and after."""

    answers: int
    before: Stated
    after: Stated


class HeldOutChange(Model):
    """What a calibration changes for answers that had no part in it."""

    known: KindChange | None = None
    strangers: KindChange | None = None
    worse: str | None = None


class Reliability(Model):
    """The reliability of stated probabilities over n answers whose truth is known."""

    answers: int
    right: int
    ece: float
    brier: float
    brier_of_base_rate: float
    bins: list[Bin]


class Held(Model):
    """The verdicts on held-out frames: those that had no part in the threshold by which they were judged."""

    precision: Share
    recall: Share
    false_accept_rate: Share
    reliability: Reliability


class Point(Model):
    """The effect of one threshold on the decision value of two stages, on all frames; the margin is not applied."""

    threshold: float
    precision: float
    recall: float
    false_accept_rate: float | None = None


class Measurement(Model):
    """The measurements made for a calibration."""

    frames: int
    trials: int
    known: int
    unknown: int
    right: int
    auc_pr: float
    auc_roc: float | None = None
    auc_roc_right: float
    cross_validated: Held
    points: list[Point]


class Target(Model):
    """The target of the threshold. ``precision``: the share of right answers among those believed.
    ``false_accept_rate``: the share of frames of places that the map lacks that may be believed.
    ``mean_of_negatives``: rule of the thesis (3.4.3), the mean over the frames of places that the map lacks; it has
    no value.
    """

    rule: Known[Literal["precision", "false_accept_rate", "mean_of_negatives"]]
    value: float | None = None


class CalibrationReport(Model):
    """A calibration, the measurement that it rests on, and what it would change."""

    map: str
    encoder: str
    method: Known[Literal["frames", "sequence", "map", "labels", "runs"]]
    target: Target
    stored: bool
    calibration: Calibration
    previous: Calibration
    measurement: Measurement
    change: HeldOutChange | None = None
    warnings: list[str]


class Mix(Model):
    """How many queries had each verdict."""

    recognized: int
    ambiguous: int
    unknown: int


class Effect(Model):
    """The effect of a calibration on queries whose truth is known. The calibration may have been fitted to the same
    queries, so these figures are a little too good; those of :class:`Measurement` are cross-validated. A best match
    that does not stand out counts as unknown, also where rivals explain it.
    """

    threshold: float
    margin: float
    verdicts: Mix
    precision: Share
    recall: Share
    false_accept_rate: Share
    reliability: Reliability | None = None


class LatestMeasurement(Model):
    """The latest calibrate of a map, a dry run or not."""

    at: datetime
    report: CalibrationReport


class CalibrationState(Model):
    """A map's calibration, and its effect on the frames of the latest calibrate."""

    map: str
    revision: int
    calibration: Calibration | None = None
    measured: LatestMeasurement | None = None
    now: Effect | None = None
    then: Effect | None = None
    proposed: Effect | None = None


class Intrinsics(Model):
    """Focal lengths, principal point and distortion of a camera, for upright frames of width x height pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: Known[Literal["none", "plumb_bob", "rational_polynomial", "equidistant"]] = "none"
    distortion: list[float] = Field(default_factory=list)


class Mask(Model):
    """The parts of each frame of one camera that are ignored. ``polygons`` are given by their corners, (x, y) in
    shares of the upright frame's width and height, from its top left corner; where they overlap, all that any of
    them holds is covered.
    """

    polygons: list[list[tuple[float, float]]]


class CameraView(Model):
    """A camera of a map."""

    name: str
    mask: Mask | None = None
    intrinsics: Intrinsics | None = None
    value_range: tuple[int, int] | None = None
    updated_at: datetime


class CameraList(Model):
    """All cameras of a map in the order of their names, on one page."""

    items: list[CameraView]
    next_cursor: None = None


class ChangedPlaceView(Model):
    """A place that has changed: runs pass it surely, while single frames fail and geometry finds little."""

    place: str
    passed: int
    missed: int
    inliers: float | None = None
    usual_inliers: float | None = None
    sentence: str


class ClosureAnswer(Model):
    """Where a frame was taken, and the new place if it was unknown."""

    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    place: PlaceView | None = None
    probability: float | None = None
    change: ChangeView | None = None
    pose: EstimatedPose | None = None
    score: float | None = None
    margin: float | None = None
    decision: float | None = None
    threshold: float
    reason: Known[Literal["no-regions", "few-values", "empty-map", "no-place-allowed"]] | None = None
    note: str | None = None
    matches: list[Match]
    rivals: list[RivalGroup] = Field(default_factory=list)
    verification: VerificationView | None = None
    revision: int | None = None
    explanation: MatchExplanation | None = None
    encoder: str
    milliseconds: dict[str, float]
    enrolment: Known[Literal["created", "unchanged"]] | None = None
    enrolled: PlaceView | None = None


class ComparedTraverse(Model):
    """A traverse of a comparison."""

    sequence: str
    places: list[str]


class CoverageGap(Model):
    """Two successive places of a traverse between which a pose is, too far from either."""

    before: str
    after: str
    metres: float
    aside: float


class NearPlace(Model):
    """A place near a pose."""

    place: str
    distance: float
    turn: float | None = None
    sequence: str | None = None


class CoverageView(Model):
    """Whether a pose is in a map, and how well."""

    map: str
    state: Known[Literal["covered", "other-direction", "gap", "outside"]]
    radius: float
    places: int
    looks: int
    sequences: list[str]
    directions: list[int]
    distance: float | None = None
    turn: float | None = None
    nearest: list[NearPlace]
    gap: CoverageGap | None = None


class CreatedKey(Model):
    """A new key with its secret."""

    id: str
    name: str
    role: Known[Literal["query", "enrol", "admin"]]
    maps: list[str] | None = None
    learn: bool
    state: Known[Literal["in force", "revoked", "expired"]]
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    last_used_at: datetime | None = None
    own: bool
    key: str


class DeletedPlaces(Model):
    """Places that were deleted or, in a dry run, would be."""

    dry_run: bool
    places: int
    ids: list[str]
    missing: list[str]


class DeletedSequence(Model):
    """A deleted traverse."""

    name: str
    places: int


class Descriptor(Model):
    """A frame's descriptor."""

    encoder: str
    dimension: int
    dtype: str = "float32"
    byte_order: str = "little"
    descriptor: str
    regions: int
    milliseconds: dict[str, float]


class DiskState(Model):
    """The disk of the data directory in bytes."""

    free: int
    total: int


class EarlierBelief(Model):
    """Where the robot was some frames ago, given all frames since."""

    frames_ago: int
    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    candidates: list[BelievedPlace]


class EncoderDefinition(Model):
    """All choices of an encoder besides its backbone and the values of its projections and its vocabulary."""

    layers: list[str]
    regions: int
    steps: list[float]
    unit_features: bool
    projection: int | None = None
    parts: Known[Literal["cells", "pooled"]] | None = None
    exponent: float | None = None
    least_contrast: float = 2.0
    words: int
    gamma: float
    normalization: Known[Literal["intra", "global"]]
    agreement: AgreementDefinition | None = None
    whitening: int | None = None


class EncoderSummary(Model):
    """One installed encoder as a user sees it; ``damaged`` says why it cannot be used."""

    name: str
    identity: str
    dimension: int
    local_shape: tuple[int, int]
    default: bool
    source: Known[Literal["packaged", "installed"]]
    network: str
    definition: EncoderDefinition | None = None
    calibration: Calibration | None = None
    training: dict[str, Any]
    damaged: str | None = None


class EncoderPage(Model):
    """All installed encoders."""

    items: list[EncoderSummary]
    next_cursor: str | None = None


class EnrolledPlace(Model):
    """A place after a PUT."""

    id: str
    pose: Pose | None = None
    pose_of: str | None = None
    timestamp: datetime | None = None
    sequence: str | None = None
    camera: str | None = None
    level: str | None = None
    pose_accuracy: PoseAccuracy | None = None
    metadata: dict[str, Any]
    regions: int
    picture: Known[Literal["none", "thumbnail", "image"]]
    look: str | None = None
    looks: int = 0
    created_at: datetime
    updated_at: datetime
    change: Known[Literal["created", "unchanged", "updated", "replaced"]]
    encoder: str
    milliseconds: dict[str, float]


class ExplanationView(Model):
    """The parts of a score, which is the sum of `words` and of the gains of all `cells`."""

    score: float
    words: list[float]
    query_regions: list[ExplainedRegion]
    match_regions: list[ExplainedRegion] | None = None
    regions: list[RegionPair]
    cells: list[CellPair]
    grid: tuple[int, int]


class ExportedLabel(Model):
    """A frame whose place is known."""

    id: int
    at: datetime
    sha256: str
    camera: str | None = None
    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    place: str | None = None
    enrolled: bool
    labelled_at: datetime
    labelled_by: str | None = None


class FleetAlarm(Model):
    """An alarm of a map, by its setting `alarms`."""

    map: str
    alarm: Known[Literal["worse_places", "changed_places", "quiet_stretches"]]
    raised: bool
    count: int
    since: datetime
    sentence: str


class FleetLost(Model):
    """A robot that was told no place for half a minute, until it was told one three times in a row."""

    map: str
    name: str | None = None
    session: str | None = None
    camera: str | None = None
    place: str | None = None
    raised: bool
    since: datetime
    cleared_at: datetime | None = None
    last_at: datetime | None = None


class HourCount(Model):
    """How many answers had each verdict within an hour."""

    recognized: int = 0
    ambiguous: int = 0
    unknown: int = 0
    hour: datetime


class FleetMap(Model):
    """The demand of robots on one map."""

    map: str
    sessions: int
    hours: list[HourCount]


class FleetRobot(Model):
    """One robot: an open session, or what one key or camera has asked without one."""

    map: str
    name: str | None = None
    session: str | None = None
    camera: str | None = None
    last_at: datetime
    verdict: Known[Literal["recognized", "ambiguous", "unknown"]] | None = None
    place: str | None = None
    pose: EstimatedPose | None = None
    recognized_at: datetime | None = None
    lost_since: datetime | None = None
    contradiction_note: str | None = None
    verdicts: list[Known[Literal["recognized", "ambiguous", "unknown"]]]
    answers: int


class FleetState(Model):
    """Robots, the one that was heard last first, and the maps that the key may use and that were asked, by id."""

    at: datetime
    maps: list[FleetMap]
    robots: list[FleetRobot]
    alarms: list[FleetAlarm]
    lost: list[FleetLost]


class FrameReport(Model):
    """The status of one frame."""

    frame: str
    camera: str | None = None
    status: int
    regions: int | None = None
    problem: Problem | None = None


class GapView(Model):
    """Two successive frames that are farther apart than is usual in their sequence."""

    sequence: str
    before: str
    after: str
    measure: Known[Literal["distance", "time", "similarity"]]
    value: float
    median: float
    severity: float


class GeoAccuracy(Model):
    """Standard deviations of the errors."""

    position: float
    orientation: float


class GeoAngles(Model):
    """The same rotation in degrees."""

    yaw: float
    pitch: float
    roll: float


class GeoPosition(Model):
    """A position of a GeoPose."""

    lat: float
    lon: float
    h: float


class GeoQuaternion(Model):
    """A rotation from the axes east, north and up to those of the camera: ahead, left and up."""

    x: float
    y: float
    z: float
    w: float


class GeoPose(Model):
    """Where a frame was taken, as Basic-Quaternion or Basic-YPR of OGC GeoPose 1.0, with members beside the pose."""

    position: GeoPosition
    quaternion: GeoQuaternion | None = None
    angles: GeoAngles | None = None
    accuracy: GeoAccuracy
    map: str
    place: str
    probability: float | None = None
    height_known: bool


class GroundFrameView(Model):
    """A frame of a stretch, and the place that it would become."""

    frame: int
    place: str
    pose: Pose
    spread: float
    heading_spread: float
    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    taken: datetime | None = None


class GroundStretchView(Model):
    """A stretch of a run off the map."""

    id: str
    run: str
    at: datetime
    why: str
    leaves: str
    returns: str
    length: float
    misclosure: float
    misclosure_heading: float
    recognized_elsewhere: int
    missing: int
    frames: list[GroundFrameView]


class GroundStretchList(Model):
    """All stretches that wait for review, the oldest first, on one page."""

    items: list[GroundStretchView]
    next_cursor: None = None


class Health(Model):
    """The process is alive."""

    status: str = "ok"


class Recall(Model):
    """How often the place that an exact search finds first is found first by way of the codes."""

    at_1: float
    queries: int
    shortlist: int
    places: int


class IndexStatus(Model):
    """How a map is searched now, and how it will be."""

    setting: Known[Literal["auto", "exact", "compact"]]
    tier: Known[Literal["exact", "compact"]]
    wanted: Known[Literal["exact", "compact"]]
    state: Known[Literal["ready", "unopened"]]
    rows_indexed: int
    recall: Recall | None = None
    bytes_in_memory: int


class Progress(Model):
    """How far a job is."""

    done: int
    total: int | None = None
    message: str


class JobView(Model):
    """A job: long work in the background."""

    id: str
    kind: str
    map: str | None = None
    state: Known[Literal["queued", "running", "succeeded", "failed", "cancelled"]]
    progress: Progress
    arguments: dict[str, Any]
    cancelling: bool
    resumable: bool
    attempt: int
    result: dict[str, Any] | None = None
    problem: Problem | None = None
    created_at: datetime
    started_at: datetime | None = None
    ended_at: datetime | None = None


class JobPage(Model):
    """Jobs, the newest first."""

    items: list[JobView]
    next_cursor: str | None = None


class JobsState(Model):
    """The jobs that have not ended."""

    queued: int
    running: int
    watchers: int


class KeyView(Model):
    """A key without its secret."""

    id: str
    name: str
    role: Known[Literal["query", "enrol", "admin"]]
    maps: list[str] | None = None
    learn: bool
    state: Known[Literal["in force", "revoked", "expired"]]
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    last_used_at: datetime | None = None
    own: bool


class KeyPage(Model):
    """A page of keys, the oldest first, revoked ones included."""

    items: list[KeyView]
    next_cursor: str | None = None


class KeypointsStatus(Model):
    """The keypoints that a map keeps."""

    places: int
    bytes: int


class LabelList(Model):
    """All labels, the oldest frame first, on one page."""

    items: list[ExportedLabel]
    next_cursor: None = None


class ReviewLabel(Model):
    """People's label of a frame; one of place, new and stranger is set."""

    place: str | None = None
    look: str | None = None
    new: str | None = None
    stranger: bool = False


class ReviewFrameView(Model):
    """A frame that is stored for review."""

    id: int
    at: datetime
    sha256: str
    bytes: int
    answer: dict[str, Any]
    label: ReviewLabel | None = None
    labelled_at: datetime | None = None
    labelled_by: str | None = None


class Labelled(Model):
    """The result of a label."""

    id: int
    discarded: bool
    frame: ReviewFrameView | None = None
    enrolled: PlaceView | None = None


class Layer(Model):
    """A layer of the network from which regions come."""

    name: str
    rows: int
    columns: int


class RejectedGround(Model):
    """A stretch of new ground that a person has rejected."""

    stretch: str
    run: str
    at: datetime
    poses: list[Pose]


class LearningSetting(Model):
    """The setting by which a map learns from the runs of its robots."""

    mode: Known[Literal["off", "propose", "auto"]] = "off"
    least_probability: float = 0.95
    most_looks: int = 3
    most_places: int | None = None
    new_ground: bool = False
    calibration: Known[Literal["off", "propose", "auto"]] = "propose"
    rejected_ground: list[RejectedGround] = Field(default_factory=list)


class LoadView(Model):
    """The load over time in columns: one entry of each for every step in which the service ran."""

    step_seconds: int
    at: list[datetime]
    recognized: list[int]
    ambiguous: list[int]
    unknown: list[int]
    requests: list[int]
    errors: list[int]
    p50: list[float | None]
    p99: list[float | None]
    resident: list[int | None]
    disk_free: list[int | None]
    disk_total: list[int | None]


class LookView(Model):
    """A look of a place beside its first."""

    name: str
    timestamp: datetime | None = None
    camera: str | None = None
    run: str | None = None
    least_score: float | None = None
    right: int
    wrong: int
    passed: int
    regions: int
    picture: Known[Literal["none", "thumbnail", "image"]]
    created_at: datetime
    place: str


class LookPage(Model):
    """Looks in the order in which they were added."""

    items: list[LookView]
    next_cursor: str | None = None


class MapAnswer(Model):
    """The answer of one map: its own verdict, or the problem that prevented it."""

    map: str
    status: int
    verdict: Known[Literal["recognized", "ambiguous", "unknown"]] | None = None
    probability: float | None = None
    change: ChangeView | None = None
    score: float | None = None
    margin: float | None = None
    decision: float | None = None
    threshold: float | None = None
    reason: Known[Literal["no-regions", "few-values", "empty-map", "no-place-allowed"]] | None = None
    verification: VerificationView | None = None
    rivals: list[RivalGroup] = Field(default_factory=list)
    revision: int | None = None
    encoder: str | None = None
    problem: Problem | None = None


class PoseHealth(Model):
    """How exact the poses of one traverse are, by what pictures of places beside one another say of them."""

    sequence: str
    metres: float | None = None
    degrees: float | None = None
    turned: float
    pairs: int
    remark: str | None = None


class SharedRouteView(Model):
    """Two traverses that seem to follow one route, which neither poses nor an alignment say: align them."""

    sequence: str
    other: str
    frames: int


class SilentPlaces(Model):
    """Places that were never the best match."""

    count: int
    by_chance: float
    queries: int
    wanted: int
    enough: bool
    places: list[str]


class StopView(Model):
    """Frames of one view, as where the robot stood while it mapped; pruning removes most of them."""

    sequence: str
    place: str
    frames: int


class StretchView(Model):
    """A stretch of a sequence that should be recorded again."""

    sequence: str
    first: str
    last: str
    reasons: list[Known[Literal["never-matched", "distance-gap", "time-gap", "similarity-gap", "aliased", "hub"]]]
    weight: float


class QuietStretchView(Model):
    """A stretch of a sequence that nobody drives any more."""

    sequence: str
    first: str
    last: str
    places: int
    since: date
    sentence: str


class RaisedAlarm(Model):
    """An alarm of the map that is raised."""

    alarm: Known[Literal["worse_places", "changed_places", "quiet_stretches"]]
    count: int
    since: datetime


class WorsePlaceView(Model):
    """A place that gets worse: a day is good if at least half of its frames were recognized there."""

    place: str
    days: int
    good_days: int
    days_before: int
    good_days_before: int
    chance: float
    sentence: str


class TrendsView(Model):
    """Trends of the map's places over time, by all answers and the runs of robots."""

    worse: list[WorsePlaceView]
    worse_count: int
    changed: list[ChangedPlaceView]
    changed_count: int
    quiet: list[QuietStretchView]
    quiet_count: int
    advice: dict[str, str]
    alarms: list[RaisedAlarm]


class MapHealth(Model):
    """The health of a map, judged by its own frames and by its answers."""

    map: str
    places: int
    complete: bool
    calibration_doubt: str | None = None
    answers: AnswersView
    never_matched: SilentPlaces | None = None
    aliasing: AliasingView
    gaps: list[GapView]
    gap_count: int
    gap_counts: dict[str, int]
    stops: list[StopView]
    stop_count: int
    retraverse: list[StretchView]
    retraverse_count: int
    trends: TrendsView
    shared_routes: list[SharedRouteView]
    poses: list[PoseHealth]


class MapMatch(Model):
    """One of the best places of all maps."""

    rank: int
    map: str
    probability: float | None = None
    score: float
    weight: float | None = None
    place: PlaceView


class ReviewSetting(Model):
    """Which frames a map keeps so that people can say later what they show, and how many at most."""

    verdicts: list[Known[Literal["recognized", "ambiguous", "unknown"]]] = Field(default=["ambiguous", "unknown"])
    most_frames: int = 500
    most_bytes: int = 268435456


class StorageStatus(Model):
    """The size of what is stored of a map."""

    precision: str
    bytes_per_place: int
    descriptors: int
    index: int
    database: int
    keypoints: KeypointsStatus


class VerdictCounts(Model):
    """How many answers had each verdict."""

    recognized: int = 0
    ambiguous: int = 0
    unknown: int = 0


class MapView(Model):
    """One environment, bound for life to one encoder."""

    id: str
    encoder: str
    dimension: int
    description: str
    keep: Known[Literal["none", "thumbnail", "image"]]
    same_place_radius: float
    same_place_height: float
    same_place_frames: int
    pose_accuracy: PoseAccuracy | None = None
    verification: bool
    review: ReviewSetting | None = None
    learning: LearningSetting
    alarms: AlarmSetting
    calibration: Calibration | None = None
    calibration_doubt: str | None = None
    index: IndexStatus
    storage: StorageStatus
    places: int
    last_day: VerdictCounts | None = None
    revision: int
    created_at: datetime
    updated_at: datetime


class QuarantinedMap(Model):
    """A damaged map, which is out of service."""

    id: str
    reason: str


class MapPage(Model):
    """A page of maps in the order of their ids."""

    items: list[MapView]
    next_cursor: str | None = None
    quarantined: list[QuarantinedMap]


class MatchScore(Model):
    """How similar two frames are."""

    score: float
    encoder: str
    regions: dict[str, int]
    explanation: ExplanationView | None = None
    milliseconds: dict[str, float]


class MemoryState(Model):
    """Memory in bytes."""

    resident: int | None = None
    uploads: int
    upload_limit: int


class OpenState(Model):
    """What is open, and how much may be."""

    maps: int
    most_maps: int
    files: int | None = None
    most_files: int


class OperationState(Model):
    """The requests of one operation in the last minutes; durations in milliseconds."""

    method: str
    path: str
    count: int
    errors: int
    p50: float
    p90: float
    p99: float
    max: float


class OwnKey(Model):
    """The caller, and the caller's rights."""

    id: str | None = None
    name: str
    role: Known[Literal["open", "query", "enrol", "admin"]]
    maps: list[str] | None = None
    learn: bool
    expires_at: datetime | None = None
    keys_needed: bool


class RecentMatch(Model):
    """A place that resembled a query."""

    place: str
    score: float


class PlaceMatchView(Model):
    """An answer that lists a certain place."""

    at: datetime
    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    run: Known[Literal["recognized", "ambiguous", "unknown"]] | None = None
    probability: float | None = None
    place: str | None = None
    change: ChangeView | None = None
    pose: EstimatedPose | None = None
    score: float | None = None
    margin: float | None = None
    decision: float | None = None
    threshold: float
    reason: str | None = None
    matches: list[RecentMatch]
    camera: str | None = None
    session: str | None = None
    frame: int | None = None
    operation: str | None = None
    milliseconds: float | None = None
    request_id: str | None = None
    principal: str | None = None
    key: str | None = None
    client: str | None = None
    rank: int


class PlaceMatchList(Model):
    """The latest answers that list a place, the latest first, on one page."""

    items: list[PlaceMatchView]
    next_cursor: None = None
    best: int
    recognized: int
    last_at: datetime | None = None


class PlacePage(Model):
    """Places in the order of their ids."""

    items: list[PlaceView]
    next_cursor: str | None = None


class PlannedGap(Model):
    """Two successive places of a traverse that are unusually far apart."""

    before: str
    after: str
    metres: float


class PlanView(Model):
    """Where the places of a map are: columns of equal length, in the order of enrolment. A column in which no place
    has a value is null.
    """

    map: str
    revision: str
    places: int
    step: int
    sequences: list[str]
    ids: list[str]
    sequence: list[int]
    x: list[float | None] | None = None
    y: list[float | None] | None = None
    z: list[float | None] | None = None
    latitude: list[float | None] | None = None
    longitude: list[float | None] | None = None
    heading: list[float | None] | None = None
    timestamp: list[int | None] | None = None
    flags: list[int]
    gaps: list[PlannedGap]
    gap_count: int


class QueueState(Model):
    """The queue in front of the encoder."""

    waiting: int
    limit: int


class Readiness(Model):
    """The service is ready for requests."""

    status: str = "ready"
    degraded: str | None = None
    checks: dict[str, str]
    encoder: str
    quarantined: list[QuarantinedMap]
    open: OpenState


class RecentAnswerView(Model):
    """The answer to a query of the last time, without the frame."""

    at: datetime
    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    run: Known[Literal["recognized", "ambiguous", "unknown"]] | None = None
    probability: float | None = None
    place: str | None = None
    change: ChangeView | None = None
    pose: EstimatedPose | None = None
    score: float | None = None
    margin: float | None = None
    decision: float | None = None
    threshold: float
    reason: str | None = None
    matches: list[RecentMatch]
    camera: str | None = None
    session: str | None = None
    frame: int | None = None
    operation: str | None = None
    milliseconds: float | None = None
    request_id: str | None = None
    principal: str | None = None
    key: str | None = None
    client: str | None = None


class RecentAnswerList(Model):
    """The latest answers of a map, the latest first, on one page."""

    items: list[RecentAnswerView]
    next_cursor: None = None
    kept: int
    hours: list[HourCount]


class RecordingView(Model):
    """The part of a recording that is here."""

    id: str
    bytes: int


class Region(Model):
    """One region of interest."""

    layer: str
    channel: int
    energy: float
    cells: tuple[int, int, int, int]
    box: Box


class RegionsView(Model):
    """A frame's regions of interest."""

    encoder: str
    width: int
    height: int
    layers: list[Layer]
    found: int
    regions: list[Region]
    milliseconds: dict[str, float]


class RemovedLooks(Model):
    """Looks and places of one run that were removed together."""

    run: str | None = None
    since: datetime | None = None
    until: datetime | None = None
    looks: int
    places: int


class RequestsState(Model):
    """The requests of the last minutes, without those of the console."""

    seconds: int
    under_way: int
    count: int
    errors: int
    operations: list[OperationState]


class ReviewPage(Model):
    """Frames stored for review, the newest first."""

    items: list[ReviewFrameView]
    next_cursor: str | None = None
    frames: int
    bytes: int


class SequenceSummary(Model):
    """One traverse of a map; the times are those of its first and last frames that have one."""

    name: str
    places: int
    first_at: datetime | None = None
    last_at: datetime | None = None


class SequencePage(Model):
    """Traverses in the order of their names."""

    items: list[SequenceSummary]
    next_cursor: str | None = None


class ThreadsState(Model):
    """The threads that search, read and write maps."""

    busy: int
    waiting: int
    threads: int


class ServiceState(Model):
    """The state of the service."""

    version: str
    encoder: str
    started_at: datetime
    uptime_seconds: float
    ready: bool
    degraded: str | None = None
    checks: dict[str, str]
    queue: QueueState
    storage: ThreadsState
    requests: RequestsState
    jobs: JobsState
    sessions: int
    listeners: int
    maps: int
    limits: dict[str, int | float]
    memory: MemoryState | None = None
    disk: DiskState | None = None
    settings: dict[str, Any] | None = None


class SessionAnswer(Model):
    """The belief after a frame, and the answer to the frame alone."""

    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    place: PlaceView | None = None
    probability: float | None = None
    unknown: float
    lost: bool
    candidates: list[BelievedPlace]
    session: str
    frame: int | None = None
    frames: int
    change: ChangeView | None = None
    earlier: EarlierBelief | None = None
    motion: Known[Literal["first", "sequence", "speed-limit", "odometry", "contradicted"]]
    contradiction: Known[Literal["frozen", "scale", "turned", "units", "inconsistent"]] | None = None
    contradiction_note: str | None = None
    note: str | None = None
    view: Known[Literal["covered", "constant"]] | None = None
    repeated: bool = False
    restored: bool
    frames_lost: int | None = None
    saved: bool
    single: QueryAnswer
    milliseconds: dict[str, float]


class SessionView(Model):
    """A session as it is listed."""

    advance: float | None = None
    backwards: bool = False
    speed_limit: float | None = None
    sequences: list[str] | None = None
    lag: int = 0
    camera: str | None = None
    verify: Known[Literal["auto", "always", "never"]] = "auto"
    expires_after: float | None = None
    id: str
    map: str
    created_at: datetime
    expires_at: datetime
    frames: int
    last_frame: int | None = None
    last_frame_at: datetime | None = None
    key: str | None = None
    restored: bool
    frames_lost: int | None = None
    contradiction: Known[Literal["frozen", "scale", "turned", "units", "inconsistent"]] | None = None
    contradiction_note: str | None = None
    teaches_nothing: str | None = None


class SessionPage(Model):
    """Sessions of a map in the order of their ids."""

    items: list[SessionView]
    next_cursor: str | None = None


class SessionReport(Model):
    """A session and its present belief."""

    advance: float | None = None
    backwards: bool = False
    speed_limit: float | None = None
    sequences: list[str] | None = None
    lag: int = 0
    camera: str | None = None
    verify: Known[Literal["auto", "always", "never"]] = "auto"
    expires_after: float | None = None
    id: str
    map: str
    created_at: datetime
    expires_at: datetime
    frames: int
    last_frame: int | None = None
    last_frame_at: datetime | None = None
    key: str | None = None
    restored: bool
    frames_lost: int | None = None
    contradiction: Known[Literal["frozen", "scale", "turned", "units", "inconsistent"]] | None = None
    contradiction_note: str | None = None
    teaches_nothing: str | None = None
    belief: BeliefView


class SeveralAnswer(Model):
    """Where the frames were taken, and in which map, or that this is not known."""

    verdict: Known[Literal["recognized", "ambiguous", "unknown"]]
    map: str | None = None
    place: PlaceView | None = None
    probability: float | None = None
    pose: EstimatedPose | None = None
    matches: list[MapMatch]
    maps: list[MapAnswer]
    frames: list[FrameReport]
    milliseconds: dict[str, float]


class SharedPath(Model):
    """A stretch that two traverses share, as sequence matching finds it."""

    gain: float
    query: list[int]
    reference: list[int]


class SimilarityScale(Model):
    """The meaning of the 8-bit values of the matrix: a score is `low` + value / 255 · (`high` - `low`)."""

    low: float
    high: float


class SimilarityView(Model):
    """How alike two traverses of a map are: about the matrix of their scores."""

    map: str
    encoder: str
    query: ComparedTraverse
    reference: ComparedTraverse
    rows: int
    columns: int
    scale: SimilarityScale
    stretches: list[SharedPath]
    truth: list[int | None] | None = None
    radius: float
    aligned: bool
    counterparts: list[int | None] | None = None
    milliseconds: dict[str, float]


class TakenPlace(Model):
    """A place that would be replaced, or would get into another traverse."""

    id: str
    sequence: str | None = None
    same: bool | None = None
    picture: bool | None = None


class TraverseComparison(Model):
    """What a map has already of a traverse."""

    sequence: str | None = None
    free: str | None = None
    known: int
    taken: list[TakenPlace]


class VerifyReport(Model):
    """The result of a full reading of a map."""

    ok: bool
    places: int
    rows: int
    checked_bytes: int
    problems: list[str]
    stale_caches: list[str]


class Version(Model):
    """Versions of the service and its libraries."""

    name: str = "placerec"
    version: str
    api: str = "v1"
    encoder: str
    python: str
    torch: str | None = None
    faiss: str
