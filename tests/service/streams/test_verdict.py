import pytest

from neurove_service.streams.activity import Activity
from neurove_service.streams.verdict import HOLD_S, UNCERTAIN_S, Verdicts, judge

S = 1_000_000_000


class Clock:
    def __init__(self):
        self.ns = 1000 * S

    def __call__(self):
        return self.ns


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def activity(clock):
    activity = Activity(clock)
    activity.heard(clock.ns)
    return activity


def flows(activity, clock, seconds):
    """Packets and estimates go on for some time."""
    for _ in range(int(10 * seconds)):
        clock.ns += S // 10
        activity.heard(clock.ns)
        activity.last_estimate_ns = clock.ns


def test_a_quiet_stream_is_idle_and_a_flowing_one_ok(activity, clock):
    assert judge(activity, clock.ns).verdict == "ok"
    assert judge(activity, clock.ns + 2 * S) == ("idle", "no packet for 2.0 s")


def test_two_drivers_are_named(activity, clock):
    activity.lost("foreign_packets", 7)
    verdict, why = judge(activity, clock.ns)
    assert (verdict, why) == ("unstable", "two drivers publish on this stream: 7 packets of the second one")
    flows(activity, clock, 6)
    assert judge(activity, clock.ns).verdict == "ok"


def test_a_driver_that_does_not_count_is_named(activity, clock):
    activity.add("uncounted_packets", 1)
    assert "seq 0 in every packet" in judge(activity, clock.ns).why


def test_repeated_resets_are_unstable_for_a_minute(activity, clock):
    for _ in range(3):
        activity.was_reset()
    assert judge(activity, clock.ns) == ("unstable", "3 resets in the last 60 s")
    flows(activity, clock, 61)
    assert judge(activity, clock.ns).verdict != "unstable"


def test_a_stream_without_a_certain_estimate_is_uncertain(activity, clock):
    flows(activity, clock, UNCERTAIN_S + 1)
    assert judge(activity, clock.ns).verdict == "uncertain"
    activity.certain_ns = clock.ns
    assert judge(activity, clock.ns).verdict == "ok"


def test_a_stalled_stream_names_the_reason_of_the_newest_refusal(activity, clock):
    for _ in range(30):
        clock.ns += S // 10
        activity.heard(clock.ns)
        activity.lost("malformed_packets", 1)
        activity.refusal = "event packet: width=9000: the configured cap is 4096"
    verdict, why = judge(activity, clock.ns)
    assert verdict == "stalled"
    assert why.endswith("packets are refused: event packet: width=9000: the configured cap is 4096")


def test_a_refused_camera_info_is_told(activity, clock):
    activity.refusal = "the camera info is for 640x480, the stream sends 64x48"
    activity.add("refused_cameras", 1)
    assert judge(activity, clock.ns) == ("lossy", f"camera info refused: {activity.refusal}")


def test_a_camera_that_stops_is_idle_after_a_second_and_flows_at_the_next_packet(activity, clock):
    verdicts = Verdicts(activity)
    flows(activity, clock, 1)
    assert verdicts.at(clock.ns).verdict == "ok"
    assert verdicts.at(clock.ns + S * 11 // 10).verdict == "idle"
    clock.ns += 2 * S
    activity.heard(clock.ns)
    assert verdicts.at(clock.ns).verdict == "ok"


def test_the_verdict_does_not_flap(activity, clock):
    verdicts = Verdicts(activity)
    told = []
    for turn in range(100):  # ten times a second the stream is unstable, then in order
        activity.heard(clock.ns)
        activity.last_estimate_ns = clock.ns
        activity.newest_ns = {} if turn % 2 else {"uncounted_packets": clock.ns}
        told.append(verdicts.at(clock.ns).verdict)
        clock.ns += S // 20
    assert set(told) == {"unstable"}


def test_a_worse_verdict_is_told_at_once_and_a_better_one_after_the_hold(activity, clock):
    verdicts = Verdicts(activity)
    assert verdicts.at(clock.ns).verdict == "ok"
    activity.lost("foreign_packets", 1)
    assert verdicts.at(clock.ns).verdict == "unstable"
    activity.newest_ns.clear()
    activity.last_loss_ns = None
    for turn in range(20):
        activity.heard(clock.ns)
        activity.last_estimate_ns = clock.ns
        assert verdicts.at(clock.ns).verdict == ("unstable" if turn * 0.1 <= HOLD_S else "ok")
        clock.ns += S // 10


def test_a_counter_stops_at_the_largest_number_that_can_be_sent(activity):
    for _ in range(3):
        activity.lost("gap_packets", (1 << 63) - 2)
    assert activity.counters.losses().gap_packets == (1 << 63) - 1


def test_a_stream_whose_packets_wait_is_not_idle(activity, clock):
    clock.ns += 3 * S
    activity.arrived_ns = clock.ns
    assert judge(activity, clock.ns).verdict == "stalled"
