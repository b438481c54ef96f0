"""Histories of the places of a map: frames are judged by them, and they tell what has changed."""
