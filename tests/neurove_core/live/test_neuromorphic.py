"""Cameras of neuromorphic-drivers, on a device that plays a script: timeouts, overflow, unplug, backlog."""

import neuromorphic_drivers as nd
import numpy as np
import pytest

from neurove_core.io.faults import Reason
from neurove_core.live.neuromorphic import MODELS, NeuromorphicCamera
from neurove_core.live.source import LiveEnded
from neurove_protocol import Events, Sensor
from tests.builders import make_events
from tests.neurove_core.live.nd_device import TIMEOUT, UNPLUGGED, FakeDevice, Step

EVK4 = Sensor(1280, 720)


def events(seed, n=100, start_us=0, duration_us=1000):
    return make_events(n, seed=seed, start_us=start_us, duration_us=duration_us, sensor=EVK4)


def batches_of(source):
    """Every batch until the source ends, and why it ended."""
    found = []
    with pytest.raises(LiveEnded) as ended:
        found.extend(source.batches())
    return found, ended.value


class Collected:
    """What a script gives."""

    def __init__(self, *script, **device):
        self.device = FakeDevice(script, **device)
        self.source = NeuromorphicCamera(self.device, delay_s=3600)
        self.batches = []
        with pytest.raises(LiveEnded) as ended:
            self.batches.extend(self.source.batches())
        self.ended = ended.value
        self.events = Events.join([one.events for one in self.batches])
        self.counts = {fault.reason: fault.count for fault in self.source.faults.found}


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_every_event_passes_in_order_and_nothing_is_lost():
    parts = [events(20020 + i, start_us=1000 * i) for i in range(5)]
    got = Collected(*[Step(part) for part in parts])
    assert same(got.events, Events.join(parts))
    assert not any(one.lost or one.restarted for one in got.batches)
    assert got.counts == {}


def test_the_camera_says_its_model_serial_number_and_size():
    source = NeuromorphicCamera(FakeDevice([]))
    assert (source.name, source.sensor, source.streams) == ("Prophesee EVK4 00051234", EVK4, ("events",))
    assert source.camera("cam0") is None


@pytest.mark.parametrize(("model", "name"), [(model, name) for model, (name, _) in MODELS.items()])
def test_every_model_is_one_of_the_library(model, name):
    module = getattr(nd, MODELS[model][1])
    assert nd.Name(name)
    assert module.Configuration().serialize()


def test_an_overflow_leaves_a_gap_at_its_place():
    part = events(20030, n=50)
    got = Collected(Step(events(20031), now_us=0), Step(part._replace(t=part.t + 2000), [20], dropped=7))
    sizes = [(one.events.n, one.lost) for one in got.batches if one.events.n]
    assert sizes == [(100, False), (20, False), (30, True)]
    assert got.counts == {Reason.LOST: 7}
    assert got.events.n == 150


def test_an_overflow_after_the_last_event_of_a_packet_counts_for_the_next_one():
    later = events(20033, start_us=5000)
    got = Collected(Step(events(20032), [100], dropped=1), TIMEOUT, Step(later, dropped=1))
    assert [(one.events.n, one.lost) for one in got.batches if one.events.n] == [(100, False), (100, True)]
    assert got.counts == {Reason.LOST: 1}


def test_a_timeout_gives_a_batch_and_a_quiet_camera_its_own_time():
    got = Collected(Step(events(20034)), TIMEOUT, TIMEOUT, Step(None, now_us=50_000), Step(None, now_us=70_000))
    assert [one.now_us for one in got.batches if one.now_us is not None] == [50_000, 70_000]
    assert len(got.batches) == 5


def test_a_stationary_scene_has_ticks_by_the_clock_of_this_machine():
    source = NeuromorphicCamera(FakeDevice([Step(events(20035)), *[TIMEOUT] * 2000]), delay_s=0)
    found, _ = batches_of(source)
    ticks = [one.now_us for one in found if one.now_us is not None]
    assert ticks
    assert ticks == sorted(set(ticks))


def test_an_unplugged_camera_ends_the_source_with_a_sentence():
    got = Collected(Step(events(20036)))
    assert got.ended.message == f"Prophesee EVK4 00051234: the camera stopped: {UNPLUGGED}"
    assert got.ended.exit_code == 1
    assert got.events.n == 100


def test_a_machine_that_is_too_slow_discards_what_waits_and_counts_it():
    got = Collected(
        Step(events(20037), behind_s=0.1, backlog=9),  # a short pause is no reason
        Step(events(20038, start_us=2000), behind_s=2.0, backlog=40),
        Step(events(20039, start_us=900_000)),
    )
    assert len(got.device.cleared) == 1
    assert got.counts == {Reason.LOST: 40}
    assert [one.lost for one in got.batches if one.events.n] == [False, False, True]


def test_samples_are_in_the_optical_frame_in_si_units():
    imu = [(1000 * i, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3) for i in range(4)]
    got = Collected(Step(None, imu=imu, now_us=4000), name=nd.Name.INIVATION_DAVIS346)
    (samples,) = [one.samples for one in got.batches if one.samples.n]
    assert got.source.streams == ("events", "imu")
    assert samples.t.tolist() == [0, 1000, 2000, 3000]
    np.testing.assert_allclose(samples.accel_m_s2[0], [-1.0, 2.0, -3.0])
    np.testing.assert_allclose(samples.gyro_rad_s[0], [-0.1, 0.2, -0.3], rtol=1e-6)


def test_the_camera_is_released():
    got = Collected(Step(events(20040)))
    got.source.close()
    assert got.device.closed
