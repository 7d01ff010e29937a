"""The model repository for Triton: its layout, and a configuration that protobuf itself parses.

The message below has the fields of Triton's model_config.proto that a repository of ours uses, by
the names and types that they have there: any other name, or a value of another type, is an error.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field

from rts2.model.arch import Arch
from rts2.model.errors import UsageError
from rts2.search.deploy.configuration import read
from rts2.search.deploy.triton import model

Maker = Callable[..., Path]
TEXT, WHOLE, LONG, TRUTH = Field.TYPE_STRING, Field.TYPE_INT32, Field.TYPE_INT64, Field.TYPE_BOOL
ENUMS = {
    "DataType": ("TYPE_INVALID", "TYPE_INT32", "TYPE_FP32"),
    "Kind": ("KIND_AUTO", "KIND_GPU", "KIND_CPU"),
}
MESSAGES: dict[str, dict[str, Any]] = {
    "ModelInput": {"name": TEXT, "data_type": "DataType", "dims": [LONG]},
    "ModelOutput": {"name": TEXT, "data_type": "DataType", "dims": [LONG]},
    "ModelInstanceGroup": {"count": WHOLE, "kind": "Kind"},
    "WarmupInput": {"data_type": "DataType", "dims": [LONG], "random_data": TRUTH},
    "InputsEntry": {"key": TEXT, "value": "WarmupInput"},
    "ModelWarmup": {"name": TEXT, "batch_size": WHOLE, "inputs": ["InputsEntry"]},
    "ModelParameter": {"string_value": TEXT},
    "ParametersEntry": {"key": TEXT, "value": "ModelParameter"},
    "ModelConfig": {
        "name": TEXT,
        "backend": TEXT,
        "max_batch_size": WHOLE,
        "input": ["ModelInput"],
        "output": ["ModelOutput"],
        "instance_group": ["ModelInstanceGroup"],
        "model_warmup": ["ModelWarmup"],
        "parameters": ["ParametersEntry"],
    },
}


def parsed(text: str) -> Any:
    file = descriptor_pb2.FileDescriptorProto(
        name="model_config.proto", package="t", syntax="proto3"
    )
    for name, values in ENUMS.items():
        enum = file.enum_type.add(name=name)
        for number, value in enumerate(values):
            enum.value.add(name=value, number=number)
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields.items(), 1):
            label = Field.LABEL_REPEATED if isinstance(kind, list) else Field.LABEL_OPTIONAL
            one = kind[0] if isinstance(kind, list) else kind
            own = message.field.add(name=field, number=number, label=label)
            if isinstance(one, str):
                own.type_name = f".t.{one}"
                own.type = Field.TYPE_ENUM if one in ENUMS else Field.TYPE_MESSAGE
            else:
                own.type = one
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    config = message_factory.GetMessageClass(pool.FindMessageTypeByName("t.ModelConfig"))
    return text_format.Parse(text, config())


@pytest.mark.parametrize(
    ("kind", "backend", "group"),
    [
        (("cpu", "onnxruntime", "fp32"), "onnxruntime", 2),
        (("rtx2080ti", "tensorrt", "fp16"), "tensorrt", 1),
    ],
)
def test_the_configuration_says_what_the_deployment_does(
    bundle: Maker, kind: tuple[str, ...], backend: str, group: int
) -> None:
    folder = bundle(*kind, None, True)
    deployment = read(folder / "deployment.json")
    known = deployment.triton
    assert known is not None
    root = folder / known.repository / known.name
    found = parsed((root / "config.pbtxt").read_text())
    assert (found.name, found.backend, found.max_batch_size) == (root.name, backend, 0)
    fp32, int32 = 2, 1
    assert [(each.name, each.data_type, tuple(each.dims)) for each in found.input] == [
        (name, fp32, deployment.input.shape) for name in deployment.input.names
    ]
    assert [(each.name, each.data_type, tuple(each.dims)) for each in found.output] == [
        (each.name, fp32 if each.dtype == "float32" else int32, each.shape)
        for each in deployment.outputs
    ]
    assert [(each.count, each.kind) for each in found.instance_group] == [(1, group)]
    (warm,) = found.model_warmup
    assert warm.batch_size == 1
    told = {each.key: (tuple(each.value.dims), each.value.random_data) for each in warm.inputs}
    assert told == dict.fromkeys(deployment.input.names, (deployment.input.shape, True))
    parameters = {each.key: each.value.string_value for each in found.parameters}
    assert parameters == (
        {"intra_op_thread_count": "2", "inter_op_thread_count": "1"} if kind[0] == "cpu" else {}
    )


def test_the_graph_lies_where_the_server_looks_for_it(bundle: Maker) -> None:
    folder = bundle("cpu", "onnxruntime", "fp32", None, True)
    copy = folder / "triton" / "rts2net" / "1" / "model.onnx"
    assert copy.read_bytes() == (folder / "model.onnx").read_bytes()
    assert "--model-repository=triton" in (folder / "README.md").read_text()


def test_a_parser_of_fewer_words_is_one_that_refuses() -> None:
    for text in ("max_batch: 0", 'max_batch_size: "none"', "input [ { dims: [1.5] } ]"):
        with pytest.raises(text_format.ParseError):
            parsed(text)


def test_a_runtime_that_triton_is_not_made_for_is_refused() -> None:
    with pytest.raises(UsageError, match="made for onnxruntime or tensorrt, not for openvino"):
        model(Arch(c=1), "openvino")
