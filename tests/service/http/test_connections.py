"""The register of connections: who is served, who makes room, who is refused."""

from __future__ import annotations

import pytest

from service.http.bodies import UploadMemory
from service.http.connections import MOST_SURPLUS, Connections
from service.settings import Settings
from service.telemetry.metrics import Metrics


class Caller:
    """A connection, as the register sees it."""

    gone = False

    def give_way(self) -> None:
        self.gone = True


@pytest.fixture
def connections() -> Connections:
    settings = Settings(max_connections=4, max_connections_per_address=3)
    return Connections(settings, UploadMemory(1000), Metrics())


def test_who_has_waited_longest_makes_room(connections: Connections) -> None:
    callers = [Caller() for _ in range(4)]
    for number, caller in enumerate(callers):
        assert connections.admit(caller, f"10.0.0.{number}") is None
    connections.work(callers[0])
    connections.work(callers[1])
    connections.wait(callers[1])  # has had an answer, later than the others came
    assert connections.admit(Caller(), "10.0.0.9") is None
    assert [caller.gone for caller in callers] == [False, False, True, False]
    assert connections.admit(Caller(), "10.0.0.9") is None
    assert [caller.gone for caller in callers] == [False, False, True, True]
    assert len(connections) == 4 and connections.waiting == 3


def test_where_all_are_at_work_one_more_is_refused(connections: Connections) -> None:
    for number in range(4):
        caller = Caller()
        assert connections.admit(caller, f"10.0.0.{number}") is None
        connections.work(caller)
    refused = [Caller() for _ in range(MOST_SURPLUS)]
    assert {connections.admit(caller, "10.0.0.9") for caller in refused} == {"surplus"}
    assert connections.admit(Caller(), "10.0.0.9") == "flood"
    connections.leave(refused[0])
    assert connections.admit(Caller(), "10.0.0.9") == "surplus"
    assert len(connections) == 4


def test_one_address_makes_room_for_itself_alone(connections: Connections) -> None:
    other, own = Caller(), [Caller() for _ in range(3)]
    connections.admit(other, "10.0.0.1")
    for caller in own:
        connections.admit(caller, "10.0.0.2")
        connections.work(caller)
    assert connections.admit(Caller(), "10.0.0.2") == "surplus" and not other.gone
    connections.leave(own[0])
    connections.leave(own[0])
    assert connections.admit(Caller(), "10.0.0.2") is None
    assert connections._of_address == {"10.0.0.1": 1, "10.0.0.2": 3}, "nobody is forgotten, or remembered for ever"
