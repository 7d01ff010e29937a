"""The deployment bundle: one folder with all that the target needs, and nothing that needs rts2.

A target is a row of `TARGETS`: how its files are made runnable there. Everything else (graph,
configuration, sample, check) is the same for all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...model.arch import UNTRAINED, Precision
from ...model.errors import Rts2Error, UsageError
from ...model.files import write_bytes, write_json
from ...profiles.opset import refuse_operators
from ...profiles.profile import Profile, Runtime, RuntimeSupport
from ...profiles.trtexec import PATH, WORKSPACE_MB
from .configuration import Check, Deployment, describe, read

if TYPE_CHECKING:
    from ...model.checkpoint import Network

Floats = NDArray[np.float32]

MODEL = "model.onnx"
BUILT = ("model.plan", "timing.cache", "output.json", "times.json")
"""What the scripts make on the device."""

TOLERANCE_PX = 1e-3
"""What the graph may differ from PyTorch, on the sample."""


@dataclass(frozen=True)
class Target:
    """How a runtime gets from the graph to something that runs."""

    measured: str
    """The script that runs the sample there, among the files beside this one."""
    tolerance_px: Mapping[Precision, float]
    """What it makes of a float graph, and how far each may be from the sample's expected disparity,
    on average."""
    build: Callable[[Deployment], str] | None = None
    """The script that builds an engine there."""


def trtexec(deployment: Deployment) -> str:
    """The build script for TensorRT: one `trtexec` call to build, one to run the sample."""
    half = " --fp16" if deployment.precision == "fp16" else ""
    return f"""#!/bin/sh
# Builds the engine for {deployment.device} and runs the sample through it. Run it on the device,
# at the power mode and clocks that you will use (on a Jetson: nvpmodel -q, jetson_clocks --show).
set -eu
cd "$(dirname "$0")"
TRTEXEC=${{TRTEXEC:-{PATH}}}
"$TRTEXEC" --onnx={MODEL} --saveEngine=model.plan{half} --workspace={WORKSPACE_MB} \\
    --timingCacheFile=timing.cache --buildOnly
"$TRTEXEC" --loadEngine=model.plan{half} --warmUp=500 --duration=10 --iterations=50 \\
    --loadInputs=left:sample_left.bin,right:sample_right.bin \\
    --exportOutput=output.json --exportTimes=times.json
python3 check.py
"""


TARGETS: dict[str, Target] = {
    "onnxruntime": Target("measured_onnxruntime.py", {"fp32": 0.01, "int8": 0.5}),
    "openvino": Target("measured_openvino.py", {"fp32": 0.01, "bf16": 1.0, "fp16": 0.1}),
    "tensorrt": Target("measured_tensorrt.py", {"fp32": 0.1, "fp16": 0.1}, build=trtexec),
}
"""How a bundle runs, by runtime. Beside half precision, TensorRT's tolerance allows for TF32; of a
disparity above 128 pixels the last bit of bf16 is a pixel. Integers are held against ONNX Runtime's
own answer, and processors without their instructions round differently."""


def runtime_of(profile: Profile, asked: Runtime | None = None) -> RuntimeSupport:
    """The runtime that a bundle for the device is made for: what was asked for where a bundle can
    be, else the first of the device's that one can be made for.

    Raises `UsageError` where rts2 delivers to none of the device's runtimes.
    """
    able = [support for support in profile.runtimes if support.runtime in TARGETS]
    if not able:
        raise UsageError(
            f"{profile.title} has no runtime that a bundle can be made for; "
            f"those are {', '.join(TARGETS)}"
        )
    return next((support for support in able if support.runtime == asked), able[0])


def write(
    network: Network, deployment: Deployment, profile: Profile, origin: str, folder: Path
) -> Deployment:
    """Writes the bundle into an empty folder; returns its configuration with files and hashes.

    Raises:
        UsageError: the bundle's runtime does not run the precision.
        Rts2Error: the graph has operators that the device's runtime does not take, or its
            output is not the network's.
    """
    support = runtime_of(profile, deployment.runtime)
    target = TARGETS[support.runtime]
    if deployment.precision not in target.tolerance_px:
        raise UsageError(
            f"a bundle for {profile.title} runs {' or '.join(target.tolerance_px)} on "
            f"{support.runtime}, not {deployment.precision}; rts2-quantize makes such a graph"
        )
    model = folder / MODEL
    sample = _sample(deployment)
    disparity = _export(network, deployment, support, origin, model, sample)
    written = [model]
    for name, values in (("left", sample[0]), ("right", sample[1]), ("disparity", disparity)):
        path = folder / f"sample_{name}.bin"
        write_bytes(path, np.ascontiguousarray(values, dtype="<f4").tobytes())
        written.append(path)
    scripts = {"check.py": _text("check.py"), "measured.py": _text(target.measured)}
    if target.build is not None:
        scripts["build.sh"] = target.build(deployment)
    deployment = deployment.model_copy(update={"weights": origin, "runtime": support.runtime})
    scripts["README.md"] = _readme(deployment, profile, support)
    for name, text in scripts.items():
        write_bytes(folder / name, text.encode())
        written.append(folder / name)
    if target.build is not None:
        (folder / "build.sh").chmod(0o755)
    complete = deployment.model_copy(
        update={
            "files": tuple(describe(path) for path in sorted(written)),
            "check": Check(tolerance_px=target.tolerance_px[deployment.precision]),
        }
    )
    write_json(folder / "deployment.json", complete.model_dump(mode="json", by_alias=True))
    return complete


def stale(folder: Path) -> tuple[Path, ...]:
    """The files of an earlier bundle in `folder`, and what its scripts made; none without one."""
    path = folder / "deployment.json"
    files = read(path).files if path.is_file() else ()
    names = (*(file.name for file in files), *BUILT) if files else ()
    return tuple(folder / name for name in names if Path(name).name == name)


def _sample(deployment: Deployment) -> tuple[Floats, Floats]:
    """A normalised pair of the input's shape: a smooth random texture, the right one shifted.

    It needs no photograph, and every part of the network answers to it.
    """
    _, channels, height, width = deployment.input.shape
    shift = 16
    chance = np.random.default_rng(0)
    coarse = chance.standard_normal((channels, height // 4 + 1, (width + shift) // 4 + 1))
    texture = np.kron(coarse, np.ones((4, 4)))[:, :height, : width + shift].astype(np.float32)
    return texture[None, :, :, :width], texture[None, :, :, shift : shift + width]


def _export(
    network: Network,
    deployment: Deployment,
    support: RuntimeSupport,
    origin: str,
    path: Path,
    sample: tuple[Floats, Floats],
) -> Floats:
    """Writes the graph, checks it, and returns PyTorch's disparity of the sample, or that of the
    graph itself where it is one of integers.
    """
    import torch

    from ...model.export import OPSET, Deployed, export, parity
    from .integers import answer, lower

    opset = support.opset or OPSET
    resolution, forms = deployment.input.resolution, deployment.forms
    export(network, path, resolution, origin, opset=opset, forms=forms)
    refuse_operators(path, support)
    left, right = (torch.from_numpy(np.ascontiguousarray(image)) for image in sample)
    found = parity(path, network, left, right)
    if not found.disparity_px <= TOLERANCE_PX:
        raise Rts2Error(
            f"the exported graph differs from its network by {found.disparity_px:.2g} px, and "
            f"{TOLERANCE_PX:g} px is allowed; check the checkpoint for extreme weights"
        )
    if deployment.precision == "int8":
        lower(path)
        return answer(path, *sample)
    with torch.inference_mode():
        disparity: Floats = Deployed(network).eval()(left, right)[0].numpy()
    return disparity


def _warning(deployment: Deployment) -> str:
    """What the weights do not promise."""
    if deployment.weights == UNTRAINED:
        return "They are random: the frame rate is real, the disparity means nothing."
    expected = deployment.expected
    if expected is None or expected.evidence.accuracy is None:
        return "What accuracy they reach is not known."
    if expected.judged_on is not None:
        return f"Accuracies in `deployment.json` are theirs, judged on {expected.judged_on}."
    return "Accuracies in `deployment.json` are those of the search's source, not of these weights."


def next_step(runtime: Runtime) -> str:
    """The command that builds and checks a bundle of a runtime on the device."""
    return "python3 check.py" if TARGETS[runtime].build is None else "sh build.sh"


def _text(name: str) -> str:
    return (resources.files(__package__) / "scripts" / name).read_text(encoding="utf-8")


def _readme(deployment: Deployment, profile: Profile, support: RuntimeSupport) -> str:
    """What an integrator reads first."""
    expected = deployment.expected
    promise = "No search promised a frame rate for it."
    if expected is not None:
        promise = (
            f"Expected: {expected.fps:.1f} FPS ({expected.fps_low:.1f} to "
            f"{expected.fps_high:.1f} at {expected.confidence:.0%}), {expected.evidence.latency}"
        )
        if expected.runtime != support.runtime:
            promise += (
                f" for {expected.runtime}; what is built here runs on {support.runtime}, "
                "whose speed the check tells"
            )
        promise += "."
    return f"""# {deployment.arch.label()} for {profile.title}

{promise}
Weights: {deployment.weights}. {_warning(deployment)}

    {next_step(support.runtime)}

runs the sample pair through the network on this device, compares the disparity with what is
expected, and prints the measured frame rate beside the promised one. `deployment.json` says how
images become inputs, what the outputs mean, and the hash of every file.
"""
