import time
from dataclasses import replace

import pytest

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.models import bundle
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.streams.intake import Arrival

SMALL = ModelConfig(
    canonical=CanonicalConfig(width=24, height=16),
    network=NetworkConfig(channels=(4, 4), features=8, hidden=8),
    settle_windows=4,
    low_activity_events=10,
)


@pytest.fixture(scope="session")
def models_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for seed, name in ((1, "one"), (2, "two")):
        bundle.save(replace(bundle.untrained(seed, SMALL, name), trained=True), folder / f"{name}.safetensors")
    return folder


@pytest.fixture
def slot(models_dir):
    slot = ModelSlot("one", models_dir, Rules(probation_s=0.2))
    yield slot
    slot.close()


def arrived():
    """A packet of a replay that arrived now and did not wait."""
    now_ns = time.monotonic_ns()
    return Arrival(now_ns, now_ns, now_ns // 1000)
