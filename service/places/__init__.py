"""Enrolment, places and traverses."""
