"""Maps that learn from their robots: further looks of places, from frames whose place a whole run knows beyond doubt.

``frames`` is a run with its odometry, ``smoothing`` the place of each frame by all others, ``anchors`` the frames
beyond doubt and the way between them, ``proposals`` what a run teaches, ``known_frames`` what it says of the map's
calibration, ``witnesses`` which runs are independent, ``corroboration`` what may be taken without a person, ``cohort``
from which score on a look is believed, ``looks`` which of them a place keeps, ``statistics`` how they serve and when
one is withdrawn, and ``new_ground`` where a run left the map and came back.
"""

from core.learning.cohort import Cohort, cohort_of, least_score
from core.learning.corroboration import PendingProposal, corroborated
from core.learning.frames import RunFrame, Trail
from core.learning.known_frames import PlacedFrame, placed_frames, trials_of
from core.learning.looks import MOST_LOOKS, kept
from core.learning.new_ground import GroundFrame, GroundStretch, NewGround, new_ground_of
from core.learning.proposals import Lesson, LessonOptions, Proposal, lesson_of
from core.learning.smoothing import Posterior, WeighedFrame, smoothed
from core.learning.statistics import LookStatistics, services
from core.learning.witnesses import Witness, count_witnesses

__all__ = [
    "MOST_LOOKS",
    "Cohort",
    "GroundFrame",
    "GroundStretch",
    "Lesson",
    "LessonOptions",
    "LookStatistics",
    "NewGround",
    "PendingProposal",
    "PlacedFrame",
    "Posterior",
    "Proposal",
    "RunFrame",
    "Trail",
    "WeighedFrame",
    "Witness",
    "cohort_of",
    "corroborated",
    "count_witnesses",
    "kept",
    "least_score",
    "lesson_of",
    "new_ground_of",
    "placed_frames",
    "services",
    "smoothed",
    "trials_of",
]
