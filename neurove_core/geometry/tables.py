"""Tables: the look-up tables in use, shared between the streams and models that need the same one, and bounded."""

import threading
import weakref
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from neurove_core.config import CanonicalConfig
from neurove_core.geometry.camera import lookup_table, ray_table
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.errors import NoTable

_Key = tuple[Any, ...]
_Table = NDArray[np.int32] | NDArray[np.float32]


def table_bytes(sensor: Sensor) -> int:
    """Memory of a look-up table [bytes].

    >>> table_bytes(Sensor(4096, 4096)) >> 20
    64
    """
    return sensor.width * sensor.height * np.dtype(np.int32).itemsize


class Tables:
    """Builds look-up tables. A table lives as long as somebody refers to it.

    Args:
        max_bytes: memory of all tables, those under way included; None: no bound.
    """

    def __init__(self, max_bytes: int | None = None) -> None:
        self.max_bytes = max_bytes
        self._tables: weakref.WeakValueDictionary[_Key, _Table] = weakref.WeakValueDictionary()
        self._building: dict[_Key, threading.Lock] = {}
        self._under_way = 0
        self._lock = threading.Lock()

    @property
    def in_use(self) -> int:
        """Memory of the tables, those under way included [bytes]."""
        return self._under_way + sum(table.nbytes for table in list(self._tables.values()))

    def ready(self, canonical: CanonicalConfig, sensor: Sensor, camera: CameraInfo | None) -> bool:
        """Whether a table is there."""
        return _key(canonical, sensor, camera) in self._tables

    def of(self, canonical: CanonicalConfig, sensor: Sensor, camera: CameraInfo | None) -> NDArray[np.int32]:
        """The table, see `lookup_table`; it is built once, whoever asks for it.

        Raises:
            NoTable: there is no memory for it. InvalidField: the camera info describes a sensor of another size.
        """
        key = _key(canonical, sensor, camera)
        made = self._shared(key, sensor, table_bytes(sensor), lambda: lookup_table(canonical, sensor, camera))
        return cast("NDArray[np.int32]", made)

    def rays(self, camera: CameraInfo) -> NDArray[np.float32]:
        """The ray of each pixel, see `ray_table`, 8 bytes a pixel; shared and bounded like the look-up tables.

        Raises:
            NoTable: there is no memory for it.
        """
        sensor = camera.sensor
        key = ("rays", sensor, *_lens(camera))
        made = self._shared(key, sensor, 2 * table_bytes(sensor), lambda: ray_table(camera))
        return cast("NDArray[np.float32]", made)

    def _shared(self, key: _Key, sensor: Sensor, needed: int, make: Callable[[], _Table]) -> _Table:
        with self._lock:
            found = self._tables.get(key)
            if found is not None:
                return found
            building = self._building.setdefault(key, threading.Lock())
        with building:
            found = self._tables.get(key)
            if found is None:
                found = self._built(key, sensor, needed, make)
            return found

    def _built(self, key: _Key, sensor: Sensor, needed: int, make: Callable[[], _Table]) -> _Table:
        with self._lock:
            used = self.in_use
            if self.max_bytes is not None and used + needed > self.max_bytes:
                self._building.pop(key, None)
                raise NoTable(str(sensor), needed, used, self.max_bytes)
            self._under_way += needed
        try:
            table = make()
            with self._lock:
                self._tables[key] = table
            return table
        finally:
            with self._lock:
                self._under_way -= needed
                self._building.pop(key, None)


TABLES = Tables()
"""The tables of this process. A service sets its bound."""


def _key(canonical: CanonicalConfig, sensor: Sensor, camera: CameraInfo | None) -> _Key:
    grid = (canonical.width, canonical.height, canonical.hfov_deg, canonical.subcells)
    if camera is None:
        return (*grid, sensor)
    return (*grid, sensor, camera.sensor, *_lens(camera))


def _lens(camera: CameraInfo) -> _Key:
    return camera.lens, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion
