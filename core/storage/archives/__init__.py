"""A whole map as one portable file: written from a moment of the map, read with nothing of it believed.

manifest → tape          what the file holds, and where in it each part lies
capture → export       a moment of a map, kept; the bytes of the file, from any position on
reading → building       a file that somebody brings, checked to the last bit; the folder of a new map
"""
