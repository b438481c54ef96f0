"""The tables of maps."""

from __future__ import annotations

from typing import Any

from sqlalchemy import CheckConstraint, Column, ForeignKeyConstraint, Index, MetaData, PrimaryKeyConstraint, Table
from sqlalchemy import UniqueConstraint as Unique
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.schema import SchemaItem
from sqlalchemy.sql.compiler import DDLCompiler

from core.ledger.statements import binary, integer, real, text
from core.ledger.tables import Tables

METADATA = MetaData()

APPLICATION_ID = 0x504C5243
"""``PLRC``: names the file of a map."""


class OfRow(PrimaryKeyConstraint):
    """The key of a table with long values by row; in SQLite, whose files have one map, the row alone is the key."""


@compiles(OfRow, "sqlite")
def _of_row_in_sqlite(element: OfRow, compiler: DDLCompiler, **_: Any) -> str:
    return "PRIMARY KEY (row)"


def _column(name: str, kind: Any, optional: bool = False, **more: Any) -> Column[Any]:
    return Column(name, kind, nullable=optional, **more)


def _table(name: str, key: tuple[str, ...], *items: SchemaItem, clustered: bool = False) -> Table:
    """A table of maps.

    Args:
        key: the columns that identify a row within its map.
        clustered: whether SQLite stores the rows in the index of the key; not for long rows.
    """
    of_map = ForeignKeyConstraint(["map"], ["maps.number"], ondelete="CASCADE")
    primary = OfRow("map", "row") if key == ("row",) else PrimaryKeyConstraint("map", *key)
    return Table(
        name, METADATA, _column("map", integer()), *items, primary,
        of_map.ddl_if(dialect="postgresql"), sqlite_strict=True, sqlite_with_rowid=not clustered,
    )  # fmt: skip


def _by_row(name: str) -> Table:
    """A table of long values by row, each followed by its checksum (:mod:`core.ledger.maps.rows`)."""
    return _table(name, ("row",), _column("row", integer()), _column("bytes", binary()))


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
    _column("recall", text(), optional=True),  # core.maps.status.Recall as JSON, as it was last measured
    _column("seal", integer()),
    sqlite_strict=True,
)

# The code of the places without a sequence is NO_SEQUENCE, and their sequence has no name.  The negative of the next
# ordinal is there as its checksum, which a statement can compute.
SEQUENCES = _table(
    "sequences", ("code",), _column("code", integer()), _column("name", text(), optional=True),
    _column("next_ordinal", integer(), server_default="0"), _column("negative", integer(), server_default="0"),
    Unique("map", "name"), CheckConstraint("next_ordinal + negative = 0"), clustered=True,
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
    _column("revision", integer()),  # of the map's write that changed it last
    _column("level", text(), optional=True),
    *(_column(name, real(), optional=True) for name in ("accuracy_metres", "accuracy_degrees")),
    _column("seal", integer()),
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
Index("places_by_revision", PLACES.c.map, PLACES.c.revision)

# The index by which places are found by their metadata (:func:`core.ledger.maps.places.tokens_of`).
TOKENS = _table(
    "tokens", ("token", "row"), _column("token", text()), _column("row", integer()), clustered=True
)  # fmt: skip

# Of each frame, by row: its descriptor and its local descriptors in the map's precision, and the code by which it is
# found (:mod:`core.index`).  Each has a table of its own, since what lies behind a long value takes long to reach.
DESCRIPTORS, LOCALS, CODES = (_by_row(name) for name in ("descriptors", "locals", "codes"))

# Apart from the places, so that a listing need not read them.
PICTURES = _table(
    "pictures", ("row",), _column("row", integer()), _column("digest", binary()), _column("size", integer()),
    _column("bytes", binary()),
)  # fmt: skip

# The checksum covers the digest of the frame, too.
KEYPOINTS = _table(
    "keypoints", ("row",), _column("row", integer()), _column("checksum", integer()), _column("record", binary())
)  # fmt: skip

# Rows that no place has any more, and the revision of the map since which that is so.  What is stored of them is
# deleted a while later, for a query may still need it; then ``cleared`` is 1, and 2 when nothing is left on the disk.
DEAD_ROWS = _table(
    "dead_rows", ("number",), _column("number", integer()), _column("revision", integer()), _column("since", real()),
    _column("cleared", integer(), server_default="0"), clustered=True,
)  # fmt: skip
Index("dead_rows_in_order", DEAD_ROWS.c.map, DEAD_ROWS.c.cleared, DEAD_ROWS.c.since)
Index("dead_rows_by_revision", DEAD_ROWS.c.map, DEAD_ROWS.c.revision)

# The stamps of a map's last revisions.
REVISIONS = _table(
    "revisions", ("revision",), _column("revision", integer()), _column("stamp", text()), _column("since", real()),
    clustered=True,
)  # fmt: skip

CAMERAS = _table(
    "cameras", ("name",), _column("name", text()), _column("mask", text(), optional=True),
    _column("intrinsics", text(), optional=True), _column("updated_at", text()), _column("seal", integer()),
    clustered=True,
)  # fmt: skip

# Frames that are stored for review, and their pictures apart, so that a listing need not read them; and the number of
# the next frame, so that none is used twice.
REVIEW_FRAMES = _table(
    "review_frames", ("number",), _column("number", integer()), _column("at", text()), _column("digest", binary()),
    _column("size", integer()), _column("answer", text()), _column("label", text(), optional=True),
    _column("seal", integer()), Unique("map", "digest"), CheckConstraint("length(digest) = 32"),
)  # fmt: skip
REVIEW_PICTURES = _table("review_pictures", ("number",), _column("number", integer()), _column("bytes", binary()))
REVIEW_NUMBERS = _table("review_numbers", (), _column("next", integer()))

ERASED_TABLES = (
    "places", "tokens", "descriptors", "locals", "codes", "keypoints", "pictures", "review_frames", "review_pictures",
)  # fmt: skip
"""The tables with what a frame shows, which PostgreSQL vacuums when deleted places are erased."""

# A file has one map.  Without statistics SQLite takes it that few rows of a table are of the same map, and reads all
# places where it should look up one.  These are of any map; the rows of an index are followed by how many of them have
# the same first column, the same first two, and so on.
_STATISTICS = {
    ("places", "places"): "1000000 1000000 1",
    ("places", "sqlite_autoindex_places_2"): "1000000 1000000 1",  # by id
    ("places", "sqlite_autoindex_places_3"): "1000000 1000000 1",  # by row
    ("places", "places_of_sequence"): "1000000 1000000 5000 1",
    ("places", "places_on_position"): "1000000 1000000 5000 2 1",
    ("places", "places_by_revision"): "1000000 1000000 64 1",
    ("places", "looks_of_places"): "1000000 1000000 3",
    ("sequences", "sequences"): "200 200 1",
    ("sequences", "sqlite_autoindex_sequences_2"): "200 200 1",  # by name
    ("tokens", "tokens"): "2000000 2000000 1000 1",
    ("review_frames", "sqlite_autoindex_review_frames_1"): "500 500 1",  # by number
    ("review_frames", "sqlite_autoindex_review_frames_2"): "500 500 1",  # by digest
}
_MORE = [
    "ANALYZE sqlite_schema",  # makes the table of statistics
    *(
        f"INSERT INTO sqlite_stat1 (tbl, idx, stat) VALUES ('{table}', '{index}', '{numbers}')"
        for (table, index), numbers in _STATISTICS.items()
    ),
]
# Compressing long values would only take time.
_UNCOMPRESSED = [
    f"ALTER TABLE {table} ALTER COLUMN bytes SET STORAGE EXTERNAL" for table in ("descriptors", "locals", "codes")
]

TABLES = Tables("maps", 14, METADATA, APPLICATION_ID, more={"sqlite": _MORE, "postgresql": _UNCOMPRESSED})
"""The tables of maps: of one in an SQLite file, of all in PostgreSQL."""
