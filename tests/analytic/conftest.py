"""Runs that the tests of plans share."""

import pytest

from spadwarp.analytic import planning


@pytest.fixture(scope="module")
def shared_runs():
    """Each run of a module's plans is traced once: the same scene, photons and seed are the same run."""
    trace, traced = planning.trace, {}

    def once(scene, photons, seed, device, progress=None, earlier=()):
        key = (scene.to_toml(), photons, seed, device, len(earlier) and earlier[0].photons)
        if key not in traced:
            traced[key] = trace(scene, photons, seed, device, progress, earlier)
        return traced[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "trace", once)
        yield
