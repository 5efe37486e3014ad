"""One run, and when two runs are the same to the bit."""

import numpy as np

PHOTONS = 300_000
RUN = {"photons": PHOTONS, "seed": 5}


def same(a, b):
    assert a.tallies.tobytes() == b.tallies.tobytes()
    assert a.energy_balance == b.energy_balance and a.counters == b.counters
    assert tuple(a.photon_ranges) == tuple(b.photon_ranges) and a.requested == b.requested and a.partial == b.partial
    assert (a.batches, a.half_photons, a.batch_moments) == (b.batches, b.half_photons, b.batch_moments)
    np.testing.assert_array_equal(a.half, b.half)
    np.testing.assert_array_equal(a.second_moment, b.second_moment)
