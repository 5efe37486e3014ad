"""Scenes: TOML in, frozen and validated models out.

`load_scene` reads a file, `Scene.from_dict` takes tables, `Scene.with_overrides` changes a scene. A section may name a
`preset`; the file's own fields lie over it and overrides over both. SI units, except where a name carries its unit.
"""

from spadwarp.scene.ambient_light import *
from spadwarp.scene.camera import *
from spadwarp.scene.laser import *
from spadwarp.scene.medium import *
from spadwarp.scene.pose import *
from spadwarp.scene.scene import *
from spadwarp.scene.sections import *
from spadwarp.scene.settings import *
from spadwarp.values import guarded

guarded(__name__)
