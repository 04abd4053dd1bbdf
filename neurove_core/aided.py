"""An estimate of the events, aided by the inertial unit of the camera: the stage after network and refinement."""

from neurove_core.estimator import Estimator
from neurove_core.inertial import state as inertial
from neurove_core.inertial.state import InertialState, Window
from neurove_core.stream_state import WindowEstimate
from neurove_protocol import CameraInfo


def aided(
    estimator: Estimator, estimate: WindowEstimate, state: InertialState, camera: CameraInfo | None
) -> tuple[WindowEstimate, InertialState]:
    """The estimate of a window by events and gyroscope, and the state after it; see `inertial.state.aid`.

    Args:
        estimator: made the estimate.
        estimate: of the next window.
        state: with the samples up to the end of the window, as far as they have arrived.
        camera: of the stream, where known.
    """
    height_m = camera.height_m if camera is not None else None
    found, state = inertial.aid(
        state,
        Window(
            estimate.start_us,
            estimate.end_us,
            estimate.twists,
            estimate.covariance if estimate.compared is None else estimate.compared,
            estimate.low_activity,
            refined=estimate.source == "refined",
            scale_m=height_m or 1.0,
            scaled=height_m is not None,
            vehicle=estimate.vehicle,
        ),
    )
    disagrees = state.disagrees
    if not found.used:
        return estimate._replace(gyro_disagrees=disagrees), state
    covariance = found.covariance
    if covariance is not None and estimate.covariance is not None and not found.resting:
        covariance = covariance.copy()
        covariance[:3, :3] = estimate.covariance[:3, :3]
    uncertain = covariance is not None and estimator.is_uncertain(found.twists, covariance)
    aided_estimate = estimate._replace(
        twists=found.twists,
        covariance=covariance,
        compared=None,
        uncertain=uncertain,
        source="gyro",
        gyro_disagrees=disagrees,
    )
    return aided_estimate, state
