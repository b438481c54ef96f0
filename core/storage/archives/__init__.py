"""Exporting a map as one portable file, and importing such a file, of which everything is checked.

manifest, tar_layout, lines     what the file holds, and where each part lies in it
exporter, virtual_archive       keeping a moment of a map; the bytes of its file, from any position on
reading, building               reading and checking a file; making the folder of a new map from it
"""
