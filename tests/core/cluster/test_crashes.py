"""Parts of a cluster that are killed, or stand still, under a load: nothing acknowledged is lost."""

from __future__ import annotations

from contextlib import closing

import pytest

from tests.core.cluster.kills import ClusterKills
from tests.servers.postgres import Postgres

pytestmark = [pytest.mark.postgres, pytest.mark.thorough, pytest.mark.timeout(600)]


@pytest.mark.parametrize(("part", "times"), [("postgres", 3), ("silence", 1), ("client", 3)])
def test_kills(postgres: Postgres, part: str, times: int) -> None:
    with closing(ClusterKills(postgres, part)) as campaign:
        for _ in range(times):
            print(campaign.kill(part))
