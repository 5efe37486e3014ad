"""Rays against triangles, boxes and the tree of a `wp.Mesh`."""

from .box import segment_meets_box
from .bvh import NO_NODE, LeafStep, TreeWalk, pack_bvh, step_leaf, step_node
from .triangle import face_distance, face_in, face_normal
from .wide import pack_wide, walk_wide

__all__ = [
    "NO_NODE",
    "LeafStep",
    "TreeWalk",
    "face_distance",
    "face_in",
    "face_normal",
    "pack_bvh",
    "pack_wide",
    "segment_meets_box",
    "step_leaf",
    "step_node",
    "walk_wide",
]
