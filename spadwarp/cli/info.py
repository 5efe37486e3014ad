"""`spadwarp info`: what a file holds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


@app.command()
def info(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A result, checkpoint, frames, analytic file, records, dataset or shard; or their directory.",
        ),
    ],
    overwrite: opt.Overwrite = False,
    json_path: opt.Json = None,
) -> None:
    """Contents of any of our files; of a result also how it was made.

    A result's includes the energy balance: where the emitted light went.

    \b
    Example:
      spadwarp info out/result.h5
    """
    outputs = opt.check_outputs(json=json_path, inputs=(path,), overwrite=overwrite)
    held = spadwarp.load(path)
    summary = spadwarp.files.summary(held)
    if not isinstance(held, spadwarp.Result):
        kind = summary["kind"]
        say(opt.rows({kind: "", **{f"  {name}": _plain(value) for name, value in summary.items() if name != "kind"}}))
        outputs.write_json(summary)
        return
    result = held
    counted = {name: result.counters.get(name, 0) for name in ("before_gate", "after_gate")}
    outside = {name: number * result.unit / result.photons for name, number in counted.items()}
    say("\n\n".join(f"{title}\n{opt.rows(lines, indent='  ')}" for title, lines in _lines(summary, outside).items()))
    outputs.write_json(summary)


def _lines(summary: Mapping[str, Any], outside: Mapping[str, float]) -> dict[str, dict[str, str]]:
    """A result's summary by headings."""
    image, gate, medium = summary["image"], summary["gate"], summary["medium"]
    made = defaultdict(lambda: "unknown", summary["provenance"])
    depth, ledger, timing = summary["truth"]["depth_m"], summary["energy_balance"], summary["timing"]
    fractions, counters = ledger["fractions"], summary["counters"]
    photons = opt.count(summary["photons"]) + (", interrupted" if summary["partial"] else "")
    water = ", ".join(f"{name.replace('_', ' ')} {_number(value)}" for name, value in medium.items())
    collected = {name.replace("_", "-"): f"{part:.4g}" for name, part in summary["collected_fraction"].items()}
    collected |= {f"({name.replace('_', ' the ')})": f"{part:.4g}" for name, part in outside.items()}
    return {
        "Result": {
            "photons": f"{photons}, seed {summary['seed']}",
            "image": f"{image['width']} x {image['height']} pixels x {gate['bins']} bins of {gate['bin_width_ps']:.5g} "
            f"ps from {gate['start_ns']:.5g} ns (path {gate['path_m'][0]:.4g} to {gate['path_m'][1]:.4g} m)",
            "water": water,
            "truth": f"{summary['truth']['pixels']} pixels"
            + (f", {depth[0]:.4g} to {depth[1]:.4g} m" if depth else ""),
            "returns": f"in {summary['pixels_with_return']} pixels, {summary['detections_per_pulse']:.4g} detections a "
            "pulse",
            **({"derivatives": "by " + ", ".join(summary["derivatives"])} if "derivatives" in summary else {}),
            **_polarisation(summary),
        },
        "Collected, as fractions of the emitted light": collected,
        f"Energy balance, {'exact' if ledger['exact'] else 'off by ' + str(ledger['difference']) + ' units'}": {
            name: f"{100 * part:10.6f} %" for name, part in fractions.items() if part
        }
        | {"sum": f"{100 * sum(fractions.values()):10.6f} %"},
        "Counted": {name: opt.count(number) for name, number in counters.items() if name not in outside},
        "Made": {
            "from": summary["scene"] or "Python",
            "on": f"{made['device']} ({made['device_name']}), {made['date']}"
            + (f", the first of {len(made['parts'])} parts" if "parts" in made else ""),
            "with": ", ".join(f"{name} {made[name]}" for name in ("spadwarp", "warp", "numpy", "python")),
            "in": ", ".join(f"{name} {seconds:.3g} s" for name, seconds in timing.items()),
        },
    }


def _polarisation(summary: Mapping[str, Any]) -> dict[str, str]:
    """Of the channels of a result, or of the one that it holds."""
    if "channel" in summary:
        return {"light": f"{summary['channel']}-polarised alone, behind an analyser"}
    if "channels" not in summary:
        return {}
    parts = ", ".join(f"{name} {value:.4g}" for name, value in summary["channels"].items())
    degree = summary["degree_of_polarisation"]
    return {"polarisation": f"{parts}; degree of polarisation {'unknown' if degree is None else f'{degree:.3g}'}"}


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain(item)}" for name, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    return opt.count(value) if isinstance(value, int) else _number(value)


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
