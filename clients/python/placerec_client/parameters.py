"""The keyword arguments of the calls, as types: what each operation takes besides its frames.

Written from openapi.json by scripts/client.  Do not edit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, Literal, NotRequired, TypedDict


class Query(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/query``."""

    x: float | None
    """Metres in the map's frame; with y."""

    y: float | None
    """Metres in the map's frame; with x."""

    z: float | None
    """Metres: in the map's frame beside x and y; above the ellipsoid of WGS 84 beside a latitude."""

    latitude: float | None
    """Degrees, WGS 84."""

    longitude: float | None
    """Degrees, WGS 84."""

    heading: float | None
    """Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude."""

    timestamp: datetime | float | str | None
    """When the frame was taken (ISO 8601; UTC without a zone)."""

    sequence: str | None
    """The traverse that the frame belongs to."""

    camera: str | None
    """The camera of the map that took the frame; its mask is applied."""

    level: str | int | None
    """The storey on which the frame was taken: a prior, as places on others are less probable then; `levels` is a
    filter.
    """

    radius: float | None
    """Metres: the place lies within this distance of the given position."""

    heading_tolerance: float | None
    """Degrees: the heading of the place differs by at most this much from `heading`."""

    bbox: str | Sequence[float] | None
    """west,south,east,north in degrees; a west greater than east crosses the antimeridian."""

    sequences: str | Sequence[str] | None
    """The place belongs to one of these traverses: names separated by commas, or a JSON array of texts."""

    levels: str | Sequence[str] | None
    """The place is on one of these storeys: names separated by commas, or a JSON array."""

    after: datetime | float | str | None
    """The place was enrolled with this timestamp or later."""

    before: datetime | float | str | None
    """The place was enrolled with this timestamp or earlier."""

    where: str | Mapping[str, Any] | None
    """A JSON object: the place's metadata has these values under these keys, at its top level. Numbers are compared
    as numbers; texts may have at most 512 characters.
    """

    soft: str | Sequence[str] | None
    """Which of position, bbox, heading, sequences, levels, time, where are not filters but priors, which weigh the
    places; separated by commas.
    """

    prior_trust: float | None
    """The probability that level and the soft parameters are right; 0.9 if left out. The odds of a place that
    contradicts them are multiplied by at least 1 - prior_trust.
    """

    exclude_frames: int | None
    """Leave out this many of the last places of the frame's own sequence."""

    exclude_seconds: float | None
    """Leave out the places of the frame's own sequence that were taken within this many seconds of the frame, or
    that have no timestamp.
    """

    k: int
    """How many matches to list."""

    verify: Literal["auto", "always", "never"]
    """Whether the keypoints of the frame and of its best candidates are compared: always, never, or (auto) only
    where the scores leave doubt.
    """

    explain: bool
    """Explain the score of the best match."""

    encoder: str | None
    """Name or identity that the map's encoder must have (409 otherwise)."""

    format: Literal["json", "geopose", "geopose-ypr"] | None
    """geopose: an OGC GeoPose with a quaternion; geopose-ypr: with yaw, pitch and roll. If left out, the Accept
    header decides (`application/geopose+json`), and json is the default.
    """


class QueryBatch(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/query:batch``."""

    x: float | None
    """Metres in the map's frame; with y."""

    y: float | None
    """Metres in the map's frame; with x."""

    z: float | None
    """Metres: in the map's frame beside x and y; above the ellipsoid of WGS 84 beside a latitude."""

    latitude: float | None
    """Degrees, WGS 84."""

    longitude: float | None
    """Degrees, WGS 84."""

    heading: float | None
    """Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude."""

    timestamp: datetime | float | str | None
    """When the frame was taken (ISO 8601; UTC without a zone)."""

    sequence: str | None
    """The traverse that the frame belongs to."""

    camera: str | None
    """The camera of the map that took the frame; its mask is applied."""

    level: str | int | None
    """The storey on which the frame was taken: a prior, as places on others are less probable then; `levels` is a
    filter.
    """

    radius: float | None
    """Metres: the place lies within this distance of the given position."""

    heading_tolerance: float | None
    """Degrees: the heading of the place differs by at most this much from `heading`."""

    bbox: str | Sequence[float] | None
    """west,south,east,north in degrees; a west greater than east crosses the antimeridian."""

    sequences: str | Sequence[str] | None
    """The place belongs to one of these traverses: names separated by commas, or a JSON array of texts."""

    levels: str | Sequence[str] | None
    """The place is on one of these storeys: names separated by commas, or a JSON array."""

    after: datetime | float | str | None
    """The place was enrolled with this timestamp or later."""

    before: datetime | float | str | None
    """The place was enrolled with this timestamp or earlier."""

    where: str | Mapping[str, Any] | None
    """A JSON object: the place's metadata has these values under these keys, at its top level. Numbers are compared
    as numbers; texts may have at most 512 characters.
    """

    soft: str | Sequence[str] | None
    """Which of position, bbox, heading, sequences, levels, time, where are not filters but priors, which weigh the
    places; separated by commas.
    """

    prior_trust: float | None
    """The probability that level and the soft parameters are right; 0.9 if left out. The odds of a place that
    contradicts them are multiplied by at least 1 - prior_trust.
    """

    exclude_frames: int | None
    """Leave out this many of the last places of the frame's own sequence."""

    exclude_seconds: float | None
    """Leave out the places of the frame's own sequence that were taken within this many seconds of the frame, or
    that have no timestamp.
    """

    k: int
    """How many matches to list."""

    verify: Literal["auto", "always", "never"]
    """Whether the keypoints of the frame and of its best candidates are compared: always, never, or (auto) only
    where the scores leave doubt.
    """

    explain: bool
    """Explain the score of the best match."""

    encoder: str | None
    """Name or identity that the map's encoder must have (409 otherwise)."""


class ListMaps(TypedDict, total=False):
    """Parameters of ``/v1/maps``."""

    limit: int
    """Most items on a page."""


class VerifyMap(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/verify``."""


class EnrolPlace(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/places/{place}``."""

    x: float | None
    """Metres in the map's frame; with y."""

    y: float | None
    """Metres in the map's frame; with x."""

    z: float | None
    """Metres: in the map's frame beside x and y; above the ellipsoid of WGS 84 beside a latitude."""

    latitude: float | None
    """Degrees, WGS 84."""

    longitude: float | None
    """Degrees, WGS 84."""

    heading: float | None
    """Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude."""

    timestamp: datetime | float | str | None
    """When the frame was taken (ISO 8601; UTC without a zone)."""

    sequence: str | None
    """The traverse that the frame belongs to."""

    camera: str | None
    """The camera of the map that took the frame; its mask is applied."""

    level: str | int | None
    """The storey on which the frame was taken."""

    accuracy_metres: float | None
    """Standard deviation of each coordinate."""

    accuracy_degrees: float | None
    """Standard deviation of its heading; with accuracy_metres."""

    metadata: str | Mapping[str, Any] | None
    """A JSON object."""

    encoder: str | None
    """Name or identity that the map's encoder must have (409 otherwise)."""


class ListPlaces(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/places``."""

    limit: int
    """Most items on a page."""

    sequence: str | None
    """Only the places of this traverse."""

    camera: str | None
    """Only places that this camera took."""

    level: str | int | None
    """Only places on this storey."""

    after: datetime | float | str | None
    """Only places with this timestamp or a later one."""

    before: datetime | float | str | None
    """Only places with this timestamp or an earlier one."""

    where: str | Mapping[str, Any] | None
    """A JSON object: only places whose metadata has these values under these keys, at its top level."""


class EnrolPlaces(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/places``."""

    encoder: str | None
    """Name or identity that the map's encoder must have (409 otherwise)."""

    align: bool
    """With background: align the traverses of the form with those that the map has, once all frames are enrolled, as
    POST …/align does; the job's result has the reports in `aligned`.
    """

    most_speed: float | None
    """With background: metres a second of the vehicle at most; 60 if left out. A place is refused with
    `implausible-pose` whose pose is reached faster, by the timestamps of its traverse.
    """

    replace: bool
    """Whether a frame replaces the place of another frame that has its id; else it fails alone with 409
    places-taken. The same frame is never one of these.
    """

    batch: str | None
    """A name for this batch, for example a random one, to which another batch can refer with after."""

    after: str | None
    """The batch of this map after which this one is to be stored. It may still be under way: this one is encoded
    meanwhile. If it is not stored in time, the answer is 409 batch-out-of-order, and nothing of this batch is
    stored.
    """


class ListSequences(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/sequences``."""

    limit: int
    """Most items on a page."""


class UploadRecording(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/recordings/{recording}``."""

    offset: int
    """Where the piece begins."""


class AddLook(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/places/{place}/looks``."""

    timestamp: datetime | float | str | None
    """When the frame was taken (ISO 8601; UTC without a zone)."""

    camera: str | None
    """The camera of the map that took the frame; its mask is applied."""

    encoder: str | None
    """Name or identity that the map's encoder must have (409 otherwise)."""


class ListAllLooks(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/looks``."""

    limit: int
    """Most items on a page."""

    run: str | None
    """Only those that were learnt from this run."""


class DeleteLearntLooks(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/looks``."""

    run: str | None
    """Those that were learnt from this run."""

    since: datetime | float | str | None
    """Those that were added to the map at this time or later (ISO 8601; UTC without a zone)."""

    until: datetime | float | str | None
    """Those that were added before this time."""


class ReadPlan(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/plan``."""

    step: int
    """List about one place in every `step`."""


class CheckCoverage(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/coverage``."""

    x: float | None
    """Metres in the map's frame; with y."""

    y: float | None
    """Metres in the map's frame; with x."""

    z: float | None
    """Metres. Beside x and y distances without it are those in the plane; on the Earth it does nothing."""

    latitude: float | None
    """Degrees, WGS 84."""

    longitude: float | None
    """Degrees, WGS 84."""

    heading: float | None
    """Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude."""

    k: int
    """How many of the nearest places to list."""


class FollowMap(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/events``."""

    kinds: str | Sequence[str] | None
    """The kinds of events, separated by commas: query, enrolment, session, job, map, alarm; all if left out."""

    verdicts: str | Sequence[str] | None
    """Only queries with these verdicts, separated by commas: recognized, ambiguous, unknown; all if left out. Events
    of other kinds are not affected.
    """

    pictures: bool
    """Tell queries with a small picture of the frame, if the map keeps pictures of its places. This needs a key of
    the role `enrol`.
    """


class ReadCalibration(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/calibration``."""

    threshold: float | None
    """Another threshold on the decision value."""

    margin: float | None
    """Another margin."""


class QueryOrEnrol(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/query:enrol``."""

    x: float | None
    """Metres in the map's frame; with y."""

    y: float | None
    """Metres in the map's frame; with x."""

    z: float | None
    """Metres: in the map's frame beside x and y; above the ellipsoid of WGS 84 beside a latitude."""

    latitude: float | None
    """Degrees, WGS 84."""

    longitude: float | None
    """Degrees, WGS 84."""

    heading: float | None
    """Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude."""

    timestamp: datetime | float | str | None
    """When the frame was taken (ISO 8601; UTC without a zone)."""

    sequence: str | None
    """The traverse that the frame belongs to."""

    camera: str | None
    """The camera of the map that took the frame; its mask is applied."""

    level: str | int | None
    """The storey on which the frame was taken: a prior, as places on others are less probable then; `levels` is a
    filter.
    """

    accuracy_metres: float | None
    """Standard deviation of each coordinate."""

    accuracy_degrees: float | None
    """Standard deviation of its heading; with accuracy_metres."""

    radius: float | None
    """Metres: the place lies within this distance of the given position."""

    heading_tolerance: float | None
    """Degrees: the heading of the place differs by at most this much from `heading`."""

    bbox: str | Sequence[float] | None
    """west,south,east,north in degrees; a west greater than east crosses the antimeridian."""

    sequences: str | Sequence[str] | None
    """The place belongs to one of these traverses: names separated by commas, or a JSON array of texts."""

    levels: str | Sequence[str] | None
    """The place is on one of these storeys: names separated by commas, or a JSON array."""

    after: datetime | float | str | None
    """The place was enrolled with this timestamp or later."""

    before: datetime | float | str | None
    """The place was enrolled with this timestamp or earlier."""

    where: str | Mapping[str, Any] | None
    """A JSON object: the place's metadata has these values under these keys, at its top level. Numbers are compared
    as numbers; texts may have at most 512 characters.
    """

    soft: str | Sequence[str] | None
    """Which of position, bbox, heading, sequences, levels, time, where are not filters but priors, which weigh the
    places; separated by commas.
    """

    prior_trust: float | None
    """The probability that level and the soft parameters are right; 0.9 if left out. The odds of a place that
    contradicts them are multiplied by at least 1 - prior_trust.
    """

    exclude_frames: int | None
    """Leave out this many of the last places of the frame's own sequence."""

    exclude_seconds: float | None
    """Leave out the places of the frame's own sequence that were taken within this many seconds of the frame, or
    that have no timestamp.
    """

    metadata: str | Mapping[str, Any] | None
    """A JSON object."""

    k: int
    """How many matches to list."""

    verify: Literal["auto", "always", "never"]
    """Whether the keypoints of the frame and of its best candidates are compared: always, never, or (auto) only
    where the scores leave doubt.
    """

    encoder: str | None
    """Name or identity that the map's encoder must have (409 otherwise)."""


class QueryMaps(TypedDict, total=False):
    """Parameters of ``/v1/query``."""

    x: float | None
    """Metres in the map's frame; with y."""

    y: float | None
    """Metres in the map's frame; with x."""

    z: float | None
    """Metres: in the map's frame beside x and y; above the ellipsoid of WGS 84 beside a latitude."""

    latitude: float | None
    """Degrees, WGS 84."""

    longitude: float | None
    """Degrees, WGS 84."""

    heading: float | None
    """Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude."""

    timestamp: datetime | float | str | None
    """When the frame was taken (ISO 8601; UTC without a zone)."""

    sequence: str | None
    """The traverse that the frame belongs to."""

    camera: str | None
    """The camera of the map that took the frame; its mask is applied."""

    level: str | int | None
    """The storey on which the frame was taken: a prior, as places on others are less probable then; `levels` is a
    filter.
    """

    radius: float | None
    """Metres: the place lies within this distance of the given position."""

    heading_tolerance: float | None
    """Degrees: the heading of the place differs by at most this much from `heading`."""

    bbox: str | Sequence[float] | None
    """west,south,east,north in degrees; a west greater than east crosses the antimeridian."""

    sequences: str | Sequence[str] | None
    """The place belongs to one of these traverses: names separated by commas, or a JSON array of texts."""

    levels: str | Sequence[str] | None
    """The place is on one of these storeys: names separated by commas, or a JSON array."""

    after: datetime | float | str | None
    """The place was enrolled with this timestamp or later."""

    before: datetime | float | str | None
    """The place was enrolled with this timestamp or earlier."""

    where: str | Mapping[str, Any] | None
    """A JSON object: the place's metadata has these values under these keys, at its top level. Numbers are compared
    as numbers; texts may have at most 512 characters.
    """

    soft: str | Sequence[str] | None
    """Which of position, bbox, heading, sequences, levels, time, where are not filters but priors, which weigh the
    places; separated by commas.
    """

    prior_trust: float | None
    """The probability that level and the soft parameters are right; 0.9 if left out. The odds of a place that
    contradicts them are multiplied by at least 1 - prior_trust.
    """

    exclude_frames: int | None
    """Leave out this many of the last places of the frame's own sequence."""

    exclude_seconds: float | None
    """Leave out the places of the frame's own sequence that were taken within this many seconds of the frame, or
    that have no timestamp.
    """

    maps: str | Sequence[str] | None
    """Ids of the maps, separated by commas, at most 100; all maps if left out."""

    cameras: str | Mapping[str, Any] | None
    """A JSON object with the camera of each part of the form."""

    k: int
    """How many matches to list."""

    verify: Literal["auto", "always", "never"]
    """Whether the keypoints of the frame and of its best candidates are compared: always, never, or (auto) only
    where the scores leave doubt.
    """

    format: Literal["json", "geopose", "geopose-ypr"] | None
    """geopose: an OGC GeoPose with a quaternion; geopose-ypr: with yaw, pitch and roll. If left out, the Accept
    header decides (`application/geopose+json`), and json is the default.
    """


class ListSessions(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/sessions``."""

    limit: int
    """Most items on a page."""


class SendFrame(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/sessions/{session}/frames``."""

    frame: int | None
    """The robot's own number of the frame; numbers grow. A missing number is a frame that did not arrive; the last
    number again is the same frame sent again, and gets the same answer. A smaller one is refused, unless it is
    smaller by more than 1000, or the timestamp says that the robot counts anew.
    """

    timestamp: datetime | float | str | None
    """When the frame was taken. One up to a second before the last one is refused; where it goes back by more, or
    leaps ahead by more than a day, the robot's clock was set, and the run goes on by it.
    """

    forward: float | None
    """Odometry: metres forward since the last frame that the service took in, in the direction that the robot faced
    then.
    """

    left: float | None
    """Odometry: metres to the left; with forward."""

    turn: float | None
    """Odometry: degrees turned counter-clockwise since the last frame that the service took in; with forward."""

    deviation: float | None
    """Standard deviation of forward and left, metres."""

    turn_deviation: float | None
    """Standard deviation of turn, degrees."""

    odometry_x: float | None
    """Where odometry says that the robot is, in metres in odometry's own frame; instead of forward. The service
    takes the motion since the last frame that it took in from it, so that none is lost or counted twice.
    """

    odometry_y: float | None
    """Metres in odometry's frame; with odometry_x."""

    odometry_heading: float | None
    """Degrees counter-clockwise from +x of odometry's frame to where the camera looks, -360 to 360; with odometry_x."""

    odometry_covariance: str | Sequence[float] | None
    """The covariance of odometry_x, odometry_y and odometry_heading: nine numbers row by row, separated by commas,
    in metres and radians as in ROS; its growth is that of the motion.
    """

    odometry_origin: str | None
    """A name for where odometry began. If the frame before had another one, the motion between the two is not known."""

    level: str | int | None
    """The storey on which the robot is, as far as it knows: a prior, which holds until another one is stated. Where
    another is, the robot has come there by a lift.
    """

    height: float | None
    """Metres, by a barometer for example: where it leaps by more than the map's same_place_height, the robot is on
    another storey; nothing else of it counts.
    """

    k: int
    """How many matches to list."""

    encoder: str | None
    """Name or identity that the map's encoder must have (409 otherwise)."""


class ListReview(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/review``."""

    limit: int
    """Most items on a page."""

    labelled: bool | None
    """Only frames with a label, or only those without one."""


class ListAnswers(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/answers``."""

    limit: int
    """Most answers, the latest ones."""

    camera: str | None
    """Only answers to frames of this camera."""

    session: str | None
    """Only answers to frames of this session."""

    verdict: Literal["recognized", "ambiguous", "unknown"] | None
    """Only answers with this verdict."""


class ListPlaceMatches(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/places/{place}/matches``."""

    limit: int
    """Most answers, the latest ones."""

    camera: str | None
    """Only answers to frames of this camera."""

    session: str | None
    """Only answers to frames of this session."""


class Encode(TypedDict, total=False):
    """Parameters of ``/v1/encode``."""

    encoder: str | None
    """Name or identity; the default encoder if left out."""


class Regions(TypedDict, total=False):
    """Parameters of ``/v1/regions``."""

    encoder: str | None
    """Name or identity; the default encoder if left out."""

    limit: int | None
    """Only this many, those of the highest energy."""

    format: Literal["json", "png"] | None
    """json or png; if left out, the Accept header decides, and json is the default."""


class Match(TypedDict, total=False):
    """Parameters of ``/v1/match``."""

    encoder: str | None
    """Name or identity; the default encoder if left out."""

    explain: bool
    """Say which words, regions and cells carried the score."""

    format: Literal["json", "png"] | None
    """png: both frames side by side, corresponding points joined by lines; if left out, the Accept header decides,
    and json is the default.
    """


class CheckHealth(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/health``."""

    seconds: float
    """Seconds for examining the map's frames; of a large map only a part is examined in that time."""

    limit: int
    """How many places, gaps and stretches are listed at most, each."""


class CompareTraverses(TypedDict, total=False):
    """Parameters of ``/v1/maps/{map}/similarity``."""


class ImportMap(TypedDict, total=False):
    """Parameters of ``/v1/maps/import``."""

    id: str | None
    """Id of the new map; if left out, the one that the file states."""

    encoder: str | None
    """Name or identity of the encoder that the map is expected to have."""


class ListJobs(TypedDict, total=False):
    """Parameters of ``/v1/jobs``."""

    limit: int
    """Most items on a page."""

    map: str | None
    """Only the jobs of this map."""

    kind: str | None
    """Only the jobs of this kind."""

    state: Literal["queued", "running", "succeeded", "failed", "cancelled"] | None
    """Only the jobs in this state."""


class ReadJob(TypedDict, total=False):
    """Parameters of ``/v1/jobs/{job}``."""


class ListKeys(TypedDict, total=False):
    """Parameters of ``/v1/keys``."""

    limit: int
    """Most items on a page."""


class CreateKey(TypedDict, total=False):
    """Parameters of ``/v1/keys``."""

    lock_out: bool
    """Go on although no key of the role admin for all maps will be in force, so that only a command on the service's
    machine can change keys.
    """


class NarrowKey(TypedDict, total=False):
    """Parameters of ``/v1/keys/{key}``."""

    lock_out: bool
    """Go on although no key of the role admin for all maps will be in force, so that only a command on the service's
    machine can change keys.
    """


class DeleteKey(TypedDict, total=False):
    """Parameters of ``/v1/keys/{key}``."""

    lock_out: bool
    """Go on although no key of the role admin for all maps will be in force, so that only a command on the service's
    machine can change keys.
    """


class ReadAudit(TypedDict, total=False):
    """Parameters of ``/v1/audit``."""

    limit: int
    """Most items on a page."""

    map: str | None
    """Only lines about this map."""

    key: str | None
    """Only calls with the key of this id or name."""

    operation: str | None
    """Only this operation."""

    after: datetime | float | str | None
    """Only lines of this time or later."""

    before: datetime | float | str | None
    """Only lines of this time or earlier."""


class ReadHistory(TypedDict, total=False):
    """Parameters of ``/v1/service/history``."""

    hours: float
    """Hours until now."""


class NewMap(TypedDict, total=False):
    """The settings of a new map."""

    description: str

    keep: Literal["none", "thumbnail", "image"]
    """The picture that is stored of each frame. A change applies to frames enrolled from then on."""

    same_place_radius: float
    """Places within this distance in metres along the ground are the same place."""

    same_place_height: float
    """Places whose heights differ by more metres are on different storeys, and never the same place; where both have
    a level, that says it instead.
    """

    same_place_frames: int
    """Without poses: places this many frames apart in their sequence are the same place."""

    pose_accuracy: PoseAccuracy | None
    """How exact the poses of places are that do not state it themselves; null: pictures of the map's places say it
    as far as they can.
    """

    verification: bool
    """Whether keypoints of each frame are stored, by which answers are verified. A change applies to frames enrolled
    from then on.
    """

    index: Literal["auto", "exact", "compact"]
    """How the map is searched: every place compared (exact), by codes (compact), or by what suits its size (auto):
    compact from 256 places.
    """

    review: ReviewSetting | None
    """Which frames are stored to be reviewed by people; null: none."""

    learning: LearningSetting
    """How the map learns from the runs of its robots."""

    alarms: AlarmSetting
    """From which numbers on trends of the health report become events."""

    encoder: str | None
    """Name or full identity of the encoder; the default encoder if left out."""

    precision: Literal["half", "compressed"]
    """How the descriptors are stored; it cannot be changed later."""


class MapChanges(TypedDict, total=False):
    """A merge patch (RFC 7396) of a map: null restores the default, and what is left out stays as it is."""

    description: str | None

    keep: Literal["none", "thumbnail", "image"] | None

    same_place_radius: float | None

    same_place_height: float | None

    same_place_frames: int | None

    pose_accuracy: PoseAccuracy | None
    """null: nobody states it."""

    verification: bool | None

    index: Literal["auto", "exact", "compact"] | None
    """auto, exact or compact (auto from 256 places on)."""

    review: ReviewChanges | None
    """null: no frames are stored from now on."""

    learning: LearningChanges | None
    """null: nothing is learnt from now on."""

    alarms: AlarmChanges | None
    """null: no alarm is raised from now on."""

    calibration: CalibrationChanges | None


class PlaceChanges(TypedDict, total=False):
    """A merge patch (RFC 7396) of a place: null clears a field, and fields that are left out stay."""

    pose: PoseChanges | None

    timestamp: datetime | float | str | None

    sequence: str | None

    level: str | int | None
    """Null: the one that the metadata states, if any."""

    pose_accuracy: PoseAccuracy | None

    metadata: Mapping[str, Any] | None


class NewSession(TypedDict, total=False):
    """The options of a session."""

    advance: float | None
    """By how many frames of the map's traverse the robot usually moves on from one frame to the next; used where
    neither odometry nor a speed limit is given. By default it is not known: the session learns how fast the robot
    goes, up to ten frames, and whether it stands or goes in reverse.
    """

    backwards: bool
    """With advance: the robot may move against the traverse as well as along it; without, it may anyway."""

    speed_limit: float | None
    """Metres per second. Every frame then needs a timestamp, and the places need poses."""

    sequences: Sequence[str] | None
    """Only the places of these traverses."""

    lag: int
    """Also estimate where the robot was this number of frames ago, given all frames since."""

    camera: str | None
    """The camera of the map that took the frame; its mask is applied."""

    verify: Literal["auto", "always", "never"]
    """Whether the keypoints of the frame and of its best candidates are compared: always, never, or (auto) only
    where the scores leave doubt.
    """

    expires_after: float | None
    """Seconds without a frame after which the session ends; the service's setting is the default and the maximum."""


class Aligning(TypedDict, total=False):
    """Which traverse is aligned with which others."""

    poses: bool
    """Give each frame without a pose that of its counterpart; the place then says so in `pose_of`."""

    dry_run: bool
    """Only report what would be stored."""


class Pruning(TypedDict, total=False):
    """Which places are removed because their neighbours can stand in for them."""

    dry_run: bool
    """Only report which places would be removed, and how much recall would be lost."""

    max_recall_loss: float
    """How much recall may be lost, as a share of the queries."""

    similarity: float | None
    """How alike two frames of one place must look (score of the first stage) for one to stand in for the other. If
    left out, it is chosen by the loss of recall; if given, `max_recall_loss` is ignored.
    """

    sequence: str | None
    """Only places of this traverse may be removed."""

    queries: str | None
    """The traverse whose frames are the queries; it is neither searched nor pruned. If left out, every frame is a
    query for which the map is searched without that frame. This overestimates recall, since the neighbouring frames
    were taken with it.
    """

    sample: int
    """The largest number of queries."""


class Erasing(TypedDict, total=False):
    """Which frames are erased; without any, what places that were deleted before have left."""

    ids: Sequence[str] | None
    """Places of these ids, with their looks; `p7/8f3a0c52d41b9e07` is one look of `p7`."""

    filter: PlaceConditions | None
    """Places that fulfil these conditions, at least one. With a time or a camera, and no traverse or metadata, also
    looks, frames for review, answers and notes of runs of that time and camera.
    """

    session: str | None
    """Frames for review, answers and notes of this session, which ends, and the looks that the map has learnt from
    it; also if it ended long ago.
    """

    bags: bool
    """Also remove the bags of the map that wait to be enrolled, whatever they have. Otherwise, and where a job or an
    upload uses one, the result names them as `waiting_bags`: what they have is not looked at.
    """


class Merging(TypedDict, total=False):
    """Which map is merged into this one, and how conflicts are solved."""

    dry_run: bool
    """Only report what would be copied, and how far the maps overlap."""

    on_conflict: Literal["refuse", "rename", "skip"]
    """The action if an id belongs to another frame here, both maps have a sequence of the same name, or a camera has
    another mask: `refuse` the merge; `rename` what is copied, with `prefix`; `skip` such places, and append places
    of a sequence to the sequence of the same name.
    """

    prefix: str | None
    """Put before names on conflict; if left out, the other map's id and a hyphen."""

    sample: int
    """How many places the overlap is measured with at most; 0: it is not measured."""


class Reencoding(TypedDict, total=False):
    """Which new map is made from a map, and for which encoder."""

    encoder: str | None
    """Name or full identity of the encoder; the default encoder if left out."""


class CalibrationOrder(TypedDict, total=False):
    """How a map is to be calibrated, and for which target."""

    target: Target
    """The target of the threshold."""

    dry_run: bool
    """Report the calibration without storing it."""

    sequence: str | None
    """The traverse whose frames query the map."""

    pairs: Mapping[str, str | None] | None
    """For places of the sequence, the id of a place of another sequence that shows the same, or null if there is
    none. Only these places query the map. If left out, poses decide which places are the same.
    """

    most: int
    """The largest number of frames that query the map; they are chosen evenly."""

    beside: Literal["encoder", "map", "none"]
    """With the method labels, further frames, since labels are few and of the doubtful frames. `encoder`: the
    encoder's calibration, whose curve is moved as far as the labels demand; the target is not used then. `map`: the
    map's own frames, which query it as well. `none`: nothing.
    """

    labels: Sequence[Label] | None
    """One label for each frame of the form."""


class CameraDefinition(TypedDict, total=False):
    """Which part of a camera's frames is ignored, which direction each pixel looks in, and which values it has."""

    mask: Mask | None
    """The part that is ignored; null if nothing is."""

    intrinsics: Intrinsics | None
    """Of the upright frame, as in ROS's CameraInfo; null if they are not known."""

    value_range: tuple[int, int] | None
    """The values of frames of 16 bits that become black and white, such as [0, 1023] of a camera of ten bits; null:
    the upper 8 bits are used.
    """


class NewKey(TypedDict, total=False):
    """A key to create."""

    maps: Sequence[str] | None
    """Limit it to these maps; null or left out: all maps."""

    learn: bool
    """Whether maps that learn do so from the runs of its holder. An option of the role enrol; admin includes it."""

    expires_at: datetime | float | str | None
    """When it expires; null or left out: never."""

    replaces: str | None
    """The id of a key in force whose name this one has, to take its place. Then end that one, by its `expires_at` or
    by deleting it.
    """


class KeyChanges(TypedDict, total=False):
    """A merge patch (RFC 7396) of a key; fields that are left out stay. The key can only be narrowed."""

    role: Literal["query", "enrol", "admin"] | None
    """Not higher than now."""

    maps: Sequence[str] | None
    """Some of the present ones; null: all maps."""

    learn: bool | None
    """false: no map learns from its runs any more."""

    expires_at: datetime | float | str | None
    """Not later than now; null: never."""


class Deletion(TypedDict, total=False):
    """Which places to delete: those of some ids, or those that fulfil some conditions."""

    ids: Sequence[str] | None
    """Ids of places; those that are gone are listed in the answer."""

    filter: PlaceConditions | None
    """Conditions, at least one."""

    dry_run: bool
    """Only say which places would be deleted."""


class LabelOrder(TypedDict, total=False):
    """A label, that it is taken back, or that the frame is thrown away: exactly one of these."""

    place: str | None
    """It shows this place of the map."""

    look: bool
    """With place: it is also added to the looks of the place."""

    new: NewPlace | None
    """It shows a new place, as which it is enrolled."""

    stranger: bool
    """It shows no place of this map."""

    clear: bool
    """Its label is taken back."""

    discard: bool
    """It is thrown away."""


class RecordingOrder(TypedDict, total=False):
    """Which frames of a bag are enrolled, and how; as the options of ``placerec enrol``."""

    sequence: str | None
    """The traverse; null: as the file is called."""

    named: bool
    """Whether somebody chose the traverse's name; another one is made unique, as `places:compare` does."""

    id_prefix: str
    """Before the ids, which are made of topic and stamp."""

    camera: str | None
    """Of the map; its mask is applied."""

    level: str | int | None
    """The storey on which its frames were taken."""

    pose_accuracy: PoseAccuracy | None
    """How exact its poses are."""

    topic: str | None

    pose_topic: str | None

    fixed_frame: str | None

    moving_frame: str | None

    largest_gap: float
    """Seconds between poses that are bridged."""

    most_speed: float
    """Metres a second of the vehicle at most: poses that are reached faster are left out."""

    allow_lost_poses: bool
    """Also enrol a bag of which more than a tenth of the frames lose their pose, as no vehicle can have driven so;
    without it, the job fails and nothing is enrolled.
    """

    every_metres: float | None

    every_degrees: float | None

    every_seconds: float | None

    keep_standing: bool
    """Also enrol frames in which nothing changes, as where the robot stood."""

    replace: bool
    """Replace places of other frames that have these ids; else it is refused."""

    align: bool
    """Then find which frames show places that the map had already."""


class TraverseToCompare(TypedDict, total=False):
    """A traverse that would be enrolled."""

    sequence: str | None
    """The traverse's name; null: it has none."""

    named: bool
    """Whether somebody chose this name. Another one, such as that of a folder, is made unique: NAME~2 and so on,
    unless the map has these very frames under such a name already.
    """

    camera: str | None
    """The camera of the map that took the frames."""

    coordinates: Literal["metric", "geographic"] | None
    """What the frames' poses are in: metric or geographic; null: they have none."""


class Label(TypedDict):
    """The true place of one frame of a form."""

    file: str
    """Name of the file part that holds the frame."""

    place: str | None
    """Id of the place that the frame shows; null if the map lacks that place."""

    camera: NotRequired[str | None]
    """The camera of the map that took the frame; its mask is applied."""


class Target(TypedDict):
    """The target of the threshold. ``precision``: the share of right answers among those believed.
    ``false_accept_rate``: the share of frames of places that the map lacks that may be believed.
    ``mean_of_negatives``: rule of the thesis (3.4.3), the mean over the frames of places that the map lacks; it has
    no value.
    """

    rule: Literal["precision", "false_accept_rate", "mean_of_negatives"]

    value: NotRequired[float | None]


class Intrinsics(TypedDict):
    """Focal lengths, principal point and distortion of a camera, for upright frames of width x height pixels."""

    width: int
    """Pixels of a row of the upright frame for which the other values hold."""

    height: int

    fx: float
    """Focal length in pixels, as is fy."""

    fy: float

    cx: float
    """Principal point in pixels, as is cy; the first pixel's centre is at 0."""

    cy: float

    distortion_model: NotRequired[Literal["none", "plumb_bob", "rational_polynomial", "equidistant"]]
    """As in ROS's CameraInfo; equidistant: fisheye."""

    distortion: NotRequired[Sequence[float]]
    """k1, k2, p1, p2, k3 of plumb_bob, and k4, k5, k6; k1 to k4 of equidistant."""


class Mask(TypedDict):
    """The parts of each frame of one camera that are ignored. ``polygons`` are given by their corners, (x, y) in
    shares of the upright frame's width and height, from its top left corner; where they overlap, all that any of
    them holds is covered.
    """

    polygons: Sequence[Sequence[tuple[float, float]]]


class PlaceConditions(TypedDict):
    """Conditions on a place; all that are given have to hold."""

    sequence: NotRequired[str | None]
    """It belongs to this traverse."""

    camera: NotRequired[str | None]
    """This camera took its frame."""

    level: NotRequired[str | int | None]
    """It is on this storey."""

    after: NotRequired[datetime | float | str | None]
    """It has this timestamp or a later one."""

    before: NotRequired[datetime | float | str | None]
    """It has this timestamp or an earlier one."""

    where: NotRequired[Mapping[str, Any] | None]
    """Its metadata has these values under these keys, at its top level."""


class NewPlace(TypedDict):
    """The place as which a frame is enrolled."""

    x: NotRequired[float | None]
    """Metres in the map's frame; with y."""

    y: NotRequired[float | None]
    """Metres in the map's frame; with x."""

    z: NotRequired[float | None]
    """Metres: in the map's frame beside x and y; above the ellipsoid of WGS 84 beside a latitude."""

    latitude: NotRequired[float | None]
    """Degrees, WGS 84."""

    longitude: NotRequired[float | None]
    """Degrees, WGS 84."""

    heading: NotRequired[float | None]
    """Degrees: counter-clockwise from +x beside x and y, clockwise from north beside a latitude."""

    timestamp: NotRequired[datetime | float | str | None]
    """When the frame was taken (ISO 8601; UTC without a zone)."""

    sequence: NotRequired[str | None]
    """The traverse that the frame belongs to."""

    camera: NotRequired[str | None]
    """The camera of the map that took the frame; its mask is applied."""

    level: NotRequired[str | int | None]
    """The storey on which the frame was taken."""

    accuracy_metres: NotRequired[float | None]
    """Standard deviation of each coordinate."""

    accuracy_degrees: NotRequired[float | None]
    """Standard deviation of its heading; with accuracy_metres."""

    id: str
    """Id of the place."""

    metadata: NotRequired[Mapping[str, Any]]


class AlarmChanges(TypedDict):
    """Changes of what raises an alarm; null: never."""

    worse_places: NotRequired[int | None]

    changed_places: NotRequired[int | None]

    quiet_stretches: NotRequired[int | None]


class Curve(TypedDict):
    """P(right | d) = 1 / (1 + exp(-(slope · d + intercept))), d a decision value."""

    slope: float
    """Log odds gained by a decision value greater by one."""

    intercept: float
    """Log odds at the decision value 0."""

    imagined_slope: NotRequired[float]
    """Added to the slope where the whole background is imagined; left out if 0."""

    imagined_intercept: NotRequired[float]
    """Added to the intercept where the whole background is imagined; left out if 0."""


class Environment(TypedDict):
    """The prior of the scores of other places of one environment, in units of the score (see the module). ``mean``
    and ``deviation`` are μ₀ and σ₀; ``mean_weight`` and ``deviation_weight`` are κ₀ and ν₀, the number of scores
    that the prior counts as.
    """

    mean: float

    deviation: float

    mean_weight: float

    deviation_weight: float


class GeometryTerms(TypedDict):
    """How evidence joins the log odds of the first two stages (see the module)."""

    support: float
    """Weight of the log odds of the first two stages."""

    slope: float
    """Log odds gained by an evidence e times greater."""

    lead: NotRequired[float]
    """Log odds gained where the map has other places and none of them fits nearly as well."""

    intercept: float
    """Log odds where nothing says anything."""


class Calibration(TypedDict):
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

    curve: NotRequired[Curve | None]

    decision: NotRequired[str]

    frames: NotRequired[int | None]
    """Held-out or labelled frames it rests on, if known."""

    environment: NotRequired[Environment | None]
    """Scores of other places within one environment; null: not measured."""

    geometry: NotRequired[GeometryTerms | None]
    """How geometric evidence joins the probability; null: it does not."""


class CalibrationChanges(TypedDict):
    """Values of a calibration to set by hand, null restores the encoder's value; or which measured one to store."""

    threshold: NotRequired[float | None]
    """Least decision value of a recognized place; every decision value is from -1 to 1."""

    margin: NotRequired[float | None]

    measured_at: NotRequired[datetime | float | str | None]
    """Store, instead, the calibration that the latest calibrate has found, as after a dry run: the time at which it
    was measured, `measured.at` of the calibration. If it was measured again since, this is refused.
    """

    restore: NotRequired[Calibration | None]
    """Put back, instead, a calibration that the map had, whole, as it was read: to undo a change."""


class Pose(TypedDict):
    """Where a frame was taken: metres in the map's frame, or degrees on the Earth (WGS 84). ``z`` is in metres: in
    the map's frame beside x and y, above the ellipsoid of WGS 84 beside latitude and longitude. It tells storeys
    apart; distances are those along the ground. ``heading`` is in degrees: counter-clockwise from +x beside x and y,
    clockwise from north beside latitude and longitude. It is normalized to [0, 360).
    """

    x: NotRequired[float | None]

    y: NotRequired[float | None]

    z: NotRequired[float | None]

    latitude: NotRequired[float | None]

    longitude: NotRequired[float | None]

    heading: NotRequired[float | None]


class RejectedGround(TypedDict):
    """A stretch of new ground that a person has rejected."""

    stretch: str
    """Its id."""

    run: str
    """The run that proposed it."""

    at: datetime | float | str
    """When it was rejected."""

    poses: Sequence[Pose]
    """Where it is, in the order of the run."""


class LearningChanges(TypedDict):
    """Changes of how a map learns from runs; null restores a default."""

    mode: NotRequired[Literal["off", "propose", "auto"] | None]

    least_probability: NotRequired[float | None]

    most_looks: NotRequired[int | None]

    most_places: NotRequired[int | None]

    new_ground: NotRequired[bool | None]

    calibration: NotRequired[Literal["off", "propose", "auto"] | None]

    rejected_ground: NotRequired[Sequence[RejectedGround] | None]
    """Those that stay rejected; null: none."""


class PoseAccuracy(TypedDict):
    """Standard deviations of a pose, as whoever states it knows them. metres: of each coordinate along the ground.
    degrees: of the heading; None: not stated.
    """

    metres: float
    """Standard deviation of each coordinate."""

    degrees: NotRequired[float | None]
    """Standard deviation of the heading; null: it is not stated."""


class ReviewChanges(TypedDict):
    """Which frames to keep for review; null restores a default."""

    verdicts: NotRequired[Sequence[Literal["recognized", "ambiguous", "unknown"]] | None]

    most_frames: NotRequired[int | None]

    most_bytes: NotRequired[int | None]


class AlarmSetting(TypedDict):
    """From which numbers on the trends of a map raise an alarm; null: never."""

    worse_places: NotRequired[int | None]
    """Places that get worse."""

    changed_places: NotRequired[int | None]
    """Places that have changed: runs pass them, while single frames fail."""

    quiet_stretches: NotRequired[int | None]
    """Stretches that nobody drives any more."""


class LearningSetting(TypedDict):
    """The setting by which a map learns from the runs of its robots."""

    mode: NotRequired[Literal["off", "propose", "auto"]]
    """propose: looks are stored for review, and a person accepts them. auto: the map also takes those on which two
    runs, or keypoints of the frames beside them, agree, and withdraws looks that later runs contradict. off: nothing
    is learnt.
    """

    least_probability: NotRequired[float]
    """How sure the rest of a run must be of a frame's place for the frame to be proposed."""

    most_looks: NotRequired[int]
    """Looks that a place has at most by what it learns, its first and those that people added included."""

    most_places: NotRequired[int | None]
    """Places with learnt looks, and places of new ground, that the map has at most together: then it takes no look
    for a further place by itself, and no stretch; null: no limit.
    """

    new_ground: NotRequired[bool]
    """Whether stretches of runs that leave the map and come back are stored for review, too. A person accepts them,
    whatever the mode; with the mode off there are none.
    """

    calibration: NotRequired[Literal["off", "propose", "auto"]]
    """Whether the map calibrates itself: by a traverse, as soon as it is aligned with others, and by frames whose
    place a run knows beyond doubt (with the mode off there are none). propose: what they would change is measured,
    as by a dry run of `calibrate`. auto: it is stored, by runs once those of two robots, or two half a day apart,
    tell it, unless a person has calibrated the map. off: neither.
    """

    rejected_ground: NotRequired[Sequence[RejectedGround]]
    """Stretches that a person has rejected: no run proposes this ground again. One that is taken out of the list may
    be proposed again.
    """


class ReviewSetting(TypedDict):
    """Which frames a map keeps so that people can say later what they show, and how many at most."""

    verdicts: NotRequired[Sequence[Literal["recognized", "ambiguous", "unknown"]]]
    """Frames that are answered with one of these are stored."""

    most_frames: NotRequired[int]
    """Most frames; the oldest go first."""

    most_bytes: NotRequired[int]
    """Most bytes of their files together; the oldest go first."""


class PoseChanges(TypedDict):
    """Part of a pose; null removes a coordinate."""

    x: NotRequired[float | None]

    y: NotRequired[float | None]

    z: NotRequired[float | None]

    latitude: NotRequired[float | None]

    longitude: NotRequired[float | None]

    heading: NotRequired[float | None]


class FrameToCompare(TypedDict):
    """A frame that would be enrolled."""

    id: str
    """Id of its place."""

    sha256: NotRequired[str | None]
    """The digest of its bytes, where they were read already."""
