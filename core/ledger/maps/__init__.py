"""The relational part of maps: their records, places, sequences, pictures, keypoints and cameras.

The tables are those of one map in its own SQLite file, or of all maps in PostgreSQL; the number of the map is a column
of each, 1 in a file.

schema          the tables
connection      a connection to one map: it adds the map's number to every statement
checksums       of rows, which SQLite has none of
record          a map's record and counters
places          places: finding, listing and storing them
sequences       traverses, their positions and tracks
frames          pictures and keypoints, by row
columns         all places of a map as NumPy columns
writing         one write to a map; an engine of vectors adds what it has to do
map             a map: reading and writing, whatever keeps its vectors
cameras, counterparts, plan, transfer
                parts of a map
"""
