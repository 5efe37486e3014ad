"""Frames of any source in the formats of other programs: NumPy, MATLAB, PicoQuant, EXR."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.io.arrays import write_exr
from spadwarp.io.paths import atomic_path
from spadwarp.io.text import write_text
from spadwarp.limits import check_integer
from spadwarp.scene import Scene
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import truth_maps
from spadwarp.units import time_from_path

__all__ = ["FrameSequence", "SequenceFrame", "exr_metadata", "write_exr_frame", "write_mat", "write_npy", "write_ptu"]
__all__ += ["write_sensor_fusion"]

_LARGEST_VARIABLE = 2**31 - 1  # bytes of one array in a MATLAB 5 file
_LARGEST_DTIME = 32768  # bins of a T3 record of PicoQuant


@dataclass(frozen=True, eq=False, kw_only=True)
class SequenceFrame:
    """One frame of any source; without counts where there is depth alone.

    Attributes:
        images: Name → `[H, W]`; `Z` is the depth [m] where the source has it.
        counts, expected: `[H, W, T]`; expected counts are those before pile-up, of all light and noise.
        background: The part of `expected` that is not target, counts of a pixel over all bins, mean over pixels.
        pulses, gate_start, bin_width, period: As of `Frames`.
        scene: What the camera looked at.
        depth: True depth [m] `[H, W]`.
        content: What the images are, in words.
    """

    images: dict[str, NDArray[Any]]
    counts: NDArray[Any] | None = None
    expected: NDArray[np.float32] | None = None
    background: float | None = None
    pulses: int = 0
    gate_start: float = 0.0
    bin_width: float = 0.0
    period: float | None = None
    scene: Scene | None = None
    depth: NDArray[np.float32] | None = None
    content: str = ""

    def bins_of(self, scene: Scene, depth: NDArray[np.float32]) -> NDArray[np.float64]:
        """Time of flight in bins from the start of the gate, with its fraction, of depth [m] that a scene's camera sees
        `[H, W]`; NaN where there is none."""
        lines = lines_of_sight(scene)
        path = lines.path_from_range(lines.range_from_depth(depth.astype(np.float64)))
        time = time_from_path(path, scene.medium.group_index) - self.gate_start
        return (time if self.period is None else np.mod(time, self.period)) / self.bin_width


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameSequence:
    """Frames of one source, read one at a time.

    Attributes:
        name: What to call the source in an error.
        count: Of the frames.
        frame: Number of a frame, from 0 → the frame.
        same_scene: Number of a frame → numbers of all frames of its scene; None where frames have counts.
    """

    name: str
    count: int
    frame: Callable[[int], SequenceFrame]
    same_scene: Callable[[int], range] | None = None

    def at(self, number: int) -> SequenceFrame:
        """A frame; `ArgumentError` for a number that is not there."""
        if not 0 <= number < self.count:
            raise ArgumentError(f"frame = {number} is outside [0, {self.count}), the frames of {self.name}")
        return self.frame(number)

    def with_counts(self, number: int, ending: str) -> tuple[SequenceFrame, NDArray[Any]]:
        """A frame and its counts; `ArgumentError` if it has none, which files of `ending` are for."""
        frame = self.frame(number)
        if frame.counts is None:
            raise ArgumentError(f"{self.name}: frame {number} is depth without counts, which {ending} is for")
        return frame, frame.counts


def write_npy(frames: FrameSequence, path: Path, chosen: range) -> Path:
    """Counts `[H, W, T]`, or depth `[H, W]` where there are none; of several frames with these before."""

    def array_of(number: int) -> NDArray[Any]:
        frame = frames.frame(number)
        return frame.images["Z"] if frame.counts is None else frame.counts

    first, several = array_of(chosen[0]), len(chosen) > 1
    with atomic_path(path) as temporary:
        shape = (len(chosen), *first.shape) if several else first.shape
        array = np.lib.format.open_memmap(temporary, mode="w+", dtype=first.dtype, shape=shape)
        for row, number in enumerate(chosen):
            array[row if several else ...] = array_of(number)
        array.flush()
        del array
    return path


def write_mat(
    frames: FrameSequence, path: Path, number: int, *, extra: Mapping[str, NDArray[Any]] | None = None
) -> Path:
    """One frame as single-photon denoisers read it; `spadwarp.export` lists the variables. `extra`: further ones."""
    from scipy.sparse import csc_matrix

    frame, counts = frames.with_counts(number, ".mat")
    height, width, bins = counts.shape
    if frame.scene is None or frame.depth is None:
        raise ArgumentError("result is missing: .mat holds the truth of the scene that the counts were drawn from")
    if frame.expected is None or frame.background is None:
        raise ArgumentError(f"{frames.name} does not hold the expected counts of its frames: draw them anew")
    if 4 * counts.size > _LARGEST_VARIABLE:
        raise FileError(f"{path}: {height} x {width} x {bins} values are more than a MATLAB 5 file can hold")
    total = frame.expected.sum(axis=-1, dtype=np.float64)
    signal = np.clip(total - frame.background, 0.0, None)
    photons = max(float(total.mean()) - frame.background, 0.0)
    true_bins = np.floor(frame.bins_of(frame.scene, frame.depth)) + 1.0
    true_bins = np.where((true_bins >= 1) & (true_bins <= bins), true_bins, 0.0)
    variables = {
        # Pixels column by column, as MATLAB's reshape takes them.
        "spad": csc_matrix(counts.transpose(1, 0, 2).reshape(width * height, bins).astype(np.float64)),
        "rates": frame.expected,
        "bin": true_bins,
        "range_bins": true_bins,
        "bin_size": frame.bin_width,
        "gate_start": frame.gate_start,
        "depth": np.nan_to_num(frame.depth),
        "intensity": (signal / max(float(signal.max()), 1e-300)).astype(np.float32),
        "SBR": photons / frame.background if frame.background > 0 else np.inf,
        "photons": photons,
        "mean_signal_photons": photons,
        "mean_background_photons": frame.background,
        "pulses": float(frame.pulses),
        **(extra or {}),
    }
    return _save_mat(path, variables)


def _save_mat(path: Path, variables: Mapping[str, Any]) -> Path:
    from scipy.io import savemat

    with atomic_path(path) as temporary, temporary.open("wb") as file:
        savemat(file, variables, do_compression=True)
    return path


def write_ptu(frames: FrameSequence, path: Path, chosen: range) -> Path:
    """Counts as a T3 image of PicoQuant, one record a detection, the frames one after the other.

    With the tags that `phconvert` asks for, and the records of a MultiHarp, whose markers `tttrlib` knows, too.
    """
    import ptufile

    from spadwarp import __version__

    first, counts = frames.with_counts(chosen[0], ".ptu")
    height, width, bins = counts.shape
    if bins > _LARGEST_DTIME:
        raise FileError(f"{path}: {bins} bins are more than the {_LARGEST_DTIME} of a T3 record")
    most = max(int(frames.with_counts(number, ".ptu")[1].sum(axis=-1).max()) for number in chosen)
    sync = max(first.period or 0.0, bins * first.bin_width)
    # A pixel lasts long enough for its detections, one a sync.
    pixel_time = sync * max(most, 1)
    comment = (
        f"Counts of a simulated SPAD array, {first.pulses} pulses a frame. "
        f"Bin 0 begins at {first.gate_start * 1e9:.6f} ns of flight."
    )
    with (
        atomic_path(path) as temporary,
        ptufile.PtuWriter(
            temporary,
            (1, height, width, 1, bins),
            global_resolution=sync,
            tcspc_resolution=first.bin_width,
            pixel_time=pixel_time,
            record_type=ptufile.PtuRecordType.GenericT3,
            comment=comment,
            tags={
                "CreatorSW_Name": "spadwarp",
                "CreatorSW_Version": __version__,
                "HW_Type": "simulated SPAD array",
                "HW_Version": "1",
                "HW_SerialNo": "0",
                "MeasDesc_AcquisitionTime": max(1, round(1e3 * pixel_time * width * height * len(chosen))),  # [ms]
            },
        ) as file,
    ):
        for number in chosen:
            frame, counts = frames.with_counts(number, ".ptu")
            if (frame.gate_start, frame.bin_width) != (first.gate_start, first.bin_width):
                raise ArgumentError(f"frames {chosen[0]} and {number} have different gates: a .ptu file has one")
            file.write(np.ascontiguousarray(counts, np.uint32))
    return path


def write_exr_frame(frames: FrameSequence, path: Path, number: int) -> Path:
    """The images of one frame."""
    frame, channels = frames.frame(number), {}
    for name, image in frame.images.items():  # EXR's integers have no sign, and few programs show them
        channels[name] = image.astype(np.float32) if image.dtype.kind in "iu" else image
    content = f"frame {number} of {frames.count}" + (f", {frame.content}" if frame.content else "")
    return write_exr(path, channels, exr_metadata(frame.scene, content))


def exr_metadata(scene: Scene | None, content: str) -> dict[str, str | int | float]:
    """Metadata of an EXR image of depth."""
    metadata: dict[str, str | int | float] = {"content": content, "Z": "planar depth [m]"}
    if scene is not None:
        metadata |= {"pixel_tangent": scene.camera.pixel_tangent, "config": scene.to_toml()}
    return metadata


def write_sensor_fusion(frames: FrameSequence, folder: Path, stem: str, chosen: range, factor: int) -> list[Path]:
    """Frames with counts, of scenes whose targets are meshes, and their camera images; see `spadwarp.files`'
    `export_sensor_fusion`."""
    factor = check_integer("factor", factor, "[1, 64]")
    listed: list[str] = []
    written: list[Path] = []
    images: dict[Scene, dict[str, Any]] = {}
    for number in chosen:
        frame, _ = frames.with_counts(number, "sensor fusion")
        if frame.scene is None or not frame.scene.targets:
            raise ArgumentError(f"{frames.name}: frame {number} has no scene of meshes to take a finer image of")
        if frame.scene not in images:
            images = {frame.scene: _camera_image(frame, factor)}  # frames of one scene follow each other
        image = images[frame.scene]
        name = f"{stem}-{number:05}"
        written += [
            _save_mat(folder / "intensity" / f"{name}.mat", {"intensity": image["intensity"]}),
            write_mat(frames, folder / "spad" / f"{name}_p1.mat", number, extra={"bin_hr": image["bin_hr"]}),
        ]
        listed.append(f"{os.path.abspath(written[-2])}\n")
    return [*written, write_text("".join(listed), folder / f"{stem}.txt")]


def _camera_image(frame: SequenceFrame, factor: int) -> dict[str, NDArray[Any]]:
    """Truth of a camera of the same place and view with `factor` times as many pixels each way."""
    assert frame.scene is not None and frame.counts is not None
    camera, tables, bins = frame.scene.camera, frame.scene.to_dict(), frame.counts.shape[-1]
    (fx, fy), (column, row) = camera.focal_pixels, camera.principal_point
    pose = {"position": list(camera.position), "rotation_deg": list(camera.rotation_deg)}
    sides = {"width": factor * camera.width, "height": factor * camera.height}
    lens = {"fx": factor * fx, "fy": factor * fy, "cx": factor * column - 0.5, "cy": factor * row - 0.5}
    lens |= {"distortion": list(camera.distortion), "pinhole": True, "aperture_diameter": 0.01}
    tables["camera"] = {**sides, **lens, **pose}
    tables.pop("scan", None)
    scene = Scene.from_dict(tables, source=frame.scene.source)
    truth = truth_maps(scene, device="cpu")
    position = frame.bins_of(scene, truth.depth)
    inside = (position >= 0) & (position < bins)
    cosine = -np.einsum("hwi,hwi->hw", truth.normal, lines_of_sight(scene).direction)
    light = np.nan_to_num(truth.reflectance * np.clip(cosine, 0.0, 1.0))
    return {
        "bin_hr": np.where(inside, np.clip(position + 0.5, 1.0, bins), 0.0),
        "intensity": (255.0 * light / max(float(light.max()), 1e-300)).astype(np.float32),
    }
