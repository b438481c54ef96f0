"""Every error that the core raises on purpose, one class each.

The core knows no HTTP: the service maps these classes to status codes and stable problem types.
The text of each error is one plain sentence for the person who reads it.
"""

from __future__ import annotations


class PlacerecError(Exception):
    """Base of all errors below."""


# Images


class InvalidImage(PlacerecError):
    """The bytes of a frame cannot be used; base of the classes that say why."""


class EmptyImage(InvalidImage):
    """There are no bytes."""


class NotAnImage(InvalidImage):
    """The bytes are not those of any image format, or the codec cannot make pixels of them."""


class UnsupportedFormat(InvalidImage):
    """An image, but not JPEG, PNG or WebP."""


class TruncatedImage(InvalidImage):
    """The bytes end before the image does."""


class ImageTooLarge(InvalidImage):
    """More bytes than the limit."""


class TooManyPixels(InvalidImage):
    """The header announces more pixels than the limit; nothing was decoded."""


class ImageTooSmall(InvalidImage):
    """A side is shorter than 16 pixels."""


class NoRegions(PlacerecError):
    """A frame has no region of interest (a blank frame), so it has no descriptor to enrol."""


# Models


class InvalidModel(PlacerecError):
    """A network definition, a weights file or a vocabulary cannot be used."""


class MissingWeights(InvalidModel):
    """A system needs a weights file that the user has not given, or that is not there."""


class WrongVocabulary(InvalidModel):
    """A vocabulary was trained for other weights, layers, regions or step than it is used with."""


class GoldenMismatch(InvalidModel):
    """The encoder does not reproduce its golden values on this machine."""


class UnknownEncoder(PlacerecError):
    """No installed encoder has this name or identity."""


class WrongEncoder(PlacerecError):
    """The encoder that was named is not the one to which the map is bound."""


# Maps and places


class InvalidIdentifier(PlacerecError):
    """A map or place id does not have the form that the service allows."""


class InvalidField(PlacerecError):
    """A pose, timestamp, sequence, metadata or map setting is malformed."""


class InvalidCursor(PlacerecError):
    """A pagination cursor was not made by this listing."""


class UnknownMap(PlacerecError):
    """There is no map of this id."""


class MapExists(PlacerecError):
    """A map of this id exists already."""


class UnknownPlace(PlacerecError):
    """The map has no place of this id."""


class UnknownSequence(PlacerecError):
    """The map has no place of this sequence."""


class UnknownCamera(PlacerecError):
    """The map has no camera of this name."""


class NoThumbnail(PlacerecError):
    """The map keeps no picture of this place."""


class RevisionMismatch(PlacerecError):
    """The map was changed since the revision that the caller names."""


class CalibrationImpossible(PlacerecError):
    """What a map was asked does not tell when to believe its answers: too little, or too hard to tell apart."""


# Storage


class StorageFull(PlacerecError):
    """The disk is full; nothing of the write was kept."""


class StorageFailure(PlacerecError):
    """The disk refused a read or a write; nothing of the write was kept."""


class MapQuarantined(PlacerecError):
    """A map is damaged and out of service; the others serve."""


class DataDirectoryLocked(PlacerecError):
    """Another process holds the data directory."""


class DataDirectoryTooNew(PlacerecError):
    """The data was written by a later version of placerec."""


# Maps as files


class InvalidArchive(PlacerecError):
    """A file is not the export of a map, is cut or damaged, or holds what no map may hold."""


class ArchiveTooNew(PlacerecError):
    """An export was written by a later version of placerec."""


# Evaluation


class InvalidTraverse(PlacerecError):
    """A directory is no traverse: it cannot be read, or holds no image."""


class InvalidGroundTruth(PlacerecError):
    """A file that says which references are true, or kept, cannot be used."""


class InvalidResults(PlacerecError):
    """A file of results, or of similarities, cannot be used."""
