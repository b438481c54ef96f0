"""One exception for each kind of problem that the service answers with.

Written from openapi.json by scripts/client.  Do not edit.
"""

from __future__ import annotations

from placerec_client import errors
from placerec_client.errors import Problem


class BadRequest(Problem):
    """400 ``bad-request``: The request cannot be understood."""


class MalformedBody(Problem):
    """400 ``malformed-body``: The body cannot be parsed."""


class MalformedHead(Problem):
    """400 ``malformed-head``: The request is not valid HTTP."""


class KeyNeeded(Problem):
    """401 ``key-needed``: A key is needed."""


class KeyRefused(Problem):
    """401 ``key-refused``: The key is not valid."""


class FirstKeyLocal(Problem):
    """403 ``first-key-local``: The first key is created on the service's own machine."""


class ForeignPage(Problem):
    """403 ``foreign-page``: Requests from other web sites are refused."""


class MapForbidden(Problem):
    """403 ``map-forbidden``: The key is limited to other maps."""


class RoleTooLow(Problem):
    """403 ``role-too-low``: The key's role does not allow this."""


class SessionOfAnother(Problem):
    """403 ``session-of-another``: The session belongs to another key."""


class NoThumbnail(Problem):
    """404 ``no-thumbnail``: The map keeps no picture of the place."""


class NotLocalized(Problem):
    """404 ``not-localized``: The frame was not recognized."""


class UnknownCamera(Problem):
    """404 ``unknown-camera``: The camera does not exist."""


class UnknownExplanation(Problem):
    """404 ``unknown-explanation``: The picture does not exist or is no longer stored."""


class UnknownFrame(Problem):
    """404 ``unknown-frame``: The frame is not stored for review."""


class UnknownJob(Problem):
    """404 ``unknown-job``: The job does not exist."""


class UnknownKey(Problem):
    """404 ``unknown-key``: The key does not exist."""


class UnknownLook(Problem):
    """404 ``unknown-look``: The place has no such look."""


class UnknownMap(Problem):
    """404 ``unknown-map``: The map does not exist."""


class UnknownPath(Problem):
    """404 ``unknown-path``: There is no such resource."""


class UnknownPlace(Problem):
    """404 ``unknown-place``: The place does not exist."""


class UnknownRecording(Problem):
    """404 ``unknown-recording``: Nothing of the recording is here."""


class UnknownSequence(Problem):
    """404 ``unknown-sequence``: The sequence does not exist."""


class UnknownSession(Problem):
    """404 ``unknown-session``: The session does not exist."""


class UnknownStretch(Problem):
    """404 ``unknown-stretch``: No such stretch waits for review."""


class UnknownTopic(Problem):
    """404 ``unknown-topic``: The bag has no such topic."""


class MethodNotAllowed(Problem):
    """405 ``method-not-allowed``: The resource does not support this method."""


class NoGeopose(Problem):
    """406 ``no-geopose``: The answer has no GeoPose."""


class HeadTooSlow(Problem):
    """408 ``head-too-slow``: The request did not arrive in time."""


class BackupFolderMissing(Problem):
    """409 ``backup-folder-missing``: There is no folder for backups."""


class BatchOutOfOrder(Problem):
    """409 ``batch-out-of-order``: The batch before it is not stored."""


class CalibrationWorse(Problem):
    """409 ``calibration-worse``: The calibration would make answers worse."""


class FrameNeeded(Problem):
    """409 ``frame-needed``: The frame has to be sent."""


class FrameOutOfOrder(Problem):
    """409 ``frame-out-of-order``: The frame is older than an earlier one of the session."""


class ImagesMissing(Problem):
    """409 ``images-missing``: The map does not keep all its images."""


class JobEnded(Problem):
    """409 ``job-ended``: The job has already ended."""


class KeyEnded(Problem):
    """409 ``key-ended``: The key is revoked or has expired."""


class KeyExists(Problem):
    """409 ``key-exists``: Another key has this name."""


class KeyWidened(Problem):
    """409 ``key-widened``: A key can only be narrowed."""


class LastAdminKey(Problem):
    """409 ``last-admin-key``: No key could manage the service any more."""


class LookNameTaken(Problem):
    """409 ``look-name-taken``: Another frame of the place has the name of this look."""


class MapExists(Problem):
    """409 ``map-exists``: A map of this id already exists."""


class MergeConflict(Problem):
    """409 ``merge-conflict``: The maps cannot be merged as they are."""


class MixedCoordinates(Problem):
    """409 ``mixed-coordinates``: The map has coordinates of the other kind."""


class PlaceTaken(Problem):
    """409 ``place-taken``: The place has another frame."""


class PlacesTaken(Problem):
    """409 ``places-taken``: Places of other frames have these ids."""


class RecordingInUse(Problem):
    """409 ``recording-in-use``: A job reads the recording."""


class RecordingOffset(Problem):
    """409 ``recording-offset``: The piece does not continue the recording."""


class RepeatedLook(Problem):
    """409 ``repeated-look``: The look is the place's own frame."""


class StreamTaken(Problem):
    """409 ``stream-taken``: Another connection streams into the session."""


class TooManyKeys(Problem):
    """409 ``too-many-keys``: No more keys can be created."""


class TooManyLooks(Problem):
    """409 ``too-many-looks``: The place has as many looks as it may have."""


class TooManyMaps(Problem):
    """409 ``too-many-maps``: No more maps can be created."""


class TooManyPlaces(Problem):
    """409 ``too-many-places``: The map can hold no more places."""


class WrongEncoder(Problem):
    """409 ``wrong-encoder``: The map belongs to another encoder."""


class SessionExpired(Problem):
    """410 ``session-expired``: The session has ended."""


class ExportGone(Problem):
    """412 ``export-gone``: The export is no longer stored."""


class RevisionMismatch(Problem):
    """412 ``revision-mismatch``: The map has changed."""


class BodyTooLarge(Problem):
    """413 ``body-too-large``: The body has too many bytes."""


class ImageTooLarge(Problem):
    """413 ``image-too-large``: The frame has too many bytes."""


class TooManyPixels(Problem):
    """413 ``too-many-pixels``: The frame has too many pixels."""


class UrlTooLong(Problem):
    """414 ``url-too-long``: The path and the query string are too long."""


class UnsupportedFormat(Problem):
    """415 ``unsupported-format``: The image is not a JPEG, PNG or WebP file."""


class UnsupportedMediaType(Problem):
    """415 ``unsupported-media-type``: The content type is not supported here."""


class RangeNotSatisfiable(Problem):
    """416 ``range-not-satisfiable``: The range begins after the end."""


class ArchiveTooNew(Problem):
    """422 ``archive-too-new``: The file was written by a later version."""


class CalibrationImpossible(Problem):
    """422 ``calibration-impossible``: The map cannot be calibrated with these frames."""


class DigestMismatch(Problem):
    """422 ``digest-mismatch``: The body does not match its digest."""


class EmptyImage(Problem):
    """422 ``empty-image``: The frame is empty."""


class ImageTooSmall(Problem):
    """422 ``image-too-small``: The image is smaller than 16 pixels on one side."""


class ImplausiblePose(Problem):
    """422 ``implausible-pose``: No vehicle can have been at the pose."""


class InvalidArchive(Problem):
    """422 ``invalid-archive``: The file is not a valid export of a map."""


class InvalidCursor(Problem):
    """422 ``invalid-cursor``: The cursor does not belong to this list."""


class InvalidField(Problem):
    """422 ``invalid-field``: A field is not valid."""


class InvalidGroundTruth(Problem):
    """422 ``invalid-ground-truth``: The ground truth cannot be used."""


class InvalidIdentifier(Problem):
    """422 ``invalid-identifier``: The id is not valid."""


class InvalidImage(Problem):
    """422 ``invalid-image``: The frame cannot be used."""


class InvalidRecording(Problem):
    """422 ``invalid-recording``: The recording cannot be used."""


class InvalidRequest(Problem):
    """422 ``invalid-request``: The request is not valid."""


class InvalidResults(Problem):
    """422 ``invalid-results``: The results cannot be used."""


class InvalidTrajectory(Problem):
    """422 ``invalid-trajectory``: The trajectory cannot be used."""


class InvalidTraverse(Problem):
    """422 ``invalid-traverse``: The directory is not a traverse."""


class NoRegions(Problem):
    """422 ``no-regions``: The frame has no region of interest."""


class NotAnImage(Problem):
    """422 ``not-an-image``: The frame is not an image."""


class NothingEnrolled(Problem):
    """422 ``nothing-enrolled``: No frame became a place."""


class NothingToMeasure(Problem):
    """422 ``nothing-to-measure``: The map has no frames to measure the recall with."""


class PlanTooLarge(Problem):
    """422 ``plan-too-large``: The plan would list too many places."""


class TooFewFrames(Problem):
    """422 ``too-few-frames``: The sequence is too short to be aligned."""


class TooManyPairs(Problem):
    """422 ``too-many-pairs``: The traverses have too many frames to be compared."""


class TooManyToDelete(Problem):
    """422 ``too-many-to-delete``: Too many places would be deleted at once."""


class TruncatedImage(Problem):
    """422 ``truncated-image``: The image is cut short."""


class UnfitIntrinsics(Problem):
    """422 ``unfit-intrinsics``: The camera's intrinsics do not fit the frame."""


class UnknownEncoder(Problem):
    """422 ``unknown-encoder``: The encoder is not installed."""


class RateExceeded(Problem):
    """429 ``rate-exceeded``: Too many requests a second."""


class TooManySessions(Problem):
    """429 ``too-many-sessions``: Too many sessions are open."""


class HeadTooLarge(Problem):
    """431 ``head-too-large``: The headers are too many or too long."""


class ClientGone(Problem):
    """499 ``client-gone``: The client closed the connection."""


class InternalError(Problem):
    """500 ``internal-error``: The service failed."""


class InvalidKeypoints(Problem):
    """500 ``invalid-keypoints``: Keypoints of a place are damaged."""


class StorageFailure(Problem):
    """500 ``storage-failure``: The disk failed."""


class UnknownTransferCoding(Problem):
    """501 ``unknown-transfer-coding``: The transfer coding is not known."""


class BackupIncomplete(Problem):
    """503 ``backup-incomplete``: Some maps could not be saved."""


class DataDirectoryLocked(Problem):
    """503 ``data-directory-locked``: Another process uses the data directory."""


class DataDirectoryTooNew(Problem):
    """503 ``data-directory-too-new``: The data was written by a later version."""


class DataDirectoryTooOld(Problem):
    """503 ``data-directory-too-old``: The data was written by an earlier version."""


class DeadlineExceededByService(Problem, errors.DeadlineExceeded):
    """503 ``deadline-exceeded``: The time of the request is up."""


class EncoderNotInstalled(Problem):
    """503 ``encoder-not-installed``: The encoder of the map is not installed."""


class GoldenMismatch(Problem):
    """503 ``golden-mismatch``: The encoder does not reproduce its golden values."""


class InvalidModel(Problem):
    """503 ``invalid-model``: A model cannot be used."""


class JobLost(Problem):
    """503 ``job-lost``: The service stopped before the job ended."""


class JobQueueFull(Problem):
    """503 ``job-queue-full``: Too many jobs are waiting."""


class KeysUnreadable(Problem):
    """503 ``keys-unreadable``: The keys cannot be read."""


class MapBusy(Problem):
    """503 ``map-busy``: What is to be erased is still being read."""


class MapQuarantined(Problem):
    """503 ``map-quarantined``: The map is damaged and out of service."""


class MemoryFull(Problem):
    """503 ``memory-full``: Too many uploads are under way."""


class MissingExtra(Problem):
    """503 ``missing-extra``: A package is not installed."""


class MissingWeights(Problem):
    """503 ``missing-weights``: A model has no weights."""


class NotReady(Problem):
    """503 ``not-ready``: The service is not ready."""


class QueueFull(Problem):
    """503 ``queue-full``: Too many requests are waiting."""


class StagingFull(Problem):
    """503 ``staging-full``: Too many frames are waiting to be enrolled."""


class Stopping(Problem):
    """503 ``stopping``: The service is stopping."""


class StoreOfAnotherVersion(Problem):
    """503 ``store-of-another-version``: The maps were stored by another version."""


class StoreUnavailable(Problem):
    """503 ``store-unavailable``: The maps cannot be reached."""


class TooManyConnections(Problem):
    """503 ``too-many-connections``: Too many connections are open."""


class TooManyExports(Problem):
    """503 ``too-many-exports``: Too many maps are being exported."""


class TooManyImports(Problem):
    """503 ``too-many-imports``: Too many maps are being imported."""


class TooManyListeners(Problem):
    """503 ``too-many-listeners``: Too many clients listen to events."""


class TooManyOpenFiles(Problem):
    """503 ``too-many-open-files``: Too many files are open."""


class TooManyWatchers(Problem):
    """503 ``too-many-watchers``: Too many clients follow jobs."""


class WrongVocabulary(Problem):
    """503 ``wrong-vocabulary``: The vocabulary was trained for another network."""


class StorageFull(Problem):
    """507 ``storage-full``: The disk is full."""


BY_SLUG: dict[str, type[Problem]] = {
    "bad-request": BadRequest,
    "malformed-body": MalformedBody,
    "malformed-head": MalformedHead,
    "key-needed": KeyNeeded,
    "key-refused": KeyRefused,
    "first-key-local": FirstKeyLocal,
    "foreign-page": ForeignPage,
    "map-forbidden": MapForbidden,
    "role-too-low": RoleTooLow,
    "session-of-another": SessionOfAnother,
    "no-thumbnail": NoThumbnail,
    "not-localized": NotLocalized,
    "unknown-camera": UnknownCamera,
    "unknown-explanation": UnknownExplanation,
    "unknown-frame": UnknownFrame,
    "unknown-job": UnknownJob,
    "unknown-key": UnknownKey,
    "unknown-look": UnknownLook,
    "unknown-map": UnknownMap,
    "unknown-path": UnknownPath,
    "unknown-place": UnknownPlace,
    "unknown-recording": UnknownRecording,
    "unknown-sequence": UnknownSequence,
    "unknown-session": UnknownSession,
    "unknown-stretch": UnknownStretch,
    "unknown-topic": UnknownTopic,
    "method-not-allowed": MethodNotAllowed,
    "no-geopose": NoGeopose,
    "head-too-slow": HeadTooSlow,
    "backup-folder-missing": BackupFolderMissing,
    "batch-out-of-order": BatchOutOfOrder,
    "calibration-worse": CalibrationWorse,
    "frame-needed": FrameNeeded,
    "frame-out-of-order": FrameOutOfOrder,
    "images-missing": ImagesMissing,
    "job-ended": JobEnded,
    "key-ended": KeyEnded,
    "key-exists": KeyExists,
    "key-widened": KeyWidened,
    "last-admin-key": LastAdminKey,
    "look-name-taken": LookNameTaken,
    "map-exists": MapExists,
    "merge-conflict": MergeConflict,
    "mixed-coordinates": MixedCoordinates,
    "place-taken": PlaceTaken,
    "places-taken": PlacesTaken,
    "recording-in-use": RecordingInUse,
    "recording-offset": RecordingOffset,
    "repeated-look": RepeatedLook,
    "stream-taken": StreamTaken,
    "too-many-keys": TooManyKeys,
    "too-many-looks": TooManyLooks,
    "too-many-maps": TooManyMaps,
    "too-many-places": TooManyPlaces,
    "wrong-encoder": WrongEncoder,
    "session-expired": SessionExpired,
    "export-gone": ExportGone,
    "revision-mismatch": RevisionMismatch,
    "body-too-large": BodyTooLarge,
    "image-too-large": ImageTooLarge,
    "too-many-pixels": TooManyPixels,
    "url-too-long": UrlTooLong,
    "unsupported-format": UnsupportedFormat,
    "unsupported-media-type": UnsupportedMediaType,
    "range-not-satisfiable": RangeNotSatisfiable,
    "archive-too-new": ArchiveTooNew,
    "calibration-impossible": CalibrationImpossible,
    "digest-mismatch": DigestMismatch,
    "empty-image": EmptyImage,
    "image-too-small": ImageTooSmall,
    "implausible-pose": ImplausiblePose,
    "invalid-archive": InvalidArchive,
    "invalid-cursor": InvalidCursor,
    "invalid-field": InvalidField,
    "invalid-ground-truth": InvalidGroundTruth,
    "invalid-identifier": InvalidIdentifier,
    "invalid-image": InvalidImage,
    "invalid-recording": InvalidRecording,
    "invalid-request": InvalidRequest,
    "invalid-results": InvalidResults,
    "invalid-trajectory": InvalidTrajectory,
    "invalid-traverse": InvalidTraverse,
    "no-regions": NoRegions,
    "not-an-image": NotAnImage,
    "nothing-enrolled": NothingEnrolled,
    "nothing-to-measure": NothingToMeasure,
    "plan-too-large": PlanTooLarge,
    "too-few-frames": TooFewFrames,
    "too-many-pairs": TooManyPairs,
    "too-many-to-delete": TooManyToDelete,
    "truncated-image": TruncatedImage,
    "unfit-intrinsics": UnfitIntrinsics,
    "unknown-encoder": UnknownEncoder,
    "rate-exceeded": RateExceeded,
    "too-many-sessions": TooManySessions,
    "head-too-large": HeadTooLarge,
    "client-gone": ClientGone,
    "internal-error": InternalError,
    "invalid-keypoints": InvalidKeypoints,
    "storage-failure": StorageFailure,
    "unknown-transfer-coding": UnknownTransferCoding,
    "backup-incomplete": BackupIncomplete,
    "data-directory-locked": DataDirectoryLocked,
    "data-directory-too-new": DataDirectoryTooNew,
    "data-directory-too-old": DataDirectoryTooOld,
    "deadline-exceeded": DeadlineExceededByService,
    "encoder-not-installed": EncoderNotInstalled,
    "golden-mismatch": GoldenMismatch,
    "invalid-model": InvalidModel,
    "job-lost": JobLost,
    "job-queue-full": JobQueueFull,
    "keys-unreadable": KeysUnreadable,
    "map-busy": MapBusy,
    "map-quarantined": MapQuarantined,
    "memory-full": MemoryFull,
    "missing-extra": MissingExtra,
    "missing-weights": MissingWeights,
    "not-ready": NotReady,
    "queue-full": QueueFull,
    "staging-full": StagingFull,
    "stopping": Stopping,
    "store-of-another-version": StoreOfAnotherVersion,
    "store-unavailable": StoreUnavailable,
    "too-many-connections": TooManyConnections,
    "too-many-exports": TooManyExports,
    "too-many-imports": TooManyImports,
    "too-many-listeners": TooManyListeners,
    "too-many-open-files": TooManyOpenFiles,
    "too-many-watchers": TooManyWatchers,
    "wrong-vocabulary": WrongVocabulary,
    "storage-full": StorageFull,
}
"""The exception of each kind."""
