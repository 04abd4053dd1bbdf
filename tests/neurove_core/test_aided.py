"""An aided estimate: what the gyroscope learns from, and what is served."""

import numpy as np

from neurove_core.aided import aided
from neurove_core.estimator import Estimator, WindowEstimate
from neurove_core.inertial import state as inertial
from neurove_core.inertial.state import InertialState
from tests.bundles import make_bundle
from tests.neurove_core.inertial import units

WIDE = np.diag([0.1, 0.1, 0.2, 0.04, 0.04, 0.04]) ** 2


def run(covariance: np.ndarray, compared: np.ndarray | None) -> tuple[list[WindowEstimate], InertialState]:
    """Aided estimates of windows whose events show a turn, with such covariances."""
    estimator, state, found = Estimator(make_bundle()), InertialState(), list[WindowEstimate]()
    imu, at = units.samples(units.shaking, 2.1, bias=(0.01, -0.02, 0.005)), 0
    for start_us in range(0, 2_000_000, 50_000):
        stop = int(imu.t.searchsorted(start_us + 50_000))
        state, at = inertial.push(state, imu.span(at, stop))[0], stop
        seen = units.window(start_us, units.shaking, speed=1.0)
        flags = False, True, False, False
        given = WindowEstimate(start_us, seen.end_us, seen.twists, 1000, *flags, covariance, source="refined")
        one, state = aided(estimator, given._replace(compared=compared), state, None)
        found.append(one)
    return found, state


def test_the_bias_is_learned_by_what_rules_compare_and_the_linear_part_is_the_one_that_is_served():
    wanted, state = run(WIDE, None)
    got, other = run(0.01 * WIDE, WIDE)
    assert other.bias.mean_rad_s.tobytes() == state.bias.mean_rad_s.tobytes()
    assert other.bias.mean_rad_s.any()
    for one, two in zip(got, wanted, strict=True):
        assert one.source == "gyro"
        assert one.compared is None
        assert one.twists.tobytes() == two.twists.tobytes()
        np.testing.assert_array_equal(one.covariance[3:, 3:], two.covariance[3:, 3:])
        np.testing.assert_array_equal(one.covariance[:3, :3], 0.01 * WIDE[:3, :3])
