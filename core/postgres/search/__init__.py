"""The engine ``postgres``: every service searches a map by FAISS in its own memory, and follows what others write.

PostgreSQL keeps descriptors, cells and keypoints beside the places, and the codes of the descriptors.  A service holds
the codes and the whereabouts of a map's places; before each query it reads the map's revision, and what has changed
since the one that it holds.  Rows that a query needs are read and kept in a bounded cache.

cache       rows that were read, up to a number of bytes
row_source  descriptors and cells by row, from the cache or from PostgreSQL
following   the snapshot of a map, brought up to date
map, store  a map and all maps
"""
