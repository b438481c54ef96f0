"""Recordings of a camera: bags, videos and folders of pictures, their frames in order, poses and keyframes."""

from core.recordings.frame import RecordedFrame
from core.recordings.recording import Poses, Recording, open_recording

__all__ = ["Poses", "RecordedFrame", "Recording", "open_recording"]
