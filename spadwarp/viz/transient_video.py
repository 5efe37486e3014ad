"""Light in flight as a moving picture: `video`."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.text import Text
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.files import Held, load, sequence
from spadwarp.frames import FramesFile
from spadwarp.frames.file import SequenceFile
from spadwarp.io.paths import atomic_path, check_apart
from spadwarp.limits import check_choice, check_integer, check_real
from spadwarp.result import Result
from spadwarp.viz.moving_pictures import moving_pictures
from spadwarp.viz.style import LIGHT_MAP, colour_map, new_figure, paper
from spadwarp.viz.viewer import reported_depths

__all__ = ["video"]

_DECADES = 4.0  # of the logarithmic colour scale
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
) -> Path:
    """Writes what each pixel receives, bin after bin, as an animated GIF or an MP4; returns its path.

    Every picture is a time of flight: first backscatter, then the target from near to far. All pictures have one colour
    scale, whose upper end is the 99.9th percentile of the values above zero.

    Args:
        source: What `spadwarp.load` returns, or a path that it takes. Of an analytic file or a dataset, the frames of
            one scene that report a time. Of a scene that moves, true depth, measured depth and counts, frame by frame.
        path: Ends in `.gif`, or in `.mp4`, which needs ffmpeg: on the PATH, or by `pip install 'spadwarp[video]'`.
        window_ns: Times of flight from and to [ns]; default: from the first to the last light of the gate.
        pictures: Largest number of pictures; bins are merged where there are more.
        fps: Pictures per second.
        scale: "log" over four decades, or "linear".
        frame: Number of the frame, from 0, where the source holds frames.

    Raises:
        ArgumentError: An argument out of range, or another ending.
        FileError: A file cannot be read or written, or ffmpeg is missing.
    """
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise ArgumentError(f"path = {str(path)!r} ends neither in .gif nor in .mp4")
    pictures, fps = check_integer("pictures", pictures, "[1, 1000000]"), check_real("fps", fps, "[0.01, 50]")
    check_choice("scale", scale, ("log", "linear"))
    check_apart(path, source)
    source = source if isinstance(source, Held) else load(source)
    if isinstance(source, SequenceFile):
        _write(moving_pictures(source, pictures), path, fps)
        return path
    cube, edges, label, metres_per_ns = _light(source, frame)
    kept = _window(cube, edges, window_ns)
    cube, edges = cube[:, :, kept], edges[kept.start : kept.stop + 1]
    merged = -(-cube.shape[2] // pictures)
    starts = np.arange(0, cube.shape[2], merged)
    cube = np.add.reduceat(cube, starts, axis=2)
    edges = np.append(edges[starts], edges[-1])
    label += " and picture" if merged > 1 else " and bin"
    _write(_pictures(cube, edges, label, metres_per_ns, scale), path, fps)
    return path


def _write(drawn: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> None:
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with atomic_path(path) as temporary:
        write(drawn, temporary, fps)


def _light(source: Held | str | Path, frame: int) -> tuple[NDArray[np.float64], NDArray[np.float64], str, float]:
    """Histograms `[H, W, T]`, edges [ns], what they count, metres of path per ns."""
    run = source if isinstance(source, Held) else load(source)
    if isinstance(run, Result):
        return run.detections, 1e9 * run.bin_edges, "detections per pulse, pixel", 1e-9 * run.pulse_speed
    if not isinstance(run, FramesFile):
        frames = sequence(run)
        reported, times = reported_depths(frames, frame)
        scene = frames.at(frame).scene
        assert scene is not None
        return reported.astype(np.float64), 1e9 * times, "frames per pixel", 1e-9 * scene.medium.pulse_speed
    counts, edges = run.counts(frame).astype(np.float64), 1e9 * (run.gate_start + run.edges)
    return counts, edges, "counts per pixel", 1e-9 * run.scene.medium.pulse_speed


def _window(cube: NDArray[np.float64], edges: NDArray[np.float64], window_ns: tuple[float, float] | None) -> slice:
    """The bins of a window [ns], or those from the first to the last with light in them."""
    if window_ns is not None:
        window_ns = (check_real("window_ns", window_ns[0]), check_real("window_ns", window_ns[1]))
        first, last = (int(np.searchsorted(edges, time, side="right")) - 1 for time in window_ns)
        first, last = max(first, 0), min(max(last, 0), len(edges) - 2)
        if not window_ns[0] < window_ns[1] or window_ns[0] >= edges[-1] or window_ns[1] <= edges[0]:
            raise ArgumentError(
                f"window_ns = {window_ns} has no part of the gate, {edges[0]:.5g} to {edges[-1]:.5g} ns"
            )
        return slice(first, last + 1)
    filled = np.flatnonzero(cube.any(axis=(0, 1)))
    return slice(int(filled[0]), int(filled[-1]) + 1) if len(filled) else slice(0, cube.shape[2])


def _pictures(
    cube: NDArray[np.float64],
    edges: NDArray[np.float64],
    label: str,
    metres_per_ns: float,
    scale: str,
) -> Iterator[NDArray[np.uint8]]:
    """RGB pictures, one after the other."""
    figure, image, title = _figure(cube, label, scale)
    canvas = FigureCanvasAgg(figure)
    for index in range(cube.shape[2]):
        image.set_data(cube[:, :, index])
        middle = 0.5 * (edges[index] + edges[index + 1])
        title.set_text(f"time of flight {middle:.2f} ns, path {middle * metres_per_ns:.2f} m")
        canvas.draw()
        if index == 0:
            figure.set_layout_engine("none")  # computed once, so that nothing moves between pictures
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


@paper()
def _figure(cube: NDArray[np.float64], label: str, scale: str) -> tuple[Figure, AxesImage, Text]:
    """The figure of all pictures, with what changes between them."""
    height, width = cube.shape[:2]
    values = cube[cube > 0]
    top = float(np.percentile(values, 99.9)) if values.size else 1.0
    norm = LogNorm(top * 10.0**-_DECADES, top) if scale == "log" else Normalize(0.0, top)
    colours = colour_map(LIGHT_MAP).with_extremes(bad="black", under="black")
    image_height = float(np.clip(3.6 * height / width, 1.1, 6.5))
    figure = new_figure(3.9, image_height + 0.95)
    figure.set_dpi(_DPI)
    axes, bar = figure.subplots(2, 1, height_ratios=[image_height, 0.1])
    axes.set(xticks=[], yticks=[])
    image = axes.imshow(np.zeros((height, width)), cmap=colours, norm=norm)
    figure.colorbar(image, cax=bar, orientation="horizontal", label=label, extend="both" if scale == "log" else "max")
    return figure, image, axes.set_title(" ")


def _write_gif(pictures: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> None:
    from PIL import Image

    frames: list[Any] = []
    palette = None
    for picture in pictures:
        image = Image.fromarray(picture)
        # One palette for all pictures, from the colour bar in the first, so that colours do not flicker.
        palette = image.quantize(255) if palette is None else palette
        frames.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=round(1000 / fps), loop=0, optimize=False
    )


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
