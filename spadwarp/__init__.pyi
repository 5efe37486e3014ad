# The packages, and which of their public names stand here too: for type checkers, and for `__init__.py`, which reads
# where a name is. Type checkers take "as" for public.

from spadwarp import scene as scene, water as water, mesh as mesh, checks as checks, transport as transport
from spadwarp import parallel as parallel, result as result, frames as frames, analytic as analytic
from spadwarp import inverse as inverse, dataset as dataset, denoise as denoise, evaluation as evaluation
from spadwarp import files as files, viz as viz, validate as validate, benchmark as benchmark, doctor as doctor
from spadwarp import device as device, arrays as arrays, io as io, values as values
from spadwarp.scene import Scene as Scene, load_scene as load_scene
from spadwarp.checks import check as check
from spadwarp.transport import RunOptions as RunOptions, reconstruct as reconstruct, simulate as simulate
from spadwarp.transport import truth_maps as truth_maps
from spadwarp.parallel import Ray as Ray
from spadwarp.result import Result as Result, merge as merge
from spadwarp.frames import Frames as Frames, arrival_time as arrival_time, crlb as crlb, detect as detect
from spadwarp.analytic import budget as budget, plan as plan, simulate_analytic as simulate_analytic, sweep as sweep
from spadwarp.inverse import fit as fit
from spadwarp.files import export as export, load as load
from spadwarp.arrays import to_pandas as to_pandas
from spadwarp.values import ArgumentError as ArgumentError, ConfigError as ConfigError, DeviceError as DeviceError
from spadwarp.values import FileError as FileError, MeshError as MeshError, SpadwarpError as SpadwarpError
from spadwarp.values import SpadwarpWarning as SpadwarpWarning
from spadwarp.values import __version__ as __version__
