"""Mixed precision: which one a device has, and what runs in it."""

from __future__ import annotations

from typing import Final, Literal

import torch

from ..errors import UsageError
from .recipe import Precision

Resolved = Literal["fp32", "bf16", "fp16"]

DTYPES: Final[dict[Resolved, torch.dtype]] = {
    "fp32": torch.float32,
    "bf16": torch.bfloat16,
    "fp16": torch.float16,
}

BF16_CAPABILITY: Final = (8, 0)
"""NVIDIA GPUs compute in bf16 from this compute capability on."""


def resolve(precision: Precision, device: torch.device) -> Resolved:
    """What `precision` means on `device`; `auto` is the fastest that the hardware has."""
    if precision == "auto":
        return _fastest(device)
    if precision == "fp16" and device.type != "cuda":
        raise UsageError("fp16 trains on CUDA alone; take --precision bf16 or fp32 on a CPU")
    return precision


def _fastest(device: torch.device) -> Resolved:
    if device.type == "cuda":
        new = torch.cuda.get_device_capability(device) >= BF16_CAPABILITY
        return "bf16" if new else "fp16"
    native = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return "bf16" if native else "fp32"
