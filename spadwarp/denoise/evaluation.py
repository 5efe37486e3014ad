"""`spadwarp evaluate`: every method on the same frames of a dataset, and who wins."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.make import read_manifest
from spadwarp.dataset.read import FrameReader
from spadwarp.denoise.baselines import MEDIAN_WINDOWS
from spadwarp.denoise.frames import DepthFrames, depth_frames
from spadwarp.denoise.inference import METHODS, denoise_frames, own_weights
from spadwarp.denoise.metrics import LARGER_IS_BETTER, Scores, Steps, score, staircase_steps
from spadwarp.errors import ArgumentError, FileError

__all__ = ["Evaluation", "Sample", "evaluate"]

_PHOTON_EDGES = (0.0, 3.0, 10.0, 30.0, 100.0, math.inf)  # where a dataset has photon rates instead of shares
_STAIRCASE = "staircase"


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame and what the methods make of it, depth `[H, W]` [m] by method; and what it shows, in words."""

    clean: NDArray[np.float32]
    gate: tuple[float, float]
    images: dict[str, NDArray[np.float32]]
    about: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """Scores of methods on a dataset.

    Attributes:
        data: The dataset's name and folder. about: Photons, water, backscatter and seed of the frames, in words.
        methods, targets, levels: In the order of the tables; `"input"` is the first method. A level is a share of
            backscatter pixels, or a range of photon counts.
        scores: Mean over frames, by (method, target, level).
        frames: Number of frames, by (target, level).
        windows: Side of the median that has the highest PSNR, by level [pixels].
        steps: Steps of the staircase's frames, by (method, level); empty without a staircase.
        samples: A frame by (target, level).
    """

    data: str
    about: str
    methods: tuple[str, ...]
    targets: tuple[str, ...]
    levels: tuple[str, ...]
    scores: dict[tuple[str, str, str], Scores]
    frames: dict[tuple[str, str], int]
    windows: dict[str, int]
    steps: dict[tuple[str, str], Steps]
    samples: dict[tuple[str, str], Sample]

    def mean(self, method: str, *, level: str | None = None, target: str | None = None) -> Scores:
        """Mean over targets and levels, or over those of one level or target; each counts once."""
        chosen = [
            one
            for (name, subject, at), one in self.scores.items()
            if name == method and level in (None, at) and target in (None, subject)
        ]
        return Scores.mean(chosen)

    def ranking(self) -> list[str]:
        """Methods by mean rank over all scores that can be ranked, best first."""
        ranks = {method: 0.0 for method in self.methods}
        for field, larger in LARGER_IS_BETTER.items():
            values = {method: getattr(self.mean(method), field) for method in self.methods}
            for place, method in enumerate(sorted(values, key=lambda one: values[one], reverse=larger)):
                ranks[method] += place
        return sorted(self.methods, key=lambda one: ranks[one])

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        rows = [
            {"method": method, "target": target, "level": level, **dataclasses.asdict(one)}
            for (method, target, level), one in self.scores.items()
        ]
        steps = [
            {"method": method, "level": level, "total": one.total, "resolved": one.resolved}
            for (method, level), one in self.steps.items()
        ]
        return {
            "data": self.data,
            "about": self.about,
            "ranking": self.ranking(),
            "median_windows": self.windows,
            "frames": [{"target": target, "level": level, "frames": n} for (target, level), n in self.frames.items()],
            "steps": steps,
            "scores": rows,
        }


def evaluate(
    data: str | os.PathLike[str],
    *,
    models: Sequence[str] = ("median", "gating", "usdn", "dncnn", "pyramid"),
    split: str = "test",
    frames: int = 20,
    bm3d_frames: int = 0,
    crop: tuple[int, int] | None = None,
    weights: str | os.PathLike[str] | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Evaluation:
    """Scores denoisers on a dataset of `spadwarp dataset make`.

    Args:
        data: The dataset's folder.
        models: From `spadwarp.denoise.inference.METHODS`.
        split: "test", "validation", "train" or "all".
        frames: Of each target and level, at most; the same for each method.
        bm3d_frames: Of each level for BM3D, which takes up to a minute a frame; 0 leaves it out.
        crop: (width, height) of the middle part of each frame that methods see [pixels]; all of it if not given.
        weights: File of `spadwarp train`, in place of the package's for the network that it names.
        device: torch device of the networks.
        progress: Called with ("frames", done, total).

    The median gets the window that does best at each level on these very frames; PSNR, SSIM and entropy are of depth
    scaled to 8 bits over the gate, over the pixels that see a target. A pixel without an estimate counts as one in the
    middle of the gate.

    Raises:
        ArgumentError: An argument out of range; weights of a network that is not among the models.
        FileError: No dataset, or no frames in the split; weights that cannot be read.
        SpadwarpError: A package of the extra `denoise` is missing.
    """
    wanted = [name for name in dict.fromkeys(models) if name != "bm3d"] + (["bm3d"] if bm3d_frames > 0 else [])
    if unknown := [name for name in (*models, *wanted) if name not in METHODS]:
        raise ArgumentError(f"models: {unknown[0]!r} is not one of {', '.join(map(repr, METHODS))}")
    if "histograms" in wanted:
        raise ArgumentError("models: 'histograms' needs histograms, which datasets do not keep; evaluate a result")
    if frames < 1:
        raise ArgumentError(f"frames = {frames} is outside [1, inf)")
    own = own_weights(wanted, None if weights is None else Path(weights))
    chosen, photons, about = _chosen(data, split, frames)
    reader = FrameReader(data, split, fields=("noisy", "clean", "bound", "prior"))
    names = list(reader.manifest["targets"])
    methods = ("input", *wanted)
    raw: dict[tuple[str, str, str], list[Scores]] = {}
    medians: dict[tuple[str, int], list[float]] = {}
    steps: dict[tuple[str, str], Steps] = {}
    samples: dict[tuple[str, str], Sample] = {}
    counts: dict[tuple[str, str], int] = {}
    shape = reader[0]["noisy"].shape[-2:]
    width, height = (shape[1], shape[0]) if crop is None else crop
    if not (8 <= width <= shape[1] and 8 <= height <= shape[0]):
        raise ArgumentError(f"crop = ({width}, {height}) is outside (8, 8) to ({shape[1]}, {shape[0]})")
    top, left = (shape[0] - height) // 2, (shape[1] - width) // 2
    part = slice(top, top + height), slice(left, left + width)
    if crop is not None:
        about += f"; the middle {width} x {height} pixels of each frame"
    windows = _best_windows(reader, part, chosen, medians) if "median" in wanted else {}

    total, done = sum(map(len, chosen.values())), 0
    quota = math.ceil(bm3d_frames / len({target for target, _ in chosen}))
    for (target_index, level), indices in chosen.items():
        target = names[target_index]
        used = 0
        for index in indices:
            item = reader[index]
            noisy, clean = _frame(item, part), _truth(item, part)
            done += 1
            if not _has_target(clean, noisy.gate):
                continue
            used += 1
            images: dict[str, NDArray[np.float32]] = {}
            for method in methods:
                if method == "bm3d" and used > quota:
                    continue
                image = _estimate(noisy, method, windows.get(level, 5), own.get(method), device)
                images[method] = image
                raw.setdefault((method, target, level), []).append(score(clean, image, gate=noisy.gate))
                if target == _STAIRCASE:
                    one, so_far = staircase_steps(clean, image), steps.get((method, level), Steps(total=0, resolved=0))
                    steps[method, level] = Steps(
                        total=so_far.total + one.total, resolved=so_far.resolved + one.resolved
                    )
            if (target, level) not in samples:
                text = f"{target}, BS {level}" if "photons" not in level else f"{target}, {level}"
                scene = int(item["scene"])
                text += f"; {photons[scene]:.3g} signal photons, {float(item['attenuation_lengths']):.2g} attenuation"
                text += f" lengths one way, sample {int(item['sample'])}"
                samples[target, level] = Sample(clean, noisy.gate, {**images, "input": noisy.depth[0]}, text)
            if progress is not None:
                progress("frames", done, total)
        if used:
            counts[target, level] = used
    if not raw:
        raise FileError(f"{data}: no frame of {split} sees a target")
    return Evaluation(
        data=f"{reader.manifest['name']} ({data})",
        about=about + "".join(f"; {name} with weights {path}" for name, path in own.items()),
        methods=methods,
        targets=tuple(dict.fromkeys(target for target, _ in counts)),
        levels=tuple(sorted(dict.fromkeys(level for _, level in counts), key=_level_order)),
        scores={key: Scores.mean(values) for key, values in raw.items()},
        frames=counts,
        windows=windows,
        steps={key: one for key, one in steps.items() if one.total},
        samples=samples,
    )


# Parts


def _chosen(
    data: str | os.PathLike[str], split: str, frames: int
) -> tuple[dict[tuple[int, str], list[int]], NDArray[np.float64], str]:
    """Indices of frames by (target, level); signal photons of every scene; what they show, in words."""
    import h5py

    reader = FrameReader(data, split, fields=())
    if not len(reader):
        raise FileError(f"{data}: no frames in {split}")
    with h5py.File(Path(data) / "scenes.h5") as file:
        photons = file["signal"][...] * file["pulses"][...]
    order = np.random.Generator(np.random.Philox(0)).permutation(len(reader))
    chosen: dict[tuple[int, str], list[int]] = {}
    lengths: list[float] = []
    scenes: list[int] = []
    for index in order:
        numbers = reader[int(index)]
        share, scene = float(numbers["backscatter_fraction"]), int(numbers["scene"])
        key = int(numbers["target"]), _photon_level(photons[scene]) if math.isnan(share) else f"{share:.3f}"
        if len(chosen.setdefault(key, [])) < frames:
            chosen[key].append(int(index))
            lengths.append(float(numbers["attenuation_lengths"]))
            scenes.append(scene)
    seen = photons[scenes]
    manifest = read_manifest(data)
    seed = manifest["splits"][split]["seed"] if split in manifest["splits"] else manifest["seed"]
    about = (
        f"{seen.min():.3g} to {seen.max():.3g} signal photons a pixel (median {np.median(seen):.3g}); water of "
        f"{min(lengths):.2g} to {max(lengths):.2g} attenuation lengths one way; seed {seed}"
    )
    return dict(sorted(chosen.items(), key=lambda one: (one[0][0], _level_order(one[0][1])))), photons, about


def _photon_level(photons: float) -> str:
    upper = int(np.searchsorted(_PHOTON_EDGES, photons, side="right"))
    low, high = _PHOTON_EDGES[upper - 1], _PHOTON_EDGES[min(upper, len(_PHOTON_EDGES) - 1)]
    return f"{low:g} to {high:g} photons" if math.isfinite(high) else f"over {low:g} photons"


def _level_order(level: str) -> float:
    return float(level.removeprefix("over ").split()[0])


def _frame(item: dict[str, Any], part: tuple[slice, slice]) -> DepthFrames:
    gate = (float(item["gate"][0]), float(item["gate"][1]))
    return depth_frames(item["noisy"][0][part], gate=gate, density=item["prior"][0][part])


def _truth(item: dict[str, Any], part: tuple[slice, slice]) -> NDArray[np.float32]:
    """True depth where its light falls into the gate, which is one in range."""
    return np.where(np.isfinite(item["bound"][0][part]), item["clean"][0][part], np.float32(np.nan))


def _has_target(clean: NDArray[np.float32], gate: tuple[float, float]) -> bool:
    seen = np.isfinite(clean) & (clean >= gate[0]) & (clean < gate[1])
    return bool(seen.mean() > 0.01)


def _estimate(
    frames: DepthFrames, method: str, window: int, weights: Path | None, device: str | None
) -> NDArray[np.float32]:
    if method == "input":
        return np.nan_to_num(frames.depth[0], nan=0.5 * sum(frames.gate))
    return denoise_frames(frames, model=method, window=window, weights=weights, device=device)[0][0]


def _best_windows(
    reader: FrameReader,
    part: tuple[slice, slice],
    chosen: dict[tuple[int, str], list[int]],
    errors: dict[tuple[str, int], list[float]],
) -> dict[str, int]:
    """The window of the highest mean PSNR at each level."""
    for (_, level), indices in chosen.items():
        for index in indices:
            item = reader[index]
            frames, clean = _frame(item, part), _truth(item, part)
            if not _has_target(clean, frames.gate):
                continue
            seen = np.isfinite(clean) & (clean >= frames.gate[0]) & (clean < frames.gate[1])
            for window in MEDIAN_WINDOWS:
                found, _ = denoise_frames(frames, model="median", window=window)
                square = float(np.mean((found[0] - clean)[seen] ** 2))
                errors.setdefault((level, window), []).append(-math.log10(max(square, 1e-12)))
    levels = dict.fromkeys(level for level, _ in errors)
    return {level: max(MEDIAN_WINDOWS, key=lambda one: np.mean(errors[level, one])) for level in levels}
