"""The files of a map besides its database: descriptors and index files, checked when they are read."""
