"""A service and its commands in processes that refuse torch, as `pip install neurove[serve]` leaves them."""

import os
import subprocess
import sys
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from neurove_core import models, self_test
from neurove_core.config import NetworkConfig
from neurove_core.engine.engine import Engine
from neurove_core.engine.runner import FastRunner
from neurove_core.estimator import Estimator
from neurove_core.io.packets import slices
from neurove_core.models import bundle
from neurove_core.sources import open_source
from neurove_protocol import Sensor
from neurove_protocol.events import EventPacket, encode_packet
from tests.live.conftest import Heard, Source, free_endpoint, service, wait_until

pytestmark = pytest.mark.live

REFUSE = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Refuse())
"""
SOURCES = ("pattern://?seed=20401", "sim://room?seed=20402&seconds=0.4")


@pytest.fixture(scope="module")
def without_torch(tmp_path_factory):
    """The environment of a process in which torch cannot be imported."""
    folder = tmp_path_factory.mktemp("refuse")
    (folder / "sitecustomize.py").write_text(REFUSE)
    return {"PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}


@pytest.fixture(scope="module")
def recorded():
    """The sensor and the beginning of each source, as slices."""
    found = []
    for url in SOURCES:
        source = open_source(url)
        found.append((source.sensor, list(islice(slices(source.chunks()), 100))))
    return found


@pytest.fixture(scope="module")
def int8(tmp_path_factory):
    """A bundle in int8, with a golden test that torch recorded and that allows no more than rounding."""
    config = models.find("default").config
    network = NetworkConfig(channels=(16, 32), features=32, hidden=32, v_th=0.4, precision="int8")
    made = bundle.untrained(5, config.model_copy(update={"network": network}), "whole")
    counts = np.random.default_rng(20_403).poisson(0.3, (6, *config.window_shape)).astype(np.uint8)
    made = replace(made, golden=self_test.record(Estimator(made), counts, tolerance=1e-6)).with_digest()
    path = tmp_path_factory.mktemp("int8") / "whole.safetensors"
    bundle.save(made, path)
    return made, path


def in_torch(network_of, sensor: Sensor, pieces):
    """Twists of a model for these slices, computed by torch's path where it adds in our order on this processor."""
    network = network_of.network.requires_grad_(requires_grad=False)
    ours = network.config.network.precision == "int8" or Engine(network).reads_counts
    estimator = Estimator(network_of, FastRunner(network) if ours else None)
    state, found = estimator.initial_state(sensor), {}
    for piece in pieces:
        pushed = estimator.push(piece.events, state, piece.t0_us)
        state = pushed.state
        found |= {one.start_us: one.twists for one in pushed.estimates}
    return found


def heard_of(listener, stream):
    return {one.start_us: np.array(one.twists) for one in listener.of(stream)}


def test_a_service_without_torch_answers_bit_for_bit_and_takes_a_pushed_int8_bundle(
    without_torch, recorded, int8, tmp_path, run
):
    default = bundle.from_bytes(models.find("default").to_bytes(), "default")
    made, path = int8
    endpoint = free_endpoint()
    settings = ("--max-age-s", "3600", "--queue-s", "60", "--models-dir", str(tmp_path), "--refine", "off")
    with service(endpoint, *settings, **without_torch) as (_, transport, config):
        heard = Heard(transport, config)
        for model, name in ((default, "default"), (made, "whole")):
            if model is made:
                code, _, err = run("push", path, "--connect", endpoint, "--activate", "--wait", "90")
                assert (code, err) == (0, ""), err
            for number, (sensor, pieces) in enumerate(recorded):
                stream = f"{name}{number}"
                source = Source(transport, config, stream)
                packets = [
                    EventPacket(stream, seq, sensor, piece.t0_us, piece.events) for seq, piece in enumerate(pieces)
                ]
                source.play([encode_packet(packet) for packet in packets])
                want = in_torch(model, sensor, pieces)
                wait_until(lambda stream=stream, want=want: len(heard.of(stream)) >= len(want))
                got = heard_of(heard, stream)
                assert got.keys() == want.keys()
                assert {one.model for one in heard.of(stream)} == {name}
                assert all(np.array_equal(got[at], want[at]) for at in want)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("evaluate", "default", "sim://street?seed=20404&seconds=2"), 0, "RMSE"),
        (("bundle", "inspect", "default.safetensors"), 0, "default"),
        (("bundle", "new", "new.safetensors"), 2, "neurove[train]"),
    ],
    ids=["evaluate", "inspect", "new"],
)
def test_commands_work_without_torch_or_name_the_extra(without_torch, tmp_path, arguments, code, words):
    (tmp_path / "default.safetensors").write_bytes(models.find("default").to_bytes())
    ran = subprocess.run(
        [sys.executable, "-m", "neurove_service.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
        cwd=tmp_path,
        env=os.environ | without_torch,
    )
    assert ran.returncode == code, ran.stderr
    assert words in ran.stdout + ran.stderr
