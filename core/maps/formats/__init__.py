"""Maps in the formats of other tools, made from an export file.

frames      the frames of an export file, with their places
mcap        an MCAP file of ROS 2 messages
colmap      a folder with a sparse model of COLMAP, as hloc and others read it
"""
