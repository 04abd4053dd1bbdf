"""A network in torch on a chosen device, with the windows of all streams as one batch: `--device` of offline commands.

The service and the commands without `--device` use the engine, which is faster on a CPU. Results differ from the
engine's by the rounding of float32 sums, and by a spike where a potential is that close to its threshold.
"""

import contextlib
import copy
import re
from collections.abc import Iterator, Sequence
from typing import Any, Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.kinds import Network, State
from neurove_core.networks.runner import log_sigma_of
from neurove_core.networks.state import joined, parted
from neurove_protocol.errors import InvalidField

TOLERANCE: Final = 1e-3
"""Largest accepted difference of the twists of two devices, as a share of the largest twist; see `difference`."""

NetworkT = TypeVar("NetworkT", bound=nn.Module)

_NAME: Final = re.compile(r"cpu|cuda(?::(\d{1,3}))?")


def device_of(name: str, what: str) -> torch.device:
    """The device of a name.

    Args:
        name: `cpu`, `cuda` or `cuda:N`.
        what: the command, for the error.

    Raises:
        InvalidField: there is no such device.
    """
    found = _NAME.fullmatch(name)
    if found is None:
        raise InvalidField(what, "--device", name, "cpu, cuda or cuda:N is expected")
    if name == "cpu":
        return torch.device(name)
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not count:
        why = "torch sees no GPU" if torch.version.cuda else "this build of torch has no CUDA"
        raise InvalidField(what, "--device", name, f"{why}; cpu computes the same")
    if int(found[1] or 0) >= count:
        raise InvalidField(what, "--device", name, f"torch sees {count} GPUs, the first one is cuda:0")
    return torch.device(name)


def on_device(network: NetworkT, device: torch.device) -> NetworkT:
    """A copy of a network on a device, which computes no gradients; later changes of the network do not change it."""
    return copy.deepcopy(network).to(device).eval().requires_grad_(requires_grad=False)


class DeviceRunner:
    """Runs the network itself on a device, the windows of all streams in one batch; see `Runner`.

    States stay on the device.

    Args:
        network: its weights are copied; later changes have no effect.
        device: as `device_of` gives it.
    """

    def __init__(self, network: Network, device: torch.device) -> None:
        self._network = on_device(network, device)
        self._device, self._encoding = device, network.config.network.encoding
        self.choice = f"torch on {device} (--device)"

    def initial_state(self) -> State:
        """The zero state of one stream."""
        return self._network.initial_state()

    def log_sigma(self, state: State) -> NDArray[np.float64] | None:
        """Log sigma (6) of the window that led to a state; None without a spread."""
        return log_sigma_of(self._network, state)

    @torch.inference_mode()
    def run(
        self, counts: Sequence[NDArray[np.uint8]], states: Sequence[State]
    ) -> list[tuple[NDArray[np.float64], State]]:
        """One window of each stream; see `Runner.run`."""
        windows = torch.from_numpy(np.stack(counts)).to(self._device)
        with full_precision():
            twists, after = self._network(to_spikes(windows[None], self._encoding), joined(states))
        answers = twists[0].double().cpu().numpy()
        return list(zip(answers, parted(after, len(states)), strict=True))


@contextlib.contextmanager
def full_precision() -> Iterator[None]:
    """Compute in float32 on a GPU too, where torch by default rounds the factors of convolutions to 10 bits (TF32)."""
    with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
        yield


def difference(ours: Any, theirs: Any) -> float:
    """The largest difference of two arrays or tensors, as a share of the largest absolute value of the second."""
    one, other = (np.asarray(x.detach().cpu() if isinstance(x, Tensor) else x, np.float64) for x in (ours, theirs))
    largest = float(np.abs(other).max(initial=0.0))
    return float(np.abs(one - other).max(initial=0.0)) / (largest or 1.0)
