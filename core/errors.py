"""Every error that the core raises on purpose, one class each.

The core knows no HTTP: the service maps these classes to status codes and stable problem types.
The text of each error is one plain sentence for its reader.
"""

from __future__ import annotations


class PlacerecError(Exception):
    """Base of all errors below.

    public: the text for those who may not know the addresses, paths and peers of an installation; None: it names none.
    """

    public: str | None = None


# Images


class InvalidImage(PlacerecError):
    """The bytes of a frame cannot be used; the subclasses say why."""


class EmptyImage(InvalidImage):
    """There are no bytes."""


class NotAnImage(InvalidImage):
    """The bytes are of no image format, or the codec cannot decode them."""


class UnsupportedFormat(InvalidImage):
    """The bytes are an image, but not a JPEG, PNG or WebP file."""


class TruncatedImage(InvalidImage):
    """The bytes end before the image does."""


class ImageTooLarge(InvalidImage):
    """The image has more bytes than the limit."""


class TooManyPixels(InvalidImage):
    """The header announces more pixels than the limit; nothing was decoded."""


class ImageTooSmall(InvalidImage):
    """A side is shorter than 16 pixels."""


class NoRegions(PlacerecError):
    """A frame has no region of interest (a blank frame), so it has no descriptor to enrol."""


class InvalidKeypoints(PlacerecError):
    """Arrays or a stored record cannot be the keypoints of a frame."""


class UnfitIntrinsics(PlacerecError):
    """A camera's intrinsics are of frames of another shape."""


# Models


class InvalidModel(PlacerecError):
    """A network definition, a weights file or a vocabulary cannot be used."""

    public = "A model cannot be used; the log of the service says which, and why."


class MissingWeights(InvalidModel):
    """A system needs a weights file that the user has not given, or that does not exist."""


class WrongVocabulary(InvalidModel):
    """A vocabulary was trained with other weights, layers, regions or quantisation steps than it is used with."""


class GoldenMismatch(InvalidModel):
    """The encoder does not reproduce its golden values on this machine."""


class UnknownEncoder(PlacerecError):
    """No installed encoder has this name or identity."""


class WrongEncoder(PlacerecError):
    """The encoder that the caller names is not the map's encoder."""


# Maps and places


class InvalidIdentifier(PlacerecError):
    """A map or place id does not have the form that the service allows."""


class InvalidField(PlacerecError):
    """A pose, timestamp, sequence, metadata or map setting is malformed."""


class MixedCoordinates(PlacerecError):
    """A pose is in metres and the places of the map have latitudes and longitudes, or the other way round."""


class InvalidCursor(PlacerecError):
    """A pagination cursor was not made by this listing."""


class UnknownMap(PlacerecError):
    """There is no map with this id."""


class MapExists(PlacerecError):
    """A map with this id exists already."""


class UnknownPlace(PlacerecError):
    """The map has no place with this id."""


class UnknownStretch(PlacerecError):
    """No stretch of this id waits for review."""


class UnknownLook(PlacerecError):
    """The place has no look of this name."""


class RepeatedLook(PlacerecError):
    """The frame of a look is the one with which its place was enrolled."""


class LookNameTaken(PlacerecError):
    """Another frame of the place has the name of a look: the first digits of their SHA-256 are the same."""


class TooManyLooks(PlacerecError):
    """The place has as many looks as it may have."""


class TooManyToDelete(PlacerecError):
    """More places fulfil the conditions than may be forgotten at once; none was."""


class MapBusy(PlacerecError):
    """Places that are to be erased are still being read."""


class UnknownSequence(PlacerecError):
    """The map has no place in this sequence."""


class UnknownCamera(PlacerecError):
    """The map has no camera with this name."""


class UnknownFrame(PlacerecError):
    """The map keeps no such frame for review."""


class NoThumbnail(PlacerecError):
    """The map keeps no picture of this place."""


class RevisionMismatch(PlacerecError):
    """The map has changed since the revision that the caller names."""


class CalibrationImpossible(PlacerecError):
    """The queries do not suffice for a calibration: they are too few, or right answers look like wrong ones."""


class CalibrationWorse(PlacerecError):
    """A calibration would make answers worse that had no part in it, or have strangers believed."""


# Storage


class StorageFull(PlacerecError):
    """The disk is full; the write was undone."""


class StorageFailure(PlacerecError):
    """The disk refused a read or a write; a write was undone."""


class TooManyOpenFiles(StorageFailure):
    """The process or the machine has no file descriptor left; a write was undone."""


class StoreUnavailable(StorageFailure):
    """The servers that keep the maps cannot be reached now, or refuse the service; a write was undone."""


class StoreOfAnotherVersion(StorageFailure):
    """The data on the servers was made by another version of placerec, which this one does not read."""


class MapQuarantined(PlacerecError):
    """A map is damaged and out of service; other maps are not affected."""


class DataDirectoryLocked(PlacerecError):
    """Another process holds the data directory."""


class DataDirectoryTooNew(PlacerecError):
    """The data was written by a later version of placerec."""


class DataDirectoryTooOld(PlacerecError):
    """The data was written by an earlier version of placerec, in a form that is not read."""


# Runs


class FrameOutOfOrder(PlacerecError):
    """A run has already taken in this frame or a later one."""


# Maps as files


class InvalidArchive(PlacerecError):
    """A file is not the export of a map, is incomplete or damaged, or holds what no map may hold."""


class ArchiveTooNew(PlacerecError):
    """An export was written by a later version of placerec."""


# Recordings


class InvalidRecording(PlacerecError):
    """A bag, a video or a folder cannot be read, or holds no frame."""


class UnknownTopic(PlacerecError):
    """A bag has no such topic, the topic has another type, or several topics could be meant."""


class InvalidTrajectory(PlacerecError):
    """A trajectory file cannot be read, a line of it is malformed, or it does not fit the frames."""


# Evaluation


class InvalidTraverse(PlacerecError):
    """A directory is not a traverse: it cannot be read, or it holds no image."""


class InvalidGroundTruth(PlacerecError):
    """A file that lists true references, or references to keep, cannot be used."""


class MissingExtra(PlacerecError):
    """A package is not installed that comes with an extra of placerec; the text names the extra."""


class InvalidResults(PlacerecError):
    """A file of results or of similarities cannot be used."""
