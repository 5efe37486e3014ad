"""Denoising of depth frames by a network with trained weights, or by one of the baselines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.denoise.baselines import BASELINES, MEDIAN_WINDOWS, median_filter
from spadwarp.denoise.frames import POOLED, DepthFrames, depth_frames
from spadwarp.denoise.recipe import MODELS
from spadwarp.errors import ArgumentError, DeviceError, FileError, SpadwarpError
from spadwarp.io.parsing import parse_json
from spadwarp.io.paths import existing_file
from spadwarp.limits import check_choice

__all__ = ["METHODS", "WEIGHTS", "apply", "denoise_frames", "features_of_histograms", "weights_metadata"]

WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the package's weights."""

METHODS = (*MODELS, *(name for name in BASELINES if name != "input"))
"""What `apply` takes as `model`."""

_PIXELS_AT_ONCE = {"cpu": 1 << 16, "cuda": 1 << 23}  # a batch that fits into a CPU's cache is faster


def apply(
    depth: ArrayLike,
    *,
    gate: tuple[float, float],
    model: str = "pyramid",
    profile: ArrayLike | None = None,
    counts: ArrayLike | None = None,
    background: ArrayLike | None = None,
    response: ArrayLike | None = None,
    weights: str | Path | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> NDArray[np.float32]:
    """Denoises depth frames.

    Args:
        depth: `[H, W]` or `[N, H, W]` [m], planar depth or range; NaN and 0 mean that nothing was reported.
        gate: (start, stop) of the camera's gate, in depth or range as `depth` is [m]. The network sees depth over the
            gate: distances need not be those of its training.
        model: "pyramid", "dncnn" or "usdn"; or a baseline: "median", "gating", "bm3d". With counts, "pyramid" means
            "histograms", the variant of PyramidNet that uses them.
        profile: The water's backscatter over the gate in equal bins, `[bins]`, in any unit; taken as flat if not
            given. PyramidNet and gating use it.
        counts: Histograms that `depth` was estimated from, over the gate in equal bins, `[H, W, T]` or `[N, H, W, T]`.
            PyramidNet uses them, with `background` and `response`: where photons are few, neighbouring pixels together
            show more than each alone.
        background: Expected background counts, the same for all pixels `[T]`, or of each pixel `[H, W, T]`.
        response: Instrument response per bin centred on its time zero, `[2 r + 1]`, as
            `spadwarp.frames.InstrumentResponse.per_bin` gives it.
        weights: File of `spadwarp train`; default: the weights of the package.
        device: torch device of the network; default: the first GPU, else the CPU.
        progress: Called with ("frames", done, total).

    Returns:
        float32 of `depth`'s shape [m]. NaN where there is no target: PyramidNet decides that itself and fills pixels
        that the camera missed; the others have NaN where `depth` has. A frame without any report stays empty.

    Raises:
        ArgumentError: An argument out of range.
        SpadwarpError: A package of the extra `denoise` is missing; a device that does not exist; weights that cannot be
            read.
    """
    features = None
    if counts is not None and model in ("pyramid", "histograms"):
        model = "histograms"
        if background is None or response is None:
            raise ArgumentError("counts need background and response, which are missing")
        features = features_of_histograms(
            counts,
            background=background,
            response=response,
            device=device,
            to_depth=lambda part: gate[0] + (gate[1] - gate[0]) * part,
        )
    frames = depth_frames(depth, gate=gate, profile=profile, features=features)
    found, seen = denoise_frames(frames, model=model, weights=weights, device=device, progress=progress)
    return np.where(seen, found, np.float32(np.nan)).reshape(np.shape(depth))


def denoise_frames(
    frames: DepthFrames,
    *,
    model: str,
    window: int = 5,
    weights: str | Path | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Depth of every pixel, within the gate [m], and where a target is seen: float32 and bool `[N, H, W]`.

    Arguments and errors are those of `apply`; `model` may also be "input", the frames as they are; `window`: side of
    the median [pixels].
    """
    if model != "input":
        check_choice("model", model, METHODS)
    if model == "histograms" and frames.features is None:
        raise ArgumentError('model = "histograms" needs counts with their background and response; they are missing')
    reported = ~np.isnan(frames.depth)
    if model in BASELINES:
        if weights is not None:
            raise ArgumentError(f"weights are for a network, not for {model!r}")
        if window < 1 or window % 2 == 0:
            raise ArgumentError(f"window = {window} is not an odd number >= 1, such as {MEDIAN_WINDOWS}")
        found = median_filter(frames, window=window) if model == "median" else BASELINES[model](frames)
        return found, reported
    torch = require_torch()
    place = torch_device(device)
    network = load_network(model, weights, str(place))
    inputs = frames.network_input(histograms=model == "histograms")
    start, stop = frames.gate
    found, seen = np.empty_like(frames.depth), reported.copy()
    part = max(1, _PIXELS_AT_ONCE[place.type] // frames.depth[0].size)
    # glibc returns memory to the system after each frame, and fresh pages take as long as half the network, unless a
    # block this large (at most 32 MiB) was freed before: M_TRIM_THRESHOLD in mallopt(3).
    torch.empty(31 << 20, dtype=torch.uint8)
    for first in range(0, len(inputs), part):
        some = slice(first, first + part)
        with torch.inference_mode():
            batch = torch.from_numpy(inputs[some]).to(place)
            output = network(batch).float()
            if model == "histograms":  # errors at edges differ in a rotated frame: their mean is smaller
                output = 0.5 * (output + network(batch.flip(2, 3)).float().flip(2, 3))
            output = output.cpu().numpy()
        found[some] = start + (stop - start) * np.clip(output[:, 0], 0.0, 1.0)
        if output.shape[1] > 1:
            seen[some] = output[:, 1] > 0.0
        if progress is not None:
            progress("frames", min(first + part, len(inputs)), len(inputs))
    seen &= reported.any(axis=(1, 2), keepdims=True)
    return found, seen


def features_of_histograms(
    counts: ArrayLike,
    *,
    background: ArrayLike,
    response: ArrayLike,
    device: str | None = None,
    to_depth: Callable[[NDArray[np.float32]], NDArray[Any]] | None = None,
) -> NDArray[np.float32]:
    """Features of histograms over the gate, as `spadwarp.denoise.histogram_features` makes them, frame by frame.

    Args:
        counts: `[H, W, T]` or `[N, H, W, T]`, not negative.
        background: Expected background counts, the same for all pixels `[T]`, or of each pixel `[H, W, T]`.
        response: Instrument response per bin centred on its time zero, `[2 r + 1]`.
        device: torch device.
        to_depth: Converts parts of the gate `[N, POOLED, H, W]` to depths [m].

    Returns:
        float32 `[N, FEATURES, H, W]`; first the pooled depths, as parts of the gate where `to_depth` is not given.

    Raises:
        ArgumentError: Shapes or values that cannot be.
    """
    torch = require_torch()
    from spadwarp.denoise.histogram_features import extract_features

    cubes = np.asarray(counts)
    levels, taps = (np.array(given, np.float32) for given in (background, response))
    if cubes.ndim not in (3, 4) or cubes.dtype.kind not in "biuf" or cubes.size == 0:
        raise ArgumentError(f"counts are {cubes.dtype} {cubes.shape}; numbers [H, W, T] or [N, H, W, T] are needed")
    one, each = cubes.shape[-1:], cubes.shape[-3:]
    if levels.shape not in (one, each) or not (np.isfinite(levels).all() and (levels >= 0).all()):
        raise ArgumentError(f"background has shape {levels.shape}; {one} or {each} is needed, of numbers >= 0")
    if taps.ndim != 1 or taps.size % 2 == 0 or not (np.isfinite(taps).all() and taps.sum() > 0):
        raise ArgumentError(f"response has shape {taps.shape}; an odd number of values centred on time zero is needed")
    place = torch_device(device)
    tap = torch.from_numpy((taps / taps.sum())[None]).to(place)
    level = torch.from_numpy(levels if levels.ndim == 3 else levels[None, None])[None].to(place)
    level = level.clamp_min(1e-6 * float(level.mean()) + 1e-9)
    found = []
    with torch.inference_mode():
        for cube in cubes.reshape(-1, *cubes.shape[-3:]):
            frame = torch.from_numpy(cube.astype(np.float32)[None]).to(place)
            found.append(extract_features(frame, level, tap).cpu().numpy())
    features = np.concatenate(found)
    if to_depth is not None:
        features[:, :POOLED] = to_depth(features[:, :POOLED])
    return features


def weights_metadata(model: str, weights: str | Path | None = None) -> dict[str, Any]:
    """How the weights in a file were made: model, recipe, seed, hours, machine, validation PSNR.

    `weights`: the file; default: the package's for `model`. Raises `FileError`; `ArgumentError` for an unknown model.
    """
    path = _weights_path(model, weights)
    try:
        return {name: parse_json(text) if text[:1] in ("{", "[") else text for name, text in _header(path).items()}
    except ValueError as error:
        raise FileError(f"{path}: its header is damaged: {error}") from error


@lru_cache(maxsize=8)
def load_network(model: str, weights: str | Path | None = None, device: str = "cpu") -> Any:
    """A network with its weights, ready to run."""
    torch = require_torch()
    from safetensors.torch import load_file

    from spadwarp.denoise.networks import build_network

    path = _weights_path(model, weights)
    named = _header(path).get("model", model)
    if named != model:
        raise FileError(f"{path}: weights of {named!r}, not of {model!r}")
    try:
        network: Any = build_network(model)
        values = {name: value.float() for name, value in load_file(path).items()}  # counters are cast back
        network.load_state_dict(values)
        if wrong := [name for name, value in values.items() if not torch.isfinite(value).all()]:
            raise ValueError(f"{wrong[0]} is not finite")
    except Exception as error:  # safetensors and torch have errors of their own
        raise FileError(f"{path}: not weights of {model!r}: {error}") from error
    network = network.to(torch.device(device)).to(memory_format=torch.channels_last)
    return network.eval().requires_grad_(False)


def own_weights(models: Sequence[str], weights: str | Path | None) -> dict[str, Path]:
    """`weights` by the network that the file names; empty without. Raises `ArgumentError` if it is none of `models`."""
    if weights is None:
        return {}
    model = _header(existing_file(weights)).get("model")
    if model not in MODELS:
        raise FileError(f"{weights}: not weights of spadwarp train: its header names no network")
    if model not in models:
        raise ArgumentError(f"weights = '{weights}' are of {model!r}, which is not among models: {', '.join(models)}")
    return {model: Path(weights)}


def require_torch() -> Any:
    """The module torch. Raises `SpadwarpError` where it or safetensors is not installed."""
    try:
        import safetensors  # noqa: F401
        import torch
    except ModuleNotFoundError as error:
        raise SpadwarpError(f"denoising needs {error.name}: pip install 'spadwarp[denoise]'") from error
    return torch


def torch_device(name: str | None) -> Any:
    """The torch device "cpu", "cuda" or "cuda:N"; default: the first GPU, else the CPU. Raises `DeviceError`."""
    torch = require_torch()
    if name is None:
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if not (name == "cpu" or name.split(":")[0] == "cuda"):
        raise DeviceError(f"device = {name!r} is not 'cpu' or 'cuda:N'")
    if name != "cpu":
        index = int(name.partition(":")[2] or 0)
        if not (torch.cuda.is_available() and index < torch.cuda.device_count()):
            raise DeviceError(f"device = {name!r}: torch sees {torch.cuda.device_count()} GPUs")
    return torch.device(name)


def _weights_path(model: str, weights: str | Path | None) -> Path:
    if model not in MODELS:
        raise ArgumentError(f"model = {model!r} is not one of {', '.join(map(repr, MODELS))}")
    return existing_file(WEIGHTS / f"{model}.safetensors" if weights is None else weights)


def _header(path: Path) -> dict[str, str]:
    """Metadata in the header of a safetensors file."""
    require_torch()
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return dict(file.metadata() or {})
    except (OSError, ValueError, SafetensorError) as error:
        raise FileError(f"{path}: not a safetensors file: {error}") from error
