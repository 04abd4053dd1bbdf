"""Processes that learn one model together: each takes its share of a batch, and all end with the same weights.

Every rank computes on its own device; what depends on the whole batch (the norms' statistics, the losses that balance
each other, the gradient) is averaged over all of them: N devices take the step that one would take on the same batch.
"""

import contextlib
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor, nn

from neurove_protocol.errors import InvalidField, NeuroVEError

_TIMEOUT: Final = timedelta(minutes=10)  # of one exchange; a rank that died is noticed at once


class LostRank(NeuroVEError):
    """A process that learns with others ended before them."""

    code = "lost_rank"

    def __init__(self, rank: int, exit_code: int | None) -> None:
        why = f"process {rank} of the run ended with code {exit_code}: go on with --resume"
        super().__init__(why, rank=rank, exit_code=exit_code)


@dataclass(frozen=True)
class Ranks:
    """One of the processes of a run, and what it exchanges with the others."""

    rank: int = 0
    count: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def first(self) -> bool:
        """Whether this is the one that writes files."""
        return self.rank == 0

    def mean(self, value: Tensor) -> Tensor:
        """The mean of a tensor over all ranks, the same bits on each; gradients flow into every rank's own."""
        if self.count == 1:
            return value
        mean: Tensor = _Mean.apply(value, self.count)  # type: ignore[no-untyped-call]  # torch's own
        return mean

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace each gradient by its mean over all ranks, in one exchange."""
        if self.count == 1:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        means = self.mean(torch.cat([gradient.reshape(-1) for gradient in gradients]))
        for gradient, mean in zip(gradients, torch.split(means, [one.numel() for one in gradients]), strict=True):
            gradient.copy_(mean.view_as(gradient))

    def gather(self, value: Any) -> list[Any]:
        """What each rank has, in their order."""
        if self.count == 1:
            return [value]
        values: list[Any] = [None] * self.count
        dist.all_gather_object(values, value)
        return values


ALONE: Final = Ranks()
"""A run of one process, on the CPU."""


class _Mean(torch.autograd.Function):
    """The mean over all ranks; backwards the same, for each rank's loss depends on what every rank gave."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, count: int) -> Tensor:
        ctx.count = count
        return _averaged(value, count)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _averaged(gradients[0], ctx.count), None


def _averaged(value: Tensor, count: int) -> Tensor:
    total = value.detach().clone(memory_format=torch.contiguous_format)
    dist.all_reduce(total)
    return total / count


class SharedNorm(nn.Module):
    """A batch norm whose statistics are of all ranks' batches together; its state is that of torch's own.

    torch's SyncBatchNorm has no CPU form. Each rank must hold as many rows as every other.

    Args:
        norm: BatchNorm1d or BatchNorm2d with affine parameters and running statistics, whose tensors it takes over.
        ranks: that it shares with.
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor

    def __init__(self, norm: nn.BatchNorm1d | nn.BatchNorm2d, ranks: Ranks) -> None:
        super().__init__()
        self.weight, self.bias = norm.weight, norm.bias
        for name, buffer in norm.named_buffers():
            self.register_buffer(name, buffer)
        self.eps, self.momentum, self.ranks = norm.eps, norm.momentum or 0.0, ranks

    def forward(self, x: Tensor) -> Tensor:
        """(rows, C) or (rows, C, H, W), normalised by the mean and variance over all but C, of all ranks."""
        over = [axis for axis in range(x.dim()) if axis != 1]
        along = (slice(None), *(None,) * (x.dim() - 2))
        mean = self.ranks.mean(x.mean(over))
        centred = x - mean[along]
        variance = self.ranks.mean(centred.square().mean(over))
        with torch.no_grad():
            n = self.ranks.count * x.numel() // x.shape[1]
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (n / (n - 1)), self.momentum)
            self.num_batches_tracked += 1
        return centred * (self.weight * torch.rsqrt(variance + self.eps))[along] + self.bias[along]


def share_norms(module: nn.Module, ranks: Ranks) -> None:
    """Put a SharedNorm in the place of every batch norm; names and values in the module's state stay."""
    for name, child in list(module.named_children()):
        if isinstance(child, nn.BatchNorm1d | nn.BatchNorm2d):
            setattr(module, name, SharedNorm(child, ranks))
        else:
            share_norms(child, ranks)


def device_of(wanted: str, rank: int = 0, devices: int = 1) -> torch.device:
    """The device of a rank.

    Args:
        wanted: `cpu`, `cuda` (one GPU for each rank), or `auto`: GPUs where there are enough, else the CPU.
        rank: whose.
        devices: how many ranks there are.

    Raises:
        InvalidField: another name, or fewer GPUs than ranks.
    """
    if wanted not in ("auto", "cpu", "cuda"):
        raise InvalidField("training", "device", wanted, "auto, cpu or cuda is expected")
    there = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if wanted == "cuda" and there < devices:
        raise InvalidField("training", "device", wanted, f"{devices} GPUs are needed, torch sees {there}")
    return torch.device("cpu" if wanted == "cpu" or there < devices else f"cuda:{rank}")


@contextlib.contextmanager
def process_group(devices: int, device: str, work: Callable[..., Any], arguments: tuple[Any, ...]) -> Iterator[Ranks]:
    """Inside this, `devices` processes of this machine learn together, and this one is the first of them.

    Args:
        devices: how many, at least 1; with 1 no process is started.
        device: see `device_of`.
        work: what the others do, a function of a module; it gets these arguments and then its Ranks.
        arguments: they must pickle.

    Raises:
        InvalidField: of `device_of`. LostRank: another process ended before this one.
    """
    if devices == 1:
        yield Ranks(device=device_of(device))
        return
    first = Ranks(0, devices, device_of(device, 0, devices))
    context = multiprocessing.get_context("spawn")  # neither torch's threads nor CUDA survive a fork
    others: list[_Other] = []
    with tempfile.TemporaryDirectory() as meeting, contextlib.ExitStack() as ends:
        store, threads = str(Path(meeting) / "ranks"), torch.get_num_threads()
        for rank in range(1, devices):
            ready, told = context.Pipe(duplex=False)
            own = Ranks(rank, devices, device_of(device, rank, devices))
            other = context.Process(target=_learn, args=(own, store, threads, told, work, arguments), daemon=True)
            other.start()
            told.close()
            others.append(_Other(rank, other, ready))
            ends.callback(others[-1].end)
        for each in others:
            each.wait()
        with _joined(first, store):
            try:
                yield first
            except BaseException as error:
                lost = (
                    next((each for each in others if each.ended()), None) if isinstance(error, RuntimeError) else None
                )
                for each in others:
                    each.process.kill()  # before the group ends, else each would tell that the first one is gone
                if lost is None:
                    raise
                raise lost.error() from error  # torch tells no more than that a connection was closed


class _Other(NamedTuple):
    """A process of the run, as the first one sees it."""

    rank: int
    process: Any
    ready: Any  # a pipe that tells when it is up

    def wait(self) -> None:
        """Until it is up: joining a group that one of them never joins would take the whole timeout."""
        try:
            self.ready.recv()
        except EOFError:  # it ended before it was up
            self.process.join()
            raise self.error() from None

    def ended(self) -> bool:
        self.process.join(1.0)  # its connections are closed a moment before it is gone
        return self.process.exitcode is not None

    def error(self) -> LostRank:
        return LostRank(self.rank, self.process.exitcode)

    def end(self) -> None:
        self.ready.close()
        if sys.exc_info()[0] is None:
            self.process.join(60)  # it has had the last exchange, and ends by itself
        self.process.kill()
        self.process.join()


def _learn(ranks: Ranks, store: str, threads: int, up: Any, work: Callable[..., Any], arguments: Any) -> None:
    """One of the other processes, from its beginning to its end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the first one ends the others
    torch.set_num_threads(threads)
    up.send(True)
    with _joined(ranks, store):
        work(*arguments, ranks)


@contextlib.contextmanager
def _joined(ranks: Ranks, store: str) -> Iterator[None]:
    """Inside this the group of all ranks exists."""
    if ranks.device.type == "cuda":
        torch.cuda.set_device(ranks.device)
    else:
        loopback = next((name for _, name in socket.if_nameindex() if name.startswith("lo")), None)
        if loopback:  # else the port would be open to the network
            os.environ.setdefault("GLOO_SOCKET_IFNAME", loopback)
    dist.init_process_group(
        "nccl" if ranks.device.type == "cuda" else "gloo",
        init_method=f"file://{store}",
        rank=ranks.rank,
        world_size=ranks.count,
        timeout=_TIMEOUT,
    )
    try:
        yield
    finally:
        dist.destroy_process_group()
