"""The command doctor: checks of the connection, the streams and this machine, each with what to do about it."""

import argparse
import json
import threading
from collections.abc import Sequence
from typing import Any, Final

from neurove_protocol import Flag, TwistEstimate
from neurove_protocol.control import HealthReply, StreamStatus
from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError
from neurove_service.cli.arguments import add_client_flags, client_config, command
from neurove_service.cli.inertial_text import imu_text
from neurove_service.cli.installation import (
    Check,
    check_cameras,
    check_engine,
    check_extras,
    check_kernels,
    check_processor,
)
from neurove_service.config import ClientConfig, ConfigError

_LISTEN_S: Final = 2.0
"""Longest wait for an estimate of every stream."""

_OLD_PACKET_S: Final = 2.0
"""A stream whose newest packet is older has stopped."""

_WIDE: Final = 200
"""Columns of the table where no terminal limits them."""


def doctor(args: argparse.Namespace) -> int:
    """Check connection, streams, compiled kernels, processor, cameras and installed extras."""
    checks = [*_check_connection(args), check_kernels(), check_processor(), check_engine(), check_cameras()]
    checks += check_extras()
    ok = not any(check.level == "bad" for check in checks)
    if args.json:
        print(json.dumps({"ok": ok, "checks": [check._asdict() for check in checks]}))
    else:
        _print_table(checks)
    return 0 if ok else EXIT_FAILURE


def _check_connection(args: argparse.Namespace) -> list[Check]:
    """As `_check_network`; wrong settings are a check too, so that the others are still made."""
    try:
        config = client_config(args)
    except ConfigError as error:
        return [Check("settings", error.message, "bad", "correct the flag or the variable NEUROVE_*")]
    return _check_network(config)


def _check_network(config: ClientConfig) -> list[Check]:
    """Whether a service answers, and the state of its streams."""
    from neurove_service.clients import ask

    where = ", ".join(config.connect)
    try:
        transport = ask.connect(config)
    except ask.NoService:
        advice = "start `neurove serve`, or give the endpoint with --connect or NEUROVE_CONNECT"
        return [Check("connection", f"no router and no service at {where}", "bad", advice)]
    except NeuroVEError as error:
        return [Check("connection", error.message, "bad", "correct --connect or --zenoh-config")]
    with transport:
        try:
            replies = ask.health(transport, config)
        except ask.NoService:
            advice = f"start `neurove serve` with prefix {config.prefix}, and check the access list of the router"
            return [Check("connection", f"a router answers at {where}, but no service", "bad", advice)]
        statuses = answering(replies)
        estimates = _newest_estimates(transport, config, set(statuses))
    found = [_check_node(reply, where) for reply in replies]
    for name, status in sorted(statuses.items()):
        found += check_stream(status, estimates.get(name))
        found += check_standby(name, replies)
    return found or [Check("connection", f"no node at {where}", "bad", "start `neurove serve`")]


def answering(replies: Sequence[HealthReply]) -> dict[str, StreamStatus]:
    """The status of each stream, of the node that answers it where several nodes serve it."""
    every = [status for reply in replies for status in reply.streams]
    every.sort(key=lambda status: status.standby is None or status.standby.role == "answers")
    return {status.stream: status for status in every}


def check_standby(stream: str, replies: Sequence[HealthReply]) -> list[Check]:
    """Which node answers a stream, which nodes follow, and whether one is ready; none where no node stands by.

    Args:
        stream: its name.
        replies: of all nodes.
    """
    found = [(reply.node, status) for reply in replies for status in reply.streams if status.stream == stream]
    standing = [(node, status.standby) for node, status in found if status.standby is not None]
    if not standing:
        return []
    what = f"stream {stream}: standby"
    always = sorted(node for node, status in found if status.standby is None)
    if always:
        advice = "set standby on every node that serves the stream"
        return [Check(what, f"{', '.join(always)} publishes without standby", "bad", advice)]
    leaders = sorted(node for node, standby in standing if standby.role == "answers")
    follows = [
        f"{node} follows, {'ready' if standby.equal else 'not ready: its state is not equal yet'}"
        for node, standby in sorted(standing)
        if standby.role != "answers"
    ]
    state = "; ".join([f"{' and '.join(leaders) or 'no node'} answers", *(follows or ["no other node serves it"])])
    if len(leaders) == 1 and any(standby.role == "follows" and standby.equal for _, standby in standing):
        return [Check(what, state, "ok")]
    advice = "run it again in a second; see deploy/docs/standby.md"
    return [Check(what, state, "bad", advice)]


def _newest_estimates(transport: Any, config: ClientConfig, streams: set[str]) -> dict[str, TwistEstimate]:
    """The newest estimate of each stream; waits at most `_LISTEN_S` for the first one of every stream."""
    from neurove_service.clients import ask

    received: dict[str, TwistEstimate] = {}
    complete = threading.Event()

    def on_estimate(estimate: TwistEstimate) -> None:
        received[estimate.stream] = estimate
        if received.keys() >= streams:
            complete.set()

    if streams:
        ask.listen(transport, config, on_estimate, lambda _: None)
        complete.wait(_LISTEN_S)
    return received


def _check_node(reply: HealthReply, where: str) -> Check:
    state = f"service {reply.version} at {where}, model {reply.model.name}"
    if reply.ok:
        return Check(f"node {reply.node}", state, "ok")
    if reply.namesakes:
        return Check(f"node {reply.node}", f"{state}: {reply.why}", "bad", "give each node its own name: --node NAME")
    return Check(f"node {reply.node}", f"{state}: {reply.why}", "bad", "run `neurove health`; see the log of the node")


def check_stream(status: StreamStatus, estimate: TwistEstimate | None) -> list[Check]:
    """Feed, clock, calibration and camera height of one stream.

    Args:
        status: of the node that serves the stream.
        estimate: the newest one; None if none arrived.
    """
    name = f"stream {status.stream}"
    return [
        _check_feed(f"{name}: feed", status),
        _check_clock(f"{name}: clock", status),
        Check(f"{name}: calibration", "the service has a CameraInfo", "ok")
        if status.calibrated
        else Check(
            f"{name}: calibration",
            "no CameraInfo",
            "bad",
            "let the driver publish its CameraInfo; `neurove drive --calibration FILE` does",
        ),
        _check_height(f"{name}: height", estimate),
        *_check_imu(f"{name}: inertial unit", status),
    ]


def _check_feed(what: str, status: StreamStatus) -> Check:
    if status.verdict in ("unstable", "lossy"):
        advice = "see `Verdicts of a stream` in deploy/README.md"
        return Check(what, f"{status.verdict}: {status.why}", "bad", advice)
    return Check(what, "nothing is lost now", "ok")


def _check_clock(what: str, status: StreamStatus) -> Check:
    if status.verdict == "stalled":
        advice = "check that the driver's times increase and are in microseconds"
        return Check(what, f"stalled: {status.why}", "bad", advice)
    if status.last_packet_age_s > _OLD_PACKET_S:
        state = f"newest packet {status.last_packet_age_s:.1f} s old"
        return Check(what, state, "bad", "check that the driver runs and reaches the service")
    return Check(what, f"plausible: newest packet {status.last_packet_age_s:.1f} s old", "ok")


def _check_imu(what: str, status: StreamStatus) -> list[Check]:
    if status.imu is None:
        return []
    state = imu_text(status.imu)
    if status.imu.disagrees:
        advice = "check axes, signs and times of the driver's samples; README.md of protocol/ says which are expected"
        return [Check(what, state, "bad", advice)]
    if status.imu.problem:
        return [Check(what, state, "bad", "check that the driver sends samples in time, on the clock of its events")]
    return [Check(what, state, "ok")]


def _check_height(what: str, estimate: TwistEstimate | None) -> Check:
    if estimate is None:
        return Check(what, f"unknown: no estimate within {_LISTEN_S:.0f} s", "info")
    if Flag.UNSCALED in estimate.flags:
        return Check(
            what,
            "unknown to the service, which assumes 1 m",
            "bad",
            "set CameraInfo.height_m in the driver; `neurove drive --height M` does",
        )
    return Check(what, "known", "ok")


def _print_table(checks: list[Check]) -> None:
    from rich.table import Table
    from rich.text import Text

    from neurove_service.cli.console import console

    table = Table("", "check", "state", "what to do", box=None, padding=(0, 2, 0, 0), header_style="dim")
    styles = {"ok": "green", "bad": "bold red", "info": "dim"}
    for check in checks:
        table.add_row(
            Text(check.level, style=styles[check.level]), Text(check.what), Text(check.state), Text(check.advice)
        )
    usual = console()
    (usual if usual.is_terminal else console(width=_WIDE)).print(table)


def add_doctor(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove doctor`."""
    add_client_flags(command(parser, doctor))
