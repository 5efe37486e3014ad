"""`spadwarp train`: a recipe and a dataset in, weights out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, say
from spadwarp.cli._progress import progress
from spadwarp.limits import environment_integer


@app.command()
def train(
    recipe: Annotated[Path, typer.Argument(metavar="RECIPE", help="Training recipe (TOML).", show_default=False)],
    out: opt.Out,
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Dataset; by default the recipe's.", show_default=False)
    ] = None,
    steps: Annotated[
        int | None, typer.Option(parser=opt.whole_number, metavar="N", help="Updates. By default the recipe's.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(parser=opt.whole_number, metavar="N", help="Seed. By default the recipe's.")
    ] = None,
    device: opt.TorchDevice = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Train a denoiser on scenes that are drawn as it goes, or on the clean scenes of a dataset.

    New noise is drawn for each step; with a pool, as in the recipe for histograms, a sample serves several steps (6
    there, on average). After the first steps the command says how long it will take. Writes weights (safetensors),
    log.jsonl, curves.png and a checkpoint; Ctrl-C or SIGTERM keep a checkpoint of the last step, and the same command
    resumes the training. Another recipe or number of steps needs a new folder. On several GPUs: torchrun
    --nproc-per-node N -m spadwarp train ...

    \b
    Example:
      spadwarp train configs/training/pyramid.toml --out runs/pyramid/
    """
    from spadwarp.denoise import load_training_recipe
    from spadwarp.denoise import train as run

    changes: dict[str, Any] = {}
    if data is not None:
        changes["data"] = str(data)
    if seed is not None:
        changes["seed"] = seed
    if steps is not None:
        changes["optimiser"] = {"steps": steps}
    chosen = load_training_recipe(recipe, overrides=changes)
    first = environment_integer("RANK", 0) == 0
    outputs = opt.check_outputs(
        out if first else None,  # one process of torchrun writes
        (f"{chosen.model}.safetensors", "log.jsonl", "curves.png", "checkpoint.pt"),
        json=json_path,
        inputs=(recipe,),
        overwrite=overwrite,
        resume=True,
    )
    with progress(quiet=quiet or not first, unit="steps") as shown:
        trained = run(chosen, out, device=device, progress=shown, notify=None if quiet or not first else complain)
    if first:
        if not quiet:
            over = "photon numbers" if chosen.model == "histograms" else "levels of backscatter"
            say(
                opt.rows(
                    {
                        "model": f"{chosen.model}, {opt.count(chosen.optimiser.steps)} steps, seed {chosen.seed}",
                        "validation": f"{trained.psnr:.2f} dB PSNR, mean over {over}",
                        "time": f"{trained.seconds:.0f} s",
                        "written": f"{trained.weights} ({opt.in_bytes(trained.weights.stat().st_size)})",
                    }
                )
            )
        outputs.write_json({"psnr": trained.psnr, "seconds": trained.seconds, "weights": trained.weights})
