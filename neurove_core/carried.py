"""What a stream carries from window to window, as bytes: another process goes on with it, bit for bit.

The bytes are msgpack and name the dtype and the shape of every array. They are read without unpickling: only the
classes of `_KINDS` are made, and the network state must have the shapes of the reader's own model.
"""

import sys
from typing import Any, Final, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from neurove_core.inertial.agreement import Agreement, Track
from neurove_core.inertial.bias import Bias
from neurove_core.inertial.moving import Tilt
from neurove_core.inertial.state import Learned
from neurove_core.networks.arrays import ArrayState
from neurove_core.refine.ground import GroundEvents, GroundState
from neurove_core.refine.ground_sway import Sway
from neurove_core.refine.rotation import Filter
from neurove_core.refine.scatter import Scatter
from neurove_core.refine.scene import Scene
from neurove_core.refine.stages import State as Stages
from neurove_core.refine.standing import Standing
from neurove_core.refine.trembling import Trembling
from neurove_core.stream_state import StreamState
from neurove_core.timescales import Longer
from neurove_protocol.errors import InvalidField, NeuroVEError

MAX_BYTES: Final = 32 << 20
"""Cap of the bytes of one stream's state."""

_KINDS: Final[dict[str, Any]] = {
    kind.__name__: kind
    for kind in (
        *(ArrayState, Filter, GroundEvents, GroundState, Longer, Scatter, Scene, Stages, Standing, Sway, Trembling),
        *(Agreement, Bias, Learned, Tilt, Track),
    )
}
_DTYPES: Final = ("|u1", "|i1", "|b1", "<u2", "<i2", "<u4", "<i4", "<i8", "<u8", "<f4", "<f8")
_PARTS: Final = ("network", "age", "end_us", "stages", "ground", "recent", "longer")
_WHAT: Final = "stream state"
_MAX_TEXT: Final = 256


class Carried(NamedTuple):
    """The parts of a `StreamState` that a stream carries over the end of a window."""

    network: Any
    age: int
    end_us: int
    stages: Stages
    ground: GroundState
    recent: tuple[NDArray[np.uint8], ...]
    longer: Longer
    inertial: Learned | None = None  # of the inertial unit; None without one

    def into(self, state: StreamState) -> StreamState:
        """A state with these parts; sensor, lens and the open window are its own."""
        return state._replace(**{name: getattr(self, name) for name in _PARTS})


def encode(state: StreamState, inertial: Learned | None = None) -> bytes:
    """The carried parts of a state that has processed a window, and of its inertial unit."""
    packed: bytes = msgpack.packb([_packed(one) for one in (*(getattr(state, name) for name in _PARTS), inertial)])
    return packed


def decode(data: bytes, own: StreamState) -> Carried:
    """Read the carried parts of another process.

    Args:
        data: from `encode`.
        own: a state of the reader with the same model; the network state must have its shapes.

    Raises:
        InvalidField: the bytes are no such state, or that of another model.
    """
    if len(data) > MAX_BYTES:
        raise InvalidField(_WHAT, "size", len(data), f"at most {MAX_BYTES} bytes")
    try:
        values = [_unpacked(one) for one in msgpack.unpackb(data, max_bin_len=MAX_BYTES, max_ext_len=0)]
        carried = Carried(*values)
    except NeuroVEError:
        raise
    except (ValueError, TypeError, LookupError, RecursionError, msgpack.UnpackException) as error:
        raise InvalidField(_WHAT, "data", type(error).__name__, "the state of a stream as msgpack") from None
    if _shape(carried.network) != _shape(own.network):
        raise InvalidField(_WHAT, "network", type(carried.network).__name__, "the shapes of this node's model")
    if not (_is_count(carried.age) and isinstance(carried.end_us, int) and carried.network.finite()):
        raise InvalidField(_WHAT, "network", carried.age, "finite numbers, an age and the end of a window")
    kinds = (Stages, GroundState, tuple, Longer, Learned | None)
    for name, value, kind in zip(Carried._fields[3:], carried[3:], kinds, strict=True):
        if not isinstance(value, kind):
            raise InvalidField(_WHAT, name, type(value).__name__, str(kind))
    if carried.inertial is not None and not _is_sound(carried.inertial):
        raise InvalidField(_WHAT, "inertial", type(carried.inertial).__name__, "arrays of its shapes, finite")
    return carried


def _is_sound(inertial: Learned) -> bool:
    kinds = (Bias, Tilt, Track, Agreement, int, bool)
    if not all(isinstance(value, kind) for value, kind in zip(inertial, kinds, strict=True)):
        return False
    try:
        return inertial.is_sound()
    except (AttributeError, TypeError):
        return False


def _is_count(value: object) -> bool:
    return type(value) is int and value >= 0


def _packed(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if _is_tensor(value):
        return ["tensor", *_bytes_of(value.detach().numpy())]
    if isinstance(value, np.ndarray):
        return ["array", *_bytes_of(value)]
    if isinstance(value, np.generic):
        return ["scalar", *_bytes_of(np.asarray(value))]
    if hasattr(value, "_fields"):
        return ["named", type(value).__name__, [_packed(one) for one in value]]
    assert isinstance(value, tuple), type(value)
    return ["tuple", [_packed(one) for one in value]]


def _bytes_of(array: NDArray[Any]) -> tuple[str, list[int], bytes]:
    return array.dtype.str, list(array.shape), array.tobytes()


def _unpacked(value: Any) -> Any:
    if not isinstance(value, list):
        if value is None or isinstance(value, bool | int | float):
            return value
        if isinstance(value, str) and len(value) <= _MAX_TEXT:
            return value
        raise ValueError("neither a number, a short text nor a list")
    kind, *rest = value
    if kind == "tuple":
        return tuple(_unpacked(one) for one in rest[0])
    if kind == "named":
        return (_KINDS | _kinds_of_torch())[rest[0]](*(_unpacked(one) for one in rest[1]))
    dtype, shape, data = rest
    if dtype not in _DTYPES:
        raise ValueError("another dtype")
    array = np.frombuffer(data, np.dtype(dtype)).reshape(shape).copy()
    if kind == "tensor":
        return sys.modules["torch"].from_numpy(array)
    return array[()] if kind == "scalar" else array


def _shape(value: Any) -> Any:
    """The structure of a network state: classes, whole numbers, and the dtype and shape of each array or tensor."""
    if isinstance(value, np.ndarray) or _is_tensor(value):
        return type(value).__name__, value.dtype, tuple(value.shape)
    if isinstance(value, int):
        return value
    if isinstance(value, tuple):
        return type(value).__name__, tuple(_shape(one) for one in value)
    return type(value).__name__


def _is_tensor(value: Any) -> bool:
    torch = sys.modules.get("torch")  # without it nothing is a tensor, and a service does not load it for this
    return torch is not None and isinstance(value, torch.Tensor)


def _kinds_of_torch() -> dict[str, Any]:
    """The classes of the networks that run in torch; none in a process that has not loaded it."""
    if "torch" not in sys.modules:
        return {}
    from neurove_core.networks.ann import AnnState
    from neurove_core.networks.neurove import NetworkState
    from neurove_core.networks.snn_ang import SnnAngState
    from neurove_core.spiking.aslstm import ASLSTMState
    from neurove_core.spiking.lif import LIFState

    return {kind.__name__: kind for kind in (AnnState, ASLSTMState, LIFState, NetworkState, SnnAngState)}
