"""The simulator against physics whose answer is known without it.

>>> import spadwarp
>>> results = spadwarp.validate.run(["slab", "cube60"], photons=1_000_000, seed=1)
>>> all(result.passed for result in results)
True
"""

from spadwarp.validate.cases import *
from spadwarp.values import guarded

guarded(__name__)
