"""Kernels of transport are loaded once: the one that the launches take."""

import spadwarp_kernels as sk
from helpers.lit_box import lit_box
from spadwarp_kernels.transport import launch


def test_the_kernel_that_is_loaded_is_launched(device, monkeypatch):
    made, make = [], launch.make_transport_kernel
    monkeypatch.setattr(launch, "make_transport_kernel", lambda *choices: made.append(make(*choices)) or made[-1])
    model = sk.Model(device, mesh=None, surfaces=sk.make_surfaces(None, device=device), scale=2.0**50, **lit_box())
    spec = sk.TransportSpec("next_event", mesh=False)
    sk.load_transport_kernel(spec, device, model=model, photon_count=20)
    sk.launch_transport(spec, model, sk.make_data(model), seed=1, first_id=0, photon_count=20)
    assert len(made) == 2 and made[0] is made[1]
