"""The deployment bundle: one folder with all that the target needs, and nothing that needs rts2.

A runtime is a row of `TARGETS`, in a file of its own: what it needs beside the graph. Everything
else (graph, configuration, samples, check) is the same for all.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ...model.arch import Precision
from ...model.bundle import CONFIGURATION, MODEL, contents
from ...model.errors import Rts2Error, UsageError
from ...model.files import write_bytes, write_json
from ...profiles.opset import refuse_operators
from ...profiles.profile import Profile, Runtime, RuntimeSupport
from ...profiles.trtexec import Generation
from . import ort, ov, triton, trt
from .configuration import describe
from .readme import readme
from .samples import answers, scenes
from .samples import written as written_samples
from .schema import Deployment
from .target import Order, Target

if TYPE_CHECKING:
    from ...model.checkpoint import Network
    from ...model.data.scene import Scene

VERIFY: Final = "verify.py"

TOLERANCE_PX = 1e-3
"""What the graph may differ from PyTorch, on a sample."""

TARGETS: Final[dict[Runtime, Target]] = {
    "onnxruntime": ort.TARGET,
    "openvino": ov.TARGET,
    "tensorrt": trt.TARGET,
}
"""How a bundle runs, by runtime."""

TOOLS: Final = ("rts2", "torch", "onnx", "onnxruntime")
"""Whose versions a bundle tells: they write the graph, and what is expected of it."""


@dataclass(frozen=True)
class Source:
    """A network, and how its weights came to be."""

    network: Network
    origin: str


def runtime_of(
    profile: Profile, asked: Runtime | None = None, precision: Precision = "fp32"
) -> RuntimeSupport:
    """The runtime that a bundle for the device is made for: what was asked for where a bundle can
    be, else the first of the device's that one can be made for, in the precision if any has it.

    Raises `UsageError` where rts2 delivers to none of the device's runtimes.
    """
    able = [support for support in profile.runtimes if support.runtime in TARGETS]
    if not able:
        raise UsageError(
            f"{profile.title} has no runtime that a bundle can be made for; "
            f"those are {', '.join(TARGETS)}"
        )
    own = (support for support in able if support.runtime == asked)
    fitting = (support for support in able if precision in TARGETS[support.runtime].tolerances)
    return next(own, None) or next(fitting, able[0])


def write(
    source: Source,
    deployment: Deployment,
    profile: Profile,
    folder: Path,
    generation: Generation | None = None,
    for_triton: bool = False,
) -> Deployment:
    """Writes the bundle into an empty folder; returns its configuration with files and hashes.

    `generation` is of TensorRT, where the device has more than one; `for_triton` adds a model
    repository.

    Raises:
        UsageError: the device or the bundle's runtime does not run the precision, or the device
            has no TensorRT of that generation.
        Rts2Error: the graph has operators that the device's runtime does not take, or its
            output is not the network's.
    """
    support = runtime_of(profile, deployment.runtime, deployment.precision)
    target = TARGETS[support.runtime]
    _refuse(deployment, profile, support, target, generation)
    known = triton.model(deployment.arch, support.runtime) if for_triton else None
    graph = folder / MODEL
    pairs = scenes(deployment.input.resolution)
    _export(source, deployment, support, graph, pairs[0])
    expected = answers(graph, pairs)
    plan_to = None if known is None else triton.file(known, support.runtime)
    made = target.make(
        Order(graph, deployment.precision, profile, support, generation, plan_to=plan_to)
    )
    if deployment.precision == "int8":
        # Beside the float answer, what integers cost would hide what a runtime gets wrong.
        expected = answers(graph, pairs)
    deployment = deployment.model_copy(
        update={
            "weights": source.origin,
            "runtime": support.runtime,
            "execution": made.execution,
            "layers": made.layers,
            "calibration": made.calibration,
            "triton": known,
            "check": written_samples(
                folder, pairs, expected, target.tolerances[deployment.precision]
            ),
            "versions": _versions(support.runtime),
        }
    )
    if known is not None:
        triton.write(folder, deployment, known)
    write_bytes(folder / VERIFY, script().encode())
    return _completed(deployment, profile, target, folder)


def stale(folder: Path) -> tuple[Path, ...]:
    """The files of an earlier bundle in `folder`, and what its scripts made; none without one."""
    if not (folder / CONFIGURATION).is_file():
        return ()
    known = contents(folder)
    if not known:
        return ()
    names = [file.name for file in known]
    left = (name for target in TARGETS.values() for name in target.leaves)
    return tuple(folder / name for name in (*names, *left, *triton.plans(names)))


def script() -> str:
    """verify.py, the same in every bundle."""
    return (resources.files(__package__) / "scripts" / VERIFY).read_text(encoding="utf-8")


def _refuse(
    deployment: Deployment,
    profile: Profile,
    support: RuntimeSupport,
    target: Target,
    generation: Generation | None,
) -> None:
    """Raises `UsageError` for what cannot be, before anything is made."""
    precision = deployment.precision
    if precision not in target.tolerances:
        raise UsageError(
            f"a bundle for {profile.title} runs {' or '.join(target.tolerances)} on "
            f"{support.runtime}, not {precision}; {_instead(profile, precision)}"
        )
    refusal = profile.refusal(precision)
    if refusal is not None:
        raise UsageError(f"{profile.title} does not run {precision}: {refusal.reason}")
    if support.runtime == "tensorrt":
        trt.generation_of(profile, support, generation)
    elif generation is not None:
        raise UsageError(f"--tensorrt is for TensorRT; this bundle runs on {target.title}")


def _instead(profile: Profile, precision: Precision) -> str:
    """What brings a precision that a runtime does not have."""
    other = runtime_of(profile, precision=precision).runtime
    if precision in TARGETS[other].tolerances and profile.refusal(precision) is None:
        return f"--runtime {other} has it"
    return "rts2-quantize makes such a graph"


def _export(
    source: Source, deployment: Deployment, support: RuntimeSupport, path: Path, pair: Scene
) -> None:
    """Writes the float graph, and checks its operators and, on a pair, its answers."""
    import torch

    from ...model.export import OPSET, export, parity
    from ...model.predictor import prepared

    resolution, forms = deployment.input.resolution, deployment.forms
    opset = support.opset or OPSET
    export(
        source.network,
        path,
        resolution,
        source.origin,
        opset=opset,
        forms=forms,
        runtime=support.runtime,
    )
    refuse_operators(path, support)
    multiple = deployment.arch.multiple
    left, right = (torch.from_numpy(prepared(image, multiple)) for image in (pair.left, pair.right))
    found = parity(path, source.network, left, right)
    if not found.disparity_px <= TOLERANCE_PX:
        raise Rts2Error(
            f"the exported graph differs from its network by {found.disparity_px:.2g} px, and "
            f"{TOLERANCE_PX:g} px is allowed; check the checkpoint for extreme weights"
        )


def _completed(
    deployment: Deployment, profile: Profile, target: Target, folder: Path
) -> Deployment:
    """The deployment with its files, README and configuration written last."""

    def listed() -> Deployment:
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        files = tuple(describe(path, folder) for path in paths)
        return deployment.model_copy(update={"files": files})

    write_bytes(folder / "README.md", readme(listed(), profile, target).encode())
    complete = listed()
    write_json(folder / CONFIGURATION, complete.model_dump(mode="json", by_alias=True))
    return complete


def _versions(runtime: Runtime) -> dict[str, str]:
    """What wrote the bundle, and the runtime's own version where it is installed."""
    installed = runtime == "openvino" and find_spec(runtime) is not None
    return {tool: version(tool) for tool in ((*TOOLS, runtime) if installed else TOOLS)}
