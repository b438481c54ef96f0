"""The whole path from a picture to an answer."""

from core.recognition.recognition import Answer, enrol, locate, recognize
from core.recognition.selection import Selection

__all__ = ["Answer", "Selection", "enrol", "locate", "recognize"]
