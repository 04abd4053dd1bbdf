import gc
import threading

import numpy as np
import pytest

from neurove_core.config import CanonicalConfig
from neurove_core.geometry.camera import PIECE_PX, lookup_table, undistort
from neurove_core.geometry.tables import Tables, table_bytes
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.errors import NoTable

CANONICAL = CanonicalConfig()
SENSOR = Sensor(640, 480)
LENS = CameraInfo(
    stream="cam0", width=640, height=480, lens="pinhole", fx=500, fy=501, cx=320, cy=240, distortion=(-0.3, 0.1, 0, 0)
)
FISHEYE = LENS.model_copy(
    update={"lens": "equidistant", "fx": 200.0, "fy": 200.0, "distortion": (0.01, 0.01, 0.0, 0.0)}
)


@pytest.mark.parametrize("camera", [LENS, FISHEYE], ids=["pinhole", "equidistant"])
def test_the_pieces_of_a_table_leave_no_trace(camera):
    assert camera.width * camera.height > 2 * PIECE_PX
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    x, y = undistort((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, camera)
    focal = CANONICAL.width / 2 / np.tan(np.radians(CANONICAL.hfov_deg) / 2)
    column, row = np.floor(x * focal + CANONICAL.width / 2), np.floor(y * focal + CANONICAL.height / 2)
    inside = (column >= 0) & (column < CANONICAL.width) & (row >= 0) & (row < CANONICAL.height)
    expected = np.where(inside, row * CANONICAL.width + column, -1)
    np.testing.assert_array_equal(lookup_table(CANONICAL, SENSOR, camera), expected)


def test_streams_with_one_lens_share_a_table_and_another_lens_has_its_own():
    tables = Tables()
    first = tables.of(CANONICAL, SENSOR, LENS)
    assert tables.of(CANONICAL, SENSOR, LENS.model_copy(update={"stream": "cam1", "height_m": 2.0})) is first
    assert tables.of(CANONICAL, SENSOR, FISHEYE) is not first
    assert tables.of(CANONICAL, SENSOR, None) is not first


def test_a_table_beyond_the_bound_is_refused_by_name_until_another_one_is_let_go():
    tables = Tables(max_bytes=3 * table_bytes(SENSOR) // 2)
    first = tables.of(CANONICAL, SENSOR, None)
    with pytest.raises(NoTable, match="sensor=640x480: its look-up table takes 1.2 MiB"):
        tables.of(CANONICAL, SENSOR, LENS)
    del first
    gc.collect()
    assert tables.in_use == 0
    assert tables.of(CANONICAL, SENSOR, LENS).size == 640 * 480


def test_threads_that_need_one_table_get_the_same_one():
    tables, found = Tables(), []
    threads = [threading.Thread(target=lambda: found.append(tables.of(CANONICAL, SENSOR, LENS))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({id(table) for table in found}) == 1
    assert tables.in_use == table_bytes(SENSOR)
