"""Test processes run side by side: threads of one would wait for cores that another holds."""

import torch

torch.set_num_threads(1)
