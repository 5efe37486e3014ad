"""One run, and when two runs are the same to the bit."""

import numpy as np

PHOTONS = 300_000
RUN = {"photons": PHOTONS, "seed": 5}


def same(a, b):
    assert a.tallies.tobytes() == b.tallies.tobytes()
    assert a.energy_balance == b.energy_balance and a.counters == b.counters
    assert tuple(a.photon_ranges) == tuple(b.photon_ranges) and a.requested == b.requested and a.partial == b.partial
    assert (a.second_moment is None) == (b.second_moment is None)
    if a.second_moment is not None:
        np.testing.assert_array_equal(a.second_moment, b.second_moment)
