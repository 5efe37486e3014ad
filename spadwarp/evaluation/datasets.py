"""Comparison of denoisers: scores of a frame, as an image and as a measurement; of every method on a dataset."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset import FrameItem, FrameReader, read_manifest
from spadwarp.denoise.baselines import MEDIAN_WINDOWS, compared
from spadwarp.denoise.frames import DepthFrames, depth_frames
from spadwarp.denoise.inference import estimate_frames, target_threshold
from spadwarp.values import ArgumentError, FileError, check_integer

__all__ = ["Evaluation", "evaluate"]

_EDGE = 0.05  # a jump of depth between neighbours that is an edge [m]
_PHOTON_EDGES = (0.0, 3.0, 10.0, 30.0, 100.0, math.inf)  # levels of datasets that have no backscatter fractions
_STAIRCASE = "staircase"

LARGER_IS_BETTER = {
    "psnr": True,
    "ssim": True,
    "rmse_mm": False,
    "within_1cm": True,
    "within_5cm": True,
    "edge_mm": False,
}
"""Scores in which methods can be ranked."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of one frame, over the pixels that see a target.

    SSIM has an 11 × 11 Gaussian window of σ = 1.5 (Wang et al., IEEE TIP 13, 600, 2004); pixels without a target are
    white in both images.
    """

    psnr: float  # of depth scaled to 8 bits over the gate [dB]; 100 where no pixel differs
    ssim: float  # structural similarity of the same
    entropy: float  # Shannon entropy of the denoised image [bit]
    rmse_mm: float  # root mean square error of depth [mm]
    within_1cm: float  # part of the pixels whose error is below 1 cm
    within_5cm: float  # and below 5 cm
    edge_mm: float  # mean absolute error within two pixels of an edge of the truth, a jump over 5 cm [mm]; else NaN

    @classmethod
    def mean(cls, scores: list[Scores]) -> Scores:
        """Mean of each field, without NaN."""
        means = {}
        for field in fields(cls):
            values = np.array([getattr(score, field.name) for score in scores])
            means[field.name] = float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
        return cls(**means)


def score(clean: NDArray[np.float32], estimate: NDArray[np.float32], *, gate: tuple[float, float]) -> Scores:
    """Scores of a depth `[H, W]` [m], NaN counts as the end of the gate, by the true one, NaN without a target.

    Raises `ArgumentError` for shapes that differ, or no target in the frame within the gate.
    """
    from skimage.measure import shannon_entropy
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    if clean.shape != estimate.shape or clean.ndim != 2:
        raise ArgumentError(f"estimate has shape {estimate.shape}; {clean.shape} is needed")
    start, stop = gate
    seen = np.isfinite(clean) & (clean >= start) & (clean < stop)
    if not seen.any():
        raise ArgumentError(f"no pixel sees a target within {start:g} to {stop:g} m")
    estimate = np.nan_to_num(estimate, nan=stop)

    def eight_bits(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
        scaled = np.clip((np.where(seen, depth, stop) - start) / (stop - start), 0.0, 1.0)
        return np.round(255.0 * scaled).astype(np.uint8)

    truth, image = eight_bits(clean), eight_bits(estimate)
    same = np.array_equal(truth[seen], image[seen])
    psnr = 100.0 if same else float(peak_signal_noise_ratio(truth[seen], image[seen], data_range=255))
    side = min(truth.shape)
    _, similarity = structural_similarity(
        truth, image, data_range=255, full=True, sigma=1.5, gaussian_weights=side >= 11, use_sample_covariance=False,
        **({} if side >= 11 else {"win_size": side - 1 + side % 2}),
    )  # fmt: skip
    error = np.abs(estimate.astype(np.float64) - clean)[seen]
    edge = near_jumps(clean, seen, _EDGE)[seen]
    return Scores(
        psnr=psnr,
        ssim=float(similarity[seen].mean()),
        entropy=float(shannon_entropy(image)),
        rmse_mm=1e3 * float(np.sqrt(np.mean(error**2))),
        within_1cm=float(np.mean(error < 0.01)),
        within_5cm=float(np.mean(error < 0.05)),
        edge_mm=1e3 * float(error[edge].mean()) if edge.any() else float("nan"),
    )


def near_jumps(clean: NDArray[np.float32], seen: NDArray[np.bool_], jump: float) -> NDArray[np.bool_]:
    """Pixels that see a target within two of the border of the target, or of a jump of its depth [m]."""
    from scipy.ndimage import binary_dilation

    filled = np.where(seen, clean, np.float32(1e3))
    jumps = np.zeros(clean.shape, bool)
    for values, rows in ((filled, jumps), (filled.T, jumps.T)):
        step = np.abs(np.diff(values, axis=0)) > jump
        rows[:-1] |= step
        rows[1:] |= step
    return np.asarray(binary_dilation(jumps) & seen)


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Steps of about 10 cm between neighbouring faces: their number, and how many a frame resolves to ± 3 cm."""

    total: int = 0
    resolved: int = 0

    def __add__(self, other: Steps) -> Steps:
        return Steps(total=self.total + other.total, resolved=self.resolved + other.resolved)


def staircase_steps(clean: NDArray[np.float32], estimate: NDArray[np.float32]) -> Steps:
    """Counts neighbouring faces whose medians differ by 10 ± 3 cm in the truth, and by that ± 3 cm in the estimate.

    Faces are the connected parts of the true depth between jumps of more than 2.5 cm, of at least 100 pixels; two are
    neighbours if they are within eight pixels of each other.
    """
    from scipy.ndimage import binary_dilation, label

    seen = np.isfinite(clean)
    filled = np.where(seen, clean, np.float32(-1e3))
    flat = seen.copy()
    for values, rows in ((filled, flat), (filled.T, flat.T)):
        rows[:-1] &= np.abs(np.diff(values, axis=0)) < 0.025
    faces, count = label(flat)
    masks = [mask for number in range(1, count + 1) if (mask := faces == number).sum() >= 100]
    grown = [binary_dilation(mask, iterations=4) for mask in masks]
    estimate = np.nan_to_num(estimate, nan=0.0)
    total = resolved = 0
    for (first, near), (second, also_near) in combinations(zip(masks, grown, strict=True), 2):
        true_step = float(np.median(clean[first]) - np.median(clean[second]))
        if 0.07 <= abs(true_step) <= 0.13 and (near & also_near).any():
            step = float(np.median(estimate[first]) - np.median(estimate[second]))
            total += 1
            resolved += abs(step - true_step) <= 0.03
    return Steps(total=total, resolved=resolved)


# Of a dataset.


class Sample(NamedTuple):
    """One frame: true depth `[H, W]` [m], gate [m], depth by method `[H, W]` [m], and a caption.

    NaN where no target is, or where the method says that none is: it gives it a probability below
    `target_threshold`.
    """

    clean: NDArray[np.float32]
    gate: tuple[float, float]
    images: dict[str, NDArray[np.float32]]
    caption: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """Scores of methods on a dataset."""

    data: str  # the dataset's name and folder
    summary: str  # photons, water, backscatter and seed of the frames, as text
    methods: tuple[str, ...]  # in the order of the tables; "input" is the first
    targets: tuple[str, ...]  # in the order of the tables
    levels: tuple[str, ...]
    """Backscatter fractions, the part of the pixels that report backscatter, or ranges of photon counts."""
    scores: dict[tuple[str, str, str], Scores]  # mean over frames, by (method, target, level)
    frames: dict[tuple[str, str], int]  # number of frames, by (target, level)
    windows: dict[str, int]  # side of the median that has the highest PSNR, by level [pixels]
    steps: dict[tuple[str, str], Steps]
    """Steps of the staircase's frames, by (method, level); empty without a staircase."""
    samples: dict[tuple[str, str], Sample]  # a frame by (target, level)

    def mean(self, method: str, *, level: str | None = None, target: str | None = None) -> Scores:
        """Mean over targets and levels, or over those of one level or target; each counts once."""
        chosen = (
            one for one in self.scores if one[0] == method and target in (None, one[1]) and level in (None, one[2])
        )
        return Scores.mean([self.scores[one] for one in chosen])

    def ranking(self) -> list[str]:
        """Methods by mean rank over all scores that can be ranked, best first."""
        ranks = dict.fromkeys(self.methods, 0)
        for name, larger in LARGER_IS_BETTER.items():
            values = {method: getattr(self.mean(method), name) for method in self.methods}
            for rank, method in enumerate(sorted(values, key=lambda method: values[method], reverse=larger)):
                ranks[method] += rank
        return sorted(self.methods, key=lambda method: ranks[method])

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        return {
            "data": self.data,
            "summary": self.summary,
            "ranking": self.ranking(),
            "median_windows": self.windows,
            "frames": [{"target": target, "level": level, "frames": n} for (target, level), n in self.frames.items()],
            "steps": [{"method": key[0], "level": key[1], **vars(steps)} for key, steps in self.steps.items()],
            "scores": [
                {"method": method, "target": target, "level": level, **vars(scores)}
                for (method, target, level), scores in self.scores.items()
            ],
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
    """Scores denoisers on a dataset of `spadwarp dataset`.

    Args:
        data: The dataset's folder.
        models: From `spadwarp.denoise.METHODS`.
        split: "test", "validation", "train" or "all".
        frames: Of each target and level, at most; the same for each method.
        bm3d_frames: Of each level for BM3D, which takes up to a minute per frame; 0 leaves it out.
        crop: (width, height) of the middle part of each frame that is used [pixels]; default: the whole frame.
        weights: File of `spadwarp train`; the method "own" is its network with these weights.
        device: torch device of the networks.
        progress: Called with ("frames", done, total).

    The median gets the window that has the highest PSNR at each level on these very frames. PSNR, SSIM and entropy are
    of depth scaled to 8 bits over the gate, over the pixels that see a target. A pixel without an estimate counts as
    one in the middle of the gate.

    Raises:
        ArgumentError: An argument out of range; weights of the network for histograms.
        FileError: No dataset, or no frames in the split; weights that cannot be read.
        SpadwarpError: A package of the extra `denoise` is missing.
    """
    wanted = [name for name in dict.fromkeys(models) if name != "bm3d"] + ["bm3d"] * (bm3d_frames > 0)
    frames = check_integer("frames", frames, "[1, 1000000000]")
    bm3d_frames = check_integer("bm3d_frames", bm3d_frames, "[0, 1000000000]")
    methods = compared(wanted, None if weights is None else Path(weights))
    return _Comparison(data, split, frames, crop, methods, device).scored(bm3d_frames, progress)


class _Comparison:
    """Which frames of a dataset are scored by which methods, and their scores, with the keys of `Evaluation`."""

    def __init__(
        self,
        data: str | os.PathLike[str],
        split: str,
        frames: int,
        crop: tuple[int, int] | None,
        methods: dict[str, dict[str, Any]],
        device: str | None,
    ) -> None:
        self.data, self.split, self.methods, self.device = data, split, methods, device
        self.chosen, self.photons, self.summary = _choose(data, split, frames)
        self.reader = FrameReader(data, split, fields=("noisy", "clean", "bound", "prior"))
        rows, columns = self.reader.shape
        width, height = crop or (columns, rows)
        if not (8 <= width <= columns and 8 <= height <= rows):
            raise ArgumentError(f"crop = ({width}, {height}) is outside (8, 8) to ({columns}, {rows})")
        top, left = (rows - height) // 2, (columns - width) // 2
        self.part = slice(top, top + height), slice(left, left + width)
        if crop is not None:
            self.summary += f"; the middle {width} x {height} pixels of each frame"
        if own := methods.get("own"):
            self.summary += f"; own weights of {own['model']}: {own['weights']}"
        self.scores: dict[tuple[str, str, str], list[Scores]] = {}
        self.steps: dict[tuple[str, str], Steps] = {}
        self.frames: dict[tuple[str, str], int] = {}
        self.samples: dict[tuple[str, str], Sample] = {}
        self.windows = self._best_windows() if "median" in methods else {}

    def _frame(self, index: int) -> tuple[FrameItem, DepthFrames, NDArray[np.float32], NDArray[np.bool_] | None]:
        """The item, its noisy frame, true depth where its light is within the gate, and which pixels see the target."""
        item = self.reader[index]
        noisy, prior, bound, clean = (item[name][0][self.part] for name in ("noisy", "prior", "bound", "clean"))
        gate = (float(item["gate"][0]), float(item["gate"][1]))  # in range; only light within it has a bound
        clean = np.where(np.isfinite(bound), clean, np.float32(np.nan))
        seen = np.isfinite(clean) & (clean >= gate[0]) & (clean < gate[1])
        return item, depth_frames(noisy, gate=gate, density=prior), clean, seen if seen.mean() > 0.01 else None

    def _best_windows(self) -> dict[str, int]:
        """The window of the highest mean PSNR at each level."""
        quality: dict[tuple[str, int], list[float]] = {}
        for (_, level), indices in self.chosen.items():
            for index in indices:
                _, frames, clean, seen = self._frame(index)
                for window in MEDIAN_WINDOWS if seen is not None else ():
                    found = estimate_frames(frames, model="median", window=window).depth[0]
                    square = float(np.mean((found - clean)[seen] ** 2))
                    quality.setdefault((level, window), []).append(-math.log10(max(square, 1e-12)))
        levels = dict.fromkeys(level for level, _ in quality)
        return {level: max(MEDIAN_WINDOWS, key=lambda window: np.mean(quality[level, window])) for level in levels}

    def _score_frame(self, index: int, target: str, level: str, bm3d_frames: int) -> None:
        """Scores a frame by every method; a frame in which less than 1 % of the pixels see a target is left out."""
        item, noisy, clean, seen = self._frame(index)
        if seen is None:
            return
        count = self.frames[target, level] = self.frames.get((target, level), 0) + 1
        images: dict[str, NDArray[np.float32]] = {}
        for method, named in self.methods.items():
            if method == "bm3d" and count > bm3d_frames:
                continue
            window = self.windows.get(level, 5)
            found = estimate_frames(noisy, window=window, device=self.device, **named)
            images[method] = found.masked(target_threshold(named["model"]))[0]
            self.scores.setdefault((method, target, level), []).append(score(clean, found.depth[0], gate=noisy.gate))
            if target == _STAIRCASE:
                steps = self.steps.get((method, level), Steps())
                self.steps[method, level] = steps + staircase_steps(clean, found.depth[0])
        if count == 1:
            caption = (
                f"{target}, {level if 'photons' in level else f'backscatter fraction {level}'}; "
                f"{self.photons[int(item['scene'])]:.3g} signal photons, {float(item['attenuation_lengths']):.2g} "
                f"attenuation lengths one way, sample {int(item['sample'])}"
            )
            self.samples[target, level] = Sample(clean, noisy.gate, {**images, "input": noisy.depth[0]}, caption)

    def scored(self, bm3d_frames: int, progress: Callable[[str, int, int], None] | None) -> Evaluation:
        """Means over all frames; BM3D has as many of each level."""
        targets = {target for target, _ in self.chosen}
        done, total = 0, sum(map(len, self.chosen.values()))
        for (target, level), indices in self.chosen.items():
            for index in indices:
                self._score_frame(index, target, level, math.ceil(bm3d_frames / len(targets)))
                done += 1
                if progress is not None:
                    progress("frames", done, total)
        if not self.scores:
            raise FileError(f"{self.data}: no frame of {self.split} sees a target")
        return Evaluation(
            data=f"{self.reader.manifest['name']} ({self.data})",
            summary=self.summary,
            methods=tuple(self.methods),
            targets=tuple(dict.fromkeys(target for target, _ in self.frames)),
            levels=tuple(sorted(dict.fromkeys(level for _, level in self.frames), key=_level_order)),
            scores={key: Scores.mean(values) for key, values in self.scores.items()},
            frames=self.frames,
            windows=self.windows,
            steps={key: steps for key, steps in self.steps.items() if steps.total},
            samples=self.samples,
        )


def _choose(
    data: str | os.PathLike[str], split: str, frames: int
) -> tuple[dict[tuple[str, str], list[int]], NDArray[np.float64], str]:
    """Indices of frames by (target, level); signal photons of every scene; what the frames show, as text."""
    reader = FrameReader(data, split, fields=())
    if not len(reader):
        raise FileError(f"{data}: no frames in {split}")
    photons = reader.scene_numbers("signal") * reader.scene_numbers("pulses")
    chosen: dict[tuple[int, str], list[int]] = {}
    lengths, scenes = [], []
    for index in np.random.Generator(np.random.Philox(0)).permutation(len(reader)):
        numbers = reader[int(index)]
        fraction, scene = float(numbers["backscatter_fraction"]), int(numbers["scene"])
        key = int(numbers["target"]), _photon_level(photons[scene]) if math.isnan(fraction) else f"{fraction:.3f}"
        if len(chosen.setdefault(key, [])) < frames:
            chosen[key].append(int(index))
            lengths.append(float(numbers["attenuation_lengths"]))
            scenes.append(scene)
    seen = photons[scenes]
    manifest = read_manifest(data)
    seed = manifest["splits"][split]["seed"] if split in manifest["splits"] else manifest["seed"]
    summary = (
        f"{seen.min():.3g} to {seen.max():.3g} signal photons per pixel (median {np.median(seen):.3g}); water of "
        f"{min(lengths):.2g} to {max(lengths):.2g} attenuation lengths one way; seed {seed}"
    )
    names, order = list(manifest["targets"]), sorted(chosen, key=lambda key: (key[0], _level_order(key[1])))
    return {(names[target], level): chosen[target, level] for target, level in order}, photons, summary


def _photon_level(photons: float) -> str:
    upper = int(np.searchsorted(_PHOTON_EDGES, photons, side="right"))
    low, high = _PHOTON_EDGES[upper - 1], _PHOTON_EDGES[min(upper, len(_PHOTON_EDGES) - 1)]
    return f"{low:g} to {high:g} photons" if math.isfinite(high) else f"over {low:g} photons"


def _level_order(level: str) -> float:
    return float(level.removeprefix("over ").split()[0])
