"""Models to change between, and slots that serve them."""

from dataclasses import replace

import pytest
import torch

from neurove_core.config import WindowConfig
from neurove_core.models import bundle
from tests.bundles import proven
from tests.service.conftest import SMALL
from tests.service.models.swapping import Slots


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swap")
    for seed, name in ((1, "one"), (2, "two"), (3, "three")):
        bundle.save(proven(bundle.untrained(seed, SMALL, name)), folder / f"{name}.safetensors")
    one = bundle.load(folder / "one.safetensors")
    plain = replace(one, golden=None)  # the golden test is that of other scales
    bundle.save(replace(plain, name="similar", offset=torch.full((6,), 1e-4)), folder / "similar.safetensors")
    bundle.save(replace(plain, name="wild", scale=torch.full((6,), 50.0)), folder / "wild.safetensors")
    bundle.save(replace(plain, name="absurd", scale=torch.full((6,), 1e4)), folder / "absurd.safetensors")
    bundle.save(bundle.untrained(7, SMALL, "random"), folder / "random.safetensors")
    short = SMALL.model_copy(update={"window": WindowConfig(duration_us=20_000, bins=5)})
    bundle.save(bundle.untrained(4, short, "short"), folder / "short.safetensors")
    wide = SMALL.model_copy(update={"canonical": SMALL.canonical.model_copy(update={"width": 30})})
    bundle.save(bundle.untrained(5, wide, "wide"), folder / "wide.safetensors")
    return folder


@pytest.fixture
def slots(folder):
    made = Slots(folder)
    yield made
    for slot in made.made:
        slot.close()
