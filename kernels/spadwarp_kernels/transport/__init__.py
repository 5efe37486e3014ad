"""The transport kernel, what it takes and writes, and its launch."""

from .kernel import make_transport_kernel
from .launch import (
    Data,
    Model,
    launch_transport,
    load_transport_kernel,
    make_data,
    read_ledger,
)

__all__ = [
    "Data",
    "Model",
    "launch_transport",
    "load_transport_kernel",
    "make_data",
    "make_transport_kernel",
    "read_ledger",
]
