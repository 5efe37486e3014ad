"""The transport kernel, what it takes and writes, and its launch."""

from .kernel import BRUTE_FORCE_FACES, ESTIMATORS, Records, TransportSpec, make_transport_kernel
from .launch import (
    Data,
    Model,
    launch_transport,
    load_transport_kernel,
    make_data,
    make_layers,
    make_records,
    make_surfaces,
    make_textures,
    read_ledger,
    surface_choices,
)

__all__ = [
    "BRUTE_FORCE_FACES",
    "ESTIMATORS",
    "Data",
    "Model",
    "Records",
    "TransportSpec",
    "launch_transport",
    "load_transport_kernel",
    "make_data",
    "make_layers",
    "make_records",
    "make_surfaces",
    "make_textures",
    "make_transport_kernel",
    "read_ledger",
    "surface_choices",
]
