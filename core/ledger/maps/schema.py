"""The tables of maps."""

from __future__ import annotations

from typing import Any

from sqlalchemy import CheckConstraint, Column, ForeignKeyConstraint, Index, MetaData, PrimaryKeyConstraint, Table
from sqlalchemy import UniqueConstraint as Unique
from sqlalchemy.schema import SchemaItem

from core.ledger.statements import DialectName, binary, integer, real, text

METADATA = MetaData()

LEVELS: dict[DialectName, list[str]] = {
    "sqlite": [
        f"ALTER TABLE places ADD COLUMN {one}"
        for one in ("level TEXT", "accuracy_metres REAL", "accuracy_degrees REAL")
    ]
}
"""The statements that bring the file of a map of 1.0 up to date."""


def _column(name: str, kind: Any, optional: bool = False, **more: Any) -> Column[Any]:
    return Column(name, kind, nullable=optional, **more)


def _table(name: str, key: tuple[str, ...], *items: SchemaItem, clustered: bool = False) -> Table:
    """A table of maps.

    Args:
        key: the columns that identify a row within its map.
        clustered: whether SQLite stores the rows in the index of the key; not for long rows.
    """
    of_map = ForeignKeyConstraint(["map"], ["maps.number"], ondelete="CASCADE")
    return Table(
        name, METADATA, _column("map", integer()), *items, PrimaryKeyConstraint("map", *key),
        of_map.ddl_if(dialect="postgresql"), sqlite_strict=True, sqlite_with_rowid=not clustered,
    )  # fmt: skip


MAPS = Table(
    "maps",
    METADATA,
    _column("number", integer(), primary_key=True),
    _column("id", text(), unique=True),
    _column("record", text()),  # MapRecord as JSON
    _column("listed", integer(), server_default="1"),  # 0: it is being built
    _column("touched", real(), server_default="0"),  # the moment of the last write, seconds since 1970
    _column("places", integer(), server_default="0"),  # how many there are
    _column("looks", integer(), server_default="0"),  # how many they have besides their first ones
    _column("numbers", integer(), server_default="1"),  # the number of the next place
    _column("rows", integer(), server_default="0"),  # the number of the next row
    _column("codes", integer(), server_default="0"),  # the code of the next sequence or lost track
    _column("revision", integer(), server_default="0"),  # grows with every write
    _column("stamp", text(), server_default=""),  # drawn at random by the write that made this revision
    _column("collection", integer(), server_default="0"),  # Milvus's id of the collection that has its descriptors
    _column("seal", integer()),
    sqlite_strict=True,
)

# The code of the places without a sequence is NO_SEQUENCE, and their sequence has no name.
SEQUENCES = _table(
    "sequences", ("code",), _column("code", integer()), _column("name", text(), optional=True),
    _column("next_ordinal", integer(), server_default="0"), Unique("map", "name"), clustered=True,
)  # fmt: skip

# Track and station are the sequence and the ordinal at which another traverse shows what this place shows
# (:class:`core.places.Whereabouts`); NULL: those of the place itself.  That sequence may be gone, whose code is never
# used again.  pose_of is the id of the place whose pose the place got with its station; NULL: the pose is its own.
#
# A look is a row of its own that has what its place has, so that whatever searches, reads and checks rows need not know
# of looks.  look_of is the number of its place, its id is its address (:func:`core.places.look_address`), and frame,
# camera and picture are its own.  looks is how many a place has; seen is when a look's frame was taken, and run the run
# from which it, or a place of new ground, was learnt; least is the score of two stages from which a match with it is
# believed, NULL: from any.  right, wrong and passed are how it served since (:class:`core.learning.LookStatistics`).
PLACES = _table(
    "places", ("number",),
    _column("number", integer()),  # grows in the order of enrolment
    _column("id", text()),
    _column("row", integer()),  # of its frame: descriptors, picture and keypoints
    _column("checksum", integer()),  # of its descriptors; 0: where they are has its own
    _column("digest", binary()),
    _column("regions", integer()),
    _column("picture", text()),
    *(_column(name, real(), optional=True) for name in ("x", "y", "z", "latitude", "longitude", "heading")),
    _column("timestamp", text(), optional=True),
    _column("sequence", integer()),
    _column("ordinal", integer()),
    _column("camera", text(), optional=True),
    _column("track", integer(), optional=True),
    _column("station", integer(), optional=True),
    _column("pose_of", text(), optional=True),
    _column("metadata", text()),
    _column("look_of", integer(), optional=True),
    _column("looks", integer()),
    _column("seen", text(), optional=True),
    _column("run", text(), optional=True),
    _column("least", real(), optional=True),
    *(_column(name, integer()) for name in ("right", "wrong", "passed")),
    _column("created_at", text()),
    _column("updated_at", text()),
    _column("key", integer(), optional=True),  # of its entity in Milvus
    _column("revision", integer()),  # of the map's write that changed it last
    _column("seal", integer()),
    # Behind all that tables of 1.0 have, so that the checksums of its rows hold.
    _column("level", text(), optional=True),
    *(_column(name, real(), optional=True) for name in ("accuracy_metres", "accuracy_degrees")),
    Unique("map", "id"), Unique("map", "row"), CheckConstraint("length(digest) = 32"),
    CheckConstraint("picture IN ('none', 'thumbnail', 'image')"), CheckConstraint("row >= 0"),
    clustered=True,
)  # fmt: skip
Index("places_of_sequence", PLACES.c.map, PLACES.c.sequence, PLACES.c.number)
# With the number, and made after the index above by its name: a PostgreSQL without statistics takes the later of two
# indexes that seem as good to it, and the other one would have it walk through a whole sequence.
Index("places_on_position", PLACES.c.map, PLACES.c.sequence, PLACES.c.ordinal, PLACES.c.number)
Index(
    "looks_of_places", PLACES.c.map, PLACES.c.look_of,
    sqlite_where=PLACES.c.look_of.is_not(None), postgresql_where=PLACES.c.look_of.is_not(None),
)  # fmt: skip
Index("places_by_revision", PLACES.c.map, PLACES.c.revision).ddl_if(dialect="postgresql")
Index("places_by_key", PLACES.c.key, unique=True, sqlite_where=PLACES.c.key.is_not(None))

# The index by which places are found by their metadata (:func:`core.ledger.maps.places.tokens_of`).
TOKENS = _table(
    "tokens", ("token", "row"), _column("token", text()), _column("row", integer()), clustered=True
)  # fmt: skip

# Apart from the places, so that a listing need not read them.
PICTURES = _table(
    "pictures", ("row",), _column("row", integer()), _column("digest", binary()), _column("size", integer()),
    _column("bytes", binary()),
)  # fmt: skip

# The checksum covers the digest of the frame, too.
KEYPOINTS = _table(
    "keypoints", ("row",), _column("row", integer()), _column("checksum", integer()), _column("record", binary())
)  # fmt: skip

CAMERAS = _table(
    "cameras", ("name",), _column("name", text()), _column("mask", text(), optional=True),
    _column("intrinsics", text(), optional=True), _column("updated_at", text()), _column("seal", integer()),
    clustered=True,
)  # fmt: skip
