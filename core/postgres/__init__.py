"""Maps in PostgreSQL, which any number of processes may use at the same time.

PostgreSQL has all that a map is: its record, its places, their descriptors, local descriptors, keypoints and pictures,
unless these are put into an object store.  Each write is one of its transactions, so that it happens whole or not at
all, and two processes cannot overwrite each other.  What searches the descriptors is an engine beside it
(:mod:`core.milvus`).

tables          the tables beside those of any map
rows            descriptors by row, and rows that no place has any more
objects_table   objects of pictures that no row names any more
writing, map, store
                a write, a map and all maps, less what an engine adds
review, exporter, verification, sweep
                parts of them
"""
