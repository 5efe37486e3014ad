"""Figures of a result, of depth frames, of the analytic model, of a fit and of a scene; and what notebooks show."""

from __future__ import annotations

import base64
import html as markup
import io
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import SymmetricalLogLocator
from numpy.typing import ArrayLike, NDArray

from spadwarp.analytic import AnalyticResult, Proposal
from spadwarp.files import summary
from spadwarp.frames import Frames, FramesFile, Method, first_photon_probabilities
from spadwarp.inverse import Fit
from spadwarp.io.text import fact, progress_report
from spadwarp.result import (
    POLARISED,
    Channel,
    FluxValues,
    Result,
    analyser_channel,
    apparent,
    degree_of_polarisation,
    unclear_pixels,
)
from spadwarp.result.analysis import noise_caption, off_edges, pixel_channel, pixel_standard_error
from spadwarp.scene import Medium, Scene
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import Spectrum, truth_maps
from spadwarp.values import ArgumentError, ConfigError, SpadwarpError, check_integer, count, percent, rounded
from spadwarp.viz import style
from spadwarp.viz.style import BLUE, INTENSITY_MAP, PAGE, TEXT, Panels, log_axis, paper, save, shown_limits

__all__ = ["draw", "draw_denoised", "draw_depth", "draw_result", "draw_spectrum", "html", "plot", "progress_bar"]

KINDS = ("depth", "intensity", "histogram", "truth", "flux")
"""Figures of a result."""


@paper()
def plot(
    shown: Result | Frames | FramesFile | Scene | AnalyticResult | Fit,
    kind: Literal["depth", "intensity", "histogram", "truth", "flux"] | None = None,
    *,
    method: Any = "centroid",
    frame: int = 0,
    pixel: tuple[int, int] | None = None,
    device: Any = None,
    width: float = PAGE,
) -> Figure:
    """A figure of a result, of frames or of a scene; notebooks show it, `savefig` writes it.

    Of a result, `kind` is "depth" (default), "intensity", "histogram", "truth" or "flux". Frames: one of them, from a
    file with its depth. An analytic result: its maps and a frame. A fit: its counts and residuals. A scene: true depth
    and reflectance, by ray casting. `method`: estimator of a result's depth; `frame`: its number, from 0; `pixel`: row
    and column of one more pixel to show; `width`: [inch], 7.2 for a journal's page, 3.5 for its column.

    Raises `ArgumentError` for another kind, a frame that is not there, or a width outside [2.5, 50]; `MeshError` where
    a target of the scene cannot be read.
    """
    if isinstance(shown, Result):
        if kind not in (None, *KINDS):
            raise ArgumentError(f"kind = {kind!r} is not one of {', '.join(map(repr, KINDS))}")
        depth = shown.depth(method=method, device=device) if kind in (None, "depth") else None
        return _result_figure(shown, kind or "depth", depth, method, width, pixel)
    if kind is not None:
        raise ArgumentError(f"kind = {kind!r} needs a result, not a {type(shown).__name__}")
    if isinstance(shown, AnalyticResult):
        return _analytic_figure(shown, width)
    if isinstance(shown, Fit):
        return _fit_figure(shown, width)
    if isinstance(shown, Frames | FramesFile):
        return _frame_figure(shown, frame, width, pixel)
    truth = truth_maps(shown, device=device)
    panels = Panels(truth.depth.shape, 2, width=width)
    panels.show_depth(truth.depth, "Truth", shown_limits(truth.depth))
    panels.show(truth.reflectance, "Reflectance", "Lambertian reflectance", INTENSITY_MAP, (0.0, 1.0))
    panels.figure.caption(repr(shown))
    return panels.figure


def draw(shown: FramesFile | AnalyticResult | Fit | Scene, path: str | Path, **options: Any) -> Path:
    """Writes the figure of `plot`, with its options; returns the path. Raises `FileError`."""
    return save(plot(shown, **options), path)


@paper()
def draw_result(
    result: Result,
    directory: str | Path,
    *,
    kinds: Sequence[str] = KINDS[:-1],
    depth: NDArray[np.float64] | None = None,
    method: Method = "centroid",
    formats: Sequence[str] = ("png",),
    width: float = PAGE,
) -> list[Path]:
    """Writes pictures of depth, intensity, histograms, truth and flux, such as `depth.png`; returns their paths.

    `depth`: frame `[H, W]` [m] to show, by default `result.depth(method=method)`; `formats`: "png", and "pdf" with
    vectors; `width`: [inch]. Frames without returns give empty pictures. The folder is made if it is missing.

    Raises `FileError` where the folder or a file cannot be written.
    """
    if depth is None and "depth" in kinds:
        depth = result.depth(method=method)
    written = []
    for kind in kinds:
        figure = _result_figure(result, kind, depth, method, width)
        written += [save(figure, Path(directory) / f"{kind}.{ending}") for ending in formats]
    return written


_MOST_DEPTHS = 6  # panels of lines


@paper()
def draw_spectrum(
    spectrum: Spectrum, path: str | Path, *, depth: Mapping[float, NDArray[np.float64]], width: float = PAGE
) -> Path:
    """Writes a picture of runs at several wavelengths: the colour of their light, depth and histograms of all pixels by
    line; returns its path.

    `depth`: frames by wavelength `[H, W]` [m], of which up to six are shown. `width`: [inch]. Raises `FileError`.
    """
    lines = [*spectrum.results]
    shown = [lines[k] for k in np.unique(np.linspace(0, len(lines) - 1, min(len(lines), _MOST_DEPTHS)).astype(int))]
    first = spectrum.results[lines[0]]
    panels = Panels(first.truth.depth.shape, 1 + len(shown), width=width, below=(2.0,))
    panels.figure.caption(_caption(replace(first, scene=spectrum.scene)))
    axis, bar = panels.place("Colour of the light")
    # A photon of the line has the energy of the laser's less what the wavelength makes of it.
    energy = [spectrum.shares[nm] / nm * one.intensity for nm, one in spectrum.results.items()]
    axis.imshow(style.srgb(np.stack(energy, axis=-1), lines))
    bar.axis("off")
    style.middle_text(bar, "CIE 1931, as a screen shows it")
    limits = style.target_limits(first.truth.depth, np.stack([depth[nm] for nm in shown]))
    for nm in shown:
        panels.show_depth(depth[nm], f"Depth at {nm:.6g} nm", limits)
    (curves,) = panels.below()
    tops = []
    for nm, shade in zip(lines, style.colour_map("turbo")(np.linspace(0.05, 0.95, len(lines))), strict=True):
        one = spectrum.results[nm]
        light = one.histogram.sum(axis=(0, 1)) * one.scene.laser.photons_per_pulse * one.scene.detector.pde
        tops.append(float((light := light * spectrum.shares[nm]).max()))
        label = f"{nm:.6g} nm" if nm in shown else None
        curves.stairs(light, 1e9 * one.bin_edges, baseline=None, color=shade, label=label)
    top = max(tops) or 1.0
    curves.set(xlabel="time of flight [ns]", ylabel="detections per\npulse and bin, all pixels", yscale="log")
    curves.set(xlim=1e9 * first.bin_edges[[0, -1]], ylim=(1e-5 * top, 3.0 * top))
    log_axis(curves, "y")
    panels.figure.key([curves], 0.8)
    return save(panels.figure, path)


# A result

_NOISY = "; {} of the pixels: more noise of the simulation than of the photons"
_HATCHED = "{} of the pixels: the brightest bin not known to a third, noise of the simulation; more photons{} help"


def _hatched(pixels: NDArray[np.bool_]) -> str:
    return f"{'hatched, ' * bool(pixels.mean() < style.MOST_HATCHED)}{percent(pixels.mean())} %"


def _typical_pixels(
    light: NDArray[Any], depth: NDArray[Any] | None, pixel: tuple[int, int] | None
) -> dict[str, tuple[int, int]]:
    """Pixels with typical light of the target, off its edges, and of the water, and the one asked for."""
    groups = {"Typical pixel": light > 0}
    if depth is not None:
        target, _ = off_edges(np.where(light > 0, depth, np.nan))
        groups = {"Typical pixel of the target": target, "Typical pixel of the water": np.isnan(depth) & (light > 0)}
    found = {name: style.median_pixel(light, group) for name, group in groups.items() if group.any()}
    if pixel is not None:
        for index, name, length in zip(pixel, ("row", "column"), light.shape, strict=True):
            check_integer(f"pixel: {name}", index, f"[0, {length - 1}]")
        found["Pixel asked for"] = pixel
    return found


def _result_figure(
    result: Result,
    kind: str,
    depth: NDArray[Any] | None,
    method: str,
    width: float,
    pixel: tuple[int, int] | None = None,
) -> Figure:
    if kind == "histogram":
        return _histogram_figure(result, width, pixel)
    if kind == "flux":
        return _flux_figure(result, width)
    truth, unclear = result.truth, unclear_pixels(result)
    shown_channels = POLARISED if result.scene.camera.channels else ()
    count_of = 2 + len(shown_channels) + bool(shown_channels) if kind == "intensity" else 3
    panels = Panels(truth.depth.shape, count_of, width=width)
    panels.figure.caption(_caption(result))
    if unclear.any() and kind != "truth":
        more = result.scene.has_straight_sight and result.reconstruction is None
        panels.figure.note(_HATCHED.format(_hatched(unclear), " or a reconstruction" if more else ""))
    if kind == "intensity":
        panels.unclear = unclear
        per_pulse = result.scene.detectable_photons_per_pulse
        ballistic = result.expected("ballistic").sum(axis=-1)
        panels.show_intensity(result.intensity * per_pulse, "All light in the gate", "expected detections per pulse")
        panels.unclear = None
        panels.show_intensity(ballistic * per_pulse, "Ballistic light alone", "expected detections per pulse")
        for channel in shown_channels:
            part, name = analyser_channel(result, channel).intensity * per_pulse, style.CHANNEL_NAMES[channel]
            panels.show_intensity(part, f"{name.capitalize()} light", "expected detections per pulse")
        if shown_channels:
            panels.unclear = unclear
            part = degree_of_polarisation(result, gated=True)
            low = -1.0 if (part < 0.0).any() else 0.0
            panels.show(part, "Degree of polarisation", "of all light in the gate", "viridis", (low, 1.0))
    elif kind == "truth":
        normal = 0.5 + 0.5 * truth.normal * np.array([1.0, -1.0, -1.0])
        panels.show_depth(truth.depth, "Depth", shown_limits(truth.depth))
        axis, bar = panels.place("Normal")
        axis.imshow(np.where(np.isfinite(normal), normal, float(style.MISSING)).clip(0.0, 1.0))
        bar.axis("off")
        style.middle_text(bar, "red: right, green: up,\nblue: to the camera")
        style.middle_text(axis, "" if np.isfinite(normal).any() else "no values")
        panels.show(truth.reflectance, "Reflectance", "Lambertian reflectance", INTENSITY_MAP, (0.0, 1.0))
    else:
        measured = np.asarray(depth, dtype=np.float64)
        limits = style.target_limits(truth.depth, measured)
        panels.unclear = unclear
        panels.show_depth(measured, f"Measured ({method})", limits)
        panels.unclear = None
        panels.show_depth(truth.depth, "Truth", limits)
        panels.unclear = unclear
        panels.show_error(measured - truth.depth, "Measured − truth")
    return panels.figure


def _histogram_figure(result: Result, width: float, pixel: tuple[int, int] | None) -> Figure:
    light = sum(result.expected(name).sum(axis=2) for name in ("ballistic", "forward_scattered"))
    on_target = np.isfinite(result.truth.depth) & bool(light.any())
    pixels = _typical_pixels(np.where(on_target, light, result.intensity), result.truth.depth, pixel)
    unclear = unclear_pixels(result)
    figure = style.new_figure(width, 2.3 * max(len(pixels), 1))
    figure.caption(_caption(result))
    axes = figure.subplots(max(len(pixels), 1), 1, squeeze=False)[:, 0]
    merged = False
    for axis, (name, (row, column)) in zip(axes, pixels.items(), strict=False):
        axis.set(xlabel="time of flight [ns]", xlim=1e9 * result.bin_edges[[0, -1]])
        noisy = "\nits brightest bin is noise of the simulation" if unclear[row, column] else ""
        axis.set_title(f"{name}: row {row}, column {column}{noisy}", color="firebrick" if noisy else TEXT)
        merged |= _plot_pixel(result, axis, row, column)
    if pixels:
        title = "wide steps: means of bins that are added up, since the light of each is not known to a third"
        figure.key(axes, 1.35, title=style.wrapped(title, width - 0.3) if merged else "")
    else:
        style.middle_text(axes[0], "nothing returned in the gate")
        axes[0].set_yticks([])
    return figure


# Light of the water is nearly all co-polarised, and light of the target half: a wide line below the components, and a
# dotted one above them, hide neither each other nor them.
_CHANNEL_LINES: dict[Channel, dict[str, Any]] = {
    "co": {"color": style.PURPLE, "linewidth": 3.0, "zorder": 1.5},
    "cross": {"color": "black", "linestyle": (0, (1, 1.5)), "linewidth": 1.1, "zorder": 4},
}


def _plot_pixel(result: Result, axis: Axes, row: int, column: int) -> bool:
    """Components of one pixel over time of flight, and over the range along its line of sight; of polarised light also
    what each channel has of all of them.

    Where light is sparse, bins are added up until their sum is known to a third, see `merged_edges`; returns whether.
    """
    per_pulse = result.scene.detectable_photons_per_pulse
    time, better = 1e9 * result.bin_edges, result.reconstruction
    error = np.zeros(len(time) - 1)  # without batches it is not known, and bins stay as they are
    if better is not None:
        cubes = better.histogram[:, row, column], better.error[row, column]
        parts, error = (cube.astype(np.float64) * per_pulse for cube in cubes)
    else:
        parts = result.tallies[:, row, column] * (result.tally_value[row, column] * per_pulse)
        error = pixel_standard_error(result, row, column) * per_pulse if result.batches > 1 else error
    total = parts.sum(axis=0)
    weight = np.divide(error**2, total, out=np.zeros_like(total), where=total > 0)
    # No light before its time, and none of unscattered light's bins in a mean of later ones.
    breaks = [*(int(part.argmax()) for part in parts > 0), *(np.flatnonzero(parts[0])[-1:] + 1)]
    edges = merged_edges(total, weight * total, breaks)
    curves: list[tuple[NDArray[Any], NDArray[Any], dict[str, Any]]] = []
    for name, part in zip(result.scene.components, parts, strict=True):
        own = np.arange(len(time)) if name == "ballistic" else merged_edges(part, weight * part, breaks)
        wide = {"linewidth": 1.4, "zorder": 3} if name == "ballistic" else {"linewidth": 0.9, "zorder": 2}
        label, colour = style.COMPONENTS[name]
        curves.append((merged_means(part, own), own, {"label": label, "color": colour, **wide}))
    means = np.concatenate([values for values, *_ in curves])
    top = float(parts.max())
    bottom = float(np.clip(0.5 * means[means > 0].min(), 1e-7 * top, 0.01 * top))
    if error.any():  # standard errors of the bins of a group taken as independent
        spread = np.sqrt(np.add.reduceat(error**2, edges[:-1])) / np.diff(edges)
        lower, upper = (np.maximum(merged_means(total, edges) + sign * spread, 0.01 * bottom) for sign in (-1, 1))
        label = "all light ± standard error"
        axis.stairs(upper, time[edges], baseline=lower, fill=True, color="0.75", zorder=1, label=label)
    for channel, line in _CHANNEL_LINES.items() if result.scene.camera.channels else ():
        seen = pixel_channel(result, channel, row, column).sum(axis=0) * per_pulse
        curves.append((merged_means(seen, edges), edges, {"label": style.CHANNEL_NAMES[channel], **line}))
    # Zeros lie below the axis, so that a single bin still shows as a spike.
    for heights, own, drawn in (curve for curve in curves if curve[0].any()):
        axis.stairs(np.maximum(heights, 0.01 * bottom), time[own], baseline=None, **drawn)
    style.arrival_line(axis, 1e9 * float(result.true_path()[row, column]) / result.pulse_speed, time)
    axis.set(ylim=(bottom, 3.0 * top), yscale="log", ylabel="detections\nper pulse and bin")
    log_axis(axis, "y")
    axis.xaxis.minorticks_on()
    axis.grid(which="major")
    _range_axis(result, axis, row, column)
    return any(len(own) < len(time) for _, own, _ in curves)


def _range_axis(result: Result, axis: Axes, row: int, column: int) -> None:
    """A second axis above: range along the line of sight."""
    speed, line = 1e-9 * result.pulse_speed, lines_of_sight(result.scene)[row, column]

    def to_range(at: ArrayLike) -> NDArray[np.float64]:
        # Range 0 before light can go from laser to lens: an axis cannot begin with NaN.
        return np.nan_to_num(line.range_from_path(np.asarray(at) * speed))

    def to_time(at: ArrayLike) -> NDArray[np.float64]:
        return line.path_from_range(at) / speed

    above = axis.secondary_xaxis("top", functions=(to_range, to_time))
    above.set_xlabel("range [m]")
    above.xaxis.minorticks_on()


def _caption(result: Result) -> str:
    photons = style.power_text(result.photons) if result.photons >= 1e6 else count(result.photons)
    light = channel_text(result.provenance.get("channel"))
    return f"{photons} photons{how_made(result)}{light}; {_water_text(result.scene.medium)}; seed {result.seed}"


def how_made(result: Result) -> str:
    """What a caption adds to the photons."""
    return ", interrupted" * result.partial + ", reconstructed" * (result.reconstruction is not None)


def channel_text(channel: str | None) -> str:
    """Words of a caption for light of one channel alone; none for all light."""
    names = {str(key): name for key, name in style.CHANNEL_NAMES.items()}
    return f", {names[channel]} light" if channel in names else ""


_LAWS = {"fournier_forand": "Fournier–Forand ", "two_term_henyey_greenstein": "two-term "}
_SYMBOLS = {"anisotropy": "g", "alpha": "α", "particle_index": "n", "junge_slope": "µ"}


def _water_text(medium: Medium) -> str:
    if medium.layers:
        extinctions = ", ".join(f"{water.extinction:.3g}" for water in medium.waters)
        return f"{len(medium.waters)} layers of water, c = {extinctions} 1/m"
    if medium.is_mixture:
        law = ", ".join(one.name for one in medium.constituents)
    elif medium.phase_function == "tabulated":
        law = f"phase function {Path(str(medium.phase_table)).stem}"
    else:
        values = (f"{_SYMBOLS.get(name, name)} = {value:.4g}" for name, value in medium.phase_parameters.items())
        law = _LAWS.get(medium.phase_function, "") + ", ".join(values)
    albedo = "U(0, 0.97)" if medium.albedo == "lu2024" else f"{medium.albedo:.3g}"
    grid = "" if medium.grid is None else f", with {medium.grid.shape or Path(str(medium.grid.file)).name}"
    return f"water c = {medium.extinction:.3g} 1/m, albedo {albedo}, {law}{grid}"


# Light inside the water

_PROPERTIES = {"attenuation": "K_d [1/m]", "reflectance": "R", "mean_cosine": "mean cosine"}
_LEAST = 1e-5  # of the brightest voxel, that a slice shows


def _flux_figure(result: Result, width: float) -> Figure:
    """A row for each section of `[[flux]]`. Raises `ConfigError` without any."""
    sections = result.scene.flux
    if not sections:
        raise ConfigError("kind = 'flux' needs a result with [[flux]]", source=result.scene.source)
    across = 2 if width > 5.0 else 1
    heights = []
    for section in sections:
        height = 2.7
        if section.positions is None:  # slices as wide as their place
            x, y, z = np.subtract(section.upper, section.lower)
            height = float(np.clip((width / across - 1.5) * max(x, y) / z + 0.75, 1.4, 3.6))
        heights += [height] * (2 // across)
    figure = style.new_figure(width, sum(heights))
    figure.caption(_caption(result))
    axes = figure.subplots(len(heights), across, squeeze=False, height_ratios=heights).reshape(-1, 2)
    for section, (left, right) in zip(sections, axes, strict=True):
        if section.positions is None:
            for axis, planes in ((left, "zx"), (right, "zy")):
                _slice(figure, axis, section.name, result.flux[section.name]["fluence"], planes)
        else:
            _profiles(result, section.name, left, right)
    return figure


def _profiles(result: Result, section: str, left: Axes, right: Axes) -> None:
    """Irradiances over the planes, and what follows from them."""
    light = result.flux[section]["irradiance"]
    position, kinds = light.dimensions["position"][0], light.dimensions["kind"][0]
    for axis in (left, right):
        style.plain_axis(axis)
        axis.set(ylabel="along the axis [m]", ylim=(position[-1], position[0]) if len(position) > 1 else None)
    for k, kind in enumerate(kinds):
        values = np.where(light.values[:, k] > 0, light.values[:, k], np.nan)
        label = kind.replace("_", " ")
        error = None if light.errors is None else light.errors[:, k]
        left.errorbar(values, position, xerr=error, fmt=".-", color=style.SERIES[k], label=label, linewidth=0.9)
    left.set(xlabel=f"irradiance per photon [{light.unit.replace('^2', '²')}]", title=section)
    log_axis(left, "x")
    below: dict[str, Any] = {"fontsize": 6.5, "loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}
    left.legend(**below, ncols=2)
    if light.errors is None:
        style.middle_text(right, "too few batches")
        return
    found = apparent(result, section)
    for k, (name, label) in enumerate(_PROPERTIES.items()):
        places, values = found.middle if name == "attenuation" else found.position, getattr(found, name)
        look: Any = {"fmt": ".-", "color": style.SERIES[k], "label": label, "linewidth": 0.9}
        right.errorbar(values, places, xerr=found.errors[name], **look)
    right.set(xlabel="K_d, R, mean cosine", title="apparent optical properties")
    log_axis(right, "x")
    right.legend(**below, ncols=3)


def middle_plane(light: FluxValues, planes: str) -> tuple[NDArray[np.float64], list[tuple[float, float]]]:
    """Fluence on the middle plane of a volume, gate by gate, and the ends of its sides `planes`, to the right and
    downwards [m]."""
    axis = 1 + next(k for k in range(3) if "xyz"[k] not in planes)
    sides = [np.asarray(light.dimensions[name][0]) for name in planes]
    halves = [0.5 * float(side[1] - side[0]) if len(side) > 1 else 0.5 for side in sides]
    ends = [(float(side[0]) - half, float(side[-1]) + half) for side, half in zip(sides, halves, strict=True)]
    return np.take(light.values, light.values.shape[axis] // 2, axis=axis), ends


def _slice(figure: Figure, axis: Axes, section: str, light: FluxValues, planes: str) -> None:
    """Fluence in all gates on the middle plane across the third axis; z to the right."""
    found, ends = middle_plane(light, planes)
    across = next(name for name in "xyz" if name not in planes)
    axis.set(xlabel=f"{planes[0]} [m]", ylabel=f"{planes[1]} [m]", title=f"{section}, across {across}")
    top = float(light.values.sum(axis=0).max())
    if not top > 0.0:
        style.middle_text(axis, "no light")
        return
    look: Any = {"norm": LogNorm(_LEAST * top, top), "cmap": style.colour_map(INTENSITY_MAP)}
    look |= {"interpolation": "nearest", "extent": (*ends[0], ends[1][1], ends[1][0])}
    shown = axis.imshow(np.maximum(found.sum(axis=0), _LEAST * top), **look)
    figure.colorbar(shown, ax=axis, label="fluence per\nphoton [1/m²]", shrink=0.9)


# Bins wide enough to mean something

_ERROR = 1.0 / 3.0  # relative standard error at which a bin stands alone
_NARROW = 8  # bins that are added up before a group may end for its width


def merged_edges(
    values: NDArray[np.float64], variance: NDArray[np.float64], breaks: Sequence[int] = ()
) -> NDArray[np.intp]:
    """Edges, as indices of bins, of groups that are wide enough to mean something, `[G + 1]`.

    A bin that is known to a third stands alone. The bins between two such bins are added up from the left until their
    sum is known to a third, or until the group is as wide as what lies before it in that stretch. Bins before the first
    and after the last light stay apart, so that light does not seem to come before its time; no group goes across
    `breaks`. `values`, `variance`: `[T]`.
    """
    alone = (values > 0) & (variance <= (_ERROR * values) ** 2)
    filled = np.flatnonzero(values)
    first, last = (int(filled[0]), int(filled[-1]) + 1) if len(filled) else (0, 0)
    ends = alone | np.append(alone[1:], True)  # bins with which a stretch ends
    ends[[edge - 1 for edge in (first, last, *breaks)]] = True
    edges, start, total, error = [0], 0, 0.0, 0.0
    for bin in range(len(values)):
        total, error = total + values[bin], error + variance[bin]
        width, inside = bin + 1 - edges[-1], first <= bin < last
        if ends[bin]:  # what is left over joins the group before it, as a stretch without light does
            if inside and (not total or (start < edges[-1] and width < edges[-1] - edges[-2])):
                edges.pop()
            start = bin + 1
        elif not inside or not (0.0 < error <= (_ERROR * total) ** 2 or width >= max(_NARROW, edges[-1] - start)):
            continue
        edges.append(bin + 1)
        total = error = 0.0
    return np.array(edges, np.intp)


def merged_means(values: NDArray[np.float64], edges: NDArray[np.intp]) -> NDArray[np.float64]:
    """Mean over the bins of each group, `[G]`."""
    return np.add.reduceat(values, edges[:-1]) / np.diff(edges)


# Depth frames


def _frame_figure(
    frames: Frames | FramesFile, number: int, width: float, pixel: tuple[int, int] | None = None
) -> Figure:
    """One frame: of a file depth by its best estimator, its error, the bound; of counts alone the time of the fullest
    bin; intensity; the counts of typical pixels over time."""
    file = frames if isinstance(frames, FramesFile) and frames.best_method is not None else None
    if isinstance(frames, FramesFile):
        shown, index = frames.frame(number), 0
    else:
        shown, index = frames, number
        if not 0 <= number < (1 if frames.summed else frames.frames):
            raise ArgumentError(f"frame = {number} is outside [0, {1 if frames.summed else frames.frames})")
    counts = np.asarray(shown.counts if shown.summed else shown.counts[index])
    intensity = counts.sum(axis=-1)
    on_target = np.isfinite(file.truth_depth) if file is not None else np.zeros(intensity.shape, bool)
    light = (np.asarray(shown.expected) - np.asarray(shown.background) * on_target[..., None]).sum(axis=-1)
    pixels = _typical_pixels(light if light.any() else intensity, None if file is None else file.truth_depth, pixel)
    panels = Panels(intensity.shape, 2 if file is None else 4, width=width, below=(1.7,) * len(pixels))
    hatched = ""
    if file is None:
        edges = 1e9 * (shown.gate_start + shown.edges)
        fullest = np.where(intensity > 0, (0.5 * (edges[:-1] + edges[1:]))[counts.argmax(axis=-1)], np.nan)
        panels.show_depth(fullest, "Fullest bin", shown_limits(fullest), "time of flight [ns]")
    else:
        method: Any = file.best_method
        depth, truth, bound = file.depth(method, number), file.truth_depth, file.bound_depth()
        if file.noise_ratio is not None:
            panels.unclear = noisy = file.noise_ratio > 1.0
            hatched = _NOISY.format(_hatched(noisy)) if noisy.any() else ""
        panels.show_depth(depth, f"Depth ({method})", style.target_limits(truth, depth))
        panels.show_error(depth - truth, "Depth − truth")
        known = "" if np.isfinite(bound).any() else ": unknown"
        panels.show_positive(1e3 * bound, f"Cramér–Rao bound{known}", "standard deviation [mm]")
    panels.show_intensity(intensity, "Intensity", "counts in a frame")
    axes = panels.below()
    for axis, (name, place) in zip(axes, pixels.items(), strict=True):
        _plot_counts(shown, counts, file, axis, name, place)
    if axes:
        panels.figure.key(axes, 1.7)
    which = "all frames added up" if shown.summed else f"frame {shown.first_frame + index}"
    mode = "" if file is None else f", {file.scene.detector.mode.replace('_', '-')}{channel_text(file.channel)}"
    noise = hatched or noise_caption(shown.target_noise_ratio)
    panels.figure.caption(f"{which}: {count(shown.pulses)} pulses{mode}; seed {shown.seed}{noise}")
    return panels.figure


def _plot_counts(
    frames: Frames, counts: NDArray[Any], file: FramesFile | None, axis: Axes, name: str, place: tuple[int, int]
) -> None:
    """Counts of a pixel, their mean, the true arrival."""
    row, column = place
    # Means without dead time and afterpulsing.
    detector = None if file is None else file.scene.detector
    hazard = np.asarray(frames.expected[row, column]).astype(np.float64)
    background = np.broadcast_to(np.asarray(frames.background[row, column]).astype(np.float64), hazard.shape)
    share = np.divide(background, hazard, out=np.zeros_like(hazard), where=hazard > 0)
    pile_up = detector is not None and detector.mode == "first_photon"
    expected = frames.exposure * (first_photon_probabilities(hazard) if pile_up else hazard)
    label = "expected" + ("" if detector else " before pile-up")
    if detector and detector.mode == "free_running" and detector.dead_time_ns > 0:
        label += " without dead time"
    edges = 1e9 * (frames.gate_start + frames.edges)
    counts = counts[row, column]
    axis.stairs(counts, edges, fill=True, color="0.72", label="counts of the frame")
    axis.stairs(expected, edges, baseline=None, color=BLUE, linewidth=1.0, label=label)
    axis.stairs(share * expected, edges, baseline=None, color=style.GREEN, linewidth=0.8, label="background part")
    if file is not None:
        line = lines_of_sight(file.scene)[row, column]
        path = line.path_from_range(line.range_from_depth(file.truth_depth[row, column].astype(np.float64)))
        style.arrival_line(axis, 1e9 * float(path) / file.scene.medium.pulse_speed, edges)
    top = float(max(counts.max(), expected.max(), 1.0))
    scale = "counts per bin"
    if top > max(10.0, 50 * float(np.median(expected))):
        axis.set_yscale("symlog", linthresh=1.0)
        scale += "\n(linear to 1, then log)"
        axis.set_yticks([0] + [10**e for e in range(int(np.log10(top)) + 1)])
        axis.yaxis.set_minor_locator(SymmetricalLogLocator(base=10, linthresh=1.0, subs=range(2, 10)))
    axis.set(xlim=edges[[0, -1]], ylim=(0, 1.3 * top), xlabel="time of flight [ns]", ylabel=scale)
    axis.xaxis.minorticks_on()
    noisy = file is not None and file.noise_ratio is not None and file.noise_ratio[row, column] > 1.0
    text = f"{name}: row {row}, column {column}"
    axis.set_title(text + ("\nnoise of the simulation" if noisy else ""), color="firebrick" if noisy else TEXT)


def _analytic_figure(result: AnalyticResult, width: float) -> Figure:
    frame, labels = (part[0] for part in ((result.depth, result.labels) if len(result.depth) else result.sample(1)))
    truth, analytic = result.truth.depth, result.scene.analytic
    limits = shown_limits(truth, margin=0.05)
    outliers = f", {labels.sum()} outliers" if labels.any() else ""
    ratio, colours = result.signal_to_backscatter, style.PROBABILITY_MAP
    panels = Panels(truth.shape, 6, width=width)
    panels.show_positive(result.signal, "Signal S", "detections per pulse", INTENSITY_MAP)
    panels.show_positive(1e3 * result.sigma_depth, "Cramér–Rao bound σ*", "standard deviation [mm]")
    panels.show_positive(ratio, "Signal to backscatter", "signal over backscatter", INTENSITY_MAP)
    false_peak = np.where(np.isnan(truth), np.nan, result.outlier_probability)
    panels.show(false_peak, "Outlier probability", "probability of a false peak", colours, (0.0, 1.0))
    panels.show_depth(truth, "Truth", limits)
    panels.show_depth(frame, f"A depth frame{outliers}", limits)
    panels.figure.caption(
        f"analytic, {analytic.form} form; water c = {result.scene.medium.extinction:.3g} 1/m; "
        f"backscatter {analytic.backscatter.replace('_', ' ')}; seed {result.seed}"
    )
    return panels.figure


@paper()
def draw_depth(
    image: NDArray[np.float64],
    intensity: NDArray[Any],
    path: str | Path,
    *,
    quantity: Literal["depth", "range"],
    title: str,
    width: float = PAGE,
) -> Path:
    """An image `[H, W]` [m] of "depth" or "range" beside the intensity; returns the path. `width`: [inch]."""
    panels = Panels(image.shape, 2, width=width)
    panels.show_depth(image, title, shown_limits(image, beyond=1.0, weights=intensity), style.LABELS[quantity])
    panels.show_intensity(intensity, "Intensity", "sum over bins")
    return save(panels.figure, path)


@paper()
def draw_denoised(
    noisy: NDArray[np.float32],
    denoised: NDArray[np.float32],
    path: str | Path,
    *,
    gate: tuple[float, float],
    title: str,
    quantity: Literal["depth", "range"] = "depth",
    truth: NDArray[np.float32] | None = None,
    width: float = PAGE,
) -> Path:
    """A frame before and after, depth or, as the `quantity` says, range `[H, W]` [m] each; returns the path.

    With the truth also that, the error, and in colours of their own the pixels in which a target was missed or
    invented, and their parts of the target and of the water: NaN stands for no target. `width`: of the picture [inch].
    """
    if truth is not None and np.isfinite(truth).any():
        low, high = style.target_limits(truth, denoised)
    else:
        low, high = shown_limits(denoised if np.isfinite(denoised).any() else noisy, beyond=1.0)
    limits = max(low, gate[0] - 1.0), min(high, gate[1] + 1.0)
    panels = Panels(noisy.shape, 2 if truth is None else 4, width=width)
    label = style.LABELS[quantity]
    panels.show_depth(noisy, "Input", limits, label)
    if truth is None:
        panels.show_depth(denoised, "Denoised", limits, label)
    else:
        target, found = np.isfinite(truth), np.isfinite(denoised)
        missed, invented = target & ~found, found & ~target
        parts = (some.sum() / max(1, of.sum()) for some, of in ((missed, target), (invented, ~target)))
        label += "\nblack: missed, {} %\nred: invented, {} %".format(*map(percent, parts))
        style.mark_pixels(panels.show_depth(denoised, "Denoised", limits, label), missed, invented)
        panels.show_depth(truth, "Truth", limits)
        panels.show_error(denoised - truth, "Denoised − truth")
    panels.figure.caption(title)
    return save(panels.figure, path)


# A fit

_MOST_POINTS = 160  # bins are added up to at most so many


def _fit_figure(fit: Fit, width: float) -> Figure:
    counts, expected = fit.counts.sum(axis=2), fit.expected.sum(axis=2, dtype=np.float64)
    panels = Panels(counts.shape, 3 if fit.depth is None else 4, width=width, below=(1.6, 0.9))
    panels.show_intensity(counts, "Counts", "counts in the exposure")
    residual = (counts - expected) / np.sqrt(np.maximum(expected, 1e-12))
    residual[expected <= 0] = np.nan
    for image, name, label in (
        (residual, "Residual", "(counts − fit) / √fit"),
        (fit.goodness.pixels, "Deviance", "(deviance − expected) / σ"),
    ):
        reach = max(style.error_limit(image), 1.0)
        panels.show_scaled(image, name, label, style.ERROR_MAP, (-reach, reach))
    if fit.depth is not None:
        panels.show_depth(fit.depth, "Depth", shown_limits(fit.depth))
    top, bottom = panels.below()
    starts = np.arange(0, fit.counts.shape[2], -(-fit.counts.shape[2] // _MOST_POINTS))
    measured, mean = (
        np.add.reduceat(cubes.sum(axis=(0, 1), dtype=np.float64), starts) for cubes in (fit.counts, fit.expected)
    )
    edges = 1e9 * np.append(fit.edges[starts], fit.edges[-1])
    top.stairs(measured, edges, fill=True, color="0.72", label="counts, all pixels")
    top.stairs(mean, edges, baseline=None, color=BLUE, linewidth=1.0, label="fit")
    low = max(0.5, float(mean[mean > 0].min(initial=np.inf))) if mean.any() else 0.5
    top.set(xlim=edges[[0, -1]], ylim=(0.5 * low, 3.0 * max(float(measured.max()), 2.0 * low)), ylabel="counts")
    log_axis(top, "y", most=5)
    top.tick_params(labelbottom=False)
    top.legend(loc="upper right", ncols=2)
    left = (measured - mean) / np.sqrt(np.maximum(mean, 1.0))
    reach = max(3.5, 1.1 * float(np.abs(left).max()))
    factor, unit = style.power_unit(reach)
    bottom.axhline(0.0, color=TEXT, linewidth=0.6)
    bottom.plot(0.5 * (edges[:-1] + edges[1:]), left / factor, ".", color=style.RED, markersize=2.5)
    bottom.set(xlim=edges[[0, -1]], ylim=(-reach / factor, reach / factor), xlabel="time of flight [ns]")
    bottom.set_ylabel(f"residual\n/ √fit{unit}")
    values = [
        f"{item.name} = {rounded(item.value, item.standard_error)} ± {item.standard_error:.2g} {item.unit}".rstrip()
        if np.isfinite(item.value)
        else f"{item.name}: not known"
        for item in fit.estimates.values()
    ]
    good = f"{'BAD FIT: ' * fit.goodness.is_bad}{fit.goodness.summary()}"
    panels.figure.caption("; ".join([good, *values, f"{count(fit.pulses)} pulses"]))
    return panels.figure


# What notebooks show


def progress_bar(unit: str = "photons") -> Callable[[str, int, int], None]:
    """A bar for the argument `progress` of `spadwarp.simulate` and others: one call, one bar.

    In a notebook it is drawn below the cell, elsewhere it is a line of text on standard error.

        spadwarp.simulate(scene, photons=2e6, progress=spadwarp.viz.progress_bar())

    `unit`: what is counted, such as "photons", "frames" or "steps".
    """
    ipython = sys.modules.get("IPython")
    in_notebook = ipython is not None and hasattr(ipython.get_ipython(), "kernel")
    return progress_report(_display() if in_notebook else _print, unit)


def _print(part: float | None, text: str) -> None:
    print(f"\r{text:<79}", end="\n" if part in (None, 1.0) else "", file=sys.stderr, flush=True)


def _display() -> Callable[[float | None, str], None]:
    """Shows a bar below the cell, at first a new one."""
    from IPython.display import HTML, display

    handle: Any = None

    def show(part: float | None, text: str) -> None:
        nonlocal handle
        bar = HTML(f"<progress value='{part or 0.0:.4f}' max='1'></progress> {markup.escape(text)}")
        if handle is None:
            handle = display(bar, display_id=True)
        else:
            handle.update(bar)

    return show


_HIDDEN = ("kind", "timing", "provenance", "counters", "pilot")


def html(shown: Result | Frames | Scene | AnalyticResult | Proposal) -> str:
    """A picture, but not of a proposal, and a table of numbers as HTML, for `_repr_html_`."""
    picture, left, numbers = "", "style='text-align:left'", dict[str, Any]()
    try:
        if not isinstance(shown, Proposal):
            buffer = io.BytesIO()
            plot(shown).savefig(buffer, format="png", dpi=100)
            data = base64.b64encode(buffer.getvalue()).decode("ascii")
            picture = f"<img src='data:image/png;base64,{data}' style='max-width:100%'>"
        numbers = summary(shown)
    except SpadwarpError as error:  # a mesh that is not there, no device
        picture = f"<p>{markup.escape(str(error))}</p>"
    facts = [fact(name, value) for name, value in numbers.items() if name not in _HIDDEN and value not in ({}, [], ())]
    cells = "".join(
        f"<tr><th {left}>{markup.escape(name)}</th><td {left}>{markup.escape(value)}</td></tr>" for name, value in facts
    )
    return f"<div><b>{markup.escape(repr(shown))}</b>{picture}<table>{cells}</table></div>"
