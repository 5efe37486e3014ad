"""The instrument response against quadrature."""

import numpy as np
import pytest
from scipy import integrate, stats

from spadwarp.frames import InstrumentResponse, instrument_response, read_response, response_matrix
from spadwarp.values import ArgumentError

PS = 1e-12


TIMES = np.array([-60.0, -10.0, 5.0, 40.0, 200.0, 390.0]) * PS
RESPONSES = {
    "gaussian": InstrumentResponse(sigma=90 * PS),
    "tail": InstrumentResponse(sigma=60 * PS, tail=150 * PS),
    "short tail": InstrumentResponse(sigma=100 * PS, tail=3 * PS),
    "vanishing tail": InstrumentResponse(sigma=100 * PS, tail=0.01 * PS),
    "long tail": InstrumentResponse(sigma=20 * PS, tail=900 * PS),
    "exponential": InstrumentResponse(tail=120 * PS),
    "measured": InstrumentResponse(times=TIMES, values=[0.0, 3.0, 10.0, 6.0, 1.0, 0.0]),
    "delta": InstrumentResponse(),
}


def test_widths_of_pulse_and_jitter_add_in_quadrature():
    irf = instrument_response(pulse_fwhm=85e-12, jitter_fwhm=200e-12)
    assert irf.fwhm == pytest.approx(np.hypot(85e-12, 200e-12))
    assert irf.density(0.5 * irf.fwhm) / irf.density(0.0) == pytest.approx(0.5)


def test_the_tail_is_the_convolution_of_both():
    irf = RESPONSES["tail"]
    law = stats.exponnorm(irf.tail / irf.sigma, scale=irf.sigma)
    t = np.linspace(-500, 3000, 201) * PS
    np.testing.assert_allclose(irf.density(t), law.pdf(t), rtol=1e-8, atol=1e-4)
    np.testing.assert_allclose(irf.cumulative(t), law.cdf(t), atol=1e-12)
    assert irf.mean == pytest.approx(law.mean())


@pytest.mark.parametrize("name", [name for name in RESPONSES if name != "delta"])
def test_density_cumulative_and_its_integral_are_one_curve(name):
    irf = RESPONSES[name]
    lower, upper = irf.support
    t = np.linspace(lower, upper, 400_001)
    density, cumulative = irf.density(t), irf.cumulative(t)
    # The jump of an exponential costs the trapezoid half a step.
    tolerance = density.max() * (t[1] - t[0]) if name == "exponential" else 1e-6
    np.testing.assert_allclose(integrate.cumulative_trapezoid(density, t, initial=0), cumulative, atol=tolerance)
    integral = integrate.cumulative_trapezoid(cumulative, t, initial=0)
    np.testing.assert_allclose(integral, irf.cumulative_integral(t), atol=tolerance * (upper - lower))
    assert 1 - 2e-7 < cumulative[-1] - cumulative[0] <= 1 + 1e-12
    assert irf.mean == pytest.approx(integrate.trapezoid(t * density, t), rel=1e-3, abs=1e-15)
    assert irf.density(irf.mode) == pytest.approx(density.max(), rel=1e-3)


def _dense(matrix, bins, sources):
    dense = np.zeros((bins, sources))
    for k in range(bins):
        entries = slice(matrix.row_start[k], matrix.row_start[k + 1])
        np.add.at(dense[k], matrix.source_bin[entries], matrix.weight[entries])
    return dense


AXIS = dict(source_start=10e-9, source_width=100 * PS, source_bins=40)


@pytest.mark.parametrize("name", RESPONSES)
def test_matrix_is_the_average_over_each_source_bin(name):
    irf = RESPONSES[name]
    edges = 10e-9 + np.concatenate([[0.0], np.cumsum(np.random.default_rng(1).uniform(20, 180, 39))]) * PS
    dense = _dense(response_matrix(irf, **AXIS, edges=edges), 39, 40)
    points = (np.arange(4000) + 0.5) / 4000 * 100 * PS
    for k in (0, 17, 39):
        arrivals = 10e-9 + k * 100 * PS + points
        expected = np.diff(irf.cumulative(edges[None, :] - arrivals[:, None]), axis=1).mean(0)
        np.testing.assert_allclose(dense[:, k], expected, atol=5e-4 if name in ("delta", "exponential") else 1e-6)


@pytest.mark.parametrize("name", ["gaussian", "tail", "delta"])
def test_wrapping_loses_nothing_when_the_window_is_the_period(name):
    period = 1.73e-9  # neither a multiple of the bins nor a divisor of the source
    edges = np.linspace(0, period, 23) + 3e-9
    dense = _dense(response_matrix(RESPONSES[name], **AXIS, edges=edges, period=period), 22, 40)
    np.testing.assert_allclose(dense.sum(0), 1.0, atol=1e-6)


def test_wrapping_shifts_by_whole_periods():
    irf, period = RESPONSES["tail"], 2e-9  # 20 source bins
    edges = 10e-9 + np.arange(21) * 100 * PS
    dense = _dense(response_matrix(irf, **AXIS, edges=edges, period=period), 20, 40)
    np.testing.assert_allclose(dense[:, :20], dense[:, 20:], atol=1e-6)
    # The detector sees a circle: each source bin's column is the one before it, rotated.
    np.testing.assert_allclose(np.roll(dense[:, 3], 1), dense[:, 4], atol=1e-6)


def test_a_window_without_light_is_empty():
    matrix = response_matrix(RESPONSES["gaussian"], **AXIS, edges=[1.0, 2.0, 3.0])
    assert matrix.row_start.tolist() == [0, 0, 0] and matrix.weight.size == 0


def test_a_response_has_times_or_a_value_for_each_bin(tmp_path):
    (tmp_path / "bins.csv").write_text("# of a pulse\n1\n4\n1\n")
    np.save(tmp_path / "bins.npy", np.array([1.0, 4.0, 1.0]))
    (tmp_path / "times.csv").write_text("time_ps,value\n-100,0\n-50,1\n0,4\n\n50,1\n100,0\n")
    same = [read_response(tmp_path / name, bin_width=50e-12) for name in ("bins.csv", "bins.npy", "times.csv")]
    for one in same:
        assert one.mean == pytest.approx(0.0, abs=1e-15) and one.fwhm == pytest.approx(same[0].fwhm)
        np.testing.assert_allclose(one.per_bin(50e-12), same[0].per_bin(50e-12), atol=1e-12)
    np.save(tmp_path / "bad.npy", np.zeros(4))
    for name, words, options in (("bins", "bin width is missing", {}), ("bad", "is not a resp", {"bin_width": 5e-11})):
        with pytest.raises(ArgumentError, match=words):
            read_response(tmp_path / f"{name}.npy", **options)
    (tmp_path / "triangle.csv").write_text("time_ps,value\n-50,0\n0,4\n150,0\n")
    triangle = read_response(tmp_path / "triangle.csv", bin_width=50e-12)
    assert triangle.mean == pytest.approx((-50 + 0 + 150) / 3 * PS)
    assert triangle.mode == 0 and triangle.fwhm == pytest.approx(100 * PS, rel=1e-3)


@pytest.mark.parametrize("scale", [5e-324, 1e-310, 1e-160, 1e300, 1.7e308 / 4])
def test_the_unit_of_a_measured_response_does_not_matter(scale, tmp_path):
    """Neither sums that overflow nor values below the smallest normal number change its shape."""
    shape, times = np.array([1.0, 4.0, 2.0]), [0.0, 1e-10, 2e-10]
    for name, values in {"unit": shape, "scaled": shape * scale}.items():
        np.save(tmp_path / f"{name}.npy", values)
    unit, scaled = (read_response(tmp_path / f"{name}.npy", bin_width=1e-10) for name in ("unit", "scaled"))
    assert scaled.mean == pytest.approx(unit.mean, abs=1e-22) and scaled.fwhm == pytest.approx(unit.fwhm)
    scaled, unit = (InstrumentResponse(times=times, values=values) for values in (shape * scale, shape))
    assert scaled.fwhm == unit.fwhm


def measured(times):
    return lambda: InstrumentResponse(times=times, values=[0.0, 1.0, 0.0])


def response(**changes):
    return lambda: instrument_response(**{"pulse_fwhm": 0, "jitter_fwhm": 0, **changes})


def matrix(**changes):
    given = {"irf": RESPONSES["gaussian"], **AXIS, "edges": np.linspace(0.0, 1e-9, 11), **changes}
    return lambda: response_matrix(given.pop("irf"), **given)


REFUSED = [
    ("times of a measured response", measured([0.0, 5e-324, 1e-323])),  # of no usable length
    ("pulse_fwhm = -1", response(pulse_fwhm=-1)),
    ("no density", lambda: InstrumentResponse().density(0.0)),
    ("irf = 1e-10 is not of the type InstrumentResponse", matrix(irf=1e-10)),
    ("source_width = -1e-10 is outside", matrix(source_width=-1e-10)),
    ("finite, ascending times", matrix(edges=[2.0, 1.0])),
    # In the wrong unit; fills no memory.
    (r"of .* s on a side is longer than 1e\+07 bins of 1e-10 s", lambda: InstrumentResponse(sigma=1.0).per_bin(1e-10)),
]


@pytest.mark.parametrize(("message", "call"), REFUSED)
def test_wrong_input_is_named(message, call):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_ps,value\n0,1\n1,x\n", r"irf\.csv.*line 3"),
        ("0,1\n1,-1\n", r"irf\.csv.*line 2: value = -1 is outside \[0, 1e30\]"),
        ("0,1\n", r"irf\.csv.*two or more"),
        ("0,1\n1e300,1\n", r"irf\.csv.*line 2: time_ps = 1e[+]300 is outside"),
    ],
)
def test_a_bad_file_is_named(tmp_path, text, message):
    (tmp_path / "irf.csv").write_text(text)
    with pytest.raises(ArgumentError, match=message):
        read_response(tmp_path / "irf.csv")
