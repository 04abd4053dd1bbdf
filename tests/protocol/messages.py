"""One valid example and one strategy of every message on the wire, as plain values: what the generic laws run over."""

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from neurove_protocol import CameraInfo, EventPacket, Events, Sensor, TwistEstimate
from neurove_protocol.codec import Message
from neurove_protocol.control import (
    ActivateReply,
    ActivateRequest,
    ChunkRequest,
    ErrorReply,
    HealthReply,
    HealthRequest,
    ModelsReply,
    ModelsRequest,
    ProgressReply,
    PushReply,
    PushRequest,
    Request,
    RollbackRequest,
    StreamStatus,
)
from neurove_protocol.duty import (
    DrainReply,
    DrainRequest,
    DutyReply,
    DutyRequest,
    StateReply,
    StateRequest,
    TakeRequest,
)
from neurove_protocol.events import decode_packet, encode_packet
from neurove_protocol.imu import MAX_ACCEL_M_S2, MAX_GYRO_RAD_S, Imu, ImuPacket, decode_imu, encode_imu

Fields = dict[str, Any]
Path = tuple[str | int, ...]

bounded = settings(max_examples=60, deadline=None, derandomize=True, database=None)
"""Every run draws the same examples, and not more of them than a gate can wait for."""


def soa(events: list[tuple[int, int, int, int]], *, wide: bool = False) -> bytes:
    """The blob soa6 (or `wide`, soa8) of (offset, x, y, p), written from the contract and not with our encoder."""
    n = len(events)
    offsets = struct.pack(f"<{n}{'I' if wide else 'H'}", *(event[0] for event in events))
    x = struct.pack(f"<{n}H", *(event[1] for event in events))
    return offsets + x + struct.pack(f"<{n}H", *(y | p << 15 for _, _, y, p in events))


EVENTS = [(0, 0, 0, 1), (3, 345, 0, 0), (3, 17, 259, 1), (65535, 345, 259, 0)]
MODEL: Fields = {
    "name": "spire-7",
    "digest": "5e" * 32,
    "trained": True,
    "provenance": "simulated corridors, seed 7",
    "parameters": 381_446,
    "release": 7,
    "figures": {"rmse_linear_m_s": 0.125, "re": 0.25},
    "signature": "trusted",
}
STATUS: Fields = {
    "v": 1,
    "node": "rover-1",
    "stream": "cam0",
    "verdict": "lossy",
    "why": "3 of 1000 packets were lost on the way",
    "width": 346,
    "height": 260,
    "calibrated": True,
    "packets_received": 997,
    "events_received": 199_400,
    "windows": 79,
    "estimates": 79,
    "resets": 1,
    "outside_events": 12,
    "lost": {
        "gap_packets": 3,
        "overload_packets": 0,
        "duplicate_packets": 0,
        "out_of_order_packets": 0,
        "foreign_packets": 0,
        "stale_packets": 0,
        "malformed_packets": 0,
        "failed_packets": 0,
        "late_events": 41,
        "skipped_windows": 0,
        "shed_windows": 0,
        "restart_windows": 0,
    },
    "latency_ms": {"p50": 3.25, "p95": 5.5, "p99": 9.75},
    "last_packet_age_s": 0.004,
    "recovered_packets": 0,
    "uncounted_packets": 0,
    "refused_cameras": 1,
    "refusal": "t0_us=-1: must be 0 or more",
    "unrefined_windows": 2,
    "imu": {
        "rate_hz": 1000.5,
        "samples": 4_000,
        "lost_packets": 1,
        "refused_packets": 2,
        "dropped_packets": 3,
        "late_samples": 5,
        "used": False,
        "resting": False,
        "bias_rad_s": [0.0625, 0.0, -0.125],
        "bias_sigma_rad_s": 0.0005,
        "offset_ms": 3.5,
        "disagrees": True,
        "problem": "the gyroscope turns the other way about y",
    },
    "latency_histogram": {"counts": [0, 1, 70, 7, 1, 0, 0, 0, 0, 0, 0], "sum_ms": 280.5},
    "flag_counts": {"gap": 2, "settling": 20},
    "sigma": [0.25, 0.25, 0.5, 0.125, 0.0625, 0.125],
    "standby": {
        "role": "follows",
        "leader": "rover-2",
        "term": 7,
        "equal": True,
        "other_model": "",
        "draining": False,
        "followers": 0,
    },
}
EXAMPLES: dict[str, Fields] = {
    "EventPacket": {
        "v": 1,
        "stream": "cam0",
        "seq": 7,
        "width": 346,
        "height": 260,
        "t0_us": -1_000,
        "n": len(EVENTS),
        "format": "soa6",
        "data": soa(EVENTS),
    },
    "CameraInfo": {
        "v": 1,
        "stream": "cam0",
        "width": 346,
        "height": 260,
        "lens": "pinhole",
        "fx": 226.4,
        "fy": 226.1,
        "cx": 173.6,
        "cy": 133.7,
        "distortion": [-0.048, 0.011, -0.0005, 0.0002],
        "height_m": 0.31,
    },
    "ImuPacket": {
        "v": 1,
        "stream": "cam0",
        "seq": 7,
        "n": 2,
        "t": struct.pack("<2q", -1_000, 0),
        "accel_m_s2": struct.pack("<6d", 0.0, -9.75, 0.5, 0.0, -10.0, 0.0),
        "gyro_rad_s": struct.pack("<6d", 0.0, -0.125, 0.0, 0.0625, 0.0, 0.0),
    },
    "TwistEstimate": {
        "v": 1,
        "stream": "cam0",
        "seq": 41,
        "start_us": -50_000,
        "end_us": 0,
        "bin_end_us": [-25_000, 0],
        "twists": [[0.25, 0.0, 1.5, 0.0, -0.125, 0.0], [0.5, 0.0, 1.5, 0.0, -0.25, 0.0]],
        "frame_id": "camera_optical",
        "model": "spire-7",
        "digest": "5e" * 32,
        "epoch": 2,
        "events": 9_214,
        "flags": ["settling", "uncalibrated"],
        "covariance": [0.25 if i == j else 0.125 if i + j == 2 else 0.0 for i in range(6) for j in range(6)],
        "trace": {"received_ns": 1_000, "queued_ns": 2_000, "computed_ns": 3_000, "published_ns": 4_000},
        "node": "rover-1",
        "host": {"end_ns": 1_700_000_000_000_000_000, "uncertainty_ns": 200_000, "age_ns": 4_000_000},
        "source": "refined",
        "term": 7,
    },
    "StreamStatus": STATUS,
    "HealthRequest": {"v": 1},
    "HealthReply": {
        "v": 1,
        "node": "rover-1",
        "ok": False,
        "why": "stream cam0 is lossy",
        "uptime_s": 3_600.5,
        "version": "0.1.0",
        "model": MODEL,
        "epoch": 2,
        "refused_streams": 0,
        "streams": [STATUS],
        "ready": True,
        "change": "spire-7 is active",
        "rollbacks": 1,
        "internal_errors": {"packet": 2},
        "dropped_log_lines": 3,
        "missing_streams": ["cam1"],
        "namesakes": 1,
        "labels": {"site": "hall-2"},
        "form": "sparse (fastest)",
    },
    "ModelsRequest": {"v": 1},
    "ModelsReply": {
        "v": 1,
        "node": "rover-1",
        "active": MODEL,
        "previous": MODEL,
        "epoch": 2,
        "available": [MODEL],
        "unreadable": {"old.safetensors": "the header names no model"},
        "staged": [MODEL],
        "partial": {"6e" * 32: 1_048_576},
    },
    "PushRequest": {"v": 1, "digest": "5e" * 32, "size": 1_526_784, "name": "spire-7.safetensors", "signature": b"{}"},
    "ChunkRequest": {"v": 1, "offset": 1_048_576, "length": 478_208},
    "ProgressReply": {"v": 1, "node": "rover-1", "step": "fetching", "text": "1.0 of 1.5 MiB"},
    "PushReply": {"v": 1, "node": "rover-1", "model": MODEL, "fetched": 1_526_784},
    "ActivateRequest": {
        "v": 1,
        "model": "spire-7",
        "expect": "6e0a5e5e",
        "shadow_s": 30.0,
        "canary": ["cam0"],
        "force": "new lens",
    },
    "RollbackRequest": {"v": 1, "expect": "5e5e5e5e"},
    "ActivateReply": {"v": 1, "node": "rover-1", "active": MODEL, "previous": MODEL, "epoch": 3, "changed": True},
    "DutyRequest": {"v": 1, "stream": "cam0"},
    "DutyReply": {
        "v": 1,
        "node": "rover-2",
        "stream": "cam0",
        "role": "follows",
        "term": 7,
        "leader": "rover-1",
        "equal": True,
        "missed_us": 60_000,
        "draining": False,
        "digest": "5e" * 32,
    },
    "StateRequest": {"v": 1, "stream": "cam0", "digest": "5e" * 32, "after_us": 60_000},
    "StateReply": {
        "v": 1,
        "node": "rover-1",
        "stream": "cam0",
        "digest": "5e" * 32,
        "end_us": 50_000,
        "data": b"\x97\xc0",
    },
    "TakeRequest": {"v": 1, "stream": "cam0", "node": "rover-1", "term": 7, "start_us": -50_000},
    "DrainRequest": {"v": 1, "resume": True},
    "DrainReply": {"v": 1, "node": "rover-1", "handed": {"cam0": "rover-2"}, "kept": {"cam1": "no other node"}},
    "ErrorReply": {
        "v": 1,
        "code": "unknown_model",
        "message": "model='spire-9': not on this node; available: spire-7",
        "details": {"value": "spire-9", "tried": 3, "seconds": 0.5, "remote": True, "hint": None},
    },
}


@dataclass(frozen=True)
class Kind:
    """One message of the contract: how its bytes are read and written, and a valid example of its fields."""

    name: str
    decode: Callable[[bytes], Any]
    encode: Callable[[Any], bytes]
    strict: bool  # a request: refuses fields that it does not know
    optional: frozenset[str]  # fields that may be left out

    def fields(self) -> Fields:
        """A fresh copy of the example, to be spoilt."""
        return unshared(EXAMPLES[self.name])

    def bytes(self) -> bytes:
        """The example on the wire."""
        return pack(EXAMPLES[self.name])

    def __str__(self) -> str:
        return self.name


def _kind(model: type[Message]) -> Kind:
    optional = frozenset(name for name, field in model.model_fields.items() if not field.is_required()) - {"v"}
    return Kind(model.__name__, model.decode, model.encode, issubclass(model, Request), optional)


MODELS: tuple[type[Message], ...] = (
    CameraInfo,
    TwistEstimate,
    StreamStatus,
    HealthRequest,
    HealthReply,
    ModelsRequest,
    ModelsReply,
    PushRequest,
    ChunkRequest,
    ProgressReply,
    PushReply,
    ActivateRequest,
    ActivateReply,
    RollbackRequest,
    DutyRequest,
    DutyReply,
    StateRequest,
    StateReply,
    TakeRequest,
    DrainRequest,
    DrainReply,
    ErrorReply,
)
EVENT_PACKET = Kind("EventPacket", decode_packet, encode_packet, strict=False, optional=frozenset())
IMU_PACKET = Kind("ImuPacket", decode_imu, encode_imu, strict=False, optional=frozenset())
KINDS = (EVENT_PACKET, IMU_PACKET, *map(_kind, MODELS))
BY_NAME = {kind.name: kind for kind in KINDS}


def pack(fields: object) -> bytes:
    """The fields on the wire, by a packer that is not ours."""
    data = msgpack.packb(fields)
    assert isinstance(data, bytes)
    return data


def paths(value: object, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Every value inside a message with the way to it, parents before children; without the version."""
    if path and path[-1] != "v":
        yield path, value
    for key, child in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from paths(child, (*path, key))


def unshared(fields: Fields) -> Fields:
    """A copy in which no part stands twice, unlike what copy.deepcopy makes of an example."""
    copy = msgpack.unpackb(pack(fields))
    assert isinstance(copy, dict)
    return copy


def replaced(fields: Fields, path: Path, value: object) -> Fields:
    """A copy of the fields with another value at the end of the path."""
    fields = unshared(fields)
    *way, last = path
    place: Any = fields
    for key in way:
        place = place[key]
    place[last] = value
    return fields


def dotted(path: Path) -> str:
    """The path as an error names it."""
    return ".".join(map(str, path))


# --- strategies: any valid message

counts = st.integers(0, 2**63 - 1)
int64s = st.integers(-(2**63), 2**63 - 1)
floats = st.floats(allow_nan=False, allow_infinity=False)
focals, heights = st.floats(1, 1e6), st.floats(1e-3, 1e4)
centres = st.floats(-1e6, 1e6)
sentences = st.text(st.characters(exclude_categories=["Cs"]), max_size=40)
names = st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", fullmatch=True)
digests = st.from_regex(r"[0-9a-f]{64}", fullmatch=True)
prefixes = st.from_regex(r"[0-9a-f]{8,64}", fullmatch=True)
models = st.fixed_dictionaries(
    {
        "name": sentences,
        "digest": sentences,
        "trained": st.booleans(),
        "provenance": sentences,
        "parameters": counts,
        "release": counts,
        "figures": st.dictionaries(sentences, floats, max_size=3),
        "signature": st.sampled_from(["unsigned", "unchecked", "trusted", "untrusted"]),
    }
)
inertial_units = st.fixed_dictionaries(
    {
        **dict.fromkeys(("rate_hz", "bias_sigma_rad_s"), floats),
        **{name: counts for name, value in STATUS["imu"].items() if type(value) is int},
        **dict.fromkeys(("used", "resting", "disagrees"), st.booleans()),
        "bias_rad_s": st.none() | st.lists(floats, min_size=3, max_size=3),
        "offset_ms": st.none() | floats,
        "problem": sentences,
    }
)
roles = st.sampled_from(["answers", "follows", "listens", "absent"])
standbys = st.fixed_dictionaries(
    {
        "role": roles,
        "leader": st.none() | names,
        "term": counts,
        "equal": st.booleans(),
        "other_model": sentences,
        "draining": st.booleans(),
        "followers": counts,
    }
)
statuses = st.fixed_dictionaries(
    {
        "node": names,
        "stream": names,
        "verdict": st.sampled_from(["ok", "lossy", "stalled", "idle", "unstable", "uncertain"]),
        "why": sentences,
        "refusal": sentences,
        "calibrated": st.booleans(),
        "lost": st.fixed_dictionaries(dict.fromkeys(STATUS["lost"], counts)),
        "latency_ms": st.none() | st.fixed_dictionaries(dict.fromkeys(("p50", "p95", "p99"), floats)),
        "last_packet_age_s": floats,
        "imu": st.none() | inertial_units,
        "latency_histogram": st.none()
        | st.fixed_dictionaries(
            {"counts": st.lists(counts, min_size=11, max_size=11), "sum_ms": st.floats(0, 1e12, allow_nan=False)}
        ),
        "flag_counts": st.dictionaries(sentences, counts, max_size=3),
        "sigma": st.none() | st.lists(floats, min_size=6, max_size=6),
        "standby": st.none() | standbys,
        **{name: counts for name, value in STATUS.items() if type(value) is int and name != "v"},
    }
)


@st.composite
def cameras(draw: st.DrawFn) -> Fields:
    lens = draw(st.sampled_from(["pinhole", "equidistant"]))
    terms = draw(st.sampled_from([0, 4, 5] if lens == "pinhole" else [0, 4]))
    return {
        "stream": draw(names),
        "width": draw(st.integers(1, 1 << 15)),
        "height": draw(st.integers(1, 1 << 15)),
        "lens": lens,
        "fx": draw(focals),
        "fy": draw(focals),
        "cx": draw(centres),
        "cy": draw(centres),
        "distortion": draw(st.lists(centres, min_size=terms, max_size=terms)),
        "height_m": draw(st.none() | heights),
    }


@st.composite
def covariances(draw: st.DrawFn) -> list[float]:
    rows = draw(st.lists(floats.map(abs), min_size=6, max_size=6))
    upper = draw(st.lists(floats, min_size=15, max_size=15))
    found = {(i, i): variance for i, variance in enumerate(rows)}
    found |= dict(zip(((i, j) for i in range(6) for j in range(i + 1, 6)), upper, strict=True))
    return [found[min(i, j), max(i, j)] for i in range(6) for j in range(6)]


@st.composite
def estimates(draw: st.DrawFn) -> Fields:
    bins = draw(st.integers(1, 6))
    start_us = draw(st.integers(-(2**63), 2**63 - 2))
    return {
        "stream": draw(names),
        "seq": draw(counts),
        "start_us": start_us,
        "end_us": draw(st.integers(start_us + 1, 2**63 - 1)),
        "bin_end_us": draw(st.lists(int64s, min_size=bins, max_size=bins)),
        "twists": draw(st.lists(st.lists(floats, min_size=6, max_size=6), min_size=bins, max_size=bins)),
        "frame_id": draw(sentences),
        "model": draw(sentences),
        "digest": draw(digests),
        "epoch": draw(counts),
        "events": draw(counts),
        "flags": draw(st.lists(sentences, max_size=4)),
        "covariance": draw(st.none() | covariances()),
        "trace": draw(st.fixed_dictionaries(dict.fromkeys(EXAMPLES["TwistEstimate"]["trace"], int64s))),
        "node": draw(st.none() | names),
        "host": draw(st.none() | st.fixed_dictionaries({"end_ns": int64s, "uncertainty_ns": counts, "age_ns": counts})),
        "source": draw(st.sampled_from(["network", "refined", "gyro"])),
        "term": draw(st.none() | counts),
    }


ANY: dict[str, st.SearchStrategy[Fields]] = {
    "CameraInfo": cameras(),
    "TwistEstimate": estimates(),
    "StreamStatus": statuses,
    "HealthRequest": st.just({}),
    "HealthReply": st.fixed_dictionaries(
        {
            "node": names,
            "ok": st.booleans(),
            "why": sentences,
            "uptime_s": floats,
            "version": sentences,
            "model": models,
            "epoch": counts,
            "refused_streams": counts,
            "streams": st.lists(statuses.map(lambda status: {"v": 1, **status}), max_size=2),
            "ready": st.booleans(),
            "change": sentences,
            "rollbacks": counts,
            "internal_errors": st.dictionaries(sentences, counts, max_size=3),
            "dropped_log_lines": counts,
            "missing_streams": st.lists(names, max_size=2),
            "namesakes": counts,
            "labels": st.dictionaries(names, names, max_size=3),
            "form": sentences,
        }
    ),
    "ModelsRequest": st.just({}),
    "ModelsReply": st.fixed_dictionaries(
        {
            "node": names,
            "active": models,
            "previous": st.none() | models,
            "epoch": counts,
            "available": st.lists(models, max_size=3),
            "unreadable": st.dictionaries(sentences, sentences, max_size=3),
            "staged": st.lists(models, max_size=2),
            "partial": st.dictionaries(digests, counts, max_size=2),
        }
    ),
    "PushRequest": st.fixed_dictionaries(
        {
            "digest": digests,
            "size": st.integers(1, 2**63 - 1),
            "name": sentences.filter(bool),
            "signature": st.none() | st.binary(max_size=40),
        }
    ),
    "ChunkRequest": st.fixed_dictionaries({"offset": counts, "length": st.integers(1, 1 << 20)}),
    "ProgressReply": st.fixed_dictionaries({"node": names, "step": sentences, "text": sentences}),
    "PushReply": st.fixed_dictionaries({"node": names, "model": models, "fetched": counts}),
    "ActivateRequest": st.fixed_dictionaries(
        {
            "model": sentences.filter(bool),
            "expect": st.none() | prefixes,
            "shadow_s": st.floats(0, 3600),
            "canary": st.lists(names, max_size=3),
            "force": st.none() | sentences.filter(bool).map(lambda text: text[:200]),
        }
    ),
    "RollbackRequest": st.fixed_dictionaries({"expect": st.none() | prefixes}),
    "ActivateReply": st.fixed_dictionaries(
        {"node": names, "active": models, "previous": models, "epoch": counts, "changed": st.booleans()}
    ),
    "DutyRequest": st.fixed_dictionaries({"stream": names}),
    "DutyReply": st.fixed_dictionaries(
        {
            "node": names,
            "stream": names,
            "role": roles,
            "term": counts,
            "leader": st.none() | names,
            "equal": st.booleans(),
            "missed_us": st.none() | int64s,
            "draining": st.booleans(),
            "digest": sentences,
        }
    ),
    "StateRequest": st.fixed_dictionaries({"stream": names, "digest": digests, "after_us": st.none() | int64s}),
    "StateReply": st.fixed_dictionaries(
        {"node": names, "stream": names, "digest": digests, "end_us": int64s, "data": st.binary(max_size=40)}
    ),
    "TakeRequest": st.fixed_dictionaries(
        {"stream": names, "node": names, "term": counts, "start_us": st.none() | int64s}
    ),
    "DrainRequest": st.fixed_dictionaries({"resume": st.booleans()}),
    "DrainReply": st.fixed_dictionaries(
        {
            "node": names,
            "handed": st.dictionaries(sentences, sentences, max_size=2),
            "kept": st.dictionaries(sentences, sentences, max_size=2),
        }
    ),
    "ErrorReply": st.fixed_dictionaries(
        {
            "code": sentences,
            "message": sentences,
            "details": st.dictionaries(sentences, sentences | int64s | floats | st.booleans() | st.none(), max_size=4),
        }
    ),
}


@st.composite
def packets(draw: st.DrawFn, max_events: int = 40, max_span_us: int = 2**32 - 1) -> EventPacket:
    """Any valid packet, its events in the corners of the sensor too."""
    sensor = Sensor(draw(st.integers(1, 4096)), draw(st.integers(1, 4096)))
    t0_us = draw(st.integers(-(2**62), 2**62 - 1))
    rows = draw(
        st.lists(
            st.tuples(
                st.integers(0, min(max_span_us, 2**63 - 1 - t0_us)),
                st.integers(0, sensor.width - 1),
                st.integers(0, sensor.height - 1),
                st.integers(0, 1),
            ),
            max_size=max_events,
        )
    )
    t, x, y, p = zip(*sorted(rows), strict=True) if rows else ((), (), (), ())
    events = Events.from_columns([t0_us + offset for offset in t], x, y, p)
    return EventPacket(draw(names), draw(counts), sensor, t0_us, events)


@st.composite
def imu_packets(draw: st.DrawFn, max_samples: int = 20) -> ImuPacket:
    """Any valid packet, its numbers at their bounds too."""
    t = sorted(draw(st.lists(st.integers(-(2**62), 2**62 - 1), min_size=1, max_size=max_samples)))
    accel, gyro = (
        draw(st.lists(st.lists(st.floats(-most, most), min_size=3, max_size=3), min_size=len(t), max_size=len(t)))
        for most in (MAX_ACCEL_M_S2, MAX_GYRO_RAD_S)
    )
    return ImuPacket(draw(names), draw(counts), Imu(np.array(t), np.array(accel), np.array(gyro)))


def assert_same_imu(left: ImuPacket, right: ImuPacket) -> None:
    """Bit for bit."""
    assert (left.stream, left.seq) == (right.stream, right.seq)
    for name in Imu._fields:
        a, b = getattr(left.samples, name), getattr(right.samples, name)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), name


def same(left: object, right: object) -> bool:
    """Equal in type and value all the way down, -0.0 apart from 0.0: nothing was rounded or turned on the way."""
    if type(left) is not type(right):
        return False
    if isinstance(left, dict) and isinstance(right, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list) and isinstance(right, list):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, float) and isinstance(right, float):
        return left == right and math.copysign(1, left) == math.copysign(1, right)
    return left == right


def assert_same_packet(left: EventPacket, right: EventPacket) -> None:
    """Bit for bit: all columns, their types, and everything in the header."""
    assert (left.stream, left.seq, left.sensor, left.t0_us) == (right.stream, right.seq, right.sensor, right.t0_us)
    assert_same_events(left.events, right.events)


def assert_same_events(left: Events, right: Events) -> None:
    """Bit for bit: the columns and their types."""
    for name in Events._fields:
        a, b = getattr(left, name), getattr(right, name)
        assert a.dtype == b.dtype, name
        assert a.tobytes() == b.tobytes(), name
