"""The inertial unit of one stream: IMU packets in, the gyroscope's part of each estimate out, and its status."""

from collections.abc import Callable
from typing import Final

from neurove_core.aided import aided
from neurove_core.estimator import Estimator
from neurove_core.inertial import state as inertial
from neurove_core.inertial.gyro import EXTRAPOLATED_US
from neurove_core.inertial.state import InertialState, Learned
from neurove_core.stream_state import WindowEstimate
from neurove_protocol import CameraInfo
from neurove_protocol.control import ImuStatus
from neurove_protocol.errors import InvalidField, NeuroVEError
from neurove_protocol.imu import decode_imu
from neurove_service import logs
from neurove_service.guard import Guard

log = logs.get(__name__)

SILENT_NS: Final = 1_000_000_000
"""A unit without a packet for this time is silent."""

MAX_GAP_PACKETS: Final = 100_000
"""A larger jump of the number is a restart of the driver and no loss."""


class Inertial:
    """The inertial unit of one stream. The worker of the stream uses it; any thread may read `status`.

    Args:
        stream: its name.
        now_ns: monotonic clock of this node [ns].
        guard: counts errors of the stage, which cost no answer.
    """

    def __init__(self, stream: str, now_ns: Callable[[], int], guard: Guard | None = None) -> None:
        self._stream, self._now_ns, self._guard = stream, now_ns, guard or Guard()
        self._state = InertialState()
        self._expected: int | None = None
        self._received_ns = 0
        self._samples = self._lost = self._refused = self._late = self._dropped = 0
        self._used = self._missed = False
        self._adopted: tuple[int, Learned] | None = None
        self._apart_us = 0  # the newest sample is later than the newest window by this

    def accept(self, payload: bytes, received_ns: int) -> None:
        """Add the samples of a packet; one that breaks a rule is counted and costs nothing else."""
        with self._guard.at("imu packet", stream=self._stream):
            self._add(payload, received_ns)

    def _add(self, payload: bytes, received_ns: int) -> None:
        try:
            packet = decode_imu(payload)
            if packet.stream != self._stream:
                why = f"received on the key of stream {self._stream!r}"
                raise InvalidField("imu packet", "stream", packet.stream, why)
        except NeuroVEError as error:
            self._refused += 1
            if self._refused & (self._refused - 1) == 0:
                log.warning("imu packet refused", stream=self._stream, why=error.message, total=self._refused)
            return
        self._received_ns = received_ns
        missing = packet.seq - (packet.seq if self._expected is None else self._expected)
        if 0 < missing <= MAX_GAP_PACKETS:
            self._lost += missing
        self._expected = packet.seq + 1
        self._state, late = inertial.push(self._state, packet.samples)
        self._samples += packet.samples.n
        self._late += late

    def drop(self, packets: int) -> None:
        """Count packets that the queue dropped."""
        self._dropped += packets

    def restart(self) -> None:
        """Forget what was compared with the events: the stream restarts. The bias stays."""
        self._state = InertialState(samples=self._state.samples, bias=self._state.bias)

    @property
    def learned(self) -> Learned | None:
        """What this node has learned of the unit up to the newest window; None without a unit."""
        return Learned.of(self._state) if self._samples else None

    def adopt(self, start_us: int, learned: Learned | None) -> None:
        """Go on with what another node has learned from the window that begins here; dropped if there is none."""
        self._adopted = (start_us, learned) if learned is not None else None

    def _adopt_at(self, start_us: int) -> None:
        if self._adopted is not None and start_us >= self._adopted[0]:
            if start_us == self._adopted[0]:
                self._state = self._adopted[1].into(self._state)
            self._adopted = None

    def aid(
        self, estimates: list[WindowEstimate], estimator: Estimator, camera: CameraInfo | None
    ) -> list[WindowEstimate]:
        """The estimates of consecutive windows by events and gyroscope; unchanged without a unit or after an error.

        Args:
            estimates: by the events.
            estimator: made them.
            camera: of the stream, where known.
        """
        if not self._samples:
            return estimates
        found = []
        for estimate in estimates:
            self._adopt_at(estimate.start_us)
            disagreed = self._state.disagrees
            try:
                one, self._state = aided(estimator, estimate, self._state, camera)
            except Exception as error:  # noqa: BLE001  # it must not cost the answer of the events
                self._guard.caught("gyroscope", error, stream=self._stream)
                one, self._state = estimate, InertialState()
            found.append(one)
            self._used = one.source == "gyro"
            self._missed = not self._used and not self._state.disagrees
            self._apart_us = int(self._state.samples.t[-1]) - estimate.end_us if self._state.samples.n else 0
            if self._state.disagrees and not disagreed:
                log.warning("gyroscope disagrees with the events", stream=self._stream, why=self._state.agreement.why)
        return found

    def status(self) -> ImuStatus | None:
        """The unit and what is wrong with it; None if no packet has arrived."""
        state = self._state
        if not self._samples and not self._refused:
            return None
        t, silent_ns = state.samples.t, self._now_ns() - self._received_ns
        span_s = float(t[-1] - t[0]) / 1e6 if t.size else 0.0
        silent = silent_ns > SILENT_NS
        sigma = float(state.bias.variance_at(int(t[-1]) if t.size else 0).max()) ** 0.5
        x, y, z = state.bias.mean_rad_s.tolist()
        offset_us = state.agreement.offset_us
        return ImuStatus(
            rate_hz=0.0 if silent or span_s <= 0 else (t.size - 1) / span_s,
            samples=self._samples,
            lost_packets=self._lost,
            refused_packets=self._refused,
            dropped_packets=self._dropped,
            late_samples=self._late,
            used=self._used and not silent,
            resting=state.resting,
            bias_rad_s=(x, y, z) if state.bias.known else None,
            bias_sigma_rad_s=sigma,
            offset_ms=None if offset_us is None else offset_us / 1e3,
            disagrees=state.disagrees,
            problem=self._problem(silent_ns),
        )

    def _problem(self, silent_ns: int) -> str:
        """What is wrong, in one sentence; empty if nothing is."""
        if not self._samples:
            return "every packet was refused"
        if silent_ns > SILENT_NS:
            return f"no packet for {silent_ns / 1e9:.1f} s"
        if self._state.disagrees:
            return self._state.agreement.why
        if self._missed and abs(self._apart_us) > EXTRAPOLATED_US + 1_000_000:
            where = f"{abs(self._apart_us) / 1e6:.1f} s {'after' if self._apart_us > 0 else 'before'} the events"
            return f"its newest sample is {where}: its clock is not that of the camera"
        if self._missed:
            return "no samples at the time of the newest window: they arrive too late, or some are missing"
        return ""
