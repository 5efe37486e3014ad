"""Pictures, pages and videos: arrays in, images out."""

from spadwarp.viz.budget import plot_budget, plot_sweep
from spadwarp.viz.contact_sheet import draw_dataset
from spadwarp.viz.frames import draw_analytic, draw_recording
from spadwarp.viz.targets import describe_targets, draw_targets
from spadwarp.viz.transient_video import video
from spadwarp.viz.validation import draw_validation
from spadwarp.viz.viewer import view

__all__ = [
    "describe_targets",
    "draw_analytic",
    "draw_dataset",
    "draw_recording",
    "draw_targets",
    "draw_validation",
    "plot_budget",
    "plot_sweep",
    "video",
    "view",
]
