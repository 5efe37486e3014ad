"""Light that scatters close to a wide lens: all of it arrives, in closed form and against a plain count of photons."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.estimators import cells
from helpers.scenes import scene
from reference.aperture import Rig, count
from reference.walk import Medium
from spadwarp.scene import Scene
from spadwarp.validate.cases import vessel_reading, white_vessel

pytestmark = pytest.mark.physics


@pytest.mark.slow
@pytest.mark.parametrize(("estimator", "photons"), [("analog", 40_000), ("next_event", 50_000), ("guided", 60_000)])
def test_a_closed_white_vessel_is_as_bright_as_its_volume_says(estimator, photons, device):
    """Imaging through the lens centre, with the lens point on a disc, loses 29 % of this light."""
    one = Scene.from_dict(white_vessel(estimator))
    read = [spadwarp.simulate(one, photons=photons, seed=seed, device=device).histogram.sum() for seed in range(16)]
    error = np.std(read, ddof=1) / math.sqrt(16)
    assert error < 0.02 * np.mean(read)
    assert np.mean(read) == pytest.approx(vessel_reading(), abs=3 * error)


@pytest.mark.slow
def test_a_wide_lens_collects_what_a_plain_count_of_photons_does(device):
    """Total of each component: 0.4 m of lens before a plate at 2.2 m, in focus; water that scatters on the way."""
    exact = {"max_collisions": 1000, "weight_cutoff": 0.0}
    half = math.tan(math.radians(25.0))
    rig = Rig(
        medium=Medium(0.5, 0.8, 0.8),
        laser=(-0.1, 0.0),
        half_angle=math.radians(20.0),
        aperture_radius=0.2,
        field=(half, half),
        focus=2.2,
        plate_depth=2.2,
        plate_size=(3.0, 3.0),
        reflectance=0.7,
    )
    expected, error = count(rig, 600_000, np.arange(9.0), np.random.default_rng(1))
    expected, error = expected.sum(axis=1), np.sqrt((error**2).sum(axis=1))
    assert (error < 0.05 * expected).all()
    for estimator, photons in (("analog", 40_000), ("guided", 20_000)):
        found = cells(scene(transport={"estimator": estimator, **exact}), device, photons, seeds=8)
        parts = found.reshape(8, 3, 8).sum(axis=2)
        apart = parts.mean(axis=0) - expected
        assert (np.abs(apart) < 3.5 * np.hypot(error, parts.std(axis=0, ddof=1) / math.sqrt(8))).all(), estimator
