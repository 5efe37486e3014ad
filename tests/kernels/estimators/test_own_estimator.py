"""An estimator from outside the package: one function, and one line in the table."""

import math

import pytest
import warp as wp

import spadwarp_kernels as sk
from spadwarp_kernels.estimators.registry import make_next_event
from spadwarp_kernels.photon.queue import Request
from spadwarp_kernels.photon.state import PhotonState, World


def make_half(spec: sk.TransportSpec) -> sk.Estimator:
    """next_event with half of the light."""
    next_event = make_next_event(spec)
    whole = next_event.request_event

    @wp.func
    def request_event(s: wp.ref[PhotonState], world: wp.ref[World]) -> Request:
        request = whole(s, world)
        request.weight *= 0.5
        return request

    return next_event._replace(request_event=request_event)


def water_model():
    """Water in front of a camera, on the CPU."""
    medium, laser, camera, gate, limits = sk.Medium(), sk.Laser(), sk.Camera(), sk.Gate(), sk.Limits()
    medium.extinction, medium.albedo, medium.anisotropy, medium.axis_threshold = 0.3, 0.8, 0.9, 1.0
    laser.axis, laser.spread = wp.vec3(0.0, 0.0, 1.0), 1.0 - math.cos(math.radians(5.0))
    camera.width, camera.height, camera.pixel_tangent = 4, 4, 0.1
    camera.aperture_radius, camera.aperture_area = 0.02, math.pi * 0.02**2
    gate.start, gate.stop, gate.bins, gate.bins_per_metre = 1.0, 21.0, 20, 1.0
    limits.max_path, limits.max_collisions = 30.0, 20
    surfaces = sk.make_surfaces(None, device="cpu")
    return sk.Model(wp.get_device("cpu"), medium, laser, camera, gate, limits, sk.Guiding(), None, surfaces, 2.0**50)


def test_an_estimator_of_ones_own(monkeypatch):
    monkeypatch.setitem(sk.ESTIMATORS, "half", make_half)
    monkeypatch.setitem(sk.ESTIMATORS, "nothing", lambda spec: sk.Estimator())
    model, totals, contributions, ledgers = water_model(), {}, {}, {}
    for name in ("next_event", "half", "nothing"):
        data = sk.make_data(model)
        spec = sk.TransportSpec(name, mesh=False)
        sk.launch_transport(spec, model, data, seed=3, first_id=0, photon_count=5000)
        totals[name] = int(data.tally.numpy().sum())
        ledgers[name], counters = sk.read_ledger(data)
        contributions[name] = counters["contributions"]
        assert sk.ESTIMATORS[name](spec).scores == (name != "nothing")
    assert totals["half"] == pytest.approx(0.5 * totals["next_event"], rel=1e-6)
    assert contributions["half"] == contributions["next_event"] > 0
    assert totals["nothing"] == contributions["nothing"] == 0
    assert ledgers["nothing"] == ledgers["half"] == ledgers["next_event"]


def test_a_name_that_is_not_in_the_table():
    with pytest.raises(ValueError, match="estimator = 'other' is not one of 'none', 'analog', 'next_event', 'guided'"):
        sk.launch_transport(
            sk.TransportSpec("other", mesh=False),
            water_model(),
            sk.make_data(water_model()),
            seed=1,
            first_id=0,
            photon_count=1,
        )
