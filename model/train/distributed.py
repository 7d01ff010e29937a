"""Several processes as one: sums across them, and batch norm over the whole batch.

`torchrun` starts the processes and says so in the environment; without it there is one. Torch's
own SyncBatchNorm runs on CUDA alone; `GlobalNorm` runs wherever an all-reduce does, and its
weights go by the same names as those of the norm that it stands for.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from textwrap import shorten
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.rendezvous import rendezvous

from ..errors import Rts2Error, UsageError

Found = TypeVar("Found")

MEETING_SECONDS = 120
"""How long a process waits for the first one at the start; torchrun starts them together."""


class Everywhere(Rts2Error):
    """An error that every process raises at once, so that one of them may tell it for all."""

    def __init__(self, error: Rts2Error, text: str | None = None) -> None:
        super().__init__(str(error) if text is None else text)
        self.exit_code = error.exit_code


class Lost(Rts2Error):
    """Another process has ended, which mostly tells why by itself."""


@dataclass(frozen=True)
class World:
    """One process among all of a run."""

    rank: int = 0
    size: int = 1
    local: int = 0
    """Which of its machine's processes it is."""
    local_size: int = 1
    """How many processes its machine has."""

    @property
    def first(self) -> bool:
        """Whether this is the process that writes and speaks."""
        return self.rank == 0

    def total(self, numbers: Sequence[int]) -> list[int]:
        """Each number summed over all processes."""
        if self.size == 1:
            return list(numbers)
        with self._meeting():
            summed = torch.tensor(numbers, dtype=torch.int64, device=_device())
            dist.all_reduce(summed)
        return [int(number) for number in summed]

    def add(self, tensors: Sequence[Tensor]) -> None:
        """Sums each tensor over all processes, in place, in one message."""
        if self.size == 1 or not tensors:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        with self._meeting():
            dist.all_reduce(flat)
        parts = torch.split(flat, [tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view(tensor.shape))

    def gathered(self, value: Any) -> list[Any]:
        """The value of every process, in their order."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        with self._meeting():
            dist.all_gather_object(values, value)
        return values

    def together(self, work: Callable[[], Found]) -> Found:
        """What `work` gives; where it fails in one process, all of them raise its error.

        `work` must not meet the other processes. Where not all fail alike, the error names the
        first process that did.
        """
        if self.size == 1:
            return work()
        found: list[Found] = []
        own: Rts2Error | None = None
        try:
            found.append(work())
        except Rts2Error as error:
            own = error
        every = self.gathered(own)
        failed = [rank for rank, error in enumerate(every) if error is not None]
        if failed:
            first: Rts2Error = every[failed[0]]
            alike = all(str(error) == str(first) for error in every)
            raise Everywhere(first, None if alike else f"process {failed[0]}: {first}") from own
        return found[0]

    def everywhere(self, error: Rts2Error) -> Rts2Error:
        """`error`, marked as one that every process raises."""
        return error if self.size == 1 else Everywhere(error)

    def lost(self, error: RuntimeError) -> Lost:
        """What torch raises where another process is gone, in one line of ours."""
        return Lost(f"process {self.rank} lost the others ({shorten(first_line(error), 160)})")

    @contextmanager
    def _meeting(self) -> Iterator[None]:
        """Turns what torch raises where another process is gone into a `Lost`."""
        try:
            yield
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as error:
            raise self.lost(error) from error


def world_of_environment() -> World:
    """What torchrun says in the environment; one process without it."""
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    told = [os.environ.get(name, alone) for name, alone in zip(names, "0101", strict=True)]
    if not all(number.isascii() and number.isdigit() for number in told):
        raise UsageError(f"{', '.join(names)} must be whole numbers, not {', '.join(told)}")
    rank, size, local, local_size = map(int, told)
    if rank >= size:
        raise UsageError(f"RANK must be 0 to WORLD_SIZE − 1; it is {rank} of {size}")
    return World(rank, size, local, max(local_size, 1))


def require_divides(world: World, batch: int, accumulate: int) -> None:
    """Every process needs the same share of every micro-batch; else a `UsageError`."""
    micro = batch // accumulate
    if micro % world.size:
        fitting = ", ".join(str(size) for size in range(1, micro + 1) if micro % size == 0)
        cut = f" (a batch of {batch} in {accumulate} micro-batches)" if accumulate > 1 else ""
        raise world.everywhere(
            UsageError(
                f"the batch must divide among the processes: {micro} samples{cut} "
                f"among {world.size}; start one of {fitting} processes, or change --batch"
            )
        )


def join(world: World, device: torch.device) -> None:
    """Meets the other processes: over NCCL where they have a GPU each, else over Gloo.

    Raises `UsageError` where nothing says where to meet, or nobody is there.
    """
    if world.size == 1:
        return
    backend = "nccl" if device.type == "cuda" else "gloo"
    try:
        patience = timedelta(seconds=MEETING_SECONDS)
        store, *_ = next(rendezvous("env://", world.rank, world.size, timeout=patience))
        store.set_timeout(dist.default_pg_timeout)
        dist.init_process_group(backend, store=store, rank=world.rank, world_size=world.size)
    except (ValueError, RuntimeError, OSError) as error:
        raise UsageError(
            f"the processes cannot meet: {first_line(error).rstrip('.')}; start them with "
            "torchrun, which says where (MASTER_ADDR, MASTER_PORT)"
        ) from error


def leave(world: World) -> None:
    """Ends what `join` began."""
    if world.size > 1 and dist.is_initialized():
        dist.destroy_process_group()


def share_norms(network: nn.Module) -> None:
    """Puts a `GlobalNorm` in the place of every batch norm, around the same weights."""
    for module in list(network.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, nn.BatchNorm2d | nn.BatchNorm3d):
                setattr(module, name, GlobalNorm.around(child))


class GlobalNorm(nn.modules.batchnorm._BatchNorm):
    """Batch norm whose batch is that of all processes together."""

    @staticmethod
    def around(norm: nn.BatchNorm2d | nn.BatchNorm3d) -> GlobalNorm:
        """The same norm, parameters and statistics shared."""
        found = GlobalNorm(
            norm.num_features,
            norm.eps,
            norm.momentum,
            track_running_stats=norm.track_running_stats,
            device="meta",
        )
        for name, parameter in norm.named_parameters():
            setattr(found, name, parameter)
        for name, buffer in norm.named_buffers():
            setattr(found, name, buffer)
        return found.train(norm.training)

    def _check_input_dim(self, inputs: Tensor) -> None:
        """Any number of dimensions will do."""

    def forward(self, inputs: Tensor) -> Tensor:
        """(B, C, …) → the same shape; the statistics are in fp32 and over every process."""
        if not self.training:
            return super().forward(inputs)
        values = inputs.float()
        axes = [0, *range(2, values.dim())]
        shape = [1, -1, *[1] * (values.dim() - 2)]
        number = values.numel() // values.shape[1] * dist.get_world_size()
        mean = _total(values.sum(axes)) / number
        centred = values - mean.view(shape)
        variance = _total(centred.square().sum(axes)) / number
        if self.track_running_stats:
            self._remember(mean.detach(), variance.detach(), number)
        scale = self.weight * (variance + self.eps).rsqrt()
        normed: Tensor = centred * scale.view(shape) + self.bias.view(shape)
        return normed.to(inputs.dtype)

    def _remember(self, mean: Tensor, variance: Tensor, number: int) -> None:
        """Moves the running statistics, as torch's norms do: with the unbiased variance."""
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        self.num_batches_tracked.add_(1)
        momentum = 0.1 if self.momentum is None else self.momentum
        self.running_mean.lerp_(mean, momentum)
        self.running_var.lerp_(variance * number / max(number - 1, 1), momentum)


class _Sum(torch.autograd.Function):
    """The sum over all processes; each process's loss is a part of one, so gradients sum too."""

    @staticmethod
    def forward(_context: Any, values: Tensor) -> Tensor:
        summed = values.clone()
        dist.all_reduce(summed)
        return summed

    @staticmethod
    def backward(_context: Any, gradient: Tensor) -> Tensor:
        summed = gradient.contiguous().clone()
        dist.all_reduce(summed)
        return summed


def _total(values: Tensor) -> Tensor:
    """`values` summed over all processes, differentiably."""
    summed: Tensor = _Sum.apply(values)  # type: ignore[no-untyped-call]  # torch's own
    return summed


def first_line(error: BaseException) -> str:
    """The first line of an error's text: torch adds the stack of its own sources."""
    return str(error).strip().partition("\n")[0]


def _device() -> torch.device:
    nccl = dist.get_backend() == "nccl"
    return torch.device("cuda", torch.cuda.current_device()) if nccl else torch.device("cpu")
