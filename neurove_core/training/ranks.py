"""Data-parallel training: several processes share each batch, and all of them end with the same weights.

Every rank computes on its own device. Everything that depends on the whole batch is averaged over all ranks: the
statistics of the norms, the losses of the dynamic scaling, and the gradient. N devices therefore take the step that one
device would take on the same batch.
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

_TIMEOUT: Final = timedelta(minutes=10)  # of one exchange; the end of a rank is detected at once


class LostRank(NeuroVEError):
    """A process of a distributed run ended early."""

    code = "lost_rank"

    def __init__(self, rank: int, exit_code: int | None) -> None:
        why = f"process {rank} of the run ended with code {exit_code}: continue with --resume"
        super().__init__(why, rank=rank, exit_code=exit_code)


@dataclass(frozen=True)
class Ranks:
    """One of the processes of a run, and its exchanges with the others."""

    rank: int = 0
    count: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def first(self) -> bool:
        """Whether this rank writes the files."""
        return self.rank == 0

    def mean(self, value: Tensor) -> Tensor:
        """Mean of a tensor over all ranks, with the same bits on each; gradients flow into the tensor of every rank."""
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
        """The value of each rank, in the order of the ranks."""
        if self.count == 1:
            return [value]
        values: list[Any] = [None] * self.count
        dist.all_gather_object(values, value)
        return values


ALONE: Final = Ranks()
"""A run of one process on the CPU."""


class _Mean(torch.autograd.Function):
    """Mean over all ranks; backward it averages too, because the loss of each rank depends on the values of all."""

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
    """A batch norm with statistics over the batches of all ranks; its state is that of the norm of torch.

    It exists because SyncBatchNorm of torch does not run on the CPU. All ranks must hold the same number of rows.

    Args:
        norm: BatchNorm1d or BatchNorm2d with affine parameters and running statistics; its tensors are used.
        ranks: this rank, and its exchange with the others.
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
        """Normalise (rows, C) or (rows, C, H, W) by the mean and variance over all axes but C and over all ranks."""
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
    """Replace every batch norm by a SharedNorm; names and values in the state of the module stay the same."""
    for name, child in list(module.named_children()):
        if isinstance(child, nn.BatchNorm1d | nn.BatchNorm2d):
            setattr(module, name, SharedNorm(child, ranks))
        else:
            share_norms(child, ranks)


def device_of(wanted: str, rank: int = 0, devices: int = 1) -> torch.device:
    """Select the device of a rank.

    Args:
        wanted: `cpu`, `cuda` (one GPU for each rank), or `auto` (GPUs if there are enough, else the CPU).
        rank: number of the rank.
        devices: number of ranks.

    Raises:
        InvalidField: the name is unknown, or there are fewer GPUs than ranks.
    """
    if wanted not in ("auto", "cpu", "cuda"):
        raise InvalidField("training", "device", wanted, "auto, cpu or cuda is expected")
    available = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if wanted == "cuda" and available < devices:
        raise InvalidField("training", "device", wanted, f"{devices} GPUs are needed, torch sees {available}")
    return torch.device("cpu" if wanted == "cpu" or available < devices else f"cuda:{rank}")


@contextlib.contextmanager
def process_group(devices: int, device: str, work: Callable[..., Any], arguments: tuple[Any, ...]) -> Iterator[Ranks]:
    """Run `devices` processes on this machine as one group; the caller is the first rank.

    Args:
        devices: number of processes, at least 1; with 1 no process is started.
        device: see `device_of`.
        work: function of a module that every other rank calls with `arguments` and its Ranks.
        arguments: must be picklable.

    Raises:
        InvalidField: as `device_of`. LostRank: another process ended before this one.
    """
    if devices == 1:
        yield Ranks(device=device_of(device))
        return
    first = Ranks(0, devices, device_of(device, 0, devices))
    context = multiprocessing.get_context("spawn")  # the threads of torch and CUDA do not survive a fork
    others: list[_Other] = []
    with tempfile.TemporaryDirectory() as meeting, contextlib.ExitStack() as ends:
        store, threads = str(Path(meeting) / "ranks"), torch.get_num_threads()
        for rank in range(1, devices):
            ready, started = context.Pipe(duplex=False)
            own = Ranks(rank, devices, device_of(device, rank, devices))
            other = context.Process(target=_run_rank, args=(own, store, threads, started, work, arguments), daemon=True)
            other.start()
            started.close()
            others.append(_Other(rank, other, ready))
            ends.callback(others[-1].end)
        for each in others:
            each.wait()
        with _group(first, store):
            try:
                yield first
            except BaseException as error:
                lost = (
                    next((each for each in others if each.ended()), None) if isinstance(error, RuntimeError) else None
                )
                for each in others:
                    each.process.kill()  # before the group ends; otherwise each logs that the first rank is gone
                if lost is None:
                    raise
                raise lost.error() from error  # torch reports only that a connection was closed


class _Other(NamedTuple):
    """Another process of the run, as the first rank handles it."""

    rank: int
    process: Any
    ready: Any  # a pipe that reports when the process has started

    def wait(self) -> None:
        """Wait until the process has started; joining a group with a missing member would take the whole timeout."""
        try:
            self.ready.recv()
        except EOFError:  # it ended during its start
            self.process.join()
            raise self.error() from None

    def ended(self) -> bool:
        self.process.join(1.0)  # its connections close shortly before it ends
        return self.process.exitcode is not None

    def error(self) -> LostRank:
        return LostRank(self.rank, self.process.exitcode)

    def end(self) -> None:
        self.ready.close()
        if sys.exc_info()[0] is None:
            self.process.join(60)  # it has done the last exchange and ends by itself
        self.process.kill()
        self.process.join()


def _run_rank(ranks: Ranks, store: str, threads: int, started: Any, work: Callable[..., Any], arguments: Any) -> None:
    """Main function of the other processes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first rank ends the others
    torch.set_num_threads(threads)
    started.send(True)
    with _group(ranks, store):
        work(*arguments, ranks)


@contextlib.contextmanager
def _group(ranks: Ranks, store: str) -> Iterator[None]:
    """Create the group of all ranks, and destroy it at the end."""
    if ranks.device.type == "cuda":
        torch.cuda.set_device(ranks.device)
    else:
        loopback = next((name for _, name in socket.if_nameindex() if name.startswith("lo")), None)
        if loopback:  # otherwise the port would be open to the network
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
