"""The whole path from a picture to an answer."""

from core.maps import Selection
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, enrol, locate, recognize

__all__ = ["Answer", "Query", "Question", "Selection", "enrol", "locate", "recognize"]
