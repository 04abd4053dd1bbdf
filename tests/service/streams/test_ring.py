import numpy as np
import pytest

from neurove_core.ingest.windows import Window
from neurove_service.streams.ring import Ring, pack

SHAPE = (10, 16, 24)


def window(number, share=0.1):
    rng = np.random.default_rng(number)
    counts = rng.integers(1, 255, SHAPE, np.uint8, endpoint=True) * (rng.random(SHAPE) < share).astype(np.uint8)
    return Window(number * 50_000, counts, 1000 + number, number)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("shape", [SHAPE, (10, 130, 172)], ids=["small", "more than 16 bits of cells"])
def test_a_packed_window_is_lossless_and_not_larger_than_its_counts(share, shape):
    counts = np.resize(window(3, share).counts, shape)
    entry = pack(Window(7, counts, 5, 2))
    back = entry.window()
    np.testing.assert_array_equal(back.counts, counts)
    assert (back.start_us, back.events, back.outside) == (7, 5, 2)
    assert entry.size <= counts.size + 256
    if share <= 0.1:
        assert entry.size < counts.size / 1.5 + 256


def test_a_ring_keeps_the_newest_windows_in_order():
    ring = Ring(4, 1 << 30)
    for number in range(10):
        ring.append(pack(window(number)))
    assert [entry.start_us // 50_000 for entry in ring.newest(100)] == [6, 7, 8, 9]
    assert [entry.start_us // 50_000 for entry in ring.newest(2)] == [8, 9]
    assert [entry.start_us // 50_000 for entry in ring.after(8 * 50_000)] == [8, 9]
    assert len(ring.after(None)) == 4


def test_a_ring_never_exceeds_its_maximum_size():
    entry = pack(window(0, 1.0))
    ring = Ring(1000, 3 * entry.size + 10)
    for number in range(50):
        ring.append(pack(window(number, 1.0)))
        assert ring.bytes <= 3 * entry.size + 10
    assert len(ring.newest(1000)) == 3
