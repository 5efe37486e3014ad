"""Hypothesis in all tests: the same examples each time, and nothing fails because a machine is slow."""

from hypothesis import HealthCheck, settings

settings.register_profile("spadwarp", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("spadwarp")
