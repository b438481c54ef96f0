"""The tables of maps in PostgreSQL beside those of any map."""

from __future__ import annotations

from sqlalchemy import Column, Index, MetaData, PrimaryKeyConstraint, Table

from core.ledger import Tables
from core.ledger.maps import review, schema
from core.ledger.statements import binary, integer, real, text

_METADATA = MetaData()

# The descriptors of each row in the map's precision, [D] and [C, L], and the code by which services find it
# (:mod:`core.index`); NULL where an engine has no codes.
DESCRIPTORS = Table(
    "descriptors", _METADATA, Column("map", integer(), nullable=False), Column("row", integer(), nullable=False),
    Column("descriptor", binary(), nullable=False), Column("local", binary(), nullable=False), Column("code", binary()),
    PrimaryKeyConstraint("map", "row"),
)  # fmt: skip

# Rows that no place has any more, and the revision of the map since which that is so.  What is stored of them is
# deleted a while later, for a query may still need it; then ``cleared`` is 1.
DEAD_ROWS = Table(
    "dead_rows", _METADATA, Column("map", integer(), nullable=False), Column("row", integer(), nullable=False),
    Column("revision", integer(), nullable=False), Column("since", real(), nullable=False),
    Column("cleared", integer(), nullable=False, server_default="0"), PrimaryKeyConstraint("map", "row"),
)  # fmt: skip
Index("dead_rows_in_order", DEAD_ROWS.c.map, DEAD_ROWS.c.cleared, DEAD_ROWS.c.since)
Index("dead_rows_by_revision", DEAD_ROWS.c.map, DEAD_ROWS.c.revision)

# The stamps of a map's last revisions.
REVISIONS = Table(
    "revisions", _METADATA, Column("map", integer(), nullable=False), Column("revision", integer(), nullable=False),
    Column("stamp", text(), nullable=False), Column("since", real(), nullable=False),
    PrimaryKeyConstraint("map", "revision"),
)  # fmt: skip

# Keys of entities in Milvus that are no place's any more.
DEAD_KEYS = Table(
    "dead_keys", _METADATA, Column("map", integer(), nullable=False), Column("key", integer(), primary_key=True),
    Column("since", real(), nullable=False),
)  # fmt: skip
Index("dead_keys_of_map", DEAD_KEYS.c.map, DEAD_KEYS.c.since)

_OF_MAPS = [
    f"ALTER TABLE {table} ADD FOREIGN KEY (map) REFERENCES maps ON DELETE CASCADE"
    for table in (
        "descriptors",
        "dead_rows",
        "dead_keys",
        "revisions",
        "review_frames",
        "review_pictures",
        "review_numbers",
    )
]
_MORE = [
    *_OF_MAPS,
    # Compressing them would only take time.
    "ALTER TABLE descriptors ALTER COLUMN descriptor SET STORAGE EXTERNAL",
    "ALTER TABLE descriptors ALTER COLUMN local SET STORAGE EXTERNAL",
    "ALTER TABLE descriptors ALTER COLUMN code SET STORAGE EXTERNAL",
    # Keys of entities are never used twice, also if their transaction fails.
    "CREATE SEQUENCE drawn_keys",
]

ERASED_TABLES = ("places", "tokens", "pictures", "keypoints", "descriptors", "review_frames", "review_pictures")
"""The tables with what a frame shows, which are vacuumed when deleted places are erased."""

TABLES = (
    Tables("maps", 5, schema.METADATA),
    Tables("review", 1, review.METADATA),
    Tables("vectors", 2, _METADATA, more={"postgresql": _MORE}),
)
"""Of all maps."""
