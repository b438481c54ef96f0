"""Which replica a call goes to."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

from ray.serve.request_router import PendingRequest, RequestRouter, RunningReplica


class ShortestQueueRouter(RequestRouter):
    """The replica with the fewest calls of this front gets the next one; of equal ones that with the fewest frames.

    Ray Serve's own router compares two replicas that it draws by lot.  A front makes at most two calls to a replica at
    a time, so a draw would often miss the one that has nothing to do.  Frames of other fronts decide
    between those that are equal, as far as Ray Serve knows it.

    Ray Serve sends this class to the front as a copy, with copies of what its module has; so each method imports what
    it shares with the front.
    """

    async def choose_replicas(
        self, candidate_replicas: Sequence[RunningReplica], pending_request: PendingRequest | None = None
    ) -> list[list[RunningReplica]]:
        """All replicas that Ray Serve may take, each a group of its own, the best one first."""
        from service.ray_serve.loads import LOADS

        def load(replica: RunningReplica) -> tuple[tuple[int, int], int, float]:
            known = self.replica_queue_len_cache.get(replica.replica_id)
            return LOADS.of(replica.replica_id), known or 0, random.random()

        order = sorted(self.select_available_replicas(list(candidate_replicas)) or candidate_replicas, key=load)
        if pending_request is not None and pending_request.args:
            LOADS.choose(pending_request.args[0], order[0].replica_id)
        return [[replica] for replica in order]

    def on_request_routed(self, pending_request: PendingRequest, replica_id: Any, result: Any) -> None:
        """The replica that has taken a call; another one than the best, if that had too many of other fronts."""
        from service.ray_serve.loads import LOADS

        if pending_request.args:
            LOADS.choose(pending_request.args[0], replica_id)
