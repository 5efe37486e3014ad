"""Optical properties of natural water."""
