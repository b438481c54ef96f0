"""Where a moving robot is: a belief over the places of a map, carried from frame to frame (thesis 2.1, 2.2.6).

``graph`` knows which places follow one another, ``evidence`` what one frame's scores say, ``view`` whether the frame
shows anything new, ``motion`` how far a robot gets, ``odometry`` how far it got between two poses of odometry, and
``consistency`` whether that agrees with what frames show.
``filter`` is the hidden Markov model, ``estimate`` summarizes a belief, ``run`` puts these together and ``record``
serializes a run.
"""

from core.belief.consistency import Contradiction, ContradictionKind, OdometryCheck
from core.belief.estimate import Candidate, Estimate, agreement
from core.belief.evidence import NOTHING, Evidence, Sighting, evidence, evidence_of, sighted
from core.belief.graph import PlaceGraph, place_graph
from core.belief.motion import Odometry, Step, Stride
from core.belief.odometry import OdometryPose, motion_between
from core.belief.record import DamagedRecord, from_bytes, to_bytes
from core.belief.run import Run, RunOptions, RunState, Sight, freshness
from core.belief.view import View, view_of

__all__ = [
    "NOTHING",
    "Candidate",
    "Contradiction",
    "ContradictionKind",
    "DamagedRecord",
    "Estimate",
    "Evidence",
    "Odometry",
    "OdometryCheck",
    "OdometryPose",
    "PlaceGraph",
    "Run",
    "RunOptions",
    "RunState",
    "Sight",
    "Sighting",
    "Step",
    "Stride",
    "View",
    "agreement",
    "evidence",
    "evidence_of",
    "freshness",
    "from_bytes",
    "motion_between",
    "place_graph",
    "sighted",
    "to_bytes",
    "view_of",
]
