"""Arrival times in seconds, from arrays of every kind."""

import numpy as np
import pytest
import warp as wp

from spadwarp.frames.depth import arrival_time

GATE = dict(gate_start=100e-9, bin_width=50e-12)
IRF = np.exp(-0.5 * ((np.arange(15) - 7) / 2.0) ** 2)


def _cube(delay=(20.25, 33.5, 41.0, np.nan), bins=64, sigma=2.0):
    from scipy.stats import norm

    edges = norm.cdf(np.arange(bins + 1), np.array(delay)[:, None], sigma)
    return 500 * np.nan_to_num(np.diff(edges, axis=1)).reshape(2, 2, bins)


@pytest.mark.parametrize("method", ["peak", "centroid", "matched", "likelihood"])
def test_every_method_gives_seconds_and_nan_where_nothing_returned(method):
    cube = _cube()
    times = arrival_time(cube, **GATE, method=method, irf=IRF, device="cpu")
    assert times.shape == (2, 2) and times.dtype == np.float64
    expected = 100e-9 + np.array([20.25, 33.5, 41.0]) * 50e-12
    np.testing.assert_allclose(times.ravel()[:3], expected, rtol=0, atol=(0.51 if method == "peak" else 0.02) * 50e-12)
    assert np.isnan(times[1, 1])


def test_numpy_torch_and_warp_agree():
    cube = _cube()
    expected = arrival_time(cube, **GATE, device="cpu")
    np.testing.assert_array_equal(arrival_time(wp.array(cube, dtype=wp.float64, device="cpu"), **GATE), expected)
    np.testing.assert_allclose(arrival_time(cube.astype(np.float32), **GATE, device="cpu"), expected, rtol=1e-7)
    counts = np.rint(cube)
    expected = arrival_time(counts, **GATE, device="cpu")
    for dtype in (np.uint8, np.uint16, np.int32, np.int64):
        np.testing.assert_array_equal(arrival_time(counts.astype(dtype), **GATE, device="cpu"), expected)
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(arrival_time(torch.from_numpy(counts), **GATE), expected)


def test_frames_share_one_background():
    frames = np.stack([_cube() + 3.0, _cube() + 3.0])
    background = np.full((2, 2, 64), 3.0)
    times = arrival_time(frames, **GATE, background=background, irf=IRF, method="likelihood", device="cpu")
    assert times.shape == (2, 2, 2)
    np.testing.assert_array_equal(times[0], times[1])
    shared = arrival_time(frames, **GATE, background=np.full(64, 3.0), irf=IRF, method="likelihood", device="cpu")
    np.testing.assert_array_equal(times, shared)


def test_a_gate_leaves_out_what_lies_before_it():
    cube = _cube()
    cube[..., 3] = 1e4
    gate = (100e-9 + 10 * 50e-12, 100e-9 + 60 * 50e-12)
    assert np.nanmax(arrival_time(cube, **GATE, method="peak", device="cpu")) < gate[0]
    inside = arrival_time(cube, **GATE, method="peak", gate=gate, device="cpu")
    np.testing.assert_array_equal(inside, arrival_time(_cube(), **GATE, method="peak", device="cpu"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "guess"}, "method = 'guess'"),
        ({"bin_width": 0.0}, "bin_width = 0.0 is outside .* s"),
        ({"gate_start": np.nan}, "gate_start = nan"),
        ({"method": "matched"}, "needs an irf"),
        ({"histogram": np.full((2, 2, 8), -1.0)}, r"pixel \(0, 0\)"),
        ({"histogram": np.full((2, 2, 8), np.nan)}, "non-finite value"),
        ({"histogram": np.zeros(8)}, r"shape \(8,\)"),
        ({"histogram": np.zeros((2, 2, 0))}, "at least one pixel and one bin"),
        ({"background": np.zeros(7)}, r"background has shape \(7,\)"),
        ({"background": -1.0}, "background holds a negative"),
        ({"gate": (0.0, 1e-9)}, "gate = "),
        ({"irf": [-1.0, 2.0], "method": "matched"}, "irf must be"),
        ({"irf": np.ones((2, 2)), "method": "matched"}, "irf has shape"),
    ],
)
def test_wrong_input_is_named(changes, message):
    call = {"histogram": np.zeros((2, 2, 64)), **GATE, **changes}
    with pytest.raises(ValueError, match=message):
        arrival_time(call.pop("histogram"), **call, device="cpu")


def test_wrong_kinds_are_named():
    with pytest.raises(TypeError, match="dtype complex128"):
        arrival_time(np.zeros((2, 2, 8), complex), **GATE, device="cpu")
