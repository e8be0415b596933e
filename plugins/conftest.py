"""Triton's kernels run in its interpreter where there is no CUDA GPU.

Triton reads that when it is imported, which tests of other folders do: `pytest` loads this file before it collects any.
"""

import os

import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")
