"""The inertial unit of a stream in words, for watch, health and doctor."""

from neurove_protocol.control import ImuStatus


def imu_text(unit: ImuStatus) -> str:
    """The inertial unit of a stream in one sentence: its problem, or its rate, bias and offset."""
    if unit.problem:
        cure = "; the estimates use the events alone" if not unit.used else ""
        word = "gyroscope disagrees with the events" if unit.disagrees and unit.rate_hz else "inertial unit"
        return f"{word}: {unit.problem}{cure}"
    bias = "not known before the first rest"
    if unit.bias_rad_s is not None:
        numbers = " ".join(f"{one:+.4f}" for one in unit.bias_rad_s)
        bias = f"{numbers} ± {unit.bias_sigma_rad_s:.4f} rad/s"
    offset = "" if unit.offset_ms is None else f", its times are {unit.offset_ms:+.0f} ms late"
    lost = unit.lost_packets + unit.refused_packets + unit.dropped_packets
    missing = f", {lost:,} packets lost or refused" if lost else ""
    state = "; the camera rests" if unit.resting else ""
    return f"inertial unit {unit.rate_hz:,.0f} Hz, gyroscope bias {bias}{offset}{missing}{state}"
