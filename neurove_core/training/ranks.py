"""Data-parallel training: several processes share each batch, and all of them end with the same weights.

Every rank computes on its own device. Everything that depends on the whole batch is averaged over all ranks: the
statistics of the norms, the losses of the dynamic scaling, and the gradient. N devices therefore take the step that one
device would take on the same batch. `joining` makes the group of ranks, `launch` starts the ranks of one machine.
"""

import re
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from neurove_protocol.errors import EXIT_FAILURE, InvalidField, NeuroVEError

T = TypeVar("T")

_IN_TOUCH_S: Final = 1.0  # interval of the messages of ranks that wait for others


class LostRank(NeuroVEError):
    """A process of a distributed run ended early, or cannot be reached any more."""

    code = "lost_rank"
    exit_code = EXIT_FAILURE

    def __init__(self, rank: int, why: str) -> None:
        sentence = f"process {rank} of the run {why}; if no launcher starts it again, continue with --resume"
        super().__init__(sentence, rank=rank, why=why)


@dataclass(frozen=True)
class Ranks:
    """One of the processes of a run, and its exchanges with the others."""

    rank: int = 0
    count: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    local_rank: int = 0  # number among the ranks of this machine
    machine: int = 0
    machines: int = 1
    tensors: Any = None  # group of torch that exchanges tensors of the device; None: the default group

    @property
    def first(self) -> bool:
        """Whether this rank writes the files."""
        return self.rank == 0

    @property
    def leads(self) -> bool:
        """Whether this rank makes the sequences of its machine."""
        return self.local_rank == 0

    def mean(self, value: Tensor) -> Tensor:
        """Mean of a tensor over all ranks, with the same bits on each; gradients flow into the tensor of every rank."""
        if self.count == 1:
            return value
        mean: Tensor = _Mean.apply(value, self)  # type: ignore[no-untyped-call]  # torch's own
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
        """The value of each rank, in the order of the ranks.

        Raises:
            LostRank: another rank has ended or cannot be reached.
        """
        if self.count == 1:
            return [value]
        values: list[Any] = [None] * self.count
        try:
            dist.all_gather_object(values, value)
        except RuntimeError as error:  # torch and gloo have no class of their own for a closed connection
            raise self.lost(error) from error
        return values

    def from_rank(self, rank: int, data: bytes) -> bytes:
        """The bytes of one rank on every rank.

        Raises:
            LostRank: another rank has ended or cannot be reached.
        """
        size = self.gather(len(data))[rank]
        if self.count == 1 or not size:
            return data if self.rank == rank else b""
        buffer = (
            torch.frombuffer(bytearray(data), dtype=torch.uint8)
            if self.rank == rank
            else torch.empty(size, dtype=torch.uint8)
        )
        try:
            dist.broadcast(buffer, rank)
        except RuntimeError as error:
            raise self.lost(error) from error
        return buffer.numpy().tobytes()

    def agree(self, what: str, value: Any) -> None:
        """Check that a value is the same on every rank.

        Raises:
            InvalidField: another rank has another value.
        """
        for rank, other in enumerate(self.gather(value)):
            if other != value:
                raise InvalidField("training", what, value, f"process {rank} of the run has {other}")

    def together(self, work: Callable[[], T]) -> T:
        """Do long work while the ranks stay in touch, until every rank has done its own; a lost rank is noticed.

        Args:
            work: of this rank; its exceptions are those of this function.

        Raises:
            LostRank: another rank failed, has ended or cannot be reached.
        """
        if self.count == 1:
            return work()
        doing = _Work(work)
        while True:
            doing.ended.wait(_IN_TOUCH_S)
            states = self.gather((doing.ended.is_set(), doing.failed))
            if doing.failed and states[self.rank][1]:
                return doing.result()
            for rank, (_, failed) in enumerate(states):
                if failed:
                    raise LostRank(rank, f"failed: {failed}")
            if all(ended for ended, _ in states):
                return doing.result()

    def lost(self, error: RuntimeError) -> LostRank:
        """The error for an exchange that failed on this rank."""
        return LostRank(self.rank, f"lost the connection to another one ({first_words(error)})")


def first_words(error: Exception) -> str:
    """The first sentence of an error of torch, without the place in its sources.

    >>> first_words(RuntimeError("[/gloo/pair.cc:553] Connection closed by peer [127.0.0.1]:11657. This is typical."))
    'Connection closed by peer [127.0.0.1]:11657'
    """
    line = (str(error).splitlines() or [type(error).__name__])[0]
    return re.sub(r"^\[/[^]]*\] ", "", line).partition(". ")[0][:200]


ALONE: Final = Ranks()
"""A run of one process on the CPU."""


def alone(device: torch.device | None) -> Ranks:
    """A run of one process on a device; None: the CPU."""
    return ALONE if device is None else Ranks(device=device)


class _Work(Generic[T]):
    """Work on a thread of its own. The thread does not keep the process alive."""

    def __init__(self, work: Callable[[], T]) -> None:
        self.ended, self.failed = threading.Event(), ""
        self._error: Exception | None = None
        self._result: T

        def run() -> None:
            try:
                self._result = work()
            except Exception as error:  # noqa: BLE001 (raised by `result`)
                self._error, self.failed = error, str(error) or type(error).__name__
            self.ended.set()

        self._thread = threading.Thread(target=run, name="work of the rank", daemon=True)
        self._thread.start()

    def result(self) -> T:
        """The result of the work, or its exception, once it has ended."""
        self._thread.join()  # a thread that ends while the process ends may abort it inside torch
        if self._error is not None:
            raise self._error
        return self._result


class _Mean(torch.autograd.Function):
    """Mean over all ranks; backward it averages too, because the loss of each rank depends on the values of all."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, ranks: Ranks) -> Tensor:
        ctx.ranks = ranks
        return _averaged(value, ranks)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _averaged(gradients[0], ctx.ranks), None


def _averaged(value: Tensor, ranks: Ranks) -> Tensor:
    total = value.detach().clone(memory_format=torch.contiguous_format)
    try:
        dist.all_reduce(total, group=ranks.tensors)
    except RuntimeError as error:
        raise ranks.lost(error) from error
    return total / ranks.count


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
