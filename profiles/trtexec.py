"""What NVIDIA's `trtexec` takes: its flags move from one version of TensorRT to the next.

| | 8.2 | 8.4 | 8.6 | 10 | 11 |
| --- | --- | --- | --- | --- | --- |
| workspace | `--workspace` | both | both | `--memPoolSize` | `--memPoolSize` |
| layers that stay fp32 | – | `--layerPrecisions` | the same | the same | the graph's types |
| how hard it tries | – | – | `--builderOptimizationLevel` | the same | the same |
| fp16 | `--fp16` | `--fp16` | `--fp16` | `--fp16` | the graph's types |
| pairs of Q/DQ | `--int8` | `--int8` | `--int8` | `--int8` | the graph's types |
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final, Literal, get_args

from ..model.arch import Precision
from ..model.errors import UsageError

PATH = "/usr/src/tensorrt/bin/trtexec"
"""Where JetPack and NVIDIA's packages put it."""

LOCATE = f"""TRTEXEC=${{TRTEXEC:-{PATH}}}
if ! command -v "$TRTEXEC" >/dev/null 2>&1; then
    if command -v trtexec >/dev/null 2>&1; then
        TRTEXEC=trtexec
    else
        echo "trtexec is not at $TRTEXEC; set TRTEXEC to where it is" >&2
        exit 1
    fi
fi"""
"""Has a shell script find it, or end with one line."""

WORKSPACE_MB = 1024
"""What a layer may use beside its inputs and outputs: a TX2 has 8 GB for everything."""

PRECISIONS: tuple[Precision, ...] = ("fp32", "fp16")
"""What it makes of a float graph; an INT8 engine of one would have scales that mean nothing."""

Generation = Literal["8.2", "8.6", "10", "11"]
"""Releases after which flags, or what they mean, are others."""

GENERATIONS: Final[tuple[Generation, ...]] = get_args(Generation)

POOLS_SINCE = (8, 4)
"""`--memPoolSize` came in 8.4; `--workspace` went with 10."""

LAYER_PRECISIONS_SINCE = (8, 4)
"""`--layerPrecisions` came in 8.4 and went with 11."""

LEVELS_SINCE = (8, 6)
"""`--builderOptimizationLevel` came in 8.6."""

LEVEL = 5
"""The highest: an engine is built once, and runs for years."""

STRONGLY_TYPED_SINCE = (11, 0)
"""From here on the graph alone says what is half precision and what is integers."""

LAYER_INFO = ("--profilingVerbosity=detailed", "--exportLayerInfo=layers.json")
"""Has every layer of the engine, with its precision, written down; of all versions since 8.2."""


def release(version: str) -> tuple[int, int]:
    """The first release that a text names: `8.2 to 8.6` → (8, 2), `10` → (10, 0).

    Raises `UsageError` where it names none.
    """
    found = re.search(r"(\d+)(?:\.(\d+))?", version)
    if found is None:
        raise UsageError(
            f"a TensorRT version must be a number such as 8.2.1, not {version!r}; "
            "correct the profile's runtimes"
        )
    return int(found[1]), int(found[2] or 0)


def generation(version: str) -> Generation:
    """The generation that a version belongs to: 8.4.1 is one of 8.2.

    Raises `UsageError` for what is older than all of them.
    """
    known = [each for each in GENERATIONS if release(each) <= release(version)]
    if not known:
        raise UsageError(
            f"TensorRT must be {GENERATIONS[0]} or newer, not {version}: older ones do not read "
            "opset 13; update the device"
        )
    return known[-1]


def stored(version: str, precision: Precision) -> Precision:
    """What the graph itself must hold for an engine in `precision`; the rest flags ask for."""
    typed = release(version) >= STRONGLY_TYPED_SINCE
    return precision if precision == "int8" or typed else "fp32"


def rest(version: str) -> Precision:
    """What layers that an int8 graph keeps in float may run in."""
    return "fp32" if release(version) >= STRONGLY_TYPED_SINCE else "fp16"


def keeps_layers(version: str) -> bool:
    """Whether flags can ask for single layers to stay fp32."""
    return LAYER_PRECISIONS_SINCE <= release(version) < STRONGLY_TYPED_SINCE


def build_flags(
    version: str, precision: Precision, graph: Precision = "fp32", kept: Sequence[str] = ()
) -> tuple[str, ...]:
    """How a graph is built in `precision` by that version of TensorRT.

    `graph` is what the file holds: fp32, or the types and pairs of Q/DQ that `stored` asks for.
    `kept` are the layers of a float graph that should stay fp32, as far as flags can say so.

    Raises `UsageError` for a precision that it does not make of such a graph.
    """
    known = release(version)
    if precision not in (*PRECISIONS, "int8") or stored(version, precision) != graph:
        raise UsageError(
            f"trtexec {known[0]}.{known[1]} makes no {precision} engine of "
            f"{'a float graph' if graph == 'fp32' else f'an {graph} graph'}; ask for fp32"
        )
    level = [f"--builderOptimizationLevel={LEVEL}"] if known >= LEVELS_SINCE else []
    return (_workspace(known), *level, *_precision(version, precision, kept))


def _workspace(known: tuple[int, int]) -> str:
    if known >= POOLS_SINCE:
        return f"--memPoolSize=workspace:{WORKSPACE_MB}"
    return f"--workspace={WORKSPACE_MB}"


def _precision(version: str, precision: Precision, kept: Sequence[str]) -> list[str]:
    if precision == "fp32" or release(version) >= STRONGLY_TYPED_SINCE:
        return []
    flags = ["--int8", "--fp16"] if precision == "int8" else ["--fp16"]
    if kept and keeps_layers(version):
        layers = ",".join(f"{layer}:fp32" for layer in kept)
        flags += ["--precisionConstraints=prefer", f"--layerPrecisions={layers}"]
    return flags
