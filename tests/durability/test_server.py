"""A little of what ``scripts/soak server`` does for hours: the whole service killed while several clients use it."""

from __future__ import annotations

from pathlib import Path

from tests.durability.lives import Lives
from tests.durability.server_kills import ServerKills
from tests.durability.servers import Servers


def test_killed_while_clients_use_it_it_has_lost_nothing(tmp_path: Path) -> None:
    campaign = ServerKills(tmp_path, 1)
    with Lives(tmp_path) as lives, Servers(tmp_path) as servers:
        tally = campaign.run(lives, servers, 2)
    assert tally.kills == 2
    assert tally.operations >= 10
