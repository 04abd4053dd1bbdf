"""What one camera stream carries from packet to packet, and what is estimated from each of its windows."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.ingest.channels import Recent
from neurove_core.ingest.windows import WindowsState
from neurove_core.networks.arrays import State
from neurove_core.refine import stages as refining
from neurove_core.refine.ground import GroundState
from neurove_core.refine.view import View
from neurove_core.timescales import Longer
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.velocity import Source


class StreamState(NamedTuple):
    """All that one camera stream carries from packet to packet."""

    sensor: Sensor
    camera: CameraInfo | None
    lut: NDArray[np.int32]  # sensor pixel -> canonical cell
    windows: WindowsState
    network: State
    age: int  # windows since the network state began
    end_us: int | None = None  # end of the newest window that the network has processed
    low_activity_below: float = 0.0  # a window with fewer visible events is flagged low_activity
    view: View | None = None  # for the refinement; None where estimates are not refined
    stages: refining.State = refining.State()  # of the refinement
    ground: GroundState = GroundState()  # of the refinement of the linear part
    recent: Recent = ()  # counts of earlier windows, for models with a history
    longer: Longer = Longer()  # for models with longer windows

    def without_refinement(self) -> "StreamState":
        """The state in which the refinement begins again."""
        return self._replace(stages=refining.State(), ground=GroundState())


class WindowEstimate(NamedTuple):
    """The estimate of one window."""

    start_us: int
    end_us: int
    twists: NDArray[np.float64]  # (n, 6): vx vy vz [m/s], wx wy wz [rad/s], optical frame, one row per bin; see push
    events: int
    first: bool  # the network state began in this window
    settled: bool
    low_activity: bool
    saturated: bool
    covariance: NDArray[np.float64] | None = None  # (6, 6) of each of these twists, from the bundle's calibration
    uncertain: bool = False  # the linear or the angular sigma exceeds both its bounds, see Uncertainty.is_uncertain
    source: Source = "network"  # of the angular part
    gyro_disagrees: bool = False  # the events and the gyroscope of the camera disagree
    vehicle: bool = False  # the camera is on a vehicle by the events of many windows
    compared: NDArray[np.float64] | None = None  # (6, 6) what rules compare; None if it is `covariance`
