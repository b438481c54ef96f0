"""Bags that are uploaded, and enrolled by a job."""
