"""One run, when two runs are the same to the bit, and runs of many seeds."""

import threading
from typing import NamedTuple

import numpy as np

import spadwarp_kernels as sk
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.transport import resolve_derivatives
from spadwarp.transport.model import build_model, transport_spec
from spadwarp.transport.workers import DeviceWorker

PHOTONS = 200_000
RUN = {"photons": PHOTONS, "seed": 5}


def same(a, b):
    assert a.tallies.tobytes() == b.tallies.tobytes()
    assert a.energy_balance == b.energy_balance and a.counters == b.counters
    assert tuple(a.photon_ranges) == tuple(b.photon_ranges) and a.requested == b.requested and a.partial == b.partial
    assert (a.batches, a.half_photons, a.batch_moments) == (b.batches, b.half_photons, b.batch_moments)
    np.testing.assert_array_equal(a.half, b.half)
    np.testing.assert_array_equal(a.second_moment, b.second_moment)


class Run(NamedTuple):
    """Of one seed: fractions of emitted photons `[3, H, W, T]`, and derivatives or channels `[P, 3, H, W, T]`."""

    light: np.ndarray
    signed: np.ndarray | None
    energy_balance: dict
    counters: dict


def of_seeds(one, device, photons, seeds, derivatives=(), blocks=None):
    """A run for each of the seeds, as `simulate` has it, without batches and all else that it does around the photons,
    which takes ten times as long as so few. No light is lost from the ledger or clipped."""
    target, mesh, names = pick_device(device), build_mesh(one), resolve_derivatives(one, derivatives, blocks)
    model = build_model(one, target, mesh, derivatives=names)
    spec, signed = transport_spec(one, mesh, derivatives=names), names or one.tallied_channels
    for seed in seeds:
        worker = DeviceWorker(model, spec, seed=seed, launch_size=1 << 20, signed=signed)
        worker.trace((0, photons), stopped=threading.Event())
        found = worker.tallies()
        assert sum(found.energy_balance.values()) * sk.LEDGER_UNIT == photons
        assert found.counters["invalid"] == 0 and found.counters["clipped"] == 0
        values = found.signed_tallies
        if values is not None:
            units = np.array(values.units).reshape(-1, 1, 1, 1, 1)
            values = values.tallies * (units / photons)
        yield Run(found.tallies * (1.0 / model.scale / photons), values, found.energy_balance, found.counters)
