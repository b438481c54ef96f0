"""Parts that are killed under a load: nothing acknowledged is lost, nothing is half-written, no answer is wrong."""

from __future__ import annotations

from contextlib import closing

import pytest

from tests.core.cluster.kills import ClusterKills
from tests.core.milvus.parts import MILVUS
from tests.servers.milvus import Servers

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(900)]

ROUNDS = 3


@pytest.mark.parametrize("part", MILVUS.parts)
def test_kills(servers: Servers, part: str) -> None:
    with closing(ClusterKills(MILVUS, servers, part)) as campaign:
        for _ in range(ROUNDS):
            print(campaign.kill(part))
