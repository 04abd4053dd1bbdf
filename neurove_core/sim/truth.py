"""The exact twist of a simulated camera at any time, also of a simulation without end."""

import threading
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.recording import Recording
from neurove_core.sim.simulate import Simulation, stop_us
from neurove_core.sim.world.path import CameraPath


class Truth:
    """The twist of the camera at times of its sensor clock; safe for several threads.

    An endless simulation follows one trajectory after the other. They are made when they are needed.

    Args:
        simulation: the simulated camera.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._lock = threading.Lock()
        self._starts_us = [0]
        self._paths: list[CameraPath] = [simulation.trajectory]

    def at(self, t_us: int) -> NDArray[np.float64] | None:
        """The twist (6,) at a time [us], m/s and rad/s; None before the start and after the end."""
        simulation = self._simulation
        if t_us < 0 or t_us > simulation.duration_s * 1e6:
            return None
        with self._lock:
            while simulation.next_trajectory is not None and t_us >= self._starts_us[-1] + stop_us(self._paths[-1]):
                self._starts_us.append(self._starts_us[-1] + stop_us(self._paths[-1]))
                self._paths.append(simulation.next_trajectory(len(self._paths)))
            number = bisect_right(self._starts_us, t_us) - 1
            start_us, path = self._starts_us[number], self._paths[number]
        return path.twist(np.array((t_us - start_us) / 1e6))


def truth_of(recording: Recording) -> Truth | None:
    """The truth of a simulated source; None for any other recording."""
    return Truth(recording) if isinstance(recording, Simulation) else None
