"""PyTorch: eager and compiled on the CPU, eager and as a CUDA graph on a GPU."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Final, NoReturn

from ...model.arch import Precision
from ...model.errors import Rts2Error
from ...model.ops import padded
from .session import Sized

if TYPE_CHECKING:
    import torch

COMPILERS: Final = ("g++", "clang++", "c++")
"""What PyTorch's compiler makes its kernels with, unless CXX names another."""

CAPTURE_WARM_UP = 3
"""Runs before a graph is captured: kernels are chosen and memory is taken then, not within."""

CPU: Final = "cpu"
CUDA: Final = "cuda"


class Session:
    """A network in PyTorch eager, on one device, in one precision."""

    def __init__(self, sized: Sized, device: str, precision: Precision, threads: int) -> None:
        import torch

        from ...model.checkpoint import cut
        from ...model.export import Deployed

        torch.set_num_threads(threads)
        self._threads = threads
        self._device = torch.device(device)
        self._half = _dtype(precision)
        part = cut(sized.network, sized.network.arch.up_to(sized.stages))
        network = Deployed(part).eval()
        height, width = padded(sized.resolution, network.arch.multiple)
        _lower(network, self._half)
        self._network: Any = network.to(self._device)
        chance = torch.Generator().manual_seed(0)
        pair = torch.randn(2, 1, 3, height, width, generator=chance)
        self._pair = [image.to(self._device) for image in pair]

    def run(self) -> None:
        """One pair through the network."""
        import torch

        if self._device.type == CPU and torch.get_num_threads() != self._threads:
            torch.set_num_threads(self._threads)  # one number for the whole process
        self._forward()
        self._wait()

    def node_times_ms(self, _runs: int) -> NoReturn:
        """PyTorch knows no nodes of an ONNX file."""
        raise Rts2Error(
            "PyTorch runs no ONNX file, so it has no times of its nodes; "
            "onnxruntime and openvino have"
        )

    def _forward(self) -> Any:
        import torch

        with torch.inference_mode(), _arithmetic(self._device, self._half):
            return self._network(*self._pair)

    def _wait(self) -> None:
        """A GPU works on after the call; a time without this would be that of the launch."""
        import torch

        if self._device.type == CUDA:
            torch.cuda.synchronize(self._device)


class Compiled(Session):
    """A network through torch.compile, for the one size."""

    def __init__(self, sized: Sized, device: str, precision: Precision, threads: int) -> None:
        import torch

        super().__init__(sized, device, precision, threads)
        self._network = torch.compile(self._network, dynamic=False)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the compiler's own, of what it leaves eager
                self.run()
        except Exception as error:  # a compiler fails in as many ways as it has parts
            raise Rts2Error(f"PyTorch cannot compile the network: {error}") from error


class Captured(Session):
    """A network as one CUDA graph: launched as a whole, from and to memory that stays in place."""

    def __init__(self, sized: Sized, device: str, precision: Precision, threads: int) -> None:
        import torch

        super().__init__(sized, device, precision, threads)
        # A capture must not begin on the default stream, nor with work of it under way.
        side = torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]
        side.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(side):
            for _ in range(CAPTURE_WARM_UP):
                self._forward()
        torch.cuda.current_stream(self._device).wait_stream(side)
        self._wait()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._outputs = self._forward()

    def run(self) -> None:
        """One pair through the network."""
        self._graph.replay()
        self._wait()


def eager_cpu(sized: Sized, precision: Precision, threads: int) -> Session:
    """PyTorch eager on the CPU."""
    return Session(sized, CPU, precision, threads)


def compiled_cpu(sized: Sized, precision: Precision, threads: int) -> Session:
    """PyTorch, compiled for the CPU."""
    return Compiled(sized, CPU, precision, threads)


def eager_cuda(sized: Sized, precision: Precision, threads: int) -> Session:
    """PyTorch eager on the GPU."""
    return Session(sized, CUDA, precision, threads)


def captured_cuda(sized: Sized, precision: Precision, threads: int) -> Session:
    """PyTorch on the GPU as a CUDA graph."""
    return Captured(sized, CUDA, precision, threads)


def precisions_cpu(_stored: Precision) -> tuple[Precision, ...]:
    """What PyTorch on the CPU is timed in."""
    return ("fp32",)


def precisions_cuda(_stored: Precision) -> tuple[Precision, ...]:
    """What PyTorch on this GPU is timed in; bf16 where the GPU has it."""
    import torch

    newer = torch.cuda.get_device_capability() >= (8, 0)
    return ("fp32", "bf16", "fp16") if newer else ("fp32", "fp16")


def versions() -> dict[str, str]:
    """PyTorch's version, as a profile records it."""
    import torch

    return {"torch": torch.__version__}


def versions_cuda() -> dict[str, str]:
    """PyTorch's version, and those of what it calls on a GPU, the GPU's name included."""
    import torch

    return {
        **versions(),
        "cuda": str(torch.version.cuda),
        "cudnn": str(torch.backends.cudnn.version()),  # type: ignore[no-untyped-call]
        "gpu": torch.cuda.get_device_name(),
    }


def missing() -> None:
    """PyTorch comes with rts2."""


def missing_compiler() -> str | None:
    """What to install where PyTorch finds no C++ compiler."""
    named = os.environ.get("CXX")
    if any(shutil.which(name) for name in ((named,) if named else COMPILERS)):
        return None
    lacking = f"CXX names {named}, which is none" if named else f"there is no {COMPILERS[0]}"
    return f"PyTorch compiles with a C++ compiler, and {lacking}; install g++"


def missing_gpu() -> str | None:
    """Why there is no CUDA."""
    import torch

    if torch.cuda.is_available():
        return None
    if torch.version.cuda is None:
        return "this PyTorch is built without CUDA; install a build with it (see pytorch.org)"
    return "PyTorch finds no GPU with CUDA on this machine; choose another --runtime"


def _dtype(precision: Precision) -> torch.dtype | None:
    """The half precision that is meant; None for fp32."""
    import torch

    return {"fp16": torch.float16, "bf16": torch.bfloat16}.get(precision)


def _lower(network: Any, half: torch.dtype | None) -> None:
    """Stores the convolutions' weights in half precision, so that no run casts them."""
    from torch import nn

    for module in network.modules():
        if half is not None and isinstance(module, (nn.Conv2d, nn.Conv3d)):
            module.to(half)


@contextmanager
def _arithmetic(device: torch.device, half: torch.dtype | None) -> Iterator[None]:
    """Half precision where asked for, and otherwise true fp32: no TF32 in its place."""
    import torch

    with ExitStack() as stack:
        if half is not None:
            # Without the cache: what it holds would not outlive the capture of a graph.
            stack.enter_context(torch.autocast(device.type, half, cache_enabled=False))
        if device.type == CUDA:
            flags = torch.backends.cudnn.flags
            stack.enter_context(
                flags(enabled=True, benchmark=True, deterministic=False, allow_tf32=False)
            )
        yield
