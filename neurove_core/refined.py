"""The last step of a push: the network's estimate of a window, refined by the events of the window and those before."""

import numpy as np
from numpy.typing import NDArray

from neurove_core.ingest.windows import Window
from neurove_core.refine import errors, ground, standing
from neurove_core.refine import stages as refining
from neurove_core.refine.ground import GroundState
from neurove_core.refine.rotation import Given, Rate, with_rate
from neurove_core.refine.rotation import Refined as RotationFound
from neurove_core.stream_state import StreamState, WindowEstimate

Refined = tuple[WindowEstimate, StreamState]
"""A refined estimate, and the state of the stream after it."""


def refine(window: Window, estimate: WindowEstimate, state: StreamState, duration_us: int) -> Refined:
    """An estimate, refined by the sample of its window and by those before; it does not say whether it is uncertain.

    Args:
        window: without a sample the estimate stays as it is.
        estimate: the network's.
        state: of the stream.
        duration_us: of the window [us].
    """
    estimate, state = _held(window, estimate, state)
    if window.sample is None or state.view is None or estimate.covariance is None:
        return estimate, state
    known_m = state.camera.height_m if state.camera else None
    about = window.start_us, duration_us, window.sample, state.view, estimate.twists.mean(axis=0)
    given = Given(*about, estimate.covariance, estimate.low_activity, None, known_m or 1.0, known_m is not None)
    found = refining.refine(given, state.stages)
    state = state._replace(stages=found.state, ground=state.ground if found.level else GroundState())
    estimate = _turned(estimate, found.turn, found.velocity)
    answer, state = _over_ground(window, estimate, state, found)
    if answer is estimate:
        answer = _with_errors(estimate, found, given.height_m)
    return answer._replace(vehicle=state.stages.on_vehicle), state


def _held(window: Window, estimate: WindowEstimate, state: StreamState) -> Refined:
    """The network's estimate by what is known of a stop too, see `refine.standing`."""
    if window.sample is None or state.view is None or state.camera is None or estimate.covariance is None:
        return estimate, state
    if state.camera.height_m is None:
        return estimate, state
    share = (window.events - window.outside) / max(state.low_activity_below, 1.0)
    about = estimate.end_us, share, state.camera.height_m, state.ground.standing
    found = standing.hold(estimate.twists, estimate.covariance, *about)
    state = state._replace(ground=state.ground._replace(standing=found.standing))
    if found.standing.sigma_m_s is None:
        return estimate, state
    return estimate._replace(twists=found.twists, covariance=found.covariance, source="refined"), state


def _turned(estimate: WindowEstimate, found: RotationFound, velocity: refining.Velocity | None) -> WindowEstimate:
    """The estimate with the angular part of the refinement, and the linear one if it has one, where it is accepted."""
    if estimate.covariance is None or found.outcome != "accepted":
        return estimate
    twists, covariance = with_rate(estimate.twists, estimate.covariance, found.rate, found.change_rad_s)
    if velocity is not None:
        twists[:, :3], covariance[:3, :3] = velocity
    return estimate._replace(twists=twists, covariance=covariance, source="refined")


def _with_errors(estimate: WindowEstimate, found: refining.Stages, height_m: float) -> WindowEstimate:
    """An estimate without the ground, with the terms of `refine.errors`, and less of a speed that is not seen."""
    if estimate.covariance is None:
        return estimate
    twists, covariance, turn = estimate.twists, estimate.covariance.copy(), found.turn
    if turn.errors is not None:
        covariance[3:, 3:] = (turn.errors + turn.errors.T) / 2
    if found.velocity is None:
        twists = standing.towards_zero(twists, estimate.covariance)
        rate_rad_s = float(np.linalg.norm(twists.mean(axis=0)[3:]))
        covariance = errors.of_unknown_depth(covariance, turn.shift, rate_rad_s, height_m)
    served = covariance.copy()
    if turn.outcome == "accepted":
        served[3:, 3:] = found.state.trembled(covariance[3:, 3:], assumed=turn.errors is not None)
    return estimate._replace(twists=twists, covariance=served, compared=covariance)


def _over_ground(
    window: Window,
    estimate: WindowEstimate,
    state: StreamState,
    found: refining.Stages,
) -> Refined:
    """The estimate with the motion over level ground, where it is accepted; see `refine.ground`.

    Args:
        window: with the sample of its events.
        estimate: so far; it stays the same object if the answer is not accepted.
        state: of the stream.
        found: the stages before; a camera that is on no vehicle has no ground.
    """
    if not found.level:
        return estimate, state
    if window.sample is None or state.view is None or state.camera is None or estimate.covariance is None:
        return estimate, state
    camera, height_m = state.camera, state.camera.height_m
    if height_m is None:
        return estimate, state  # nothing says that the camera looks at level ground
    events = ground.events_of(state.view, window.sample, window.start_us)
    sigma = found.turn.sigma_rad_s
    sigma = np.sqrt(np.diagonal(estimate.covariance)[3:]) if sigma is None else sigma
    known = estimate.twists.mean(axis=0), sigma, state.ground
    turned = estimate.source == "refined" and not estimate.low_activity
    measured = estimate.covariance[3:, 3:] if turned else None
    answer = ground.refine(events, estimate.start_us, estimate.end_us, camera, *known, measured)
    state = state._replace(ground=answer.state, stages=state.stages.after_ground(answer.outcome))
    if answer.outcome not in ("accepted", "turning") or answer.motion is None:
        return estimate, state
    twist, after = answer.motion.twist, answer.state
    seen = after.tilt, after.pitch_sigma, height_m, state.stages.odds
    covariance = errors.of_ground(twist, answer.motion.covariance, *seen)
    twists = np.tile(twist, (len(estimate.twists), 1))
    if answer.outcome == "turning":
        rate = Rate(twist[3:], covariance[3:, 3:])
        twists, covariance = with_rate(estimate.twists, estimate.covariance, rate, np.zeros(3))
    if state.stages.is_free:
        return _without_rate(twists, covariance, _with_errors(estimate, found, height_m)), state
    estimate = estimate._replace(twists=twists, covariance=covariance, source="refined")
    if answer.outcome == "turning":
        return estimate, state
    span_us = estimate.start_us, estimate.end_us
    narrower, stages = state.stages.narrowed(covariance, twist, span_us, camera)
    return estimate._replace(covariance=narrower, compared=covariance), state._replace(stages=stages)


def _without_rate(
    twists: NDArray[np.float64], covariance: NDArray[np.float64], before: WindowEstimate
) -> WindowEstimate:
    """The linear part of a motion over the ground, with the angular part of the estimate before it."""
    joint = [covariance.copy(), covariance.copy()]
    for one, angular in zip(joint, (before.covariance, before.compared), strict=True):
        one[:3, 3:], one[3:, :3] = 0.0, 0.0
        if angular is not None:
            one[3:, 3:] = angular[3:, 3:]
    twists = np.hstack([twists[:, :3], before.twists[:, 3:]])
    compared = None if before.compared is None else joint[1]
    return before._replace(twists=twists, covariance=joint[0], compared=compared, source="refined")
