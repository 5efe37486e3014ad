"""Pictures, pages and videos: arrays in, images out."""

from spadwarp.viz.budget import plot_budget, plot_sweep
from spadwarp.viz.transient_video import video
from spadwarp.viz.viewer import view

__all__ = ["plot_budget", "plot_sweep", "video", "view"]
