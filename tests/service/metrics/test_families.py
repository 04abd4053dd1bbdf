"""What Prometheus reads: counters of the protocol, bounded labels, and names that must stay text."""

import re
import shutil
import subprocess

import pytest
from prometheus_client.parser import text_string_to_metric_families

from neurove_protocol.control import HealthReply, StreamStatus
from neurove_service.metrics.families import MAX_LABEL, MAX_PLACES, MAX_STREAMS, Fleet, exposition
from tests.protocol.messages import MODEL, STATUS

HOSTILE = [
    '<script>alert("1")</script>',
    'a"} 1\nneurove_fake 7\n#',
    "back\\slash\\n",
    "\u202eright to left",
    "x" * 4000,
]


def status(stream="cam0", **fields):
    return StreamStatus.model_validate(STATUS | {"stream": stream} | fields)


def reply(node="n1", streams=(), **fields):
    given = {
        "node": node,
        "ok": True,
        "why": "1 stream",
        "uptime_s": 12.5,
        "version": "0.1.0",
        "model": MODEL,
        "epoch": 3,
        "refused_streams": 0,
        "streams": tuple(streams),
        "rollbacks": 2,
    }
    return HealthReply.model_validate(given | fields)


def samples(fleet):
    """Value by name and labels; a series that is there twice fails, as in Prometheus."""
    found = {}
    for family in text_string_to_metric_families(exposition(fleet).decode()):
        for sample in family.samples:
            key = (sample.name, *sorted(sample.labels.items()))
            assert key not in found
            found[key] = sample.value
    return found


def value(fleet, name, **labels):
    return samples(fleet)[(name, *sorted(labels.items()))]


def labels_of(fleet, label):
    return {dict(key[1:])[label] for key in samples(fleet) if label in dict(key[1:])}


def test_counters_are_those_of_the_status_and_losses_have_their_cause():
    fleet = Fleet([reply(streams=[status()])])
    at = {"node": "n1", "stream": "cam0"}
    assert value(fleet, "neurove_estimates_total", **at) == STATUS["estimates"]
    assert value(fleet, "neurove_lost_packets_total", cause="gap", **at) == STATUS["lost"]["gap_packets"]
    assert value(fleet, "neurove_lost_events_total", cause="late", **at) == STATUS["lost"]["late_events"]
    assert value(fleet, "neurove_flagged_estimates_total", flag="settling", **at) == 20
    assert value(fleet, "neurove_stream_verdict", verdict="lossy", **at) == 1
    assert value(fleet, "neurove_stream_verdict", verdict="ok", **at) == 0
    assert value(fleet, "neurove_angular_sigma_radians_per_second", axis="y", **at) == STATUS["sigma"][4]
    assert value(fleet, "neurove_model_rollbacks_total", node="n1") == 2
    assert value(fleet, "neurove_imu_lost_packets_total", cause="dropped", **at) == STATUS["imu"]["dropped_packets"]
    every_loss = {key for key in samples(fleet) if key[0].startswith("neurove_lost_")}
    assert len(every_loss) == len(STATUS["lost"])


def test_the_histogram_is_cumulative_and_in_seconds():
    fleet = Fleet([reply(streams=[status()])])
    at = {"node": "n1", "stream": "cam0"}
    assert value(fleet, "neurove_latency_seconds_bucket", le="0.005", **at) == 71
    assert value(fleet, "neurove_latency_seconds_bucket", le="+Inf", **at) == STATUS["estimates"]
    assert value(fleet, "neurove_latency_seconds_count", **at) == STATUS["estimates"]
    assert value(fleet, "neurove_latency_seconds_sum", **at) == pytest.approx(0.2805)


def test_an_older_node_has_no_histogram_and_no_flags_and_the_rest_is_there():
    old = status(latency_histogram=None, flag_counts={}, sigma=None)
    names = {key[0] for key in samples(Fleet([reply(streams=[old])]))}
    assert "neurove_estimates_total" in names
    assert not any("latency" in name or "flagged" in name or "sigma" in name for name in names)


def test_a_node_that_is_connected_and_silent_is_not_up():
    fleet = Fleet([reply("n1")], silent=["n2"])
    assert value(fleet, "neurove_node_up", node="n1") == 1
    assert value(fleet, "neurove_node_up", node="n2") == 0
    assert value(fleet, "neurove_node_ready", node="n2") == 0


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_name_stays_one_label_of_bounded_length(name):
    hostile = reply(model=MODEL | {"name": name}, version=name, internal_errors={name: 3})
    fleet = Fleet([hostile])
    for label in ("model", "version", "place"):
        (said,) = labels_of(fleet, label)
        assert len(said) <= MAX_LABEL
        assert said == name or len(name) > MAX_LABEL
    assert not any("fake" in key[0] for key in samples(fleet))


def test_the_number_of_series_is_bounded_and_what_is_left_out_is_counted():
    small = {"latency_histogram": None, "flag_counts": {}, "sigma": None, "imu": None}
    streams = [status(f"cam{number}", **small) for number in range(100)]
    errors = {f"place {number}": 1 for number in range(200)}
    some = reply("first", streams[:1], internal_errors=errors)
    many = [some.model_copy(update={"node": f"n{number}", "streams": tuple(streams)}) for number in range(42)]
    text = exposition(Fleet([*many, some])).decode()
    assert len(re.findall(r"^neurove_estimates_total\{", text, re.MULTILINE)) == MAX_STREAMS
    assert f'neurove_exporter_left_out{{what="streams"}} {42 * 100 + 1 - MAX_STREAMS}.0\n' in text
    assert len(re.findall(r'^neurove_internal_errors_total\{node="first"', text, re.MULTILINE)) == MAX_PLACES


def test_a_flag_that_this_version_does_not_know_adds_no_series():
    fleet = Fleet([reply(streams=[status(flag_counts={f"new{i}": 1 for i in range(64)})])])
    assert not any(flag.startswith("new") for flag in labels_of(fleet, "flag"))


def test_two_nodes_of_one_name_and_a_stream_twice_count_once():
    fleet = Fleet([reply("n1", [status("cam0"), status("cam0")]), reply("n1", [status("cam0")])])
    assert value(fleet, "neurove_node_streams", node="n1") >= 1  # samples() fails on a series that is there twice


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed (Debian: prometheus)")
def test_promtool_finds_nothing_to_improve():
    fleet = Fleet([reply(streams=[status()], internal_errors=dict.fromkeys(HOSTILE, 1))], silent=["n2"])
    checked = subprocess.run(
        ["promtool", "check", "metrics"], input=exposition(fleet), capture_output=True, check=False, timeout=120
    )
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, b"", b"")


def test_labels_of_a_node_and_its_part_in_a_stream_of_several_nodes():
    duty = {"leader": "n1", "term": 7, "equal": True}
    streams = [(status(standby=duty | {"role": role}),) for role in ("answers", "follows")]
    fleet = Fleet([reply("n1", streams[0], labels={"site": "hall-2"}), reply("n2", streams[1])])
    assert value(fleet, "neurove_node_label", node="n1", label="site", value="hall-2") == 1
    for name, of_n1, of_n2 in (("neurove_stream_answers", 1, 0), ("neurove_stream_follows", 0, 1)):
        assert value(fleet, name, node="n1", stream="cam0") == of_n1
        assert value(fleet, name, node="n2", stream="cam0") == of_n2
