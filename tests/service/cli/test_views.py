"""Tables for people."""

import io

import pytest
from rich.console import Console

from neurove_protocol.control import HealthReply, Losses, ModelInfo, ModelsReply, StandbyStatus
from neurove_service.cli.views import health_table, models_table
from neurove_service.node.health import stream_status
from neurove_service.streams.stream import Stream

INFO = ModelInfo(name="one", digest="ab" * 32, trained=False, provenance="a test", parameters=1234)


def drawn(renderable):
    console = Console(file=io.StringIO(), width=140, color_system=None)
    console.print(renderable)
    return console.file.getvalue()


@pytest.fixture
def stream(slot):
    return Stream("cam0", slot)


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
        refused_streams=4,
        streams=(status,),
        ready=False,
        internal_errors={"housekeeping": 2},
        dropped_log_lines=9,
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
        "housekeeping 2",
        "not read in time: 9",
        "max_streams is reached: 4",
        "cam0: lossy: ",
    ):
        assert word in text


@pytest.mark.parametrize(
    ("standby", "line"),
    [
        ({"role": "answers", "leader": "n1", "followers": 1}, "cam0: this node answers, 1 other node serves it"),
        ({"role": "follows", "leader": "n2", "equal": True}, "cam0: follows n2, with equal state"),
        (
            {"role": "follows", "leader": "n2", "draining": True},
            "cam0: follows n2, its state is not equal yet, is drained",
        ),
        ({"role": "listens", "leader": None}, "cam0: hears no node that answers"),
    ],
)
def test_health_says_what_a_node_does_on_a_stream_with_standby(stream, standby, line):
    found = StandbyStatus.model_validate({"term": 7, "equal": False} | standby)
    status = stream_status("n1", stream).model_copy(update={"standby": found})
    reply = HealthReply(
        node="n1",
        ok=True,
        why="ok",
        uptime_s=1.0,
        version="1",
        model=INFO,
        epoch=1,
        refused_streams=0,
        streams=(status,),
    )
    assert line in drawn(health_table([reply])).splitlines()


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
