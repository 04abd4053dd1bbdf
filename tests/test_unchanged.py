"""Answers of the default model, wire bytes and bundle bytes stay those of tests/unchanged.json.

The wire bytes are those of commit 1994648. After a change of the default model, renew the rest with
`python -m tests.test_unchanged`.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from neurove_core import models
from neurove_core.estimator import Estimator
from neurove_core.io.packets import slices
from neurove_core.sources import open_source
from neurove_core.stream_state import WindowEstimate
from neurove_protocol import EventPacket, Events, Sensor
from neurove_protocol.events import encode_packet

FILE = Path(__file__).parent / "unchanged.json"
BEFORE = json.loads(FILE.read_text())
SOURCES = [name for name in BEFORE if name.startswith("sim://")]


def estimates(source: str) -> list[WindowEstimate]:
    estimator, recording = Estimator(models.find("default")), open_source(source)
    state = estimator.initial_state(recording.sensor, recording.camera("cam0"))
    found = []
    for piece in slices(recording.chunks()):
        pushed = estimator.push(piece.events, state, piece.t0_us)
        state = pushed.state
        found += pushed.estimates
    return found


def flags(found: list[WindowEstimate]) -> list[list[bool]]:
    return [[one.first, one.settled, one.low_activity, one.saturated] for one in found]


def sigmas(found: list[WindowEstimate]) -> NDArray[np.float64]:
    return np.stack([np.sqrt(np.diagonal(one.covariance)) for one in found if one.covariance is not None])


@pytest.mark.parametrize("source", SOURCES)
def test_the_default_model_estimates_what_it_did(source: str) -> None:
    found, before = estimates(source), BEFORE[source]
    assert [one.start_us for one in found] == before["start_us"]
    assert [one.events for one in found] == before["events"]
    assert flags(found) == [row[:4] for row in before["flags"]]
    scale = models.find("default").scale.double().numpy()
    # a spike that depends on the last bit of a sum may differ on another CPU: the tolerance of a golden test
    off = np.abs(np.stack([one.twists for one in found]) - np.array(before["twists"])) / scale
    assert off.max() < 0.02
    np.testing.assert_allclose(sigmas(found), before["sigma"], rtol=0.05)


def test_a_packet_has_the_bytes_that_it_had() -> None:
    rng, n = np.random.default_rng(0), 500
    t = np.sort(rng.integers(0, 4000, n))
    events = Events.from_columns(t, *(rng.integers(0, high, n) for high in (346, 260, 2)))
    data = encode_packet(EventPacket("cam0", 7, Sensor(346, 260), 0, events))
    assert hashlib.sha256(data).hexdigest() == BEFORE["packet_sha256"]


def test_the_default_bundle_is_read_and_written_as_it_was() -> None:
    found = models.find("default")
    assert found.digest == BEFORE["default_digest"]
    assert hashlib.sha256(found.to_bytes()).hexdigest() == BEFORE["roundtrip_sha256"]


def renewed() -> dict[str, Any]:
    """What unchanged.json should hold for the default model of today."""
    model = models.find("default")
    made = BEFORE | {"default_digest": model.digest, "roundtrip_sha256": hashlib.sha256(model.to_bytes()).hexdigest()}
    for source in SOURCES:
        found = estimates(source)
        made[source] = {
            "start_us": [one.start_us for one in found],
            "events": [one.events for one in found],
            "flags": flags(found),
            "twists": [[[float(f"{v:.7g}") for v in row] for row in one.twists] for one in found],
            "sigma": [[float(f"{v:.7g}") for v in row] for row in sigmas(found)],
        }
    return made


if __name__ == "__main__":
    FILE.write_text(json.dumps(renewed(), separators=(",", ":")) + "\n")
