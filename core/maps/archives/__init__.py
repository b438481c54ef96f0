"""The file of a map, whatever stores it: its content, writing it, reading and checking it.

manifest, tar_layout, lines     what the file holds, and where each part lies in it
writing                         writing it from what a store has
reading                         reading and checking it
"""
