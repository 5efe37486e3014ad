"""The command line: a file for each command. Importing it hangs its function on `app`.

Commands use the public API only, and load what is heavy when they run: `spadwarp --help` answers at once.
"""

from spadwarp.cli import (  # noqa: F401
    init,
    examples,
    schema,
    simulate,
    detect,
    depth,
    fit,
    view,
    video,
    export,
    merge,
    analytic,
    plan,
    budget,
    crlb,
    sweep,
    water,
    particles,
    dataset,
    denoise,
    evaluate,
    train,
    check,
    info,
    presets,
    targets,
    devices,
    validate,
    bench,
    doctor,
)
from spadwarp.cli._app import app

__all__ = ["app"]
