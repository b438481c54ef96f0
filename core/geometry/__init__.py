"""Geometric verification: do the keypoints of two pictures fit one rigid scene?"""
