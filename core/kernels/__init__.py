"""Compiled inner loops, and nothing else: what each computes is said by the room that calls it."""
