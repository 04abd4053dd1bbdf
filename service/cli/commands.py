"""The table of all commands. A command's module is imported only if the user chose the command."""

import argparse
import importlib
import platform
from collections.abc import Container
from typing import Any, NamedTuple

from neurove_service.cli.parser import Parser


class Command(NamedTuple):
    """One command; its module has a function `add_NAME` that adds the arguments and sets `run`."""

    name: str
    help: str
    module: str  # in this package
    extra: str = ""  # that it needs; empty if the base install is enough


COMMANDS = (
    Command("demo", "Run driver, service and consumer on any source, then print a summary.", "running", "serve"),
    Command("serve", "Run the service until SIGINT or SIGTERM.", "running", "serve"),
    Command("drive", "Publish a recording, a synthetic source or a camera as event packets.", "running", "recordings"),
    Command("cameras", "List the event cameras at this machine, and say what is missing.", "cameras"),
    Command(
        "ros2", "Bridge the event cameras of a ROS 2 robot to the service, and its estimates back.", "ros2", "ros2"
    ),
    Command("watch", "Show live estimates of all streams.", "asking"),
    Command("health", "Show the health of every node.", "asking"),
    Command("doctor", "Check connection, streams, compiled kernels, processor, cameras and extras.", "doctor"),
    Command(
        "warm-up",
        "Compile ahead what serve, demo, drive and simulate run, and say where it is kept.",
        "warming",
        "serve",
    ),
    Command("metrics", "Show the metrics of every node for Prometheus, on one address.", "metering", "metrics"),
    Command("page", "Show streams, nodes and models live in a browser.", "paging", "page"),
    Command("models", "List the models of every node.", "asking"),
    Command("push", "Send a bundle to a running node.", "changing"),
    Command("activate", "Change the model of a running node.", "changing"),
    Command("rollback", "Activate the previous model of a running node again.", "changing"),
    Command("drain", "Hand over the streams of a node to the nodes that follow them.", "draining"),
    Command(
        "fleet", "List the nodes of a deployment, with their labels and models, and those that do not answer.", "fleet"
    ),
    Command("rollout", "Change the model of many nodes step by step, and stop or go back if one fails.", "rollout"),
    Command("bundle", "Make, inspect, sign and verify bundles: files that hold a model.", "bundles", "serve"),
    Command("record", "Record the packets that drivers publish, until Ctrl-C.", "recordings", "recordings"),
    Command("info", "Show what a recording holds: sensor, counts, rates, IMU and truth.", "recordings", "recordings"),
    Command(
        "convert",
        "Convert a recording to a packet log or a ROS 2 bag (.mcap), or to DSEC's layout (.h5).",
        "recordings",
        "recordings",
    ),
    Command("simulate", "Record a simulated event camera with its exact motion.", "recordings", "recordings"),
    Command(
        "estimate",
        "Write the estimates of a recording to a file, as the service would give them.",
        "estimating",
        "serve",
    ),
    Command("train", "Train a model on simulated sequences and recordings.", "training", "train"),
    Command("calibrate", "Fit the uncertainty of a trained model on new simulated sequences.", "training", "train"),
    Command("adapt", "Make a model better on one robot, from its recorded drive with odometry.", "adapting", "train"),
    Command("evaluate", "Compare a model's estimates with the truth, as RMSE and RE.", "training", "serve"),
    Command("reproduce", "Repeat the experiments of the paper.", "experiments", "experiments"),
    Command("bench", "Measure the speed of this machine, as ratios within one run.", "bench", "bench"),
    Command("config", "Show the settings of the service.", "running"),
    Command("install-units", "Write the systemd units of a plain machine, or show what would be written.", "units"),
    Command("completion", "Print a completion script for a shell.", "completion"),
)


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        import importlib.metadata

        print(f"neurove {importlib.metadata.version('neurove')}, Python {platform.python_version()}")
        parser.exit()


def build_parser(chosen: Container[str]) -> Parser:
    """The parser of all commands; only the commands in `chosen` have arguments, the others just their help line."""
    parser = Parser(
        prog="neurove",
        description="Ego-velocity from event cameras, as a service on Zenoh.",
        epilog="Settings come from defaults, then --config FILE (TOML), then NEUROVE_* variables, then flags.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the versions of neurove and Python and exit")
    commands = parser.add_commands()
    for name, about, module, _ in COMMANDS:
        one = commands.add_parser(name, help=about, description=about)
        if name in chosen:
            getattr(importlib.import_module(f"neurove_service.cli.{module}"), f"add_{name.replace('-', '_')}")(one)
    return parser
