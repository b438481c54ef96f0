"""What a front knows of the calls that its replicas have."""

from __future__ import annotations

from service.ray_serve.loads import Loads


def test_a_call_counts_from_its_beginning_to_its_end() -> None:
    loads = Loads()
    first, second, third = [1, 2, 3], [4], [5, 6]
    for call in (first, second, third):
        loads.begin(call)
    assert (len(loads), loads.busy) == (3, 3)  # none has a replica yet, so each is to get its own
    loads.choose(first, "a")
    loads.choose(second, "b")
    loads.choose(third, "b")
    assert (len(loads), loads.busy) == (3, 2)
    assert (loads.of("a"), loads.of("b"), loads.of("c")) == ((1, 3), (2, 3), (0, 0))
    loads.choose(third, "a")  # the other one has refused it
    loads.end(second)
    assert (loads.of("a"), loads.of("b"), loads.busy) == ((2, 5), (0, 0), 1)
    for call in (first, third):
        loads.end(call)
    assert (len(loads), loads.busy) == (0, 0)


def test_equal_calls_are_two_and_calls_of_others_do_not_count() -> None:
    loads = Loads()
    one, other = ["frame"], ["frame"]
    loads.begin(one)
    loads.choose(other, "a")
    assert loads.of("a") == (0, 0)
    loads.begin(other)
    loads.choose(other, "a")
    loads.end(one)
    assert (len(loads), loads.of("a")) == (1, (1, 1))
