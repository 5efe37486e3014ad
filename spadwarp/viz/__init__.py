"""Pictures, pages and videos: arrays in, images out."""

from spadwarp.viz.budget import draw_budget, draw_sweep
from spadwarp.viz.contact_sheet import draw_dataset
from spadwarp.viz.depth import draw_denoised, draw_depth
from spadwarp.viz.fit import draw_fit
from spadwarp.viz.frames import draw_analytic, draw_recording
from spadwarp.viz.learning_curves import draw_learning_curves
from spadwarp.viz.notebook import html, plot
from spadwarp.viz.progress import progress_bar
from spadwarp.viz.result import draw_result, picture_calls
from spadwarp.viz.targets import describe_targets, draw_mesh, draw_targets
from spadwarp.viz.transient_video import video
from spadwarp.viz.validation import draw_validation
from spadwarp.viz.viewer import view
from spadwarp.viz.water import draw_water

__all__ = ["describe_targets", "draw_analytic", "draw_budget", "draw_dataset", "draw_denoised", "draw_depth"]
__all__ += [
    "draw_fit",
    "draw_learning_curves",
    "draw_mesh",
    "draw_recording",
    "draw_result",
    "draw_sweep",
    "draw_targets",
    "draw_validation",
    "draw_water",
]
__all__ += ["html", "picture_calls", "plot", "progress_bar", "video", "view"]
