"""Velocities: doubts, frames with a case by hand, and the diagnostics that say why."""

import numpy as np
import pytest

from neurove_core.geometry.motion import Twists
from neurove_core.geometry.mounting import Mounting
from neurove_protocol import Flag, Twist, TwistEstimate
from neurove_protocol.control import StreamStatus
from neurove_service.ros2 import diagnostics
from neurove_service.ros2.diagnostics import Reporter, Seen
from neurove_service.ros2.feed import Feed
from neurove_service.ros2.velocity import ALL_DOUBTS, LINEAR_DOUBTS, WHY, Frame, Velocity
from tests.protocol.messages import EXAMPLES, STATUS

TWIST = Twist(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
DIAGONAL = (0.01, 0.04, 0.09, 0.001, 0.004, 0.009)
STAMP = 5 * 10**9


KNOWN = tuple(np.diag(DIAGONAL).ravel().tolist())


def estimate(*flags, covariance=KNOWN):
    made = EXAMPLES["TwistEstimate"]
    fields = {"twists": (TWIST,) * len(made["twists"]), "flags": tuple(flag.value for flag in flags)}
    return TwistEstimate(**(made | fields | {"covariance": covariance}))


def message(velocity, one):
    sent = velocity.message(one, STAMP, "camera")
    return sent.linear + sent.angular, np.array(sent.covariance).reshape(6, 6)


def test_an_estimate_without_doubt_is_sent_as_it_was():
    twist, covariance = message(Velocity("cam0"), estimate(Flag.LATE, Flag.GAP))
    assert twist == tuple(TWIST)
    np.testing.assert_array_equal(covariance, np.diag(DIAGONAL))


@pytest.mark.parametrize("flag", LINEAR_DOUBTS)
def test_a_doubtful_linear_part_has_a_large_variance_and_no_correlation(flag):
    full = np.diag(DIAGONAL) + 1e-4
    _, covariance = message(Velocity("cam0"), estimate(flag, covariance=tuple(full.ravel())))
    np.testing.assert_array_equal(covariance[:3, :3], 1e6 * np.eye(3))
    assert not covariance[:3, 3:].any()
    assert not covariance[3:, :3].any()
    np.testing.assert_array_equal(covariance[3:, 3:], full[3:, 3:])


@pytest.mark.parametrize("one", [*(estimate(flag) for flag in ALL_DOUBTS), estimate(covariance=None)])
def test_both_parts_are_doubtful(one):
    _, covariance = message(Velocity("cam0", variance=1e4), one)
    np.testing.assert_array_equal(covariance, 1e4 * np.eye(6))


def test_withheld_and_unstamped_estimates_are_counted():
    velocity = Velocity("cam0", doubtful="withhold")
    assert velocity.message(estimate(Flag.UNSCALED), STAMP, "camera") is None
    assert velocity.message(estimate(), None, "camera") is None
    assert velocity.message(estimate(), STAMP, "camera") is not None
    assert (velocity.sent, velocity.withheld, velocity.unstamped) == (1, 1, 1)
    assert velocity.doubted == {"unscaled": 1}


@pytest.mark.parametrize(
    ("frame", "of_events", "frame_id"),
    [(None, "camera", "camera"), (None, "", "cam0_optical_frame"), ("base_link", "camera", "base_link")],
)
def test_the_frame_has_a_name(frame, of_events, frame_id):
    sent = Velocity("cam0", Frame(frame)).message(estimate(), STAMP, of_events)
    assert (sent.header.frame_id, sent.header.stamp_ns) == (frame_id, STAMP)


def test_a_frame_turns_and_shifts_the_twist_as_by_hand():
    """A camera that looks forward, 0.5 m ahead of the base: its x is the base's -y, its y -z, its z x.

    v_c = (1, 2, 3), w_c = (.1, .2, .3) are (3, -1, -2) and (.3, -.1, -.2) along the axes of the base. The base's origin
    is 0.5 m behind: w x (-.5, 0, 0) = -.5 (0, -.2, .1), hence v_b = (3, -1 + .1, -2 - .05).
    """
    mounting = Mounting.from_angles(position_m=(0.5, 0.0, 0.0))
    twist, covariance = message(Velocity("cam0", Frame("base_link", mounting)), estimate())
    np.testing.assert_allclose(twist, (3.0, -0.9, -2.05, 0.3, -0.1, -0.2), atol=1e-12)
    # along the axes of the base .09 .01 .04 and .009 .001 .004; y has .25 times the variance of w_z, z that of w_y
    want = np.diag((0.09, 0.01 + 0.25 * 0.004, 0.04 + 0.25 * 0.001, 0.009, 0.001, 0.004))
    want[1, 5] = want[5, 1] = -0.5 * 0.004
    want[2, 4] = want[4, 2] = 0.5 * 0.001
    np.testing.assert_allclose(covariance, want, atol=1e-12)


def test_the_adjoint_is_the_inverse_of_the_twist_of_the_base():
    mounting = Mounting.from_angles(3, -20, 140, (0.1, -0.4, 0.9))
    twist = np.random.default_rng(20_300).normal(size=(4, 6))
    there = mounting.of_base(Twists(np.arange(4), twist)).twist
    np.testing.assert_allclose(there @ mounting.adjoint.T, twist, atol=1e-12)


def test_a_doubtful_part_stays_doubtful_in_another_frame():
    mounting = Mounting.from_angles(0, 30, 10, (1.0, 0.0, 0.0))
    _, covariance = message(Velocity("cam0", Frame("base_link", mounting)), estimate(Flag.UNSCALED))
    np.testing.assert_array_equal(covariance[:3, :3], 1e6 * np.eye(3))
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_every_doubt_has_words():
    assert {*ALL_DOUBTS, *LINEAR_DOUBTS} < set(WHY)


class Told:
    """Diagnostics of one stream."""

    def __init__(self, status=None):
        self.feed, self.velocity = Feed("cam0"), Velocity("cam0")
        self.status, self._reporter, self.now_ns = status, Reporter("edge"), 10**10

    def status_now(self, fault=""):
        seen = Seen("cam0", "/cam/events", self.feed, self.velocity, self.status, self.now_ns)
        return self._reporter.message([seen], fault, self.now_ns, STAMP).status[0]

    def said(self, **how):
        one = self.status_now(**how)
        return one.level, one.message


def ok_status():
    return StreamStatus(**(STATUS | {"verdict": "ok", "why": ""}))


def test_diagnostics_say_in_words_what_is_wrong():
    told = Told()
    assert told.said(fault="no connection") == (diagnostics.ERROR, "no connection")
    assert told.said() == (diagnostics.STALE, "no events on /cam/events yet")
    told.feed.newest_ns = told.now_ns
    assert told.said() == (diagnostics.ERROR, "the service does not answer for this stream")
    told.status = ok_status()
    assert told.said() == (diagnostics.OK, "estimates are published")
    told.feed.counts.lost_messages = 3
    assert told.said() == (diagnostics.WARN, "in the last second: 3 lost_messages")
    assert told.said()[0] == diagnostics.OK  # no further loss
    told.velocity.message(estimate(Flag.UNSCALED), STAMP, "camera")
    level, text = told.said()
    assert (level, text) == (diagnostics.WARN, f"the linear velocity is not reliable: {WHY[Flag.UNSCALED]}")
    told.now_ns += 3 * 10**9
    assert told.said() == (diagnostics.STALE, "no events on /cam/events for 3 s")
    values = {one.key: one.value for one in told.status_now().values}
    assert (values["lost_messages"], values["doubtful_unscaled"], values["velocity_sent"]) == ("3", "1", "1")


def test_of_two_nodes_that_answer_one_stream_each_window_is_sent_once():
    velocity, made = Velocity("cam0"), estimate()
    window_us = made.end_us - made.start_us

    def takes(term, number):
        start_us = number * window_us
        one = made.model_copy(update={"term": term, "start_us": start_us, "end_us": start_us + window_us})
        return velocity.takes(one, number)

    assert [takes(*one) for one in ((7, 0), (7, 1), (9, 1), (9, 2), (7, 2), (9, 3))] == [
        *(True, True),
        False,
        True,
        False,
        True,
    ]
