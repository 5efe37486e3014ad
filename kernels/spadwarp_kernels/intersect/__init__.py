"""Rays against triangles, boxes and the tree of a `wp.Mesh`."""

from .bvh import face_distance, face_in, face_normal, pack_bvh, walk_node

__all__ = [
    "face_distance",
    "face_in",
    "face_normal",
    "pack_bvh",
    "walk_node",
]
