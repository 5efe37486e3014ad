"""The result of a simulation as plain data, its files, the sum of results, and truth maps from other programs."""

from spadwarp.result.batch_moments import ComponentError, component_errors, dominance_warnings
from spadwarp.result.file import (
    ResultLike,
    as_result,
    load_result,
    load_truth_maps,
    save_depth_exr,
    save_result,
    save_truth_maps,
)
from spadwarp.result.labelled import to_xarray
from spadwarp.result.merging import Tallies, merge
from spadwarp.result.received import CHANNELS, Channel, degree_of_polarisation, received
from spadwarp.result.rendered_truth import EXR_PRESETS, ExrPreset, load_truth_exr
from spadwarp.result.result import COMPONENTS, Component, Result, Truth
from spadwarp.result.signed_tallies import SignedTallies
from spadwarp.result.tensors import TorchResult, TorchTruth, to_torch

__all__ = [
    "CHANNELS",
    "COMPONENTS",
    "EXR_PRESETS",
    "Channel",
    "Component",
    "ComponentError",
    "ExrPreset",
    "Result",
    "ResultLike",
    "SignedTallies",
    "Tallies",
    "TorchResult",
    "TorchTruth",
    "Truth",
    "as_result",
    "component_errors",
    "degree_of_polarisation",
    "dominance_warnings",
    "load_result",
    "load_truth_exr",
    "load_truth_maps",
    "merge",
    "received",
    "save_depth_exr",
    "save_result",
    "save_truth_maps",
    "to_torch",
    "to_xarray",
]
