"""Stages of the refinement before that of the ground: the rotation, and the motion in a scene with depth.

`rotation` is exact where the camera turns and translates little, `scene` where translation counts. Both run, until the
scene shows a camera that translates, in two windows in a row where the rotation is accepted; then its motion is the
answer, and the rotation is searched only where it is not accepted. A camera that the network certainly sees move fast
is a vehicle, which is left to the ground. So is a camera that is on a vehicle by the outcomes over the ground, see
`vehicle`: there no scene is searched for. Elsewhere a motion over the ground gives no angular velocity, because what
such a camera sees is seldom level. No scene begins where the rotation finds nothing that moves. Without a known height,
a scene is searched for only where the parts of the image disagree about the rotation.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine import errors, rotation, scatter, scene, search, trembling, vehicle
from neurove_core.refine.alignment import Grid
from neurove_core.refine.ground import Outcome
from neurove_core.refine.rotation import MAX_AGAINST, MIN_SPREAD, Filter, Given, Rate, Refined, drives, floored, spread
from neurove_core.refine.scatter import Scatter
from neurove_core.refine.scene import Moved, Scene
from neurove_core.refine.trembling import Trembling
from neurove_protocol import CameraInfo

Array = NDArray[np.float64]

DEPTH: Final = 1.6
"""Depth of a scene over the height of the camera, when it is not known."""

DEPTH_SIGMA: Final = 0.6
"""Sigma of it, as a share."""

MAX_ASIDE: Final = 0.7
"""Tangent of the greatest angle between the motion of a vehicle and the optical axis."""

ASIDE: Final = 100
"""Windows for which a camera that moved aside is on no vehicle."""

SEARCH_EVERY: Final = 4
"""While no motion in a scene is accepted, only each fourth window is searched for it."""

PATIENCE: Final = 5
"""Windows without an accepted motion in which each one is still searched."""

_CHANGE_GAIN: Final = 0.8  # of the change within a window over that since the window before
_DEPTH_ERROR: Final = 0.1  # error of the angular velocity by the velocity over depth


class Velocity(NamedTuple):
    """A linear velocity with its covariance."""

    v_m_s: Array  # (3,)
    covariance: Array  # (3, 3)


class State(NamedTuple):
    """What a stream carries from window to window."""

    filter: Filter | None = None  # of the rotation
    scene: Scene | None = None
    aside: int = 0  # windows for which the camera is on no vehicle
    idle: int = PATIENCE  # windows since a motion in the scene was accepted
    again: bool = False  # whether to look at the scene once more before it outweighs a rotation
    odds: float = vehicle.START  # that the camera is on a vehicle, see `vehicle`
    scatter: Scatter = Scatter()  # of the answers over the ground
    trembling: Trembling = Trembling()  # of the rates of these stages

    @property
    def is_free(self) -> bool:
        """Whether the outcomes over the ground show no vehicle; its motion over the ground then has no angular part."""
        return self.odds < 0

    @property
    def on_vehicle(self) -> bool:
        """Whether the outcomes over the ground show a vehicle, more than a known height alone does."""
        return self.odds >= vehicle.START + errors.SURE

    def after_ground(self, outcome: Outcome) -> "State":
        """The state after the outcome over the ground of the same window."""
        return self._replace(odds=vehicle.judged(self.odds, outcome))

    def narrowed(
        self, covariance: Array, twist: Array, span_us: tuple[int, int], camera: CameraInfo
    ) -> tuple[Array, "State"]:
        """The covariance of an answer over the ground, narrower where such answers scatter little, and the state after.

        Args:
            covariance: (6, 6) by `errors.of_ground`.
            twist: (6,) of the answer [m/s, rad/s].
            span_us: start and end of its window.
            camera: its lens.
        """
        seen = scatter.answered(self.scatter, twist, *span_us)
        found = scatter.narrowed(covariance, seen, float(np.linalg.norm(twist[:3])), camera)
        return found, self._replace(scatter=seen)

    def trembled(self, covariance: Array, *, assumed: bool) -> Array:
        """The covariance (3, 3) of an accepted rate of these stages, see `trembling.trembled`."""
        return trembling.trembled(covariance, self.trembling, assumed=assumed)


class Stages(NamedTuple):
    """Answer of both stages."""

    turn: Refined  # the angular velocity
    velocity: Velocity | None  # None where the network's stands
    level: bool  # whether the camera may be on a vehicle, which moves over level ground
    state: State


def refine(given: Given, state: State) -> Stages:
    """Refine the motion of a window by its events; `given.before` is not used."""
    found = _refined(given, state)
    if found.turn.outcome != "accepted":
        return found
    span_us = given.start_us, given.start_us + given.window_us
    after = trembling.turned(state.trembling, found.turn.rate.w_rad_s, *span_us)
    return found._replace(state=found.state._replace(trembling=after))


def _refined(given: Given, state: State) -> Stages:
    given = given._replace(before=state.filter)
    kept = State(odds=state.odds, scatter=state.scatter, trembling=state.trembling)
    if given.knows_height and not state.is_free:
        alone = rotation.refine(given)
        return Stages(alone, None, True, kept._replace(filter=alone.filter))
    before, turn = state.scene, None
    found = None
    if given.knows_height and before is not None and before.moves and state.idle < PATIENCE:
        found = _in_scene(given, before, None)
    if found is None or found.outcome != "accepted":
        turn = rotation.refine(given)
        if found is None and turn.motion is not None and _is_due(given, state, turn):
            found = _in_scene(given, before, turn.motion)
    scene, aside = before if found is None else found.scene, max(state.aside - 1, 0)
    moved = found is not None and found.outcome == "accepted"
    again = moved and turn is not None and turn.outcome == "accepted" and state.idle >= PATIENCE and not state.again
    if found is not None and moved and not again:
        aside = ASIDE if _is_aside(found) else aside
        turn = _turn(given, found, before)
        kept = kept._replace(filter=turn.filter, scene=scene, aside=aside, idle=0)
        return Stages(turn, _velocity(given, found), aside == 0, kept)
    assert turn is not None  # the rotation was searched
    idle = min(state.idle + 1, PATIENCE)
    kept = kept._replace(filter=turn.filter, scene=scene, aside=aside, idle=idle, again=again)
    return Stages(turn, None, aside == 0, kept)


def compile_kernels(grid: Grid) -> None:
    """Compile all code of these stages, so that the first window does not wait for it."""
    search.compile_kernels(grid)
    scene.compile_kernels(grid)


def _is_due(given: Given, state: State, turn: Refined) -> bool:
    """Whether to search a window for a scene after its rotation."""
    moves = state.scene is not None and state.scene.moves > 0
    if turn.outcome == "disagreeing" and not (moves and state.idle >= PATIENCE):
        return True  # a scene with depth disagrees with a search for one depth
    if not given.knows_height or turn.outcome == "still":
        return False
    first = state.scene is not None and state.scene.seen and not moves  # seen once, to be seen again
    return first or state.again or given.start_us // given.window_us % SEARCH_EVERY == 0


def _in_scene(given: Given, before: Scene | None, guess: Array | None) -> Moved | None:
    """The motion in the scene; None where it is not searched for."""
    rays, grid = given.view.rays_of(given.sample, given.window_us), given.view.grid
    if given.low_activity or rays.x.size < scene.MIN_EVENTS or spread(rays, grid) < MIN_SPREAD or drives(given):
        return None
    end_us = given.start_us + given.window_us
    known = floored(given.covariance[3:, 3:])
    try:
        return scene.moved(scene.Window(rays, grid, given.start_us, end_us, given.twist[3:], known, guess), before)
    except np.linalg.LinAlgError:  # events that make no finite Hessian
        return None


def _is_aside(found: Moved) -> bool:
    """Whether the camera certainly moves aside, as no vehicle does."""
    across, sigma = float(np.hypot(*found.shift[:2])), float(np.sqrt(np.trace(found.covariance[3:, 3:])))
    return found.scene.seen and across > MAX_ASIDE * abs(float(found.shift[2])) + 2 * sigma


def _turn(given: Given, found: Moved, before: Scene | None) -> Refined:
    end_us, motion = given.start_us + given.window_us, np.concatenate([found.w_rad_s, found.shift])
    follows = before is not None and before.end_us == given.start_us
    change = _CHANGE_GAIN * (found.w_rad_s - before.mean[:3]) if before is not None and follows else np.zeros(3)
    covariance = found.covariance[:3, :3] + np.eye(3) * (_DEPTH_ERROR * float(np.linalg.norm(found.shift))) ** 2
    filtered = Filter(motion, found.covariance, end_us, MAX_AGAINST)  # it outweighs no network
    rate = Rate(found.w_rad_s, covariance)
    wider = covariance + np.eye(3) * errors.TREMBLE_RAD_S**2
    sigma = np.sqrt(np.diagonal(covariance))
    return Refined(rate, "accepted", filtered, change, sigma, errors=wider, motion=motion)


def _velocity(given: Given, found: Moved) -> Velocity:
    depth_m = DEPTH * given.height_m
    v_m_s = depth_m * found.shift
    covariance = depth_m**2 * found.covariance[3:, 3:] + DEPTH_SIGMA**2 * np.outer(v_m_s, v_m_s)
    return Velocity(v_m_s, (covariance + covariance.T) / 2)
