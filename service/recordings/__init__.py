"""Recordings of robots: bags that are uploaded in pieces, and the job that enrols their frames."""
