"""Exporting a map as one portable file, and importing such a file, of which everything is checked.

manifest, tar_layout, lines     what the file holds, and where each part lies in it
exporter                        writing the file of a map, as it is at one moment
reading, building               reading and checking a file; making the folder of a new map from it
"""
