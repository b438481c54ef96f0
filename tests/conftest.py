"""What holds for all tests."""

from hypothesis import HealthCheck, settings

# No test may depend on the speed of the machine or on what else it does.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
