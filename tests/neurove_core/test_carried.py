"""The state of a stream goes to another process as bytes, and the estimates go on bit for bit."""

import msgpack
import numpy as np
import pytest

from neurove_core import carried
from neurove_core.config import ModelConfig
from neurove_core.estimator import Estimator
from neurove_core.inertial.state import InertialState, Learned
from neurove_core.ingest.windows import Window
from neurove_core.models import bundle
from neurove_core.refine import scene
from neurove_core.refine.rotation import Filter
from neurove_core.refine.scatter import Scatter
from neurove_core.refine.stages import State as Stages
from neurove_core.refine.trembling import Trembling
from neurove_protocol import Sensor
from neurove_protocol.errors import NeuroVEError
from tests.bundles import CONFIG, make_bundle

SENSOR = Sensor(20, 16)


def windows(config: ModelConfig, count: int, first: int = 0) -> list[Window]:
    shape = (config.input_shape[0] if not config.network.history else 2 * config.window.bins, 8, 10)
    rng = np.random.default_rng(first)
    duration = config.window.duration_us
    return [
        Window((first + i) * duration, rng.poisson(0.5, shape).astype(np.uint8), 100, 0, bridged=False)
        for i in range(count)
    ]


@pytest.mark.parametrize("kind", ["neurove", "ann"])
def test_another_process_goes_on_bit_for_bit(kind):
    estimator = Estimator(bundle.untrained(3, CONFIG.model_copy(update={"kind": kind})))
    _, state = estimator.follow(windows(CONFIG, 20), estimator.initial_state(SENSOR))
    other = carried.decode(carried.encode(state), estimator.initial_state(SENSOR)).into(estimator.initial_state(SENSOR))
    more = windows(CONFIG, 5, first=20)
    wanted, _ = estimator.follow(more, state)
    got, _ = estimator.follow(more, other)
    cold, _ = estimator.follow(more, estimator.initial_state(SENSOR))
    for one, two in zip(wanted, got, strict=True):
        assert one.twists.tobytes() == two.twists.tobytes()
        assert one.settled == two.settled
        assert one.first == two.first
    assert wanted[0].twists.tobytes() != cold[0].twists.tobytes()


def test_the_state_of_the_refinement_goes_along():
    estimator = Estimator(make_bundle())
    _, state = estimator.follow(windows(CONFIG, 3), estimator.initial_state(SENSOR))
    size = 6 + scene.COLUMNS * scene.ROWS
    moving = scene.Scene(np.arange(float(size)), np.eye(size), 2_000_000, seen=True, moves=7)
    turning = Filter(np.arange(6.0), np.eye(6), 2_000_000, 1)
    scattered = Scatter(np.arange(18.0).reshape(3, 6), np.arange(6.0), 7, 2_000_000)
    trembling = Trembling(np.arange(6.0).reshape(2, 3), np.arange(3.0), 5, 2_000_000)
    state = state._replace(stages=Stages(turning, moving, 12, 2, True, -2.5, scattered, trembling))
    got = carried.decode(carried.encode(state), state).stages
    assert (got.aside, got.idle, got.again, got.odds, got.scene.seen, got.scene.moves) == (12, 2, True, -2.5, True, 7)
    assert (got.filter.end_us, got.filter.against, got.scene.end_us) == (2_000_000, 1, 2_000_000)
    for one, two in zip(
        (*got.scatter[:2], *got.trembling[:2], got.filter.motion, got.scene.mean, got.scene.covariance),
        (*scattered[:2], *trembling[:2], turning.motion, *moving),
        strict=False,
    ):
        assert one.tobytes() == two.tobytes()
    assert (got.scatter[2:], got.trembling[2:]) == (scattered[2:], trembling[2:])


def test_every_truncation_and_the_state_of_another_model_are_refused():
    estimator = Estimator(make_bundle())
    _, state = estimator.follow(windows(CONFIG, 3), estimator.initial_state(SENSOR))
    data = carried.encode(state)
    for length in range(0, len(data), 7):
        with pytest.raises(NeuroVEError):
            carried.decode(data[:length], state)
    network = CONFIG.network.model_copy(update={"hidden": 5})
    other = Estimator(make_bundle(network=network))
    with pytest.raises(NeuroVEError, match="shapes of this node's model"):
        carried.decode(data, other.initial_state(SENSOR))


@pytest.mark.parametrize(
    "values",
    [
        [1, 2, 3],
        [["named", "Popen", [["tuple", []]]], 1, 2, None, None, ["tuple", []], None],
        [["tensor", "|O", [1], b"12345678"], 1, 2, None, None, ["tuple", []], None],
        [["tensor", "<f8", [9], b"12345678"], 1, 2, None, None, ["tuple", []], None],
    ],
)
def test_only_known_classes_and_plain_numbers_are_made(values):
    estimator = Estimator(make_bundle())
    with pytest.raises(NeuroVEError):
        carried.decode(msgpack.packb(values), estimator.initial_state(SENSOR))


def test_an_inertial_part_of_other_shapes_is_refused():
    estimator = Estimator(make_bundle())
    _, state = estimator.follow(windows(CONFIG, 3), estimator.initial_state(SENSOR))
    learned = Learned.of(InertialState())
    assert carried.decode(carried.encode(state, learned), state).inertial.bias.rested is False
    assert carried.decode(carried.encode(state), state).inertial is None
    for wrong in (
        learned._replace(bias=learned.bias._replace(mean_rad_s=np.zeros(2))),
        learned._replace(bias=learned.bias._replace(variance=np.full(3, np.nan))),
        learned._replace(track=learned.track._replace(angle_rad=np.zeros((4, 3)))),
        learned._replace(track=learned.bias),
        learned._replace(tilt=None),
        learned._replace(tilt=learned.tilt._replace(covariance=np.eye(6))),
        learned._replace(tilt=learned.tilt._replace(average_m_s2=np.zeros(2))),
    ):
        with pytest.raises(NeuroVEError, match="inertial"):
            carried.decode(carried.encode(state, wrong), state)
