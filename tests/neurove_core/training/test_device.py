"""Training on another device than the CPU: the device `meta` of torch has no values, and refuses tensors on the CPU."""

import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.training.batches import Segment
from neurove_core.training.config import DataConfig, RecipeConfig, TrainingConfig
from neurove_core.training.loop import train_segment
from neurove_core.training.ranks import Ranks
from neurove_core.training.run import TrainingRun

SEGMENT = Segment(torch.zeros(4, 4, 10, 16, 22, dtype=torch.uint8), torch.zeros(4, 4, 5, 6), torch.ones(4))


class Scaled:
    """Sequences of which only the truth is read."""

    twists = (torch.eye(6).repeat(5, 1, 1).numpy(),)

    def __len__(self):
        return 1


def config(kind, surrogate):
    network = NetworkConfig(channels=(4, 8), features=16, hidden=16, surrogate=surrogate)
    canonical = CanonicalConfig(width=22, height=16, hfov_deg=80)
    return TrainingConfig(
        name="tiny",
        model=ModelConfig(kind=kind, canonical=canonical, network=network),
        data=DataConfig(sequences=1, seconds=0.5, cameras={"pinhole:24x18": 1.0}),
        recipe=RecipeConfig(steps=12, batch=4, segment_windows=4, chunk_windows=2, warm_up_steps=2),
    )


@pytest.mark.parametrize("surrogate", ["rectangular", "arctan", "triangle"])
@pytest.mark.parametrize("kind", ["neurove", "ann", "snn-ang"])
def test_an_update_leaves_no_tensor_on_the_cpu(kind, surrogate):
    run = TrainingRun.begin(config(kind, surrogate), Scaled(), Ranks(device=torch.device("meta")))
    with pytest.raises(RuntimeError, match="cannot be called on meta tensors"):  # the loss has no value to show
        train_segment(run, SEGMENT)
    assert run.step == 1
    assert all(one.grad is not None and one.device.type == "meta" for one in run.network.parameters())


def test_a_tensor_left_on_the_cpu_is_found_this_way():
    run = TrainingRun.begin(config("neurove", "arctan"), Scaled(), Ranks(device=torch.device("meta")))
    run.scale = torch.ones(6)
    with pytest.raises(RuntimeError, match="device"):
        train_segment(run, SEGMENT)
    assert run.step == 0
