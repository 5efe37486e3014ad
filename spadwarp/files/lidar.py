"""What a lidar delivers: single photons with position and truth, as a table or a LAS file; waveforms of each shot."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.frames import Frames, Receiver, detect
from spadwarp.io.paths import write_file
from spadwarp.result import Result
from spadwarp.scene import shots_of
from spadwarp.scene.camera import to_world
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import target_map
from spadwarp.values import ArgumentError, path_from_time

__all__ = ["LIDAR_FORMATS", "PhotonCloud", "photon_cloud", "write_lidar"]

LIDAR_FORMATS = (".parquet", ".las", ".laz", ".wdp")
"""Endings of the files that `write_lidar` writes."""

NOISE = "noise"

# Classes of ASPRS for bathymetry: 40 bottom or object, 41 water surface, 45 water column, 7 noise.
_CLASSES = {"surface": 41, "ballistic": 40, "forward_scattered": 40, "backscatter": 45, NOISE: 7}

_COORDINATE = 1e-4  # unit of coordinates in a LAS file [m]
_HEADER = 60  # bytes of the record that a file of waveforms begins with


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotonCloud:
    """Detections one by one, in the order of shot and time: arrays `[N]`."""

    shot: NDArray[np.int32]  # number of the shot, from 0; without a scan 0
    row: NDArray[np.int32]  # of the pixel that has it
    column: NDArray[np.int32]
    pulse: NDArray[np.int64]  # number of the pulse in the shot
    time: Floats  # when the pulse was emitted, from the first pulse of all on [s]
    time_of_flight: Floats  # middle of the bin [s]
    position: Floats  # on the line of sight of its pixel at that time of flight, in the world [m], `[N, 3]`
    component: NDArray[np.int8]  # index into `components`: where it is from
    components: tuple[str, ...]  # those of a result, and "noise": dark counts, ambient light, crosstalk
    target: NDArray[np.int32]  # the target on the line of sight, from 0; -1 for none
    true_range: NDArray[np.float32]  # of that target [m]; NaN for none

    def __len__(self) -> int:
        return len(self.shot)

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns of the table; `component` as text."""
        arrays = {name: array for name, array in vars(self).items() if name not in ("position", "components")}
        arrays |= dict(zip("xyz", self.position.T, strict=True))
        return arrays | {"component": np.array(self.components)[self.component]}


def photon_cloud(result: Result, *, seed: int = 0, device: str | None = None) -> PhotonCloud:
    """The detections of one frame of a result's detector, each with its position and the component it is from.

    Detections are those of `spadwarp.detect` with dead time, pile-up, jitter and noise. A detector does not tell
    photons apart, so that one at a time is of each component with the share that this has of the expected detections
    there; what afterpulses follow gives them its share. Where the detector's time wraps, positions are those of the
    first period.

    Raises what `detect` and `shots_of` raise.
    """
    frames = detect(result, seed=seed, tags=True, device=device)
    assert frames.tags is not None
    _, row, column, pulse, tag_bin = frames.tags
    scene, at = result.scene, (row, column)
    middle = frames.gate_start + 0.5 * (frames.edges[:-1] + frames.edges[1:])
    flight = middle[tag_bin]
    shot = _shot_numbers(result)[at]
    emitted = (shot * float(frames.pulses) + pulse) / scene.laser.repetition_rate
    return PhotonCloud(
        shot=shot,
        row=row.astype(np.int32),
        column=column.astype(np.int32),
        pulse=pulse.astype(np.int64),
        time=np.asarray(emitted, np.float64),
        time_of_flight=flight,
        position=_positions(result, at, flight),
        component=_components(result, frames, (*at, tag_bin), seed),
        components=(*scene.components, NOISE),
        target=target_map(scene, device=device)[at],
        true_range=result.truth.range[at],
    )


def _shot_numbers(result: Result) -> NDArray[np.int32]:
    """The shot in which each pixel sees, `[H, W]`."""
    scene, (height, width) = result.scene, result.truth.depth.shape
    number = np.arange(height * width) // (height * width // scene.scan_positions)
    return number.reshape(height, width).astype(np.int32)


def _positions(result: Result, at: tuple[Any, Any], flight: Floats) -> Floats:
    """Points of the world [m] on the lines of sight of pixels at times of flight, or where these lines begin."""
    scene = result.scene
    lines = lines_of_sight(scene)[at]
    ranges = lines.range_from_path(path_from_time(flight, scene.medium.group_index))
    points = lines.points(np.where(np.isnan(ranges), lines.lead, ranges))
    if scene.scan.mode != "trajectory":
        return to_world(scene.camera, points)
    shots, number = shots_of(scene), _shot_numbers(result)[at]
    return np.einsum("nij,nj->ni", shots.rotation[number], points) + shots.position[number]


def _components(result: Result, frames: Frames, at: tuple[Any, Any, Any], seed: int) -> NDArray[np.int8]:
    """Drawn for detections in voxels, by what each component and the noise are expected to bring there."""
    import warp as wp

    scene = result.scene
    scale, gate = scene.laser.photons_per_pulse * scene.detections_per_photon, scene.gate
    axis, shape = (gate.start, gate.bin_width), result.truth.depth.shape
    choices: dict[str, Any] = {"shape": (*shape, gate.bins), "axis": axis, "device": wp.get_device("cpu")}
    receiver = Receiver.of(scene.detector, scene.laser, irf=frames.irf, **choices)
    dark = wp.zeros(shape[0] * shape[1], dtype=wp.float32, device="cpu")
    left = np.random.Generator(np.random.Philox(key=[seed, 0x70686F74])).random(len(at[0])) * frames.expected[at]
    noise = len(scene.components)
    component = np.full(len(left), noise, np.int8)
    for number, name in enumerate(scene.components):
        light = (result.expected(name) * scale).astype(np.float32).reshape(-1, gate.bins)
        rows: Any = wp.array(light, device="cpu")
        share = receiver.light(rows, dark).numpy().reshape(*shape, -1)[at]
        component[(component == noise) & (left < share)] = number
        left = left - share
    return component


# Files


def write_lidar(result: Result, path: Path, *, seed: int = 0) -> list[Path]:
    """Writes what a lidar delivers of one frame of a result; the ending of `path` selects it, see `spadwarp.export`.

    Returns the files. Raises `ArgumentError`: no detection, or bins that a file of waveforms cannot have.
    """
    ending = path.suffix.lower()
    if ending == ".wdp":
        return _write_waveforms(result, path, seed)
    cloud = photon_cloud(result, seed=seed)
    if not len(cloud):
        raise ArgumentError("no photon was detected: more pulses (detector.pulses_per_frame), or a brighter laser")
    if ending == ".parquet":
        import pyarrow
        import pyarrow.parquet

        return [write_file(path, partial(pyarrow.parquet.write_table, pyarrow.table(cloud.columns())))]
    return [_write_las(cloud, path)]


def _las_header(point_format: int, points: Floats) -> Any:
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = np.full(3, _COORDINATE), np.floor(points.min(axis=0))
    header.global_encoding.wkt = True
    header.generating_software = "spadwarp"
    return header


def _write_las(cloud: PhotonCloud, path: Path) -> Path:
    """A point for each photon, format 6."""
    import laspy

    header = _las_header(6, cloud.position)
    extra = {name: getattr(cloud, name) for name in ("shot", "pulse", "time_of_flight", "component", "target")}
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=array.dtype) for name, array in extra.items()])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.position.T
    las.gps_time = cloud.time
    las.classification = np.array([_CLASSES[name] for name in cloud.components], np.uint8)[cloud.component]
    las.return_number, las.number_of_returns = _returns(cloud)
    for name, array in extra.items():
        las[name] = array
    return write_file(path, lambda file: las.write(file, do_compress=path.suffix.lower() == ".laz"))


def _returns(cloud: PhotonCloud) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Number of each photon among those of its pixel and pulse, from 1, and how many there are; 15 at most."""
    of_pulse = np.stack([cloud.row, cloud.column, cloud.pulse])
    first = np.append(True, (np.diff(of_pulse, axis=1) != 0).any(axis=0))
    begin = np.flatnonzero(first)
    count = np.diff(np.append(begin, len(cloud)))
    number = np.arange(len(cloud)) - np.repeat(begin, count) + 1
    return np.minimum(number, 15).astype(np.uint8), np.minimum(np.repeat(count, count), 15).astype(np.uint8)


def _write_waveforms(result: Result, path: Path, seed: int) -> list[Path]:
    """A point, format 9, at the fullest bin of each pixel that has counts, and beside it the counts of all its bins."""
    import laspy

    scene, frames = result.scene, detect(result, seed=seed, tags=True)  # the same as of the photons
    spacing = 1e12 * frames.bin_width
    if abs(spacing - round(spacing)) > 1e-6 * spacing:
        text = f"gate.bin_width_ps = {spacing:.6g}: samples of a LAS file are whole picoseconds apart"
        raise ArgumentError(text)
    counts = frames.counts[0]
    at: tuple[Any, Any] = np.nonzero(counts.any(axis=2))  # type: ignore[assignment]
    if not len(at[0]):
        raise ArgumentError("no photon was detected: more pulses (detector.pulses_per_frame), or a brighter laser")
    samples = counts[at].astype("<u4" if counts.max() > 0xFFFF else "<u2")
    peak = samples.argmax(axis=1)
    flight = frames.gate_start + (peak + 0.5) * frames.bin_width
    points = _positions(result, at, flight)
    header = _las_header(9, points)
    header.global_encoding.waveform_data_packets_external = True
    descriptor = laspy.vlrs.known.WaveformPacketVlr(100, "counts of time bins")
    fields = (8 * samples.itemsize, 0, samples.shape[1], round(spacing), 1.0, 0.0)
    descriptor.parse_record_data(struct.pack("<BBIIdd", *fields))
    header.vlrs.append(descriptor)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    shot, size = _shot_numbers(result)[at], samples.shape[1] * samples.itemsize
    las.gps_time = shot * (frames.pulses / scene.laser.repetition_rate)
    las.intensity = np.minimum(samples.max(axis=1), 0xFFFF)
    las.return_number = las.number_of_returns = np.ones(len(shot), np.uint8)
    las.wavepacket_index = np.ones(len(shot), np.uint8)
    las.wavepacket_offset = _HEADER + size * np.arange(len(shot), dtype=np.uint64)
    las.wavepacket_size = np.full(len(shot), size, np.uint32)
    las.return_point_wave_location = (peak + 0.5) * spacing
    # Along the line of sight, as fast as the light of the last two bins there and back.
    end: Floats = np.full(len(peak), frames.gate_start + frames.edges[-1])
    step = _positions(result, at, end) - _positions(result, at, end - frames.bin_width)
    las.x_t, las.y_t, las.z_t = (step / spacing).T
    head = struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 65535, samples.nbytes, b"waveform data packets")
    write_file(path, lambda file: file.write(head + samples.tobytes()))
    return [write_file(path.with_suffix(".las"), partial(las.write, do_compress=False)), path]
