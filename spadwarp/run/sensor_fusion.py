"""Frames and a camera image of finer pixels, as networks that fuse both read them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError
from spadwarp.frames.export import FrameSequence, SequenceFrame, write_mat
from spadwarp.io.atomic import atomic_path
from spadwarp.io.text import write_text
from spadwarp.limits import check_integer
from spadwarp.scene import Scene
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import truth_maps

__all__ = ["write_sensor_fusion"]


def write_sensor_fusion(frames: FrameSequence, folder: Path, stem: str, chosen: range, factor: int = 8) -> list[Path]:
    """Writes frames as the loader of Lindell, O'Toole and Wetzstein (2018) for sensor fusion reads them.

    - `intensity/STEM-00000.mat`: `intensity` `[factor · H, factor · W]`, 0 to 255: reflectance times the cosine of the
      angle of view, as a photo with a flash without scattering.
    - `spad/STEM-00000_p1.mat`: the variables of `write_mat`, and `bin_hr` `[factor · H, factor · W]`, the bin of the
      true time of flight, counted from 1 at its centre and with its fraction, within [1, T]; 0 without a target.
    - `STEM.txt`: the list of the intensity files, which the loader takes.

    Args:
        frames: With counts, of scenes whose targets are meshes.
        folder: Where they are written.
        stem: Of their names.
        chosen: Numbers of the frames.
        factor: Pixels of the camera image in a pixel, along a row and along a column, in [1, 64].

    Raises:
        ArgumentError: Depth without counts, or no scene.
        FileError: A file cannot be written.
    """
    from scipy.io import savemat

    factor = check_integer("factor", factor, "[1, 64]")
    listed, written = [], []
    images: dict[Scene, dict[str, Any]] = {}
    for number in chosen:
        frame, _ = frames.with_counts(number, "sensor fusion")
        if frame.scene is None or not frame.scene.targets:
            raise ArgumentError(f"{frames.name}: frame {number} has no scene of meshes to take a finer image of")
        if frame.scene not in images:
            images = {frame.scene: _camera_image(frame, factor)}  # frames of one scene follow each other
        image = images[frame.scene]
        name = f"{stem}-{number:05}"
        intensity = folder / "intensity" / f"{name}.mat"
        with atomic_path(intensity) as temporary, temporary.open("wb") as file:
            savemat(file, {"intensity": image["intensity"]}, do_compression=True)
        spad = folder / "spad" / f"{name}_p1.mat"
        write_mat(frames, spad, number, more={"bin_hr": image["bin_hr"]})
        listed.append(os.path.abspath(intensity))
        written += [intensity, spad]
    path = folder / f"{stem}.txt"
    write_text("".join(f"{name}\n" for name in listed), path)
    return [*written, path]


def _camera_image(frame: SequenceFrame, factor: int) -> dict[str, NDArray[Any]]:
    """Truth of a camera with `factor`² pixels in each pixel of the frame's."""
    assert frame.scene is not None and frame.counts is not None
    scene, bins = _finer(frame.scene, factor), frame.counts.shape[-1]
    truth = truth_maps(scene, device="cpu")
    found = frame.bins_of(scene, truth.depth)
    seen = (found >= 0) & (found < bins)
    cosine = -np.einsum("hwi,hwi->hw", truth.normal, lines_of_sight(scene).direction)
    light = np.nan_to_num(truth.reflectance * np.clip(cosine, 0.0, 1.0))
    return {
        "bin_hr": np.where(seen, np.clip(found + 0.5, 1.0, bins), 0.0),
        "intensity": (255.0 * light / max(float(light.max()), 1e-300)).astype(np.float32),
    }


def _finer(scene: Scene, factor: int) -> Scene:
    """The scene by a camera of the same place and view with `factor` times as many pixels each way."""
    camera, tables = scene.camera, scene.to_dict()
    (fx, fy), (column, row) = camera.focal_pixels, camera.principal_point
    tables["camera"] = {
        "width": factor * camera.width,
        "height": factor * camera.height,
        "fx": factor * fx,
        "fy": factor * fy,
        "cx": factor * column - 0.5,
        "cy": factor * row - 0.5,
        "distortion": list(camera.distortion),
        "position": list(camera.position),
        "rotation_deg": list(camera.rotation_deg),
        "pinhole": True,
        "aperture_diameter": 0.01,
    }
    tables.pop("scan", None)
    return Scene.from_dict(tables, source=scene.source)
