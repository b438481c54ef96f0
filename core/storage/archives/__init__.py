"""The file of a map in a data directory (:mod:`core.maps.archives`).

stored_lines, exporter      writing the file of a map, as it is at one moment
building                    making the folder of a new map from a file, of which everything is checked
"""
