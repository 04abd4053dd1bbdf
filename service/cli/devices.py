"""The device on which offline commands run the network."""

import argparse
from typing import TYPE_CHECKING, Final

from neurove_core.extras import installed
from neurove_protocol.errors import InvalidField

if TYPE_CHECKING:
    import torch

    from neurove_core.models.bundle import Bundle
    from neurove_core.networks.device import DeviceRunner


EVALUATES: Final = (
    "run the network with torch on cpu, cuda or cuda:N, the windows of up to 64 recordings in one batch; "
    "default: the compiled code of the service"
)
"""What --device does in a command that evaluates."""

TRAINS: Final = (
    "train on cpu, cuda or cuda:N; default cpu; the estimates are compared by the compiled code of the service"
)
"""What --device does in a command that trains and then compares estimates."""

CALIBRATES: Final = (
    "run the network with torch on cpu, cuda or cuda:N, one sequence at a time; "
    "default: the compiled code of the service"
)
"""What --device does in a command that calibrates."""


def add_device_flag(parser: argparse.ArgumentParser, about: str = EVALUATES) -> None:
    """Add the device of the network."""
    parser.add_argument("--device", metavar="KIND", help=about)


def device_from(args: argparse.Namespace, what: str) -> "torch.device | None":
    """The device that --device names; None without the flag.

    Args:
        args: of the command.
        what: the command, for the error.

    Raises:
        InvalidField: there is no such device, or torch is not installed.
    """
    if args.device is None:
        return None
    if not installed("torch"):
        why = "torch is needed and not installed: pip install 'neurove[train]'"
        raise InvalidField(what, "--device", args.device, why)
    from neurove_core.networks.device import device_of

    return device_of(args.device, what)


def runner_on(args: argparse.Namespace, bundle: "Bundle", what: str) -> "DeviceRunner | None":
    """The runner of the device that --device names; None without the flag.

    Args:
        args: of the command.
        bundle: the model.
        what: the command, for the error.

    Raises:
        InvalidField: as `device_from`.
    """
    device = device_from(args, what)
    if device is None:
        return None
    from neurove_core.networks.device import DeviceRunner

    return DeviceRunner(bundle.network, device)


def refuse_pool(args: argparse.Namespace, what: str) -> None:
    """Refuse --device together with other processes.

    Raises:
        InvalidField: both are given.
    """
    if args.device is not None and (args.dask is not None or args.workers > 1):
        why = "not together with --workers or --dask: this process computes the batches"
        raise InvalidField(what, "--device", args.device, why)
