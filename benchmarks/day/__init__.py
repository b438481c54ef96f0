"""A robot's day on the job: ordinary situations, and the answers to a robot in each by each kind of query.

    python -m benchmarks.day                                            # every situation on corridor
    python -m benchmarks.day --situations standing,reverse --modes "session:*"
    python -m benchmarks.day --walk lip6 --json day.json

A map is enrolled from one traverse, a robot drives the other past it, and a real service answers the real client.
Beside the table there are closer looks: ``speeds`` at robots without odometry, ``standing`` at maps with stops,
and ``first_requests`` at what a robot waits for when a service has just started.
"""
