"""Frames of a SPAD camera: counts, arrival times, depth, the Cramér–Rao bound, files."""

from spadwarp.frames.cramer_rao import crlb, crlb_from_histogram, information_from_histogram
from spadwarp.frames.depth import Reduction, depth_frame, depth_of
from spadwarp.frames.estimators import METHODS, Method, arrival_time
from spadwarp.frames.file import FramesFile, is_frames_file
from spadwarp.frames.frames import Frames, TimeTags
from spadwarp.frames.labelled import to_xarray
from spadwarp.frames.measured import Histograms, read_histograms
from spadwarp.frames.monte_carlo_noise import MonteCarloNoise, monte_carlo_noise
from spadwarp.frames.pile_up import coates, first_photon_probabilities
from spadwarp.frames.receiver import Receiver
from spadwarp.frames.record import FrameErrors, Recording, record_frames
from spadwarp.frames.response import (
    InstrumentResponse,
    detector_response,
    instrument_response,
    read_response,
    response_matrix,
)
from spadwarp.frames.spad import detect

__all__ = [
    "METHODS",
    "FrameErrors",
    "Frames",
    "FramesFile",
    "Histograms",
    "InstrumentResponse",
    "Method",
    "MonteCarloNoise",
    "Receiver",
    "Recording",
    "Reduction",
    "TimeTags",
    "arrival_time",
    "coates",
    "crlb",
    "crlb_from_histogram",
    "depth_frame",
    "depth_of",
    "detect",
    "detector_response",
    "first_photon_probabilities",
    "information_from_histogram",
    "instrument_response",
    "is_frames_file",
    "monte_carlo_noise",
    "read_histograms",
    "read_response",
    "record_frames",
    "response_matrix",
    "to_xarray",
]
