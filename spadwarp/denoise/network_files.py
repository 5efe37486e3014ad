"""Files of networks' weights, of the package or of `spadwarp train`, and the torch that runs the networks."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any, Literal

from spadwarp.io.paths import existing_file
from spadwarp.io.text import parse_json
from spadwarp.values import DeviceError, FileError, SpadwarpError, check_choice, need_memory, shown

__all__ = ["weights_metadata"]

Precision = Literal["float16", "bfloat16", "float32"]
"""Of numbers in the layers of a network."""

MODELS = ("pyramid", "histograms", "dncnn", "usdn")
"""Names of the networks; "histograms" is for frames whose histograms are known."""

WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the package's weights."""


def weights_metadata(model: str, weights: str | Path | None = None) -> dict[str, Any]:
    """How the weights in a file were made: model, recipe, seed, hours, machine, validation PSNR.

    `weights`: the file; default: the package's for `model`. Raises `FileError`; `ArgumentError` for an unknown model.
    """
    path = weights_path(model, weights)
    header = weights_header(path)
    try:
        return {name: parse_json(text) if text[:1] in ("{", "[") else text for name, text in header.items()}
    except ValueError as error:
        raise FileError(f"{path}: its header is damaged: {error}") from error


def fast_precision(device: str) -> Precision:
    """The precision in which this device is fastest without loss: float16 on a GPU, bfloat16 on a CPU that has AMX."""
    if device != "cpu":
        return "float16"
    capabilities: dict[str, Any] = getattr(require_torch().cpu, "get_capabilities", dict)()
    return "bfloat16" if capabilities.get("amx_bf16", False) else "float32"


def require_torch() -> Any:
    """The module torch. Raises `SpadwarpError` where it or safetensors is not installed, `MemoryError`."""
    if "torch" not in sys.modules:
        need_memory(1.0, "denoising")
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
    if not (isinstance(name, str) and re.fullmatch(r"cpu|cuda(:\d{1,4})?", name, re.ASCII)):
        raise DeviceError(f"device = {shown(name)} is not 'cpu' or 'cuda:N'")
    if name != "cpu":
        index = int(name.partition(":")[2] or 0)
        if not (torch.cuda.is_available() and index < torch.cuda.device_count()):
            raise DeviceError(f"device = {name!r}: torch sees {torch.cuda.device_count()} GPUs")
    return torch.device(name)


def weights_path(model: str, weights: str | Path | None) -> Path:
    """The file, or the package's for `model`."""
    check_choice("model", model, MODELS)
    return existing_file(WEIGHTS / f"{model}.safetensors" if weights is None else weights)


def weights_header(path: Path) -> dict[str, str]:
    """Metadata in the header of a safetensors file."""
    require_torch()
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return dict(file.metadata() or {})
    except (OSError, ValueError, SafetensorError) as error:
        raise FileError(f"{path}: not a safetensors file: {error}") from error
