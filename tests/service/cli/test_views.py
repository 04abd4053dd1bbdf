"""Tables for people."""

import io
import time

import pytest
from rich.console import Console

from neurove_protocol.control import HealthReply, Losses, ModelInfo, ModelsReply
from neurove_service.cli.board import Board
from neurove_service.cli.views import health_table, models_table
from neurove_service.node.health import stream_status
from neurove_service.streams.intake import Arrival
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.service.conftest import arrived

INFO = ModelInfo(name="one", digest="ab" * 32, trained=False, provenance="a test", parameters=1234)


def drawn(renderable):
    console = Console(file=io.StringIO(), width=140, color_system=None)
    console.print(renderable)
    return console.file.getvalue()


@pytest.fixture
def stream(slot):
    return Stream("cam0", slot)


def test_a_board_shows_the_newest_velocity_its_flags_and_every_loss(stream):
    board = Board()
    assert "waiting" in drawn(board)
    packets = make_packets(60)
    for packet in packets[:30] + packets[33:]:
        for estimate in stream.accept(packet, Arrival(time.monotonic_ns(), time.monotonic_ns())):
            board.on_estimate(estimate)
    board.on_status(stream_status("n1", stream))
    text = drawn(board)
    newest = board.of("cam0").last.twist
    assert f"{newest.vx:+7.3f} m/s" in text
    assert f"{newest.wz:+7.3f} rad/s" in text
    for word in ("cam0", "lossy", "64x48", "UNTRAINED: the estimates have no meaning", "gap_packets 3", "uncalibrated"):
        assert word in text


def test_a_board_shows_the_standard_deviation_of_each_axis(stream):
    board = Board()
    for estimate in (one for packet in make_packets(60) for one in stream.accept(packet, arrived())):
        covariance = [0.0] * 36
        covariance[0], covariance[35] = 0.0625, 4e8
        board.on_estimate(estimate.model_copy(update={"covariance": tuple(covariance)}))
    assert "±0.250 m/s" in drawn(board)
    assert "±20000 rad/s" in drawn(board)


def test_a_board_counts_missed_estimates(stream):
    board = Board()
    estimates = [one for packet in make_packets(60) for one in stream.accept(packet, arrived())]
    for estimate in (estimates[0], estimates[3]):
        board.on_estimate(estimate)
    assert (board.of("cam0").count, board.of("cam0").missed) == (2, 2)
    assert board.of("cam0").mean_rate_hz > 0


def test_health_shows_verdict_reason_and_streams(stream):
    status = stream_status("n1", stream).model_copy(update={"lost": Losses(overload_packets=7), "verdict": "lossy"})
    reply = HealthReply(
        node="n1",
        ok=False,
        why="cam0 is lossy",
        uptime_s=12.0,
        version="1",
        model=INFO,
        epoch=2,
        refused_streams=0,
        streams=(status,),
        ready=False,
        change="two was rolled back: stream cam0: not finite",
        rollbacks=3,
    )
    text = drawn(health_table([reply]))
    for word in (
        "n1 not ok",
        "cam0 is lossy",
        "untrained",
        "overload_packets 7",
        "not ready",
        "not finite",
        "rollbacks: 3",
    ):
        assert word in text


def test_models_marks_active_and_previous_and_names_unreadable_files():
    other = INFO.model_copy(update={"name": "two", "digest": "cd" * 32, "trained": True})
    reply = ModelsReply(
        node="n1",
        active=INFO,
        previous=other,
        epoch=1,
        available=(INFO, other),
        unreadable={"x.safetensors": "truncated"},
    )
    text = drawn(models_table([reply]))
    assert any("active" in line and "one" in line and "no" in line for line in text.splitlines())
    assert any("previous" in line and "two" in line and "yes" in line for line in text.splitlines())
    assert "x.safetensors: truncated" in text
