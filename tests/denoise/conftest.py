"""Small arrays: more threads of torch take longer than one."""

import torch

torch.set_num_threads(1)
