"""Waiting in queues: a fleet that asks at random moments, and robots that each wait for their answer."""

from __future__ import annotations

import math

TOO_BUSY = 0.999


def waiting(arrivals: float, service: float, servers: int) -> float:
    """Mean seconds in the queue of M/M/c; infinite where more comes than is served.

    Args:
        arrivals: a second.
        service: seconds of one.

    Source: Erlang's C formula.
    """
    load = arrivals * service
    if load >= TOO_BUSY * servers:
        return math.inf
    blocked = 1.0  # Erlang's B, by its recursion over the servers
    for number in range(1, servers + 1):
        blocked = load * blocked / (number + load * blocked)
    queued = blocked / (1 - (load / servers) * (1 - blocked))
    return queued * service / (servers - load)


def servers_for(arrivals: float, service: float, most_waiting: float) -> int:
    """The fewest servers with which the mean time in the queue is at most ``most_waiting`` seconds."""
    low = max(1, math.ceil(arrivals * service))
    high = low + 1
    while waiting(arrivals, service, high) > most_waiting:
        high *= 2
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if waiting(arrivals, service, middle) <= most_waiting else (middle + 1, high)
    return low


def closed(service: float, servers: int, robots: int, thinking: float = 0.0) -> tuple[float, float]:
    """Answers a second and seconds of one, where each robot asks again ``thinking`` seconds after its answer.

    Source: exact mean value analysis of a closed network with one station of several servers (Reiser and Lavenberg,
    1980).
    """
    there = [1.0] + [0.0] * robots  # the probability of n robots at the station, with one robot fewer in the network
    rate = seconds = 0.0
    for population in range(1, robots + 1):
        seconds = sum(n * service / min(n, servers) * there[n - 1] for n in range(1, population + 1))
        rate = population / (thinking + seconds)
        now = [0.0] * (robots + 1)
        for n in range(1, population + 1):
            now[n] = rate * service / min(n, servers) * there[n - 1]
        now[0] = max(0.0, 1.0 - sum(now[1:]))
        there = now
    return rate, seconds
