"""Frames of a SPAD camera: counts, arrival times, depth, the Cramér–Rao bound, files."""

from spadwarp.frames.arrival_time import METHODS, Method, arrival_time
from spadwarp.frames.cramer_rao import crlb, crlb_from_histogram
from spadwarp.frames.frames import Frames, TimeTags
from spadwarp.frames.pile_up import coates, first_photon_probabilities
from spadwarp.frames.response import InstrumentResponse, detector_response, instrument_response, response_matrix
from spadwarp.frames.spad import detect

__all__ = [
    "METHODS",
    "Frames",
    "InstrumentResponse",
    "Method",
    "TimeTags",
    "arrival_time",
    "coates",
    "crlb",
    "crlb_from_histogram",
    "detect",
    "detector_response",
    "first_photon_probabilities",
    "instrument_response",
    "response_matrix",
]
