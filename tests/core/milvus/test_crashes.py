"""Parts that are killed under a load: nothing acknowledged is lost, nothing is half-written, no answer is wrong."""

from __future__ import annotations

import pytest

from tests.core.cluster.kills import ClusterKills
from tests.core.milvus.parts import MILVUS
from tests.servers.milvus import Servers

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(900)]

ROUNDS = 3


@pytest.mark.parametrize("part", MILVUS.parts)
def test_kills(servers: Servers, part: str) -> None:
    campaign = ClusterKills(MILVUS, servers, part)
    try:
        for _ in range(ROUNDS):
            campaign.kill(part)
    finally:
        campaign.close()
    print(campaign.tally)
