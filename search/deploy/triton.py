"""A model repository for NVIDIA's Triton Inference Server, beside the files of a bundle.

triton/rts2net/config.pbtxt
triton/rts2net/1/model.onnx      ONNX Runtime: a copy of the bundle's graph
triton/rts2net/1/model.plan      TensorRT: put there by build.sh
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Final

from ...model.arch import Arch
from ...model.bundle import MODEL
from ...model.errors import UsageError
from ...model.files import write_bytes
from ...profiles.profile import Runtime
from .schema import Deployment, OrtExecution, TritonModel

REPOSITORY: Final = "triton"
CONFIG: Final = "config.pbtxt"

FILES: Final[dict[Runtime, str]] = {"onnxruntime": MODEL, "tensorrt": "model.plan"}
"""What a backend of Triton runs, by runtime; the backends have the same names."""

TYPES: Final = {"float32": "TYPE_FP32", "int32": "TYPE_INT32"}


def model(arch: Arch, runtime: Runtime) -> TritonModel:
    """The repository of a network.

    Raises `UsageError` where Triton does not run it.
    """
    if runtime not in FILES:
        raise UsageError(
            f"a model repository for Triton is made for {' or '.join(FILES)}, not for {runtime}; "
            "give --runtime, or leave --target out"
        )
    return TritonModel(repository=REPOSITORY, name=arch.family)


def file(known: TritonModel, runtime: Runtime) -> str:
    """Where within the bundle the version's file is."""
    return f"{known.repository}/{known.name}/1/{FILES[runtime]}"


def plans(names: Iterable[str]) -> list[str]:
    """Where build.sh has put engines into the repositories among the files of a bundle."""
    roots = (PurePosixPath(name).parent for name in names if name.endswith(CONFIG))
    return [str(root / "1" / FILES["tensorrt"]) for root in roots]


def write(folder: Path, deployment: Deployment, known: TritonModel) -> None:
    """Writes the repository of a deployment that knows its execution into its bundle."""
    root = folder / known.repository / known.name
    root.mkdir(parents=True)
    write_bytes(root / CONFIG, config(deployment, known).encode())
    if FILES[deployment.runtime] == MODEL:
        copy = folder / file(known, deployment.runtime)
        copy.parent.mkdir()
        write_bytes(copy, (folder / MODEL).read_bytes())


def config(deployment: Deployment, known: TritonModel) -> str:
    """config.pbtxt: a message of the type ModelConfig in protobuf's text format."""
    given = deployment.input
    inputs = [(name, given.dtype, given.shape) for name in given.names]
    outputs = [(output.name, output.dtype, output.shape) for output in deployment.outputs]
    kind = "KIND_GPU" if deployment.runtime == "tensorrt" else "KIND_CPU"
    return f"""# One pair, normalised and padded by the client as ../../deployment.json says.
name: "{known.name}"
backend: "{deployment.runtime}"
max_batch_size: 0
input [
{_listed(inputs)}
]
output [
{_listed(outputs)}
]
instance_group [
  {{ count: 1 kind: {kind} }}
]
model_warmup [
  {{
    name: "one pair"
    batch_size: 1
{_warm(inputs)}
  }}
]
{_parameters(deployment)}"""


def _listed(tensors: Iterable[tuple[str, str, tuple[int, ...]]]) -> str:
    return ",\n".join(
        f'  {{ name: "{name}" data_type: {TYPES[dtype]} dims: {list(shape)} }}'
        for name, dtype, shape in tensors
    )


def _warm(inputs: Iterable[tuple[str, str, tuple[int, ...]]]) -> str:
    return "\n".join(
        f'    inputs {{ key: "{name}" value {{ data_type: {TYPES[dtype]} dims: {list(shape)} '
        "random_data: true } }"
        for name, dtype, shape in inputs
    )


def _parameters(deployment: Deployment) -> str:
    """The threads of ONNX Runtime, as its backend for Triton calls them."""
    execution = deployment.execution
    if not isinstance(execution, OrtExecution):
        return ""
    told = {
        "intra_op_thread_count": execution.intra_op_threads,
        "inter_op_thread_count": execution.inter_op_threads,
    }
    return "".join(
        f'parameters {{ key: "{key}" value {{ string_value: "{value}" }} }}\n'
        for key, value in told.items()
    )
