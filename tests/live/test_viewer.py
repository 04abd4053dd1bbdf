"""neurove watch --foxglove: a websocket client receives what the service estimates."""

import math

import numpy as np
import pytest

from neurove_protocol import CameraInfo, Events, Sensor, TwistEstimate
from neurove_service.clients import viewer
from neurove_service.clients.ask import health
from tests.live.conftest import free_endpoint, neurove, running, service, wait_until
from tests.protocol.messages import EXAMPLES
from tests.websocket import SUBPROTOCOL, FoxgloveClient, decoded

ESTIMATE = TwistEstimate.model_validate(EXAMPLES["TwistEstimate"])


def shown(message):
    schema = type(message).get_schema()
    return decoded(schema.name, schema.data, message.encode())


def test_an_odometry_has_the_newest_twist_and_its_covariance_and_no_pose():
    covariance = tuple(float(i * j % 7) for i in range(1, 7) for j in range(1, 7))
    odometry = shown(viewer.odometry(ESTIMATE.model_copy(update={"covariance": covariance})))
    twist = ESTIMATE.twist
    linear, angular = odometry.linear_velocity, odometry.angular_velocity
    assert (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z) == tuple(twist)
    assert tuple(odometry.velocity_covariance) == covariance
    assert odometry.body_frame_id == f"{ESTIMATE.stream}/{ESTIMATE.frame_id}"
    assert not odometry.HasField("pose")
    assert {one.key: one.value for one in odometry.metadata}["flags"] == " ".join(ESTIMATE.flags)


def test_an_unknown_covariance_is_zero_and_says_so():
    odometry = shown(viewer.odometry(ESTIMATE.model_copy(update={"covariance": None})))
    assert set(odometry.velocity_covariance) == {0.0}
    assert {one.key: one.value for one in odometry.metadata}["covariance"] == "unknown"


@pytest.mark.parametrize(
    ("lens", "distortion", "model", "coefficients"),
    [
        ("pinhole", (), "plumb_bob", [0.0] * 5),
        ("pinhole", (0.1, 0.2, 0.3, 0.4), "plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.0]),
        ("equidistant", (0.1, 0.2, 0.3, 0.4), "kannala_brandt", [0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_a_calibration_has_the_lens_of_the_camera(lens, distortion, model, coefficients):
    camera = CameraInfo(
        stream="a", width=346, height=260, lens=lens, fx=226.5, fy=226.25, cx=173.5, cy=133.75, distortion=distortion
    )
    said = shown(viewer.camera_calibration(camera, "a/camera_optical", 1_500_000_000))
    assert (said.width, said.height, said.distortion_model, list(said.D)) == (346, 260, model, coefficients)
    assert list(said.K) == [226.5, 0, 173.5, 0, 226.25, 133.75, 0, 0, 1]
    assert (said.timestamp.seconds, said.timestamp.nanos) == (1, 500_000_000)


def test_the_newest_event_of_a_pixel_gives_its_colour():
    events = Events.from_columns([0, 1, 2], [3, 3, 0], [1, 1, 0], [1, 0, 1])
    image = viewer.picture([events], Sensor(4, 2))
    assert image.shape == (2, 4, 3)
    off, on, none = image[1, 3], image[0, 0], image[0, 3]
    assert len({tuple(off), tuple(on), tuple(none)}) == 3
    np.testing.assert_array_equal(image[1, :3], np.full((3, 3), none[0]))
    message = shown(viewer.raw_image(image, "a/camera_optical", 0))
    assert (message.width, message.height, message.step, message.encoding) == (4, 2, 12, "rgb8")
    assert message.data == image.tobytes()


@pytest.mark.live
def test_a_client_receives_velocity_image_calibration_and_log_of_a_live_service():
    endpoint = free_endpoint()
    with (
        service(endpoint) as (_, transport, config),
        running("drive", "pattern://", "--connect", endpoint, "--wait", "90"),
        running("watch", "--foxglove", "127.0.0.1:0", "--connect", endpoint) as watch,
    ):
        url = watch.child.stdout.readline().strip()
        assert url.startswith("ws://127.0.0.1:")
        client = FoxgloveClient("127.0.0.1", int(url.rpartition(":")[2]))
        try:
            assert client.subprotocol == SUBPROTOCOL
            for topic in ("/cam0/odometry", "/cam0/events", "/cam0/calibration", "/log"):
                client.subscribe(topic)
            odometry = client.message("/cam0/odometry")
            assert math.isfinite(odometry.linear_velocity.x)
            assert any(odometry.velocity_covariance)
            image = client.message("/cam0/events")
            while len(set(image.data)) == 1:  # no event yet
                image = client.message("/cam0/events")
            calibration = client.message("/cam0/calibration")
            (status,) = health(transport, config)[0].streams
            sensor = (status.width, status.height)
            assert (image.width, image.height) == (calibration.width, calibration.height) == sensor
            address = url.removeprefix("ws://")
            refused = neurove("watch", "--foxglove", address, "--connect", endpoint)
            assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
            assert f"--foxglove='{address}'" in refused.stderr
            wait_until(
                lambda: neurove("activate", "untrained", "--connect", endpoint, "--force", "test").returncode == 0
            )
            while "model untrained answers now" not in client.message("/log").message:
                pass
        finally:
            client.close()
        wait_until(lambda: health(transport, config)[0].streams[0].estimates > status.estimates)
