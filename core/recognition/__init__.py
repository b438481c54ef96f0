"""The whole path from a frame to an answer, without HTTP."""
