"""Pictures, pages and videos: arrays in, images out."""

from spadwarp.viz.budget import plot_budget, plot_sweep

__all__ = ["plot_budget", "plot_sweep"]
