"""The float network to quantize: a graph as given, or a checkpoint in any form of its graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np
import onnx

from ..model.arch import Form
from ..model.console import KITTI
from ..model.errors import Rts2Error, UsageError
from ..model.graph import GraphHeader, header_of, load_graph, read_header

if TYPE_CHECKING:
    from ..model.checkpoint import Header, Network


@dataclass(frozen=True)
class Asked:
    """How a checkpoint is exported; None for what is left open, and for graphs, which are of one
    size.
    """

    resolution: tuple[int, int] | None = None
    stages: int | None = None
    opset: int | None = None


class Source:
    """A trained float network at `path`; its graphs are written to `folder`.

    Raises:
        UsageError: something is asked of a graph that was exported already.
        Rts2Error: the file is broken, holds weights that are not finite, or is quantized already.
    """

    def __init__(self, path: Path, asked: Asked, folder: Path) -> None:
        self.path, self._asked, self._folder = path, asked, folder
        self.given = path.suffix.lower() == ".onnx"
        if self.given:
            self._refuse_asked()
            _require_float(path)
            _require_finite(load_graph(path), path)

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height of the images."""
        return read_header(self.path).resolution if self.given else self._asked.resolution or KITTI

    @cached_property
    def forms(self) -> tuple[tuple[Form, ...], ...]:
        """The forms that its graph can take, the same one for all stages; none where it has one."""
        if self.given:
            return ()
        stages = self.network.arch.stages  # an export may run fewer of them
        return tuple((form,) * stages for form in get_args(Form))

    def graph(self, forms: Sequence[Form] | None = None, runtime: str = "onnxruntime") -> Path:
        """The file of its graph for a runtime, in these forms where it has any."""
        if self.given:
            return self.path
        from ..model.export import OPSET, export

        path = self._folder / f"float-{'-'.join(forms or ['given'])}-{runtime}.onnx"
        if not path.exists():
            asked = self._asked
            export(
                self.network,
                path,
                self.resolution,
                self._loaded[1].origin,
                asked.opset or OPSET,
                asked.stages,
                forms or None,
                runtime,
            )
        return path

    @property
    def network(self) -> Network:
        """The network of a checkpoint."""
        return self._loaded[0]

    @cached_property
    def _loaded(self) -> tuple[Network, Header]:
        from ..model.checkpoint import load

        return load(self.path)

    def _refuse_asked(self) -> None:
        for name in ("resolution", "stages", "opset"):
            if getattr(self._asked, name) is not None:
                raise UsageError(f"--{name} is for checkpoints; {self.path} is exported already")


def opened(path: Path) -> tuple[onnx.ModelProto, GraphHeader]:
    """A graph of ours with what it says of itself."""
    model = load_graph(path)
    return model, header_of(model, path)


def _require_float(path: Path) -> None:
    precision = read_header(path).precision
    if precision != "fp32":
        raise UsageError(f"a float graph is needed: {path} is {precision} already")


def _require_finite(model: onnx.ModelProto, path: Path) -> None:
    """As the door of checkpoints does: such a network answers nothing, in any precision."""
    for tensor in model.graph.initializer:
        if tensor.data_type != onnx.TensorProto.FLOAT:
            continue
        if not np.isfinite(onnx.numpy_helper.to_array(tensor)).all():
            raise Rts2Error(
                f"{path}: {tensor.name} holds values that are not finite; train it again"
            )
