"""What may be wrong with a scene that is valid, in numbers, before a photon is traced."""

from spadwarp.checks.checks import check, summary
from spadwarp.checks.message import CheckMessage

__all__ = ["CheckMessage", "check", "summary"]
