"""What NVIDIA's `trtexec` takes: its flags move from one version of TensorRT to the next."""

from __future__ import annotations

import re

from ..model.arch import Precision
from ..model.errors import UsageError

PATH = "/usr/src/tensorrt/bin/trtexec"
"""Where JetPack and NVIDIA's packages put it."""

WORKSPACE_MB = 1024
"""What a layer may use beside its inputs and outputs: a TX2 has 8 GB for everything."""

PRECISIONS: tuple[Precision, ...] = ("fp32", "fp16")
"""What it makes of a float graph; an INT8 engine of one would have scales that mean nothing."""

POOLS_SINCE = (8, 4)
"""`--memPoolSize` came in 8.4; `--workspace` went with 10."""

STRONGLY_TYPED_SINCE = (11, 0)
"""From here on the graph alone says what is half precision."""


def release(version: str) -> tuple[int, int]:
    """The first release that a profile's text names: `8.2 to 8.6` → (8, 2).

    Raises `UsageError` where it names none.
    """
    found = re.search(r"(\d+)\.(\d+)", version)
    if found is None:
        raise UsageError(
            f"a TensorRT version must be a number such as 8.2.1, not {version!r}; "
            "correct the profile's runtimes"
        )
    return int(found[1]), int(found[2])


def build_flags(version: str, precision: Precision) -> tuple[str, ...]:
    """How a float graph is built in `precision` by that version of TensorRT.

    Raises `UsageError` for a precision that it does not make of a float graph.
    """
    known = release(version)
    if precision not in PRECISIONS or (precision == "fp16" and known >= STRONGLY_TYPED_SINCE):
        raise UsageError(
            f"trtexec {known[0]}.{known[1]} makes no {precision} engine of a float graph; "
            "ask for fp32"
        )
    pool = f"memPoolSize=workspace:{WORKSPACE_MB}"
    memory = pool if known >= POOLS_SINCE else f"workspace={WORKSPACE_MB}"
    return (f"--{memory}", *(["--fp16"] if precision == "fp16" else []))
