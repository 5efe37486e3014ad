"""`spadwarp devices`: what photons can be traced on."""

from __future__ import annotations

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


@app.command()
def devices(overwrite: opt.Overwrite = False, json_path: opt.Json = None) -> None:
    """Devices that can trace photons: the CPU and the GPUs.

    \b
    Example:
      spadwarp devices
    """
    outputs = opt.check_outputs(json=json_path, overwrite=overwrite)
    found = spadwarp.device.devices()
    for device in found:
        memory = f", {opt.in_bytes(device['memory'])}" if device["memory"] else ""
        say(f"{device['name']:<8}  {device['description']}{memory}" + ("  (default)" if device["default"] else ""))
    if len(found) == 1:
        say("no NVIDIA GPU with driver R580 or newer was found")
    outputs.write_json({"devices": found})
