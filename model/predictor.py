"""One way to run any network on numpy images: a checkpoint in PyTorch, a graph in ONNX Runtime.

No runtime is imported before a model of its kind is opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from .arch import MEAN, STD, Arch
from .bundle import graph_of
from .data.images import Bytes, Disparity
from .errors import Rts2Error, UsageError
from .files import existing_file, parse_json
from .graph import HEADER, GraphHeader
from .inference import open_session, serving_options
from .ops import padded

if TYPE_CHECKING:
    from onnx import ModelProto
    from torch import Tensor

    from .checkpoint import Network
    from .rts2net import Stage

Input = NDArray[np.float32]

UNSAVED: Final = Path("the graph")

MULTIPLE: Final = 32
"""What the sides are padded to for a graph that does not name its arch."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a network says of one pair, at the size of its images."""

    disparity: Disparity
    """(H, W), in pixels, as the network gives it: it may fall below 0."""
    semantic: Bytes | None
    """(H, W), train ids; None without a semantic branch."""
    seconds: float
    """From the network's inputs to its full-size maps, in the run that gave this estimate."""
    stage: int | None
    """1, 2 or 3; None where a graph does not say."""


class Predictor(Protocol):
    """A network that is ready to run. Images are (H, W, 3) RGB bytes of equal size."""

    @property
    def arch(self) -> Arch | None:
        """The network's arch; None for a graph that does not name it."""

    @property
    def origin(self) -> str | None:
        """How the weights came to be, in a sentence; None where the file does not say."""

    def predict(self, left: Bytes, right: Bytes, stages: int | None = None) -> Estimate:
        """The estimate of the last of `stages` stages; `UsageError` where it cannot stop there."""

    def predict_stages(
        self, left: Bytes, right: Bytes, stages: int | None = None
    ) -> list[Estimate]:
        """The estimates of every stage that the network can show, from one run."""


def open_model(path: Path) -> Predictor:
    """A network from an ONNX file, a bundle, a checkpoint of ours, or AnyNet's released one.

    Raises:
        UsageError: there is no such file.
        Rts2Error: the file is broken, or holds no network that takes a stereo pair.
    """
    path = model_file(path)
    if is_graph(path):
        return OnnxPredictor(path)
    from .checkpoint import load

    network, header = load(path)
    return TorchPredictor(network, header.origin)


def model_file(path: Path) -> Path:
    """The file of a model, which may stand in a bundle; raises as `open_model` does."""
    return existing_file(graph_of(path), "a model (a checkpoint or an ONNX file)")


def is_graph(path: Path) -> bool:
    """Whether a model's file is an ONNX file, by its name."""
    return path.suffix.lower() == ".onnx"


def prepared(image: Bytes, multiple: int) -> Input:
    """(H, W, 3) RGB bytes → (1, 3, H', W'), normalised, padded with zeros at the bottom and right.

    H' and W' are the next multiples. The zeros come after the normalisation: they are mean grey.
    """
    import cv2

    height, width = image.shape[:2]
    tensor = np.zeros((1, 3, *padded((width, height), multiple)), np.float32)
    # Looked up plane by plane, in place: a third of the time that arithmetic takes.
    planes = cv2.split(np.ascontiguousarray(image))
    for plane, table, target in zip(planes, _normalised(), tensor[0], strict=True):
        cv2.LUT(plane, table, target[:height, :width])
    return tensor


@cache
def _normalised() -> NDArray[np.float32]:
    """What a network is given for each byte of each channel: (3, 256)."""
    mean, std = (np.array(values, np.float32)[:, None] for values in (MEAN, STD))
    levels = np.arange(256, dtype=np.float32)
    return levels / (255 * std) - mean / std


class TorchPredictor:
    """A network in PyTorch, on the CPU, in fp32."""

    def __init__(self, network: Network, origin: str | None = None) -> None:
        self.network = network.eval()
        self.arch = network.arch
        self.origin = origin

    def predict(self, left: Bytes, right: Bytes, stages: int | None = None) -> Estimate:
        return self._run(left, right, stages, last_only=True)[-1]

    def predict_stages(
        self, left: Bytes, right: Bytes, stages: int | None = None
    ) -> list[Estimate]:
        return self._run(left, right, stages, last_only=False)

    def _run(
        self, left: Bytes, right: Bytes, stages: int | None, last_only: bool
    ) -> list[Estimate]:
        import torch

        depth = self.arch.up_to(stages).stages
        pair = [torch.from_numpy(prepared(image, self.arch.multiple)) for image in (left, right)]
        shown = range(depth - 1, depth) if last_only else range(depth)
        with torch.inference_mode():
            start = perf_counter()
            found = self.network(*pair, depth)
            maps = [enlarged(found[stage], pair[0].shape[-2:]) for stage in shown]
            seconds = perf_counter() - start
        return [
            cut_back(disparity, semantic, left, seconds, stage + 1)
            for stage, (disparity, semantic) in zip(shown, maps, strict=True)
        ]


class OnnxPredictor:
    """An ONNX graph of one size in ONNX Runtime, on the CPU.

    Inputs are `left` and `right`, float32 (1, 3, H, W); outputs `disparity`, float32 (1, H, W),
    and perhaps `semantic`, int32 (1, H, W).
    """

    def __init__(self, path: Path, model: bytes | None = None) -> None:
        self.path = path
        self.session = open_session(path, serving_options(), model)
        self.size = _input_size(self.session, path)
        self.outputs = _outputs(self.session, self.size, path)
        header = _header(self.session, path)
        self.arch = None if header is None else header.arch
        self.origin = None if header is None else header.origin

    @classmethod
    def of(cls, model: ModelProto, path: Path = UNSAVED) -> OnnxPredictor:
        """A graph that is in no file; errors name `path`."""
        return cls(path, model.SerializeToString())

    def predict(self, left: Bytes, right: Bytes, stages: int | None = None) -> Estimate:
        if stages not in (None, self.stages):
            runs = "its own number of" if self.stages is None else str(self.stages)
            raise UsageError(
                f"{self.path} always runs {runs} stages, not {stages}; "
                "leave --stages out, or give the checkpoint"
            )
        for image in (left, right):
            self.require_fits((image.shape[1], image.shape[0]))
        pair = {
            "left": prepared(left, self.multiple),
            "right": prepared(right, self.multiple),
        }
        start = perf_counter()
        found = dict(zip(self.outputs, self._answer(pair), strict=True))
        seconds = perf_counter() - start
        return cut_back(found["disparity"][0], found.get("semantic"), left, seconds, self.stages)

    def predict_stages(
        self, left: Bytes, right: Bytes, stages: int | None = None
    ) -> list[Estimate]:
        return [self.predict(left, right, stages)]

    @property
    def stages(self) -> int | None:
        """How many stages the graph runs; None where it does not say."""
        return None if self.arch is None else self.arch.stages

    @property
    def multiple(self) -> int:
        """What the sides of images are padded to."""
        return MULTIPLE if self.arch is None else self.arch.multiple

    def fits(self, resolution: tuple[int, int]) -> bool:
        """Whether images of this width and height pad to the size of the graph."""
        return padded(resolution, self.multiple) == self.size[::-1]

    def require_fits(self, resolution: tuple[int, int]) -> None:
        """Raises `UsageError` for images of a width and height that do not fit."""
        if not self.fits(resolution):
            own = "{}x{}".format(*resolution)
            height, width = padded(resolution, self.multiple)
            raise UsageError(
                f"{self.path} takes images that pad to {self.size[0]}x{self.size[1]}, and {own} "
                f"pads to {width}x{height}; export the checkpoint, or open it anew, for {own}"
            )

    def _answer(self, pair: dict[str, Input]) -> list[NDArray[Any]]:
        try:
            found: list[NDArray[Any]] = self.session.run(self.outputs, pair)
        except Exception as error:  # ONNX Runtime's errors share no other base
            raise Rts2Error(f"{self.path} fails in ONNX Runtime: {error}") from error
        return found


def enlarged(stage: Stage, size: Any) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """A stage's best disparity, (H, W), and its class ids, (1, H, W), both at full size."""
    import torch.nn.functional as F

    def full(maps: Tensor) -> Tensor:
        if maps.shape[-2:] == size:
            return maps
        return F.interpolate(maps, size=size, mode="bilinear", align_corners=False)

    # The indices of `max` come five times as fast as `argmax` along a middle axis.
    semantic = None if stage.scores is None else full(stage.scores).max(1).indices.numpy()
    return full(stage.best)[0, 0].numpy(), semantic


def cut_back(
    disparity: NDArray[Any],
    semantic: NDArray[Any] | None,
    image: Bytes,
    seconds: float,
    stage: int | None,
) -> Estimate:
    """An estimate without the padding."""
    height, width = image.shape[:2]
    labels = None if semantic is None else semantic[0, :height, :width].astype(np.uint8)
    return Estimate(disparity[:height, :width].astype(np.float32), labels, seconds, stage)


def _input_size(session: Any, path: Path) -> tuple[int, int]:
    """(width, height) of both inputs, if the graph takes a stereo pair."""
    found = {node.name: (node.type, list(node.shape)) for node in session.get_inputs()}
    first = found.get("left", ("", []))
    kind, shape = first
    fixed = len(shape) == 4 and shape[:2] == [1, 3] and all(isinstance(n, int) for n in shape)
    if kind != "tensor(float)" or not fixed or found != {"left": first, "right": first}:
        wanted = "left and right, tensor(float) [1, 3, H, W] of one fixed size"
        raise Rts2Error(f"{path} must take the inputs {wanted}; it takes {_listed(found)}")
    return shape[3], shape[2]


def _outputs(session: Any, size: tuple[int, int], path: Path) -> list[str]:
    """The names of the outputs, if they are a disparity map and perhaps class ids."""
    found = {node.name: (node.type, list(node.shape)) for node in session.get_outputs()}
    shape = [1, size[1], size[0]]
    known = {"disparity": ("tensor(float)", shape), "semantic": ("tensor(int32)", shape)}
    if "disparity" not in found or any(known.get(name) != value for name, value in found.items()):
        wanted = f"disparity, tensor(float) {shape}, and at most semantic, tensor(int32) {shape}"
        raise Rts2Error(f"{path} must give the outputs {wanted}; it gives {_listed(found)}")
    return list(found)


def _header(session: Any, path: Path) -> GraphHeader | None:
    """What the graph says of itself; None if another tool wrote it."""
    entry = session.get_modelmeta().custom_metadata_map.get(HEADER)
    return None if entry is None else parse_json(entry, GraphHeader, f"the header of {path}")


def _listed(nodes: dict[str, tuple[str, list[Any]]]) -> str:
    return ", ".join(f"{name}, {kind} {shape}" for name, (kind, shape) in nodes.items()) or "none"
