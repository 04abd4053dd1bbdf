"""Training on recordings: windows as in the service, unknown truth, and errors."""

import os

import numpy as np
import pytest
import torch

from neurove_core.geometry.motion import Twists
from neurove_core.io import UnknownSource
from neurove_core.io.formats.packet_log.writer import write_mcap
from neurove_core.models import bundle
from neurove_core.sources import open_source
from neurove_core.training import config as configs
from neurove_core.training import data
from neurove_core.training.batches import draw
from neurove_core.training.config import DataConfig, TrainingConfig
from neurove_core.training.loop import train, train_segment
from neurove_core.training.recorded import RecordedSequences, split_recording
from neurove_core.training.run import TrainingRun
from neurove_protocol.errors import InvalidField
from tests.builders import make_events
from tests.neurove_core.training.test_training import MODEL, TINY
from tests.recordings import ecd_text

SOURCE = "sim://street?seed=3&seconds=1.3&camera=pinhole:24x18:75"
STILL = "\n".join(f"{t / 10} {t * 0.1} 0 0 0 0 0 1" for t in range(16))  # 1 m/s along x


def learning_from(*recordings, **changed) -> TrainingConfig:
    chosen = {"sequences": 0, "seconds": 0.5, "recordings": recordings} | changed
    return TINY.model_copy(update={"data": DataConfig.model_validate(chosen)})


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "drive.mcap"
    write_mcap(open_source(SOURCE), path)
    return path


@pytest.fixture
def ecd(tmp_path):
    folder = tmp_path / "slider"
    folder.mkdir()
    (folder / "events.txt").write_bytes(ecd_text(make_events(20_000, duration_us=1_500_000)))
    (folder / "groundtruth.txt").write_text(STILL)
    return folder


def test_a_recorded_simulation_gives_the_sequences_of_the_simulation(ours, tmp_path):
    config = learning_from(str(ours))
    recorded = RecordedSequences(tmp_path, config)
    assert recorded.missing() == 1
    assert list(recorded.fill()) == ["drive.mcap"]
    learned, simulated = data.Sequences(recorded.paths()), data.sequence_of(open_source(SOURCE), MODEL)
    assert [len(twists) for twists in learned.twists] == [10, 10]  # the remaining 5 windows are too few for a segment
    for index in range(2):
        part = slice(10 * index, 10 * index + 10)
        np.testing.assert_array_equal(learned.counts(index, 0, 10), simulated.counts[part])
        np.testing.assert_allclose(learned.twists[index], simulated.twists[part], rtol=1e-3, atol=1e-3)
        assert learned.height_m[index] == pytest.approx(simulated.height_m)


def test_a_recording_is_split_again_only_after_a_change(ours, tmp_path):
    assert list(RecordedSequences(tmp_path, learning_from(str(ours))).fill())
    assert not list(RecordedSequences(tmp_path, learning_from(str(ours))).fill())
    assert RecordedSequences(tmp_path, learning_from({"source": str(ours), "height_m": 3.0})).missing() == 1
    assert RecordedSequences(tmp_path, learning_from(SOURCE)).missing() == 1
    copy = tmp_path / "drive.mcap"
    write_mcap(open_source(SOURCE.replace("seed=3", "seed=4")), copy)
    assert RecordedSequences(tmp_path, learning_from(str(copy))).missing() == 1


def test_a_recording_of_equal_size_and_time_is_another_recording(ecd, tmp_path):
    config = learning_from({"source": str(ecd), "height_m": 1.0})
    assert list(RecordedSequences(tmp_path / "cache", config).fill())
    events = ecd / "events.txt"
    before, content = events.stat(), events.read_text()
    events.write_text(content[:-2] + ("0" if content[-2] == "1" else "1") + "\n")  # the polarity of the last event
    os.utime(events, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (events.stat().st_size, events.stat().st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    assert RecordedSequences(tmp_path / "cache", config).missing() == 1


def test_sequences_simulated_before_there_were_recordings_stay_valid(tmp_path):
    """If this fails, users must simulate all their sequences again."""
    with_recordings = TrainingConfig(data=DataConfig.model_validate({"recordings": ["FILE"]}))
    for config in (configs.load("default"), TrainingConfig(), with_recordings):
        assert data.Cache(tmp_path, config).folder.name == "84f87b804314bf9f"


def test_a_model_trained_on_recordings_only_has_them_in_its_provenance(ours, tmp_path):
    config = learning_from(str(ours))
    list(RecordedSequences(tmp_path, config).fill())
    made = bundle.load(train(config, tmp_path / "out", tmp_path))
    assert "0 simulated sequences" in made.provenance
    assert "1 recordings (drive.mcap)" in made.provenance


def test_a_folder_stands_for_the_recordings_in_it(ours, ecd, tmp_path):
    (tmp_path / "notes.md").write_text("not a recording")
    write_mcap(open_source(SOURCE), tmp_path / "a.mcap")
    config = learning_from({"source": str(tmp_path), "height_m": 1.5})
    assert list(RecordedSequences(tmp_path / "data", config).fill()) == ["a.mcap", "slider"]
    with pytest.raises(InvalidField, match="contains 2 recordings; list each"):
        RecordedSequences(tmp_path, learning_from({"source": str(tmp_path), "truth": "poses.txt"}))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UnknownSource, match="nor a folder with recordings"):
        RecordedSequences(tmp_path, learning_from(str(tmp_path / "empty")))


def test_linear_truth_needs_the_cameras_height(ecd, tmp_path):
    with pytest.raises(InvalidField, match=r"data.recordings.0.height_m=None: .* the height of its camera"):
        RecordedSequences(tmp_path, learning_from(str(ecd)))
    recorded = RecordedSequences(tmp_path, learning_from({"source": str(ecd), "height_m": 2.0}))
    list(recorded.fill())
    learned = data.Sequences(recorded.paths())
    np.testing.assert_allclose(learned.twists[0], np.tile([0.5, 0, 0, 0, 0, 0], (10, 5, 1)), atol=1e-4)
    assert set(learned.height_m) == {2.0}


def test_a_file_of_poses_serves_as_truth(ecd, tmp_path):
    truth = (ecd / "groundtruth.txt").rename(tmp_path / "poses.txt")
    with pytest.raises(InvalidField, match=r"data.recordings.0.truth=None: .* has no truth"):
        RecordedSequences(tmp_path, learning_from({"source": str(ecd), "height_m": 2.0}))
    given = {"source": str(ecd), "height_m": 2.0, "truth": str(truth)}
    assert list(RecordedSequences(tmp_path, learning_from(given)).fill()) == ["slider"]


def test_unusable_recordings_are_refused_and_the_error_names_the_field(ours, tmp_path):
    with pytest.raises(InvalidField, match="never ends"):
        RecordedSequences(tmp_path, learning_from("sim://street"))
    short = RecordedSequences(tmp_path, learning_from(SOURCE.replace("1.3", "0.3")))
    with pytest.raises(InvalidField, match=r"data.recordings.0.source=.*at most 5 consecutive windows"):
        list(short.fill())
    with pytest.raises(ValueError, match="nothing to train on"):
        DataConfig(sequences=0)
    (tmp_path / "run.toml").write_text("[data]\nrecordings = ['a', {source = 'b', height_m = -1}]\n")
    with pytest.raises(InvalidField, match=r"data.recordings.1.height_m=-1"):
        configs.load(str(tmp_path / "run.toml"))


def test_a_truth_of_some_axes_is_used_and_unknown_axes_do_not_count(ours, tmp_path):
    recording, config = open_source(str(ours)), learning_from(str(ours))
    truth = recording.twists()
    only_x = np.full_like(truth.twist, np.nan)
    only_x[:, 3] = truth.twist[:, 3]
    only_x[truth.t > 1_000_000, 3] = np.nan
    some = list(split_recording(recording, Twists(truth.t, only_x), 1.0, config))
    assert [len(one.twists) for one in some] == [10, 10]  # after 1 s the truth is unknown
    full = list(split_recording(recording, truth, 1.0, config))
    paths = [tmp_path / f"{index}.safetensors" for index in range(4)]
    for path, one in zip(paths, some + full[:2], strict=True):
        data.save(one, path)
    mixed = data.Sequences(paths)
    run = TrainingRun.begin(config, mixed)
    losses = train_segment(run, draw(np.random.default_rng(0), mixed, config.recipe))
    assert np.isfinite(losses).all()
    assert all(torch.isfinite(parameter).all() for parameter in run.network.parameters())
    alone = data.Sequences(paths[:2])
    with pytest.raises(InvalidField, match="none of them has a truth of the linear velocity"):
        TrainingRun.begin(config, alone)
