"""A measured capture against the detector model with fitted parameters: delays, depth errors, counts.

python docs/figures/measured.py CAPTURE --out measured.png

CAPTURE is a file that `spadwarp depth` reads: histograms or time tags (.npy, .mat, .h5, .ptu). The response of the
instrument (Gaussian with an exponential tail), the signal and the background of each pixel are fitted; then counts are
drawn by `spadwarp.detect`, and go through the same analysis.
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize

import spadwarp
from spadwarp.frames import InstrumentResponse, read_histograms
from spadwarp.scene import Detector
from spadwarp.values import SPEED_OF_LIGHT
from spadwarp.viz import style as viz

Floats = NDArray[np.float64]
NEIGHBOURS = 5  # side of the square of pixels that says where a pixel's surface is
PULSES = 10_000  # of the simulated frame: few counts a pulse


@dataclass(frozen=True)
class Analysis:
    """Attributes: delay of counts from the surface [s] and how often; depth errors [s]; counts of a pixel."""

    delays: Floats
    often: Floats
    errors: Floats
    counts: Floats


@dataclass(frozen=True)
class Fit:
    """Attributes: the response; its delay after the surface [s]; background counts per pixel and bin."""

    response: InstrumentResponse
    shift: float
    background: float


def window(counts: NDArray[Any], bins: int) -> tuple[NDArray[Any], int]:
    """The bins about the peak of the whole image, and the first of them."""
    total = uniform_filter(counts.sum(axis=(0, 1), dtype=np.float64), 5)
    first = int(np.clip(np.argmax(total) - bins // 2, 0, max(counts.shape[2] - bins, 0)))
    return counts[:, :, first : first + bins], first


def neighbours(counts: NDArray[Any]) -> Floats:
    """Sum of a pixel's neighbours, without itself."""
    area = NEIGHBOURS**2
    mean = uniform_filter(counts.astype(np.float32), (NEIGHBOURS, NEIGHBOURS, 1), mode="nearest")
    return np.maximum(mean * area - counts, 0.0).astype(np.float64)


def analyse(
    counts: NDArray[Any], width: float, response: InstrumentResponse, background: float
) -> tuple[Analysis, Floats]:
    """Delays, errors and counts of the pixels on smooth surfaces; and where the surface is [s]."""
    options: dict[str, Any] = {"gate_start": 0.0, "bin_width": width, "method": "likelihood", "irf": response}
    around = neighbours(counts)
    surface = spadwarp.arrival_time(around, background=background * (NEIGHBOURS**2 - 1), **options)
    level = np.nan_to_num(surface, nan=-1.0)
    step = np.maximum(
        np.abs(np.diff(level, axis=0, append=level[-1:])), np.abs(np.diff(level, axis=1, append=level[:, -1:]))
    )
    rough = uniform_filter((step > 0.5 * response.fwhm).astype(float), NEIGHBOURS) > 1e-9
    smooth = ~rough & np.isfinite(surface) & (around.sum(axis=-1) > 30)
    own = spadwarp.arrival_time(counts, background=background, **options)
    seen = smooth & np.isfinite(own)
    span = counts.shape[2] // 2
    edges = (np.arange(-span, span + 1) - 0.5) * width
    often, centre = np.zeros(2 * span), (np.arange(counts.shape[2]) + 0.5) * width
    for row, column in np.argwhere(smooth):
        here = counts[row, column]
        hit = np.flatnonzero(here)
        often += np.histogram(centre[hit] - surface[row, column], edges, weights=here[hit])[0]
    # Bins near the ends of the window are reached from some pixels only.
    keep = np.abs(edges[:-1] + 0.5 * width) < 0.3 * counts.shape[2] * width
    return (
        Analysis(
            delays=(edges[:-1] + 0.5 * width)[keep],
            often=often[keep] / max(int(smooth.sum()), 1),
            errors=(own - surface)[seen],
            counts=counts[smooth].sum(axis=-1).astype(float),
        ),
        surface,
    )


def fit(analysis: Analysis, width: float, pixels: int) -> Fit:
    """Response, shift and background by maximum likelihood of the delays."""
    times, counts = analysis.delays, analysis.often * pixels
    background = float(np.quantile(counts, 0.2))
    start = width * max(float((counts > 0.5 * counts.max()).sum()), 1.0) / 2.355

    def expected(parameters: Floats) -> Floats:
        sigma, tail, shift, signal, flat = parameters
        response = InstrumentResponse(sigma=start * math.exp(sigma), tail=start * math.exp(tail))
        return math.exp(signal) * response.density(times - shift * start) * width + math.exp(flat)

    def loss(parameters: Floats) -> float:
        model = expected(parameters)
        return float((model - counts * np.log(model)).sum() / counts.sum())

    first = [0.0, -1.0, 0.0, math.log(max(counts.sum() - background * counts.size, 1.0)), math.log(background + 1e-3)]
    best = minimize(loss, first, method="Nelder-Mead", options={"maxiter": 6000, "xatol": 1e-4, "fatol": 1e-9})
    sigma, tail, shift, _, flat = best.x
    return Fit(
        response=InstrumentResponse(sigma=start * math.exp(sigma), tail=start * math.exp(tail)),
        shift=shift * start,
        background=math.exp(flat) / pixels,
    )


def simulate(counts: NDArray[Any], width: float, fitted: Fit, surface: Floats, *, seed: int) -> NDArray[Any]:
    """Counts of the detector model for the signal and background of the neighbourhood of each pixel."""
    mean = np.maximum(uniform_filter(counts.astype(np.float32), (NEIGHBOURS, NEIGHBOURS, 1), mode="nearest"), 0.0)
    edges = np.arange(counts.shape[2] + 1) * width
    place = np.nan_to_num(surface, nan=-1.0) + fitted.shift
    apart = np.abs(0.5 * (edges[1:] + edges[:-1]) - place[..., None])
    far = apart > 3.0 * fitted.response.fwhm + 5.0 * fitted.response.tail
    level = (mean * far).sum(axis=-1) / np.maximum(far.sum(axis=-1), 1)  # background per bin
    signal = np.maximum(mean.sum(axis=-1) - level * counts.shape[2], 0.0)
    shape = np.diff(fitted.response.cumulative(edges - place[..., None]), axis=-1)
    expected = np.maximum(signal[..., None] * shape, 0.0) + level[..., None]
    frames = spadwarp.detect(
        (expected / PULSES).astype(np.float32),
        pulses=PULSES,
        seed=seed,
        gate_start=0.0,
        bin_width=width,
        detector=Detector(dark_count_rate=0.0, wrap=False),
        irf=InstrumentResponse(),
    )
    return frames.counts[0]


def compare(
    counts: NDArray[Any], width: float, *, bins: int, fwhm: float, seed: int = 1
) -> tuple[Analysis, Analysis, Fit]:
    """Analysis of the measured and of the simulated counts `[H, W, T]`, and the fit."""
    counts, _ = window(counts, bins)
    guess, background = InstrumentResponse(sigma=fwhm / 2.355), 0.5 * float(counts.mean())
    for _ in range(2):
        measured, surface = analyse(counts, width, guess, background)
        if not measured.counts.size:
            raise SystemExit("no smooth surface with enough counts; try --bins or --fwhm-ps")
        fitted = fit(measured, width, measured.counts.size)
        guess, background = fitted.response, fitted.background
    measured, surface = analyse(counts, width, guess, background)
    simulated, _ = analyse(simulate(counts, width, fitted, surface, seed=seed), width, guess, background)
    return measured, simulated, fitted


def largest_difference(one: Floats, other: Floats) -> float:
    """Kolmogorov's distance between two samples: the largest difference of their cumulative distributions."""
    both = np.sort(np.concatenate([one, other]))
    return float(np.abs(np.searchsorted(np.sort(one), both, "right") / one.size
                        - np.searchsorted(np.sort(other), both, "right") / other.size).max())  # fmt: skip


@viz.paper()
def draw(measured: Analysis, simulated: Analysis, path: Path) -> None:
    """Three panels: delays of counts, depth errors, counts a pixel."""
    figure = viz.new_figure(viz.PAGE, 2.3)
    delays, errors, counts = figure.subplots(1, 3)
    for one, style, label in (
        (measured, {"color": "black"}, "measured"),
        (simulated, {"color": viz.BLUE}, "simulated"),
    ):
        delays.step(1e9 * one.delays, np.maximum(one.often, 1e-12), where="mid", label=label, **style)
        millimetres = 0.5e3 * SPEED_OF_LIGHT * one.errors
        limit = 0.5e3 * SPEED_OF_LIGHT * 1.1 * float(np.quantile(np.abs(measured.errors), 0.98))
        errors.hist(millimetres, np.linspace(-limit, limit, 41), histtype="step", density=True, **style)
        most = float(np.quantile(measured.counts, 0.999)) + 2
        counts.hist(one.counts, np.arange(-0.5, most), histtype="step", density=True, **style)
    least = 0.5 * float(measured.often[measured.often > 0].min())
    delays.set(ylim=(least, None), xlabel="delay from the surface [ns]", ylabel="counts per pixel and bin")
    viz.log_axis(delays, "y")
    errors.set(xlabel="error of one pixel [mm in air]", ylabel="density [1/mm]")
    counts.set(xlabel="counts of a pixel", ylabel="fraction of pixels")
    for axis in (delays.xaxis, errors, counts):
        axis.minorticks_on()
    for axis in (delays, errors, counts):
        viz.plain_axis(axis)
    delays.legend(loc="upper right")
    viz.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--out", type=Path, default=Path("measured.png"))
    parser.add_argument("--bin-width-ps", type=float, help="of the histogram; of time tags: a multiple of their unit")
    parser.add_argument("--tag-unit-ps", type=float, help="of time tags in cells")
    parser.add_argument("--axes", help="order of an array's axes, such as tyx")
    parser.add_argument("--image-size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--bins", type=int, default=300, help="about the return")
    parser.add_argument("--size", type=int, default=160, help="of the square in the middle of the image that is used")
    parser.add_argument("--fwhm-ps", type=float, default=300.0, help="first guess of the response")
    options = parser.parse_args()
    read = read_histograms(
        options.capture,
        axes=options.axes,
        image_size=None if options.image_size is None else (options.image_size[1], options.image_size[0]),
        tag_unit=None if options.tag_unit_ps is None else options.tag_unit_ps * 1e-12,
        bin_width=None if options.bin_width_ps is None else options.bin_width_ps * 1e-12,
        gate_start=0.0,
        sum_frames=True,
    )
    if read.bin_width is None:
        raise SystemExit("the file does not say its bin width: --bin-width-ps")
    (height, width), half = read.values.shape[:2], options.size // 2
    rows, columns = (slice(max(side // 2 - half, 0), side // 2 + half) for side in (height, width))
    measured, simulated, fitted = compare(
        read.values[rows, columns], read.bin_width, bins=options.bins, fwhm=options.fwhm_ps * 1e-12
    )
    draw(measured, simulated, options.out)
    print(f"response: FWHM {1e12 * fitted.response.fwhm:.0f} ps, tail {1e12 * fitted.response.tail:.0f} ps")
    for name in ("errors", "counts"):
        one, other = getattr(measured, name), getattr(simulated, name)
        spread = [float(np.subtract(*np.quantile(values, (0.84, 0.16)))) / 2 for values in (one, other)]
        scale, unit = (0.5e3 * SPEED_OF_LIGHT, "mm in air") if name == "errors" else (1.0, "counts")
        print(
            f"{name}: {one.size} pixels, half of the central 68 %: measured {scale * spread[0]:.3g} {unit}, simulated "
            f"{scale * spread[1]:.3g}; largest difference of the distributions {largest_difference(one, other):.3f}"
        )
    print(f"written: {options.out}")


if __name__ == "__main__":
    main()
