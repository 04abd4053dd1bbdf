"""What tests are made of: events, packets, recordings. Everything is drawn from a seed."""

import numpy as np

from neurove_protocol import EventPacket, Events, Sensor

SENSOR = Sensor(64, 48)


def make_events(
    n: int = 1000, *, seed: int = 0, start_us: int = 0, duration_us: int = 100_000, sensor: Sensor = SENSOR
) -> Events:
    """`n` uniform events in [start_us, start_us + duration_us), ordered by time."""
    rng = np.random.default_rng(seed)
    return Events.from_columns(
        np.sort(rng.integers(start_us, start_us + duration_us, n)),
        rng.integers(0, sensor.width, n),
        rng.integers(0, sensor.height, n),
        rng.integers(0, 2, n),
    )


def make_packet(
    n: int = 100,
    *,
    seed: int = 0,
    stream: str = "cam0",
    seq: int = 0,
    t0_us: int = 0,
    duration_us: int = 4000,
    sensor: Sensor = SENSOR,
) -> EventPacket:
    """A packet of `n` uniform events in its first `duration_us`."""
    events = make_events(n, seed=seed, start_us=t0_us, duration_us=duration_us, sensor=sensor)
    return EventPacket(stream, seq, sensor, t0_us, events)


def make_packets(
    count: int, *, first_seq: int = 0, start_us: int = 0, step_us: int = 4000, **packet: object
) -> list[EventPacket]:
    """`count` packets one after the other, each `step_us` long, each drawn from its own seed."""
    return [
        make_packet(seed=first_seq + i, seq=first_seq + i, t0_us=start_us + i * step_us, duration_us=step_us, **packet)  # type: ignore[arg-type]
        for i in range(count)
    ]
