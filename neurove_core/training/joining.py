"""Join the processes of a distributed run, which torchrun or another launcher of torch has started.

A launcher gives each process its place by environment variables: RANK, WORLD_SIZE, LOCAL_RANK, LOCAL_WORLD_SIZE,
GROUP_RANK, GROUP_WORLD_SIZE, MASTER_ADDR and MASTER_PORT (https://docs.pytorch.org/docs/stable/elastic/run.html).
Without them, a run is alone.
"""

import contextlib
import ipaddress
import os
import platform
import socket
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Final

import numpy as np
import torch
import torch.distributed as dist

from neurove_core.training.ranks import LostRank, Ranks, device_of, first_words
from neurove_protocol.errors import InvalidField

_TIMEOUT: Final = timedelta(minutes=10)  # of one exchange; a closed connection is detected at once
STORE: Final = "NEUROVE_TRAINING_STORE"
"""Environment variable of processes on one machine: the folder of the files through which they find each other."""

_PLACE: Final = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


def launched() -> bool:
    """Whether a launcher of torch started this process."""
    return "RANK" in os.environ and "WORLD_SIZE" in os.environ


def place(device: str) -> Ranks:
    """The place of this process in its run, from the environment; it is not connected yet.

    Args:
        device: see `device_of`.

    Raises:
        InvalidField: a variable is missing or wrong, or there are fewer GPUs than ranks on this machine.
    """
    if not launched():
        return Ranks(device=device_of(device))
    for name in _PLACE:
        if not os.environ.get(name):
            raise InvalidField("training", name, None, "a launcher such as torchrun sets this variable; it is missing")
    rank, count = _whole("RANK", 0), _whole("WORLD_SIZE", 1)
    if not 0 <= rank < count:
        raise InvalidField("training", "RANK", rank, f"must be at least 0 and below WORLD_SIZE={count}")
    local_rank, local_count = _whole("LOCAL_RANK", rank), _whole("LOCAL_WORLD_SIZE", count)
    own = device_of(device, local_rank, local_count)
    machine, machines = _whole("GROUP_RANK", rank // local_count), _whole("GROUP_WORLD_SIZE", -(-count // local_count))
    return Ranks(rank, count, own, local_rank, machine, machines)


@contextlib.contextmanager
def joined(device: str) -> Iterator[Ranks]:
    """Join the other processes of the run, if a launcher started this one.

    Args:
        device: see `device_of`.

    Raises:
        InvalidField: see `place`; or the processes have other versions or other kinds of device.
        LostRank: the other processes cannot be reached.
    """
    ranks = place(device)
    if ranks.count == 1:
        yield ranks
        return
    if _on_loopback(os.environ["MASTER_ADDR"]):
        loopback = next((name for _, name in socket.if_nameindex() if name.startswith("lo")), None)
        if loopback:  # otherwise the ports of gloo would be open to the network
            os.environ.setdefault("GLOO_SOCKET_IFNAME", loopback)
    try:
        _connect(ranks)
    except (RuntimeError, ValueError) as error:
        raise LostRank(ranks.rank, f"cannot reach the others ({first_words(error)})") from error
    try:
        ranks.agree(
            "versions", f"Python {platform.python_version()}, torch {torch.__version__}, numpy {np.__version__}"
        )
        ranks.agree("device", ranks.device.type)
        if ranks.device.type == "cuda":
            torch.cuda.set_device(ranks.device)
            ranks = replace(ranks, tensors=dist.new_group(backend="nccl", timeout=_TIMEOUT))
        yield ranks
    finally:
        dist.destroy_process_group()


def _connect(ranks: Ranks) -> None:
    folder = os.environ.get(STORE)
    if folder is None:
        dist.init_process_group("gloo", init_method="env://", timeout=_TIMEOUT)
        return
    round_ = _whole("TORCHELASTIC_RESTART_COUNT", 0)  # a file holds what the processes of one start have said
    path = str(Path(folder) / f"round{round_}")
    store = dist.FileStore(path, ranks.count)  # type: ignore[attr-defined]  # gap in the stubs of torch
    dist.init_process_group("gloo", store=store, rank=ranks.rank, world_size=ranks.count, timeout=_TIMEOUT)


def _on_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _whole(name: str, default: int) -> int:
    text = os.environ.get(name, str(default))
    if not text.isdecimal():
        raise InvalidField("training", name, text, "a whole number is expected")
    return int(text)
