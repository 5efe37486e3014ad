"""The smallest scene that is valid, and what is said about one that is not."""

import pytest

from spadwarp.scene import Scene
from spadwarp.values import ConfigError

CAMERA = {"width": 8, "height": 6, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.01}
MINIMAL = {"medium": {"extinction": 0.3, "albedo": 0.8}, "camera": CAMERA, "gate": {"bin_width_ps": 100.0, "bins": 50}}


def scene(**sections: dict) -> Scene:
    return Scene.from_dict({**MINIMAL, **sections})


def problems(tables: dict | None = None, overrides: object = None) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        Scene.from_dict({**MINIMAL, **(tables or {})}).with_overrides(overrides)
    return caught.value.problems
