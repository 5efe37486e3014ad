"""Targets: built-in shapes and mesh files, with their colours, placed in the world."""
