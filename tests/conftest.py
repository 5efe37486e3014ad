"""Hypothesis in all tests: the same examples each time, and nothing fails because a machine is slow."""

import pytest
from hypothesis import HealthCheck, settings

import spadwarp
from helpers.runs import RUN
from helpers.scenes import scene

settings.register_profile("spadwarp", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("spadwarp")


@pytest.fixture(scope="session")
def whole():
    return {
        uncertainty: spadwarp.simulate(scene(), **RUN, device="cpu", uncertainty=uncertainty)
        for uncertainty in (False, True)
    }
