"""Denoisers of depth frames: networks, what they are compared with, how they are trained and judged.

torch is needed by `networks`, `noise`, `training` and whatever loads them, and by nothing else of spadwarp:
`pip install "spadwarp[denoise]"`.
"""
