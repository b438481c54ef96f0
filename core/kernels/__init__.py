"""Compiled inner loops; the rooms that call them say in plain NumPy what they compute."""
