"""Photon transport: a scene in, a `Result` out."""
