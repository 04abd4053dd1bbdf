"""Spike encoding of a window's counts."""

import numpy as np
import pytest
import torch

from neurove_core.networks.encoding import to_spikes, to_spikes_reference

ALL_COUNTS = torch.arange(256, dtype=torch.uint8)


def test_binary_encoding_is_one_where_there_was_an_event_and_zero_elsewhere():
    assert to_spikes(ALL_COUNTS, "binary").tolist() == [0.0] + [1.0] * 255


def test_log1p_encoding_keeps_the_number_of_events_of_a_cell():
    np.testing.assert_allclose(to_spikes(ALL_COUNTS, "log1p").numpy(), np.log1p(np.arange(256)), rtol=1e-6)


@pytest.mark.parametrize("encoding", ["binary", "log1p"])
def test_every_cell_is_encoded_on_its_own_as_float32(encoding):
    counts = torch.randint(0, 256, (3, 2, 4, 5, 6), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    spikes = to_spikes(counts, encoding)
    assert spikes.dtype == torch.float32
    assert torch.equal(spikes, to_spikes(ALL_COUNTS, encoding)[counts.long()])
    assert not spikes[counts == 0].any()


@pytest.mark.parametrize("encoding", ["binary", "log1p"])
@pytest.mark.parametrize("shape", [(4, 5, 6), (2, 3, 4, 5, 6), (1, 1, 10, 65, 86), (256,), (2, 128)])
def test_the_compiled_encoding_equals_the_plain_one_and_is_channels_last(shape, encoding):
    counts = torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    spikes = to_spikes(counts, encoding)
    assert torch.equal(spikes, to_spikes_reference(counts, encoding))
    if len(shape) >= 3:
        assert spikes.movedim(-3, -1).is_contiguous()
    mirrored = counts.flip(-1).transpose(-1, -2) if len(shape) > 1 else counts.flip(-1)
    assert torch.equal(to_spikes(mirrored, encoding), to_spikes_reference(mirrored, encoding))
