"""A run as one HTML file that any browser shows without a network: `view`."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.files import Held, load, sequence
from spadwarp.frames import FramesFile, InstrumentResponse, detector_response
from spadwarp.frames.export import FrameSequence
from spadwarp.frames.monte_carlo_noise import noise_caption
from spadwarp.frames.sequence_file import SequenceFile
from spadwarp.io.paths import check_apart
from spadwarp.result import Channel, Result, received
from spadwarp.scene import Scene
from spadwarp.scene.sight import LinesOfSight, lines_of_sight
from spadwarp.viz import style
from spadwarp.viz.pages import write_page
from spadwarp.viz.panels import median_pixel
from spadwarp.viz.result import channel_text

__all__ = ["HISTOGRAM_BYTES", "reported_depths", "view"]

HISTOGRAM_BYTES = 5_000_000
"""Largest size of the packed histograms [bytes]; with plotly and the images a page stays below 15 MB."""

_DECADES = 7.0
_MOST_BINS = 256  # of reported depths
# Blocks of pixels and of bins that are added up until the histograms fit, the finest first.
_STEPS = ((1, 1), (1, 2), (1, 4), (2, 2), (2, 4), (2, 8), (4, 4), (4, 8), (4, 16), (8, 16), (16, 16), (32, 32))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Layer:
    """Histograms of one kind; the page shows `cube` `[H, W, T]` times `factor`."""

    label: str
    colour: str
    cube: NDArray[Any]
    factor: float
    filled: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class _Page:
    """The content of a page, from a result or from frames of a camera."""

    title: str
    caption: str
    scene: Scene
    depth: NDArray[np.float64]
    method: str
    truth: NDArray[np.float64]
    reflectance: NDArray[np.float64] | None
    intensity: NDArray[np.float64]
    intensity_label: str
    layers: list[_Layer]
    edges: NDArray[np.float64]
    unit: str
    response: InstrumentResponse


def view(
    source: Held | str | Path,
    path: str | Path = "view.html",
    *,
    method: str | None = None,
    frame: int = 0,
    channel: Channel = "I",
    device: Any = None,
) -> Path:
    """Writes one self-contained HTML file; returns its path.

    It shows the depth frame as a point cloud coloured by its error, the depth frame, its truth, error and intensity as
    images, and the histogram of the pixel that is clicked on: a result's components, in wider bins where light is
    sparse, or counts of a frame with their expectation and background, with the instrument response; where there is
    depth alone, the depths that the frames of one scene report. `view.html#row,column` opens on a pixel. Histograms
    are kept to 7 decades and 7 %, counts exactly; where they would take more than `HISTOGRAM_BYTES`, bins and then
    blocks of pixels are averaged, and the page says so.

    Args:
        source: What `spadwarp.load` returns, or a path that it takes: a result, frames, an analytic file, a dataset.
        path: The file to write.
        method: Estimator of depth; default: "centroid" for a result, the last of the file for frames.
        frame: Number of the frame, from 0, where the source holds frames.
        channel: Of a result: which light counts, see `spadwarp.result.received`.
        device: Warp device for the depth frame.

    Raises:
        FileError: plotly is not installed, or a file cannot be read or written.
        ArgumentError: No such frame, method or channel.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ModuleNotFoundError as error:
        raise FileError("a page needs plotly: pip install 'spadwarp[view]'") from error
    check_apart(path, source)
    held = source if isinstance(source, Held) else load(source)
    if isinstance(held, SequenceFile):
        raise ArgumentError(
            f"{held.path} holds a scene that moves: `spadwarp view --out NAME.gif` shows it, frame by frame"
        )
    if isinstance(held, Result):
        page = _of_result(received(held, channel), method, device)
    elif channel != "I":
        raise ArgumentError(f"channel = {channel!r}: only results have channels")
    else:
        page = _of_frames(held, method, frame) if isinstance(held, FramesFile) else _of_depth(held, method, frame)
    write_page(path, "viewer.html", title=page.title, caption=page.caption, data=_data(page), plotly=get_plotlyjs())
    return Path(path)


# Sources


def _of_result(result: Result, method: str | None, device: Any) -> _Page:
    scene = result.scene
    per_pulse = scene.laser.photons_per_pulse * scene.detections_per_photon
    # In a scan the positions' numbers of photons differ by one at most.
    scale = float(result.tally_value.mean()) * per_pulse
    chosen: Any = method or "centroid"
    return _Page(
        title=_name(scene),
        caption=f"{style.spaced(result.photons)} photons, seed {result.seed}, {scene.transport.estimator}"
        + (", interrupted" if result.partial else "")
        + channel_text(result.provenance.get("channel"))
        + "; expected histograms, before the instrument response",
        scene=scene,
        depth=result.depth(method=chosen, device=device),
        method=chosen,
        truth=result.truth.depth.astype(np.float64),
        reflectance=result.truth.reflectance.astype(np.float64),
        intensity=result.intensity * per_pulse,
        intensity_label="detections per pulse",
        layers=[
            _Layer(label=label, colour=colour, cube=cube, factor=scale)
            for (label, colour), cube in zip(style.COMPONENTS.values(), result.tallies, strict=True)
        ],
        edges=result.bin_edges,
        unit="detections per pulse and bin",
        response=detector_response(scene.detector, scene.laser),
    )


def _of_frames(file: FramesFile, method: str | None, frame: int) -> _Page:
    if method is not None and method not in file.methods:
        raise ArgumentError(f"method = {method!r} is not one of {', '.join(file.methods)}, which {file.path} holds")
    counts = file.counts(frame)
    if file.expected is None or file.background is None or file.best_method is None:
        raise FileError(f"{file.path}: without expected counts and depth there is nothing to compare")
    chosen: Any = method or file.best_method
    background = np.broadcast_to(file.background, counts.shape)
    mode = file.scene.detector.mode.replace("_", "-")
    return _Page(
        title=_name(file.scene),
        caption=f"frame {frame} of {file.frames}: {style.spaced(file.pulses)} pulses, {mode}, seed {file.seed}; "
        f"expectations before pile-up{noise_caption(file.monte_carlo_noise)}",
        scene=file.scene,
        depth=file.depth(chosen, frame).astype(np.float64),
        method=chosen,
        truth=file.truth_depth.astype(np.float64),
        reflectance=None,
        intensity=file.intensity(frame).astype(np.float64),
        intensity_label="counts in the frame",
        layers=[
            _Layer(label="counts", colour="#999999", cube=counts, factor=1.0, filled=True),
            _Layer(label="expected", colour=style.BLUE, cube=file.expected, factor=file.pulses),
            _Layer(label="background part", colour=style.GREEN, cube=background, factor=file.pulses),
        ],
        edges=file.gate_start + file.edges,
        unit="counts per bin",
        response=file.irf,
    )


def _of_depth(held: Held, method: str | None, frame: int) -> _Page:
    """Depth frames without counts."""
    frames = sequence(held)
    if method is not None:
        raise ArgumentError(f"method = {method!r}: {frames.name} holds depth, not histograms")
    shown = frames.at(frame)
    assert shown.scene is not None and shown.depth is not None
    cube, edges = reported_depths(frames, frame)
    return _Page(
        title=_name(shown.scene),
        caption=f"frame {frame} of {frames.count}: {shown.content}; histograms are of the depths that the frames of "
        "this scene report",
        scene=shown.scene,
        depth=shown.images["Z"].astype(np.float64),
        method="stored",
        truth=shown.depth.astype(np.float64),
        reflectance=None,
        intensity=shown.images.get("intensity", shown.images["background"]).astype(np.float64),
        intensity_label="recorded photons" if "intensity" in shown.images else "background photon (1) or return (0)",
        layers=[_Layer(label="frames", colour="#999999", cube=cube, factor=1.0, filled=True)],
        edges=edges,
        unit="frames per bin",
        response=detector_response(shown.scene.detector, shown.scene.laser),
    )


def reported_depths(frames: FrameSequence, frame: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How many frames of a frame's scene report a time of flight, `[H, W, T]`, and the bins' edges [s]."""
    scene = frames.at(frame).scene
    assert scene is not None and frames.same_scene is not None
    bins = min(scene.gate.bins, _MOST_BINS)
    edges = np.linspace(scene.gate.start, scene.gate.stop, bins + 1)
    lines = lines_of_sight(scene)
    cube = np.zeros((scene.camera.height * scene.camera.width, bins), np.int64)
    pixels = np.arange(len(cube))
    for number in frames.same_scene(frame):
        path = lines.path_from_range(lines.range_from_depth(frames.frame(number).images["Z"].astype(np.float64)))
        place = (path / scene.medium.pulse_speed - edges[0]) / (edges[1] - edges[0])
        known = np.isfinite(place.ravel())
        cube[pixels[known], np.clip(place.ravel()[known], 0, bins - 1).astype(np.intp)] += 1
    return cube.reshape(scene.camera.height, scene.camera.width, bins), edges


def _name(scene: Scene) -> str:
    return "spadwarp" if scene.source is None else Path(scene.source).stem


# The page's data


def _port_shifts(lines: LinesOfSight) -> list[float]:
    """Of the axis of ranges: what ports add to a path, and to a range [m]; for a laser close to the lens."""
    if not lines.bent:
        return [0.0, 0.0]
    both = 2.0 if lines.laser_port is not None else 1.0
    return [both * float(np.nanmedian(lines.delay)), float(np.nanmedian(lines.lead))]


def _data(page: _Page) -> dict[str, Any]:
    """Everything for the script, arrays packed."""
    scene = page.scene
    lines = lines_of_sight(scene)
    laser = np.zeros(3) if lines.bent else lines.laser
    path = lines.path_from_range(lines.range_from_depth(page.truth))
    arrival = path / scene.medium.pulse_speed
    cloud = lines.points(lines.range_from_depth(page.depth))
    histograms, block, merged = _histograms(page.layers)
    edges = page.edges[::merged]
    if edges[-1] != page.edges[-1]:
        edges = np.append(edges, page.edges[-1])
    images = {"depth": page.depth, "truth": page.truth, "error": page.depth - page.truth, "intensity": page.intensity}
    if page.reflectance is not None:
        images["reflectance"] = page.reflectance
    return {
        "shape": list(page.depth.shape),
        "images": {name: _packed(image, "<f4") for name, image in images.items()},
        "cloud": [_packed(cloud[..., axis], "<f4") for axis in range(3)],
        "arrival": _packed(1e9 * arrival, "<f4"),
        "towards": _packed(lines.direction @ laser, "<f4"),
        "laser": float(laser @ laser),
        "port": _port_shifts(lines),
        "speed": 1e-9 * scene.medium.pulse_speed,
        "method": page.method,
        "intensityLabel": page.intensity_label,
        "histograms": histograms,
        "block": block,
        "merged": merged,
        "edges": [round(1e9 * float(edge), 6) for edge in edges],
        "unit": page.unit,
        "sparse": not any(layer.filled for layer in page.layers),
        "response": _response(page.response),
        "first": median_pixel(page.intensity, np.isfinite(page.depth) & np.isfinite(page.truth)),
    }


def _histograms(layers: list[_Layer]) -> tuple[list[dict[str, Any]], int, int]:
    """The layers, packed within `HISTOGRAM_BYTES`; the side of a block of pixels; bins that were merged."""
    for block, merged in _STEPS:
        rows = max(layers[0].cube.shape[0] // 16, block) // block * block
        trial = sum(len(_pack(_reduced(layer.cube[:rows], block, merged), layer)["codes"]) for layer in layers)
        if trial * layers[0].cube.shape[0] / rows > 1.5 * HISTOGRAM_BYTES:
            continue  # far too large, as a part of the rows shows
        packed = [_pack(_reduced(layer.cube, block, merged), layer) for layer in layers]
        if sum(len(layer["codes"]) for layer in packed) <= HISTOGRAM_BYTES / 3 * 4:
            break
    return packed, block, merged


def _reduced(cube: NDArray[Any], block: int, merged: int) -> NDArray[Any]:
    """Sums over blocks of pixels and bins; those at the ends may be smaller."""
    for axis, step in ((2, merged), (1, block), (0, block)):
        if step > 1:
            cube = np.add.reduceat(cube, np.arange(0, cube.shape[axis], step), axis=axis)
    return cube


def _pack(values: NDArray[Any], layer: _Layer) -> dict[str, Any]:
    """Counts below 65536 as they are, other values as their logarithm in 254 steps; deflated."""
    metadata = {"label": layer.label, "colour": layer.colour, "filled": layer.filled, "factor": layer.factor}
    high = float(values.max())
    if layer.filled and high < 65536:
        return {**metadata, "kind": "whole", "codes": _deflated(values.astype("<u2"))}
    lowest = high * 10.0**-_DECADES
    codes = np.zeros(values.shape, dtype=np.uint8)
    valid = values > lowest
    codes[valid] = 1 + np.round(254.0 / _DECADES * np.log10(values[valid] / lowest)).astype(np.uint8)
    return {**metadata, "kind": "log", "lowest": lowest, "decades": _DECADES, "codes": _deflated(codes)}


def _packed(values: NDArray[Any], kind: str) -> str:
    return _deflated(values.astype(kind))


def _deflated(values: NDArray[Any]) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 6)).decode("ascii")


def _response(response: InstrumentResponse) -> dict[str, list[float]] | None:
    """The response over the delay [ns], its peak 1; None for one without width."""
    low, high = response.support
    if not high > low or (response.times is None and response.sigma == response.tail == 0.0):
        return None
    delays = np.linspace(low, high, 241)
    density = response.density(delays)
    kept = density > 1e-3 * density.max()
    return {
        "delay": [round(1e9 * float(delay), 6) for delay in delays[kept]],
        "value": [round(float(value), 5) for value in density[kept] / density.max()],
    }
