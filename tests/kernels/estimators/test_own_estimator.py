"""An estimator from outside the package: one function, and one line in the table."""

import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.lit_box import lit_box
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


@pytest.mark.slow
def test_an_estimator_of_ones_own(monkeypatch):
    monkeypatch.setitem(sk.ESTIMATORS, "half", make_half)
    monkeypatch.setitem(sk.ESTIMATORS, "nothing", lambda spec: sk.Estimator())
    structs = lit_box()
    structs["gate"].start, structs["gate"].stop, structs["gate"].bins_per_metre = 1.0, 21.0, 0.4
    model = sk.Model("cpu", mesh=None, surfaces=sk.make_surfaces(None, device="cpu"), scale=2.0**50, **structs)
    totals, contributions, ledgers = {}, {}, {}
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
