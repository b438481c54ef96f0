"""Maps that learn from their robots: further looks of places, from frames whose place a whole run knows beyond doubt.

``frames`` is a run with its odometry, ``smoothing`` the place of each frame by all others, ``anchors`` the frames
beyond doubt and the way between them, ``proposals`` what a run teaches, ``corroboration`` which of it may be taken
without a person, ``cohort`` from which score on a look is believed, ``looks`` which of them a place keeps, and
``statistics`` how they serve and when one is withdrawn.
"""

from core.learning.cohort import Cohort, cohort_of, least_score
from core.learning.corroboration import PendingProposal, corroborated
from core.learning.frames import RunFrame, Trail
from core.learning.looks import MOST_LOOKS, kept
from core.learning.proposals import Lesson, LessonOptions, Proposal, lesson_of
from core.learning.smoothing import Posterior, WeighedFrame, smoothed
from core.learning.statistics import LookStatistics, services

__all__ = [
    "MOST_LOOKS",
    "Cohort",
    "Lesson",
    "LessonOptions",
    "LookStatistics",
    "PendingProposal",
    "Posterior",
    "Proposal",
    "RunFrame",
    "Trail",
    "WeighedFrame",
    "cohort_of",
    "corroborated",
    "kept",
    "least_score",
    "lesson_of",
    "services",
    "smoothed",
]
