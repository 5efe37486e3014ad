"""Frames of a SPAD camera: counts, arrival times, depth."""
