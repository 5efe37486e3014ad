"""What a file holds, in numbers and text."""

from __future__ import annotations

from typing import Any

import numpy as np

from spadwarp.analytic import AnalyticFile
from spadwarp.dataset import FrameReader
from spadwarp.files.loader import Held
from spadwarp.frames import FramesFile
from spadwarp.frames.sequence_file import SequenceFile
from spadwarp.result import Result
from spadwarp.scene import Scene

__all__ = ["summary"]


def summary(held: Held) -> dict[str, Any]:
    """What a loaded file holds, in numbers and text that JSON can hold; `kind` says what it is."""
    if isinstance(held, Result):
        return {"kind": "result", **held.summary()}
    if isinstance(held, FramesFile):
        return {"kind": "frames", **_frames(held)}
    if isinstance(held, SequenceFile):
        return {"kind": "sequence", **_sequence(held)}
    if isinstance(held, AnalyticFile):
        return {"kind": "analytic", **_analytic(held)}
    if isinstance(held, FrameReader):
        return {"kind": "dataset", **_dataset(held)}
    ended = {name: int(np.count_nonzero(held.reason == number)) for number, name in enumerate(held.reasons)}
    return {
        "kind": "records",
        "photons": len(held.id),
        "ended": {name: count for name, count in ended.items() if count},
    }


def _frames(file: FramesFile) -> dict[str, Any]:
    mean = [float(file.intensity(number).mean()) for number in range(file.frames)]
    return {
        "scene": _source(file.scene),
        "frames": file.frames,
        "pulses": file.pulses,
        "seed": file.seed,
        **_axes(file.scene, len(file.edges) - 1),
        "gate_start_ns": 1e9 * file.gate_start,
        "bin_width_ps": 1e12 * file.bin_width,
        "period_ns": None if file.period is None else 1e9 * file.period,
        "counts_per_pixel": float(np.mean(mean)) if mean else None,
        "depth_by": list(file.methods),
        "response_fwhm_ps": 1e12 * file.irf.fwhm,
        **({} if file.channel == "I" else {"channel": file.channel}),
    }


def _sequence(file: SequenceFile) -> dict[str, Any]:
    times = file.trajectory.times
    return {
        "scene": _source(file.base),
        "frames": file.frames,
        "times_s": [float(times[0]), float(times[-1])],
        "moving": list(file.trajectory.fields),
        "pulses": file.pulses,
        "seed": file.seed,
        **_axes(file.base, file.bins),
        "depth_by": list(file.methods),
    }


def _analytic(file: AnalyticFile) -> dict[str, Any]:
    estimated = file.maps["fisher"] > 0

    def median(name: str) -> float | None:
        return float(np.median(file.maps[name][estimated])) if estimated.any() else None

    chosen = file.scene.analytic
    return {
        "scene": _source(file.scene),
        "frames": file.frames,
        "seed": file.seed,
        **_axes(file.scene, file.scene.gate.bins),
        "form": chosen.form,
        "backscatter": chosen.backscatter,
        "count_law": chosen.count_law,
        "pixels_with_estimate": int(np.count_nonzero(estimated)),
        "signal_per_pulse": median("signal"),
        "sigma_depth_m": median("sigma_depth"),
        "outlier_probability": median("outlier_probability"),
    }


def _dataset(reader: FrameReader) -> dict[str, Any]:
    return {
        "name": reader.manifest["name"],
        "folder": str(reader.path),
        "shards": reader.shards if len(reader.shards) == 1 else len(reader.shards),
        "frames": len(reader),
        "image": {"width": reader.shape[1], "height": reader.shape[0]},
        "targets": list(reader.manifest["targets"]),
    }


def _axes(scene: Scene, bins: int) -> dict[str, Any]:
    return {"image": {"width": scene.camera.width, "height": scene.camera.height}, "bins": bins}


def _source(scene: Scene) -> str | None:
    return str(scene.source) if scene.source else None
