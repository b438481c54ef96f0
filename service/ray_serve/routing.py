"""Which replica a call goes to."""

from __future__ import annotations

import random
from collections.abc import Sequence

from ray.serve.request_router import PendingRequest, RequestRouter, RunningReplica


class ShortestQueueRouter(RequestRouter):
    """The replica with the fewest calls gets the next one.

    Ray Serve's own router compares two replicas that it draws by lot.  A front makes at most two calls to a replica at
    a time, so a draw would often miss the one that has nothing to do.
    """

    async def choose_replicas(
        self, candidate_replicas: Sequence[RunningReplica], pending_request: PendingRequest | None = None
    ) -> list[list[RunningReplica]]:
        """All replicas as one group: Ray Serve takes the one with the fewest calls, the first of equal ones."""
        return [random.sample(candidate_replicas, len(candidate_replicas))]
