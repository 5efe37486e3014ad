"""`spadwarp plan`: gate, pulses, laser power and largest range for a depth error."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, say
from spadwarp.cli._progress import progress
from spadwarp.units import with_prefix

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp import Scene
    from spadwarp.analytic import Proposal
from spadwarp.cli._tables import new_table, short

_PLANE = "for a plane square to the optical axis, not for the scene's target"
_MUCH_NOISE = 1.0 / 3.0  # Part of the information of the run.


@app.command()
def plan(
    scene_path: opt.ScenePath,
    depth_error: Annotated[
        float, typer.Option(parser=opt.length, metavar="LENGTH", help='Depth error asked for, such as "1cm" [m].')
    ] = "0.01",  # type: ignore[assignment]
    time: Annotated[
        float, typer.Option(parser=opt.duration, metavar="TIME", help="Longest time for a depth frame [s].")
    ] = "1",  # type: ignore[assignment]
    ranges: Annotated[
        str | None,
        typer.Option(
            "--range",
            metavar="FROM:TO",
            help="Where the target may be, such as 80cm:1.2m [m]; a plane at TO then stands for it. By default the "
            "scene's targets.",
        ),
    ] = None,
    margin: Annotated[
        float, typer.Option(parser=opt.length, metavar="LENGTH", help="Water in the gate before and behind it [m].")
    ] = "0.25",  # type: ignore[assignment]
    method: Annotated[opt.Estimator, typer.Option(help="Estimator whose error counts.")] = opt.Estimator.likelihood,
    full_power: Annotated[
        bool, typer.Option("--full-power", help="Take the largest pulse energy within the limits.")
    ] = False,
    eye_distance: Annotated[
        float | None,
        typer.Option(
            parser=opt.length,
            metavar="LENGTH",
            help="Also keep the pulse energy safe for an eye at this distance from the laser [m].",
        ),
    ] = None,
    eye_exposure: Annotated[
        float, typer.Option(parser=opt.duration, metavar="TIME", help="How long the eye looks into the beam [s].")
    ] = "100",  # type: ignore[assignment]
    photons: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Photons of the Monte Carlo run.")
    ] = "2000000",  # type: ignore[assignment]
    seed: Annotated[int, typer.Option(parser=opt.whole_number, metavar="N", help="Key of the random numbers.")] = "0",  # type: ignore[assignment]
    no_range: Annotated[bool, typer.Option("--no-range", help="Do not look for the largest range.")] = False,
    channel: opt.ChannelName = opt.Channel.I,
    write: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Scene file to write with the proposed values.")
    ] = None,
    mesh: opt.Mesh = None,
    overrides: opt.Overrides = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Gate, pulses and laser power for a depth error, and what limits it.

    A short Monte Carlo run of a window of the image measures the light. The Cramér–Rao bound is what any unbiased
    estimator can reach; it falls with the pulses. Forward scattering leaves an error that more pulses do not reduce.
    The limit for the eye is a guide, after IEC 60825-1:2014.

    \b
    Examples:
      spadwarp plan configs/scenes/staircase_5m.toml --depth-error 1cm --write planned.toml
      spadwarp plan configs/scenes/harbour_5m.toml --range 2:3 --time 100ms --eye-distance 1m
    """
    scene = opt.read_scene(scene_path, mesh=mesh, overrides=overrides)
    outputs = opt.check_outputs(
        files={"--write": write}, json=json_path, inputs=(scene_path, *scene.files), overwrite=overwrite
    )
    if ranges is None:
        _complain_of_targets(scene)
    with progress(quiet=quiet) as report:
        found = spadwarp.plan(
            scene,
            depth_error=depth_error,
            time=time,
            ranges=None if ranges is None else opt.from_to(ranges, "m", "--range"),
            margin=margin,
            method=method.value,
            full_power=full_power,
            eye_distance=eye_distance,
            eye_exposure=eye_exposure,
            photons=photons,
            seed=seed,
            largest_range=not no_range,
            channel=channel.value,
            device=device,
            progress=report,
        )
    if write is not None:
        heading = (
            f"# Proposed by `spadwarp plan {scene_path.name} --depth-error {depth_error:g}`: {_verdict(found)}\n\n"
        )
        spadwarp.io.write_text(heading + found.scene.to_toml(folder=write.parent), write)
    if not quiet:
        say(opt.rows(_lines(found)))
        opt.show_table(_terms(found))
        for name in ("co", "cross") if found.channels else ():
            say(_reception(found, name))
        say(_verdict(found))
        say(f"What would help: {found.advice}.")
        if found.pilot.run_noise > 0.5 * found.terms["forward scattering"]:
            say("The Monte Carlo run is too short to know the floor: it may be smaller; --photons takes more.")
        if found.pilot.information_noise > _MUCH_NOISE:
            say(
                f"The Monte Carlo run is short for the bound: {100 * found.pilot.information_noise:.0f} % of what its "
                "histograms say of the depth was noise, and is left out; --photons takes more."
            )
        if write is not None:
            say(f"written: {write}")
    outputs.write_json({"scene": scene_path, **found.to_dict(), "files": [] if write is None else [write]})


def _complain_of_targets(scene: Scene) -> None:
    """What `check` warns of in the targets, before a run that would be in vain; the gate is what is proposed."""
    for message in spadwarp.check(scene):
        if message.level == "warning" and message.field.startswith("targets") and "gate" not in message.text:
            complain(str(message))


def _verdict(found: Proposal) -> str:
    """One sentence."""
    asked, total = with_prefix(found.depth_error, "m"), with_prefix(found.terms["total"], "m")
    pulses = f"{opt.count(found.pulses)} pulses, {with_prefix(found.frame_time, 's')}"
    if found.pulses_for == "false peaks":
        pulses += ", for fewer than 1 % false peaks"
    if found.reached:
        return f"A depth error of {asked} is reached with {pulses} ({total}); limit: {found.limit}."
    if found.pulses_for in ("depth error", "false peaks"):
        longest = with_prefix(found.time, "s")
        return f"A depth error of {asked} takes {pulses}, more than {longest}; limit: {found.limit}."
    return f"A depth error of {asked} is out of reach: {total} with {pulses}; limit: {found.limit}."


def _lines(found: Proposal) -> dict[str, str]:
    scene, pilot, eye = found.scene, found.pilot, found.eye
    gate, laser = scene.gate, scene.laser
    power = laser.pulse_energy * laser.repetition_rate
    because = {"": "the scene's", "pile-up": "the pile-up limit", "eye": "the eye's limit"}[found.energy_limit]
    hazard = {0.0: "nowhere", float("inf"): "at any distance"}.get(
        eye.hazard_distance, f"nearer than {with_prefix(eye.hazard_distance, 'm')}"
    )
    lines = {
        "target": f"{found.target_range[0]:.4g} to {found.target_range[1]:.4g} m, optical depth "
        f"{found.optical_depth:.3g} one way",
        "gate": f"start_ns = {gate.start_ns:g}, bins = {gate.bins} of {gate.bin_width_ps:g} ps: ranges "
        f"{found.gate_range[0]:.4g} to {found.gate_range[1]:.4g} m",
        "repetition": f"{with_prefix(laser.repetition_rate, 'Hz')}: unambiguous to {found.unambiguous_range:.4g} m; "
        f"this gate allows up to {with_prefix(found.largest_rate, 'Hz')}",
        "laser": f"{with_prefix(laser.pulse_energy, 'J')} a pulse ({because}), {with_prefix(power, 'W')} on average, "
        f"{with_prefix(found.irradiance, 'W')}/m² unscattered at the target",
        "pile-up limit": f"{with_prefix(found.pile_up_energy, 'J')} a pulse: {100 * spadwarp.analytic.PILE_UP:g} % of "
        "the pulses detected in the brightest pixels",
        "eye limit": f"{with_prefix(eye.pulse_energy, 'J')} a pulse, {with_prefix(eye.average_power, 'W')} at "
        f"{with_prefix(eye.distance, 'm')} for {eye.exposure:g} s ({eye.criterion}); hazard {hazard}",
        "": f"({eye.standard})",
        "a pixel detects": f"{pilot.target:.3g} photons of the target a pulse ({pilot.unscattered:.2g} unscattered), "
        f"{pilot.backscatter:.2g} of backscatter, {pilot.noise:.2g} of noise",
    }
    if found.largest_range == found.largest_range:
        asked = f"{with_prefix(found.depth_error, 'm')} within {with_prefix(found.time, 's')}"
        ends = f"; beyond it: {found.range_limit}" if found.range_limit else ""
        none = f"none for {asked}, {_PLANE}: {found.range_limit}"
        lines["largest range"] = (
            f"{found.largest_range:.3g} m for {asked}, {_PLANE}{ends}" if found.largest_range else none
        )
    return lines


def _reception(found: Proposal, name: str) -> str:
    """What a channel of the analyser keeps of all light."""
    whole, part = found.channels["I"], found.channels[name]

    def share(field: str) -> str:
        return f"{100 * getattr(part, field) / getattr(whole, field):.3g} %" if getattr(whole, field) else "none"

    text = f"{name.capitalize()}-polarised reception keeps {share('target')} of the target's light"
    text += f", {share('backscatter')} of the backscatter and {share('noise')} of the noise"
    if not math.isfinite(part.bound) or not math.isfinite(whole.bound):
        return text + "."
    ratio = part.bound / whole.bound
    return f"{text}; the same Cramér–Rao bound takes {ratio**2:.2g} times the pulses."


def _terms(found: Proposal) -> Table:
    """The parts of the depth error at the proposed pulses."""
    pilot = found.pilot
    floors = ", ".join(f"{name} {1000 * value:.3g}" for name, value in pilot.floor.items() if name != found.method)
    about = {
        "shot noise": "falls with the root of the pulses",
        "background": "backscatter, dark counts, ambient light; falls likewise",
        "Cramér–Rao bound": "both together: the least error of an unbiased estimator",
        "forward scattering": f"{found.method}; does not fall with the pulses; {floors}",
        "pile-up": "change of the median depth",
        "total": "root of the sum of squares",
    }
    table = new_table(f"depth error, {opt.count(found.pulses)} pulses", "mm", "")
    table.columns[-1].justify = "left"
    table.columns[-1].no_wrap = False
    for name, value in found.terms.items():
        table.add_row(name, short(1000 * value), about[name])
        if name == "forward scattering":
            alone = pilot.unscattered_floor[found.method]
            unscattered = (
                f"unscattered light alone: {1000 * alone:.3g}" if alone < math.inf else "all light is scattered"
            )
            table.add_row(
                "",
                "",
                f"from {opt.count(pilot.photons)} traced photons, ±{1000 * pilot.run_noise:.2g} a pixel; "
                + unscattered,
            )
    return table
