"""Cameras of dv-processing, on the same interface that it has for files: a recording that it wrote itself."""

import dv_processing as dv
import numpy as np
import pytest

from neurove_core.live.dv_camera import MODELS, DvCamera
from neurove_core.live.source import LiveEnded
from neurove_protocol import Events
from tests.live.dv_writer import DV_SENSOR, dv_events, sample, store_of


@pytest.fixture
def recording(tmp_path):
    """An .aedat4 file with events and samples, opened by dv-processing."""
    size = (DV_SENSOR.width, DV_SENSOR.height)
    config = dv.io.MonoCameraWriter.Config("DVXplorer_ABC")
    config.addEventStream(size)
    config.addImuStream()
    path = tmp_path / "camera.aedat4"
    writer = dv.io.MonoCameraWriter(str(path), config)
    for part in range(3):
        writer.writeEvents(store_of(dv_events(20050 + part, 2000, 1_000_000 + 20_000 * part)))
    for i in range(20):
        writer.writeImu(sample(i, 1_000_000 + 1000 * i))
    del writer
    return dv.io.MonoCameraRecording(str(path))


def test_every_event_and_sample_arrives(recording):
    source = DvCamera(recording, delay_s=3600)
    assert (source.name, source.sensor, source.streams) == ("DVXplorer_ABC", DV_SENSOR, ("events", "imu"))
    batches = []
    with pytest.raises(LiveEnded, match="DVXplorer_ABC: the camera stopped"):
        batches.extend(source.batches())
    events = Events.join([one.events for one in batches])
    want = Events.join([dv_events(20050 + part, 2000, 1_000_000 + 20_000 * part) for part in range(3)])
    assert all(np.array_equal(x, y) for x, y in zip(events, want, strict=True))
    gyro = np.concatenate([one.samples.gyro_rad_s for one in batches])
    np.testing.assert_allclose(gyro[:, 2], -np.radians(np.arange(20)), rtol=1e-5)


def test_every_model_is_one_of_the_library():
    for names in MODELS.values():
        for name in names:
            assert getattr(dv.io.camera.CameraModel, name)
