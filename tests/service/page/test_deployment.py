"""What the page says about streams and nodes: verdicts, history, bounds, and numbers with their uncertainty."""

import json
import math
import time

import pytest

from neurove_protocol import Trace, Twist, TwistEstimate
from neurove_protocol.control import HealthReply, Losses, ModelInfo, StreamStatus
from neurove_service.page.deployment import MAX_NODES, MAX_STREAMS, NODES_TICKS, Deployment
from neurove_service.page.points import magnitudes
from neurove_service.page.viewers import message

DIGESTS = {"one": "1" * 64, "two": "2" * 64}
HOSTILE = "<script>alert(1)</script>\n\nevent: hello"


def estimate(stream="cam0", node="n1", covariance=None, model="one", flags=()):
    return TwistEstimate(
        stream=stream,
        seq=0,
        start_us=0,
        end_us=50_000,
        bin_end_us=(50_000,),
        twists=(Twist(3.0, 0.0, 4.0, 0.0, 0.5, 0.0),),
        model=model,
        digest=DIGESTS["one"],
        epoch=0,
        events=1000,
        flags=flags,
        covariance=covariance,
        trace=Trace(received_ns=0, queued_ns=0, computed_ns=0, published_ns=0),
        node=node,
    )


def status(stream="cam0", verdict="ok", why="", **fields):
    counts = dict.fromkeys(
        ("packets_received", "events_received", "windows", "estimates", "resets", "outside_events"), 0
    )
    return StreamStatus(
        node="n1",
        stream=stream,
        verdict=verdict,
        why=why,
        width=346,
        height=260,
        calibrated=True,
        lost=Losses(gap_packets=3),
        latency_ms=None,
        last_packet_age_s=0.0,
        **(counts | fields),
    )


def health(model="one", epoch=0, change="", uptime_s=5.0, node="n1", ok=True, why="1 stream"):
    info = ModelInfo(name=model, digest=DIGESTS.get(model, "3" * 64), trained=True, provenance="test", parameters=1)
    return HealthReply(
        node=node, ok=ok, why=why, uptime_s=uptime_s, version="0", model=info, epoch=epoch, refused_streams=0,
        streams=(), change=change,
    )  # fmt: skip


def test_the_uncertainty_of_a_speed_is_that_along_the_motion():
    diagonal = [0.0] * 36
    for axis, variance in enumerate((0.04, 9.0, 0.01, 1.0, 0.25, 1.0)):
        diagonal[axis * 7] = variance
    speed, turn = magnitudes(estimate(covariance=tuple(diagonal)))
    assert speed.value == pytest.approx(5.0)
    assert speed.sigma == pytest.approx(math.sqrt(0.36 * 0.04 + 0.64 * 0.01))  # not the 3 m/s across it
    assert turn == pytest.approx((0.5, 0.5))
    assert magnitudes(estimate())[0].sigma is None


def test_points_are_news_once_and_history_for_a_new_viewer():
    deployment = Deployment()
    for _ in range(3):
        deployment.on_estimate(estimate(flags=("gap", "late")), time.monotonic_ns())
    (stream,) = deployment.news()["streams"]
    assert [len(stream["points"]), stream["points"][0][13]] == [3, "gap late"]
    assert deployment.news()["streams"][0]["points"] == []
    assert len(deployment.everything()["streams"][0]["points"]) == 3


def test_the_verdict_and_its_reason_are_those_of_the_node_while_estimates_arrive():
    deployment = Deployment()
    deployment.on_estimate(estimate(), time.monotonic_ns())
    deployment.on_status(status(verdict="lossy", why="3 packets are missing"))
    (stream,) = deployment.news()["streams"]
    assert (stream["level"], stream["verdict"], stream["why"]) == ("warn", "lossy", "3 packets are missing")
    assert stream["lost"] == {"gap_packets": 3}


def test_model_changes_are_a_history_with_reasons_newest_first():
    deployment = Deployment()
    deployment.on_health([health()])
    deployment.on_health([health()])
    deployment.on_health([health("two", 1, "activated by an operator")])
    deployment.on_health([health("one", 2, "rolled back: diverged")])
    deployment.on_health([health("one", 0, uptime_s=1.0)])  # 5 s before
    (node,) = deployment.everything()["nodes"]
    assert [(one["model"], one["reason"]) for one in node["history"]] == [
        ("one", "the service started again"),
        ("one", "rolled back: diverged"),
        ("two", "activated by an operator"),
        ("one", "the page started; this model was active"),
    ]


def test_a_node_that_leaves_is_gone_and_comes_back():
    deployment = Deployment()
    deployment.on_token("n1", True)
    deployment.on_health([health()])
    assert deployment.everything()["nodes"][0]["verdict"] == "ok"
    deployment.on_token("n1", False)
    state = deployment.everything()
    assert state["nodes"][0]["verdict"] == "gone"
    assert state["problem"]
    deployment.on_token("n1", True)
    state = deployment.everything()
    assert (state["nodes"][0]["verdict"], state["problem"]) == ("ok", "")


def test_streams_nodes_and_texts_are_bounded():
    deployment = Deployment()
    for number in range(3 * MAX_STREAMS):
        deployment.on_estimate(estimate(f"s{number}"), time.monotonic_ns())
        deployment.on_token(f"n{number}", True)
    deployment.on_status(status("s0", "unstable", "x" * 100_000))
    state = deployment.everything()
    assert [len(state["streams"]), len(state["nodes"])] == [MAX_STREAMS, MAX_NODES]
    assert all(len(one["why"]) <= 400 for one in state["streams"])


def test_no_text_from_the_network_begins_another_event():
    deployment = Deployment()
    deployment.on_estimate(estimate(model=HOSTILE, flags=(HOSTILE,)), time.monotonic_ns())
    deployment.on_status(status(verdict="lossy", why=HOSTILE))
    deployment.on_health([health(HOSTILE, change=HOSTILE)])
    sent = message("news", deployment.news()).decode()
    assert sent.count("event:") == sent.count("event: hello") + 1  # those are inside the one line of data
    assert len(sent.rstrip("\n").splitlines()) == 2
    data = json.loads(sent.splitlines()[1].removeprefix("data: "))
    assert data["streams"][0]["model"] == data["nodes"][0]["model"]["name"] == HOSTILE


def test_news_have_the_nodes_every_half_second_and_the_first_message_has_them_always():
    deployment = Deployment()
    deployment.on_health([health()])
    with_nodes = ["nodes" in deployment.news() for _ in range(2 * NODES_TICKS)]
    assert with_nodes == ([True] + [False] * (NODES_TICKS - 1)) * 2
    assert "nodes" in deployment.everything()
