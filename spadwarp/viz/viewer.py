"""A run as one HTML file that any browser shows without a network, `view`, or as a moving picture, `video`."""

from __future__ import annotations

import base64
import shutil
import subprocess
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from spadwarp.arrays import block_sums
from spadwarp.files import Held, load, sequence
from spadwarp.files.formats import FrameSequence
from spadwarp.frames import FramesFile, InstrumentResponse, SequenceFile, detector_response
from spadwarp.io.paths import atomic_path, check_apart
from spadwarp.result import Channel, Result, analyser_channel
from spadwarp.result.analysis import noise_caption
from spadwarp.scene import Scene
from spadwarp.scene.sight import lines_of_sight
from spadwarp.values import ArgumentError, FileError, check_choice, check_integer, check_real, count
from spadwarp.viz import style
from spadwarp.viz.result import channel_text, how_made, middle_plane
from spadwarp.viz.style import PaperFigure, colour_map, median_pixel, paper

__all__ = ["video", "view"]

HISTOGRAM_BYTES = 5_000_000
"""Largest size of the packed histograms [bytes]; with plotly and the images a page stays below 15 MB."""

_DECADES = 7.0
_MOST_BINS = 256  # of reported depths
# Blocks of pixels and of bins that are added up until the histograms fit, the finest first.
_STEPS = ((1, 1), (1, 2), (1, 4), (2, 2), (2, 4), (2, 8), (4, 4), (4, 8), (4, 16), (8, 16), (16, 16), (32, 32))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Page:
    """The content of a page, from a result or from frames of a camera."""

    caption: str
    scene: Scene
    depth: NDArray[Any]
    method: str
    truth: NDArray[Any]
    intensity: NDArray[Any]
    intensity_label: str
    layers: list[dict[str, Any]]  # see `_layer`
    edges: NDArray[np.float64]
    unit: str
    response: InstrumentResponse
    sparse: bool = False  # histograms of few photons
    reflectance: NDArray[Any] | None = None


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
        channel: Of a result: which light counts, see `spadwarp.result.analyser_channel`.
        device: Warp device for the depth frame.

    Raises `FileError`: plotly is not installed, or a file cannot be read or written; `ArgumentError`: no such frame,
    method or channel.
    """
    from plotly.offline import get_plotlyjs

    check_apart(path, source)
    held = source if isinstance(source, Held) else load(source)
    if isinstance(held, SequenceFile):
        raise ArgumentError(f"{held.path} holds a scene that moves: `spadwarp view --out NAME.gif` shows it")
    if isinstance(held, Result):
        page = _of_result(analyser_channel(held, channel), method, device)
    elif channel != "I":
        raise ArgumentError(f"channel = {channel!r}: only results have channels")
    else:
        page = _of_frames(held, method, frame) if isinstance(held, FramesFile) else _of_depth(held, method, frame)
    title = "spadwarp" if page.scene.source is None else Path(page.scene.source).stem
    write_page(path, "viewer.html", title=title, caption=page.caption, data=_data(page), plotly=get_plotlyjs())
    return Path(path)


# Sources


def _layer(label: str, colour: str, cube: NDArray[Any], factor: float = 1.0, *, filled: bool = False) -> dict[str, Any]:
    """Histograms of one kind; the page shows `cube` `[H, W, T]` times `factor`."""
    return {"label": label, "colour": colour, "filled": filled, "factor": factor, "cube": cube}


def _of_result(result: Result, method: str | None, device: Any) -> _Page:
    scene = result.scene
    per_pulse = scene.detectable_photons_per_pulse
    smooth = result.reconstruction
    # In a scan the positions' numbers of photons differ by one at most.
    scale = per_pulse * (float(result.tally_value.mean()) if smooth is None else 1.0)
    cubes = zip(scene.components, result.tallies if smooth is None else smooth.histogram, strict=True)
    chosen: Any = method or "centroid"
    return _Page(
        caption=f"{count(result.photons)} photons{how_made(result)}, seed {result.seed}, {scene.transport.estimator}"
        f"{channel_text(result.provenance.get('channel'))}; expected histograms, before the instrument response",
        scene=scene,
        depth=result.depth(method=chosen, device=device),
        method=chosen,
        truth=result.truth.depth,
        sparse=smooth is None,
        reflectance=result.truth.reflectance,
        intensity=result.intensity * per_pulse,
        intensity_label="detections per pulse",
        layers=[_layer(*style.COMPONENTS[name], cube, scale) for name, cube in cubes],
        edges=result.bin_edges,
        unit="detections per pulse and bin",
        response=detector_response(scene.detector, scene.laser),
    )


def _of_frames(file: FramesFile, method: str | None, frame: int) -> _Page:
    if method is not None and method not in file.methods:
        raise ArgumentError(f"method = {method!r} is not one of {', '.join(file.methods)}, which {file.path} holds")
    counts = file.counts(frame)
    if file.best_method is None:
        raise FileError(f"{file.path}: without depth there is nothing to compare")
    chosen: Any = method or file.best_method
    background = np.broadcast_to(file.background, counts.shape)
    mode = file.scene.detector.mode.replace("_", "-")
    return _Page(
        caption=f"frame {frame} of {file.frames}: {count(file.pulses)} pulses, {mode}, seed {file.seed}; "
        f"expectations before pile-up{noise_caption(file.target_noise_ratio)}",
        scene=file.scene,
        depth=file.depth(chosen, frame),
        method=chosen,
        truth=file.truth_depth,
        intensity=file.intensity(frame),
        intensity_label="counts in the frame",
        layers=[
            _layer("counts", "#999999", counts, filled=True),
            _layer("expected", style.BLUE, file.expected, file.pulses),
            _layer("background part", style.GREEN, background, file.pulses),
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
    counted = "intensity" in shown.images
    return _Page(
        caption=f"frame {frame} of {frames.count}: {shown.content}; histograms are of the depths that the frames of "
        "this scene report",
        scene=shown.scene,
        depth=shown.images["Z"],
        method="stored",
        truth=shown.depth,
        intensity=shown.images["intensity" if counted else "background"],
        intensity_label="recorded photons" if counted else "background photon (1) or return (0)",
        layers=[_layer("frames", "#999999", cube, filled=True)],
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


# The page's data


def _data(page: _Page) -> dict[str, Any]:
    """Everything for the script, arrays packed."""
    depth, truth, intensity = (np.asarray(image, np.float64) for image in (page.depth, page.truth, page.intensity))
    lines, speed = lines_of_sight(page.scene), page.scene.medium.pulse_speed
    laser = np.zeros(3) if lines.bent else lines.laser
    port = [0.0, 0.0]  # what ports add to a path, and to a range [m]; for a laser close to the lens
    if lines.bent:
        both = 2.0 if lines.laser_port is not None else 1.0
        port = [both * float(np.nanmedian(lines.delay)), float(np.nanmedian(lines.lead))]
    cloud = lines.points(lines.range_from_depth(depth))
    histograms, block, merged = _histograms(page.layers)
    edges = np.append(page.edges[:-1:merged], page.edges[-1])
    images = {"depth": depth, "truth": truth, "error": depth - truth, "intensity": intensity}
    images |= {} if page.reflectance is None else {"reflectance": page.reflectance}
    return {
        "shape": list(depth.shape),
        "images": {name: _packed(image) for name, image in images.items()},
        "cloud": [_packed(cloud[..., axis]) for axis in range(3)],
        "arrival": _packed(1e9 * (lines.path_from_range(lines.range_from_depth(truth)) / speed)),
        "towards": _packed(lines.direction @ laser),
        "laser": float(laser @ laser),
        "port": port,
        "speed": 1e-9 * speed,
        "method": page.method,
        "intensityLabel": page.intensity_label,
        "histograms": histograms,
        "block": block,
        "merged": merged,
        "edges": [round(1e9 * float(edge), 6) for edge in edges],
        "unit": page.unit,
        "sparse": page.sparse,
        "response": _response(page.response),
        "first": median_pixel(intensity, np.isfinite(depth) & np.isfinite(truth)),
    }


def _histograms(layers: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], int, int]:
    """The layers, packed within `HISTOGRAM_BYTES`; the side of a block of pixels; bins that were merged."""
    for block, merged in _STEPS:
        rows = max(layers[0]["cube"].shape[0] // 16, block) // block * block
        sizes = block, block, merged
        trial = sum(len(_pack(block_sums(layer["cube"][:rows], sizes), layer)["codes"]) for layer in layers)
        if trial * layers[0]["cube"].shape[0] / rows > 1.5 * HISTOGRAM_BYTES:
            continue  # far too large, as a part of the rows shows
        packed = [_pack(block_sums(layer["cube"], sizes), layer) for layer in layers]
        if sum(len(layer["codes"]) for layer in packed) <= HISTOGRAM_BYTES / 3 * 4:
            break
    return packed, block, merged


def _pack(values: NDArray[Any], layer: dict[str, Any]) -> dict[str, Any]:
    """Counts below 65536 as they are, other values as their logarithm in 254 steps; deflated."""
    metadata = {name: value for name, value in layer.items() if name != "cube"}
    high = float(values.max())
    if layer["filled"] and high < 65536:
        return {**metadata, "kind": "whole", "codes": _packed(values, "<u2")}
    lowest = high * 10.0**-_DECADES
    codes = np.zeros(values.shape, dtype=np.uint8)
    valid = values > lowest
    codes[valid] = 1 + np.round(254.0 / _DECADES * np.log10(values[valid] / lowest)).astype(np.uint8)
    return {**metadata, "kind": "log", "lowest": lowest, "decades": _DECADES, "codes": _packed(codes, "u1")}


def _packed(values: NDArray[Any], kind: str = "<f4") -> str:
    """The values, deflated, as text."""
    return base64.b64encode(zlib.compress(values.astype(kind).tobytes(), 6)).decode("ascii")


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


def write_page(path: str | Path, template: str, **values: Any) -> None:
    """Writes a page of its own: values are escaped except where the template says `safe`. Raises `FileError`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    pages = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined)
    pages.policies["json.dumps_kwargs"] = {}  # keys stay in their order
    text = pages.get_template(template).render(values)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


# Moving pictures

_VIDEO_DECADES = 4.0  # of the logarithmic colour scale
_DPI = 140


def video(
    source: Held | str | Path,
    path: str | Path = "light.gif",
    *,
    window_ns: tuple[float, float] | None = None,
    pictures: int = 120,
    fps: float = 12.0,
    scale: Literal["log", "linear"] = "log",
    frame: int = 0,
    flux: str | None = None,
) -> Path:
    """Writes what each pixel receives, bin after bin, as an animated GIF or an MP4; returns its path.

    Every picture is a time of flight: first backscatter, then the target from near to far; or with `flux` a gate, in
    which the front of the light goes through the water. All pictures have one colour scale, whose upper end is the
    99.9th percentile of the values above zero.

    Args:
        source: What `spadwarp.load` returns, or a path that it takes. Of an analytic file or a dataset, the frames of
            one scene that report a time. Of a scene that moves, true depth, measured depth and counts, frame by frame.
        path: Ends in `.gif`, or in `.mp4`, which needs ffmpeg: on the PATH, or by `pip install 'spadwarp[video]'`.
        window_ns: Times of flight from and to [ns]; default: from the first to the last light of the gate.
        pictures: Largest number of pictures; bins are merged where there are more.
        fps: Pictures per second.
        scale: "log" over four decades, or "linear".
        frame: Number of the frame, from 0, where the source holds frames.
        flux: Of a result: name of a volume of `[[flux]]` with gates, shown on its middle plane across the edge with
            fewest voxels.

    Raises `ArgumentError`: an argument out of range, or another ending; `FileError`: a file cannot be read or written,
    or ffmpeg is missing.
    """
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise ArgumentError(f"path = {str(path)!r} ends neither in .gif nor in .mp4")
    pictures, fps = check_integer("pictures", pictures, "[1, 1000000]"), check_real("fps", fps, "[0.01, 50] 1/s")
    check_choice("scale", scale, ("log", "linear"))
    check_apart(path, source)
    held = source if isinstance(source, Held) else load(source)
    if isinstance(held, SequenceFile):
        drawn = _of_sequence(held, pictures)
    else:
        if flux is None:
            (cube, edges, label, metres_per_ns), sides = _light(held, frame), None
        else:
            cube, edges, label, metres_per_ns, sides = _front(held, flux)
        kept = _window(cube, edges, window_ns)
        cube, edges = cube[:, :, kept], edges[kept.start : kept.stop + 1]
        merged = -(-cube.shape[2] // pictures)
        cube, edges = block_sums(cube, (1, 1, merged)), np.append(edges[:-1:merged], edges[-1])
        label += " and picture" if merged > 1 else " and bin"
        drawn = _of_light(cube, edges, label, metres_per_ns, scale, sides)
    with atomic_path(path) as temporary:
        (_write_gif if path.suffix.lower() == ".gif" else _write_mp4)(drawn, temporary, fps)
    return path


def _light(run: Held, frame: int) -> tuple[NDArray[np.float64], NDArray[np.float64], str, float]:
    """Histograms `[H, W, T]`, edges [ns], what they count, metres of path per ns."""
    cube: NDArray[Any]
    if isinstance(run, Result):
        cube = run.expected() * run.scene.detectable_photons_per_pulse
        return cube, 1e9 * run.bin_edges, "detections per pulse, pixel", 1e-9 * run.pulse_speed
    scene: Any
    if isinstance(run, FramesFile):
        cube, edges, scene, what = run.counts(frame), run.gate_start + run.edges, run.scene, "counts"
    else:
        frames = sequence(run)
        (cube, edges), scene, what = reported_depths(frames, frame), frames.at(frame).scene, "frames"
    return cube.astype(np.float64), 1e9 * edges, f"{what} per pixel", 1e-9 * scene.medium.pulse_speed


def _front(run: Held, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64], str, float, dict[str, Any]]:
    """As `_light`, with the fluence on the middle plane of a volume, and its sides, see `_screen`."""
    volumes = {one.name: one for one in run.scene.flux if one.gates > 1} if isinstance(run, Result) else {}
    if not isinstance(run, Result) or name not in volumes:
        raise ArgumentError(f"flux = {name!r} is no volume with gates; the source has {', '.join(volumes) or 'none'}")
    light, volume = run.flux[name]["fluence"], volumes[name]
    across = min("yxz", key=lambda axis: len(light.dimensions[axis][0]))
    planes = {"x": "zy", "y": "zx", "z": "yx"}[across]
    cube, ends = middle_plane(light, planes)
    edges = volume.gate_start_ns + 1e-3 * (volume.gate_width_ps or 0.0) * np.arange(volume.gates + 1, dtype=np.float64)
    sides = dict(zip(planes, ends, strict=True))
    return np.moveaxis(cube, 0, -1), edges, "fluence [1/m²] per photon", 1e-9 * run.pulse_speed, sides


def _window(cube: NDArray[np.float64], edges: NDArray[np.float64], window_ns: tuple[float, float] | None) -> slice:
    """The bins of a window [ns], or those from the first to the last with light in them."""
    if window_ns is not None:
        window_ns = (check_real("window_ns", window_ns[0]), check_real("window_ns", window_ns[1]))
        first, last = (int(np.searchsorted(edges, time, side="right")) - 1 for time in window_ns)
        first, last = max(first, 0), min(max(last, 0), len(edges) - 2)
        if not window_ns[0] < window_ns[1] or window_ns[0] >= edges[-1] or window_ns[1] <= edges[0]:
            raise ArgumentError(f"window_ns = {window_ns} is not in the gate, {edges[0]:.5g} to {edges[-1]:.5g} ns")
        return slice(first, last + 1)
    filled = np.flatnonzero(cube.any(axis=(0, 1)))
    return slice(int(filled[0]), int(filled[-1]) + 1) if len(filled) else slice(0, cube.shape[2])


@paper()
def _screen(
    shape: tuple[int, ...], images: Sequence[tuple[str, Normalize, Colormap, str]], width: float, sides: Any = None
) -> tuple[PaperFigure, list[AxesImage]]:
    """The figure of all pictures, and its images; of each its title, scale, colours and label. `sides`: of a plane in
    the world, to the right and downwards, from and to [m]."""
    (wide, (left, right)), (high, (top, bottom)) = (sides or {"": (0, shape[1]), " ": (0, shape[0])}).items()
    image_height = float(np.clip((width - 0.3) / len(images) * (bottom - top) / (right - left), 0.9, 6.0))
    figure = style.new_figure(width, image_height + 1.0)
    axes, bars = figure.subplots(2, len(images), squeeze=False, height_ratios=[image_height, 0.1])
    drawn = []
    for axis, bar, (title, scale, colours, label) in zip(axes, bars, images, strict=True):
        axis.set(title=title, xlabel=f"{wide} [m]", ylabel=f"{high} [m]")
        if sides is None:
            axis.set(xticks=[], yticks=[], xlabel="", ylabel="")
        extent = (left, right, bottom, top)
        drawn.append(axis.imshow(np.zeros(shape[:2]), cmap=colours, norm=scale, extent=extent))
        figure.colorbar(drawn[-1], cax=bar, orientation="horizontal", label=label, extend="both")
        if not isinstance(scale, LogNorm):
            bar.locator_params(axis="x", nbins=4)  # counts may have five digits
    return figure, drawn


def _pictures(figure: PaperFigure, count: int, show: Callable[[int], str]) -> Iterator[NDArray[np.uint8]]:
    """RGB pictures, one after the other; `show` puts into the figure what changes and returns the title."""
    figure.set_dpi(_DPI)
    canvas = FigureCanvasAgg(figure)
    with paper():
        title = figure.suptitle(" ")
    for index in range(count):
        title.set_text(show(index))
        canvas.draw()
        if index == 0:
            figure.set_layout_engine("none")  # computed once, so that nothing moves between pictures
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _of_light(
    cube: NDArray[np.float64],
    edges: NDArray[np.float64],
    label: str,
    metres_per_ns: float,
    scale: str,
    sides: dict[str, Any] | None,
) -> Iterator[NDArray[np.uint8]]:
    """A picture for each bin."""
    values = cube[cube > 0]
    top = float(np.percentile(values, 99.9)) if values.size else 1.0
    norm = LogNorm(top * 10.0**-_VIDEO_DECADES, top) if scale == "log" else Normalize(0.0, top)
    shown = [("", norm, colour_map(style.LIGHT_MAP, missing="black"), label)]
    figure, (image,) = _screen(cube.shape, shown, 3.9, sides)

    def show(index: int) -> str:
        image.set_data(cube[:, :, index])
        middle = 0.5 * (edges[index] + edges[index + 1])
        return f"time of flight {middle:.2f} ns, path {middle * metres_per_ns:.2f} m"

    return _pictures(figure, cube.shape[2], show)


def _of_sequence(file: SequenceFile, most: int) -> Iterator[NDArray[np.uint8]]:
    """True depth, measured depth and counts of evenly chosen frames, at most `most`; all have the same scales."""
    method = file.best_method
    chosen = range(0, file.frames, -(-file.frames // most))
    truth = np.array([file.truth(number).depth for number in chosen])
    counts = np.array([file.counts(number).sum(axis=-1, dtype=np.int64) for number in chosen])
    near, far = style.shown_limits(truth, margin=0.1)
    depth = Normalize(near - 0.05, far + 0.05)
    light = Normalize(0.0, max(1.0, float(np.percentile(counts, 99.5))))
    shown = [(f"{name} depth", depth, colour_map(style.DEPTH_MAP), "depth z [m]") for name in ("true", "measured")]
    shown.append(("counts", light, colour_map(style.INTENSITY_MAP), "counts per pixel"))
    figure, images = _screen(truth.shape[1:], shown, 7.2)

    def show(index: int) -> str:
        number = chosen[index]
        measured = np.full(truth[index].shape, np.nan) if method is None else file.depth(method, number)
        for image, values in zip(images, (truth[index], measured, counts[index]), strict=True):
            image.set_data(values)
        return f"frame {number}, {file.trajectory.times[number]:.4g} s"

    return _pictures(figure, len(chosen), show)


def _write_gif(pictures: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> None:
    from PIL import Image

    frames: list[Any] = []
    palette = None
    for picture in pictures:
        image = Image.fromarray(picture)
        # One palette for all pictures, from the colour bar in the first, so that colours do not flicker.
        palette = image.quantize(255, Image.Quantize.MAXCOVERAGE) if palette is None else palette
        frames.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    options: dict[str, Any] = {"duration": round(1000 / fps), "loop": 0, "optimize": False}
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], **options)


def _write_mp4(pictures: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> None:
    program = shutil.which("ffmpeg")
    if program is None:
        try:
            from imageio_ffmpeg import get_ffmpeg_exe
        except ModuleNotFoundError as error:
            raise FileError("an MP4 needs ffmpeg: pip install 'spadwarp[video]', or write a .gif") from error
        program = get_ffmpeg_exe()
    first = next(pictures)
    size = f"{first.shape[1]}x{first.shape[0]}"
    command = [program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(fps)]
    # Players need even sides and colours at half resolution.
    command += ["-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-pix_fmt", "yuv420p"]
    command += ["-movflags", "+faststart", "-f", "mp4", str(path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None and process.stderr is not None
    try:
        process.stdin.write(first.tobytes())
        for picture in pictures:
            process.stdin.write(picture.tobytes())
        process.stdin.close()
    except BrokenPipeError:
        pass  # ffmpeg's message follows
    message = process.stderr.read().decode(errors="replace").strip()
    process.stderr.close()
    if process.wait() != 0:
        raise FileError(f"{path}: ffmpeg failed: {message}")
