"""What this machine has and lacks for spadwarp, and whether the simulator computes what it should: `diagnose`."""

from spadwarp.doctor.diagnosis import Diagnosis, diagnose
from spadwarp.doctor.self_test import SelfTest

__all__ = ["Diagnosis", "SelfTest", "diagnose"]
