"""The sample of a window: bounded, the same for any packets and both layouts of events, and absent where not wanted."""

import itertools

import numpy as np
import pytest

from neurove_core.config import CanonicalConfig, WindowConfig
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest.sample import CAPACITY, Sampler, sample_reference
from neurove_core.ingest.windows import WindowsState, push
from neurove_core.ingest.wire import read_packet
from neurove_protocol import EventPacket
from neurove_protocol.events import encode_packet
from tests.builders import SENSOR, make_events

CANONICAL = CanonicalConfig(width=16, height=12)
LUT = lookup_table(CANONICAL, SENSOR, None)


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 31, 32, 33, 64, 65, 1000])
@pytest.mark.parametrize("seed", range(3))
def test_every_kth_event_is_kept_however_the_packets_are_divided(n, seed):
    events, rng = make_events(n, seed=seed, start_us=50_000, duration_us=50_000), np.random.default_rng(seed)
    sampler, cuts = Sampler(50_000, capacity=16), [0, *np.sort(rng.integers(0, n + 1, 7)).tolist(), n]
    for number, (first, stop) in enumerate(itertools.pairwise(cuts)):
        piece = events.span(first, stop)
        packet = EventPacket("cam0", number, SENSOR, 50_000, piece)
        sampler.add(read_packet(encode_packet(packet)).events if number % 2 else piece)
    found = sampler.sample()
    assert_same(found, sample_reference(events, 50_000, capacity=16))
    assert n == 0 or min(n, 8) <= found.n <= 16
    assert found.n == 0 or found.t_us[0] == events.t[0] - 50_000


def test_windows_have_samples_where_they_are_wanted_and_only_there():
    events, config = make_events(60_000, duration_us=50_000), WindowConfig(duration_us=20_000, bins=5)
    for sampled in (False, True):
        state, found = WindowsState(), []
        for first in range(0, events.n, 700):
            piece = events.span(first, first + 700)
            pushed = push(piece, int(piece.t[0]), state, LUT, config, CANONICAL, sampled=sampled)
            state = pushed.state
            found += pushed.windows
        assert len(found) == 2
        if not sampled:
            assert [one.sample for one in found] == [None, None]
            continue
        for one in found:
            first, stop = np.searchsorted(events.t, [one.start_us, one.start_us + 20_000])
            assert_same(one.sample, sample_reference(events.span(first, stop), one.start_us))
            assert one.sample.n <= CAPACITY
