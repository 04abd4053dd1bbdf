"""Validation of a run on windows that it does not train on, early end, and what is told about it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurove_core.io.formats.packet_log.writer import write_mcap
from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.sources import open_source
from neurove_core.training import config as configs
from neurove_core.training import data, pipeline, validation
from neurove_core.training.config import DataConfig, RecipeConfig
from neurove_core.training.curve import draw_curve
from neurove_core.training.data import Sequences, Span
from neurove_core.training.loop import CHECKPOINT, RUN_JSON, kept_step, train, train_to_end
from neurove_core.training.ranks import Ranks
from neurove_core.training.recorded import RecordedSequences
from neurove_core.training.run import TrainingRun
from neurove_core.training.validation import Held, is_over, sentences, validate
from neurove_protocol.errors import InvalidField
from tests.neurove_core.training.test_curve import CURVE
from tests.neurove_core.training.test_training import TINY

SOURCE = "sim://street?seed=3&camera=pinhole:24x18:75&seconds="


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequences")
    list(data.Cache(folder, TINY).fill())
    return folder


@pytest.fixture(scope="module")
def sequences(folder):
    return data.Cache(folder, TINY).open()


@pytest.fixture(scope="module")
def held(folder):
    return Held.read([], [data.Cache(folder, TINY).path(0)], TINY.recipe)


def recipe(**changed):
    return TINY.model_copy(update={"recipe": RecipeConfig.model_validate(TINY.recipe.model_dump() | changed)})


def learning_from(folder, seconds, **changed):
    path = folder / f"drive-{seconds}.mcap"
    write_mcap(open_source(f"{SOURCE}{seconds}"), path)
    chosen = DataConfig.model_validate(
        {"sequences": 0, "seconds": 0.5, "recordings": [str(path)], "cameras": {"pinhole:24x18": 1.0}}
    )
    return TINY.model_copy(update={"data": chosen, "recipe": recipe(doubled=0, **changed).recipe})


@pytest.mark.parametrize(
    ("seconds", "share", "training", "kept_out"),
    [
        (1.3, 0.15, [(0, None), (0, None)], [(0, None)]),  # sequences of 10, 10 and 5 windows: the last one is held out
        (0.55, 0.15, [(0, 6)], [(6, 10)]),  # one sequence: its last segment of 4 windows
        (0.35, 0.15, [(0, None)], []),  # 6 windows do not hold two segments of 4
        (1.3, 0.0, [(0, None)] * 3, []),
    ],
)
def test_the_end_of_each_recording_is_held_out(tmp_path, seconds, share, training, kept_out):
    config = learning_from(tmp_path, seconds, validation_share=share)
    recorded = RecordedSequences(tmp_path, config)
    list(recorded.fill())
    used, kept = recorded.split()
    assert [(one.start, one.stop) for one in used] == training
    assert [(one.start, one.stop) for one in kept] == kept_out
    assert not {(one.path, one.start) for one in used} & {(one.path, one.start) for one in kept}


def test_a_span_has_the_windows_of_its_file(folder):
    path = data.Cache(folder, TINY).path(0)
    whole, part = Sequences([path]), Sequences([Span(path, 3, 8)])
    assert len(part.twists[0]) == 5
    np.testing.assert_array_equal(part.twists[0], whole.twists[0][3:8])
    np.testing.assert_array_equal(part.counts(0, 1, 3), whole.counts(0, 4, 6))


def test_the_error_of_a_validation_is_the_mean_length_in_metres_and_ignores_unknown_truth(sequences, held):
    run = TrainingRun.begin(TINY, sequences)
    with torch.no_grad():
        for parameter in run.network.parameters():
            parameter.zero_()  # every output is 0: the estimate is the offset
    found = validate(run.network, held, TINY, (run.offset, run.scale), 7)
    segment = held.simulated
    error = (run.offset - segment.twists).numpy()
    metres = np.linalg.norm(error[..., :3], axis=-1) * segment.height_m.numpy()[:, None]
    assert found["step"] == 7
    assert found["simulated_linear_error_m_s"] == pytest.approx(metres.mean(), rel=1e-5)
    expected = np.linalg.norm(error[..., 3:], axis=-1).mean()
    assert found["simulated_angular_error_rad_s"] == pytest.approx(expected, rel=1e-5)
    segment = segment._replace(twists=segment.twists.clone())
    segment.twists[..., :3] = torch.nan
    found = validate(run.network, Held(segment, None), TINY, (run.offset, run.scale), 0)
    assert found == {"step": 0, "recorded_angular_error_rad_s": pytest.approx(expected, rel=1e-5)}


def test_an_axis_without_truth_counts_as_no_error_in_a_validation(sequences, held):
    """As wheel speed has it, of which only vz is known."""
    run = TrainingRun.begin(TINY, sequences)
    segment = held.simulated._replace(twists=held.simulated.twists.clone())
    segment.twists[..., [0, 1, 3, 4, 5]] = torch.nan
    with torch.no_grad():
        for parameter in run.network.parameters():
            parameter.zero_()  # every output is 0: the estimate is the offset
    found = validate(run.network, Held(segment, None), TINY, (run.offset, run.scale), 0)
    error = (run.offset - segment.twists).abs()[..., 2] * segment.height_m[:, None]
    assert found == {"step": 0, "recorded_linear_error_m_s": pytest.approx(float(error.mean()), rel=1e-5)}


def test_a_validated_run_takes_the_same_steps_as_one_that_is_not(sequences, held, tmp_path):
    one, other = (TrainingRun.begin(TINY, sequences) for _ in range(2))
    for name, run, sets in (("one", one, None), ("other", other, held)):
        (tmp_path / name).mkdir()
        train_to_end(run, sequences, tmp_path / name, held=sets)
    weights = other.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in one.network.state_dict().items())
    assert [point["step"] for point in other.validation] == [0, *(point["step"] for point in other.curve)]
    assert one.validation == []


def test_a_run_that_gets_worse_stops_early_and_keeps_its_best_weights(folder, sequences, held, tmp_path):
    config = recipe(steps=200, warm_up_steps=0, patience=0.1)
    run = TrainingRun.begin(config, sequences)
    network, segment = run.network.eval(), held.simulated
    with torch.no_grad():
        outputs, _ = network(to_spikes(segment.counts, "log1p"), network.initial_state(segment.counts.shape[1]))
    truth = outputs * run.scale + run.offset  # what the first weights say, so every update makes it worse
    against = Held(segment._replace(twists=truth + 1e-3), None)
    path = train(config, tmp_path, folder, held=against)
    about = json.loads((tmp_path / RUN_JSON).read_text())
    best = validation.best_of(about["validation"])
    assert about["step"] < 200
    assert about["step"] - about["validation"][best]["step"] >= 20
    assert about["kept_step"] == about["validation"][best]["step"] < about["step"]
    assert any(f"stopped early, after {about['step']} of 200 updates" in told for told in about["validated"])
    run = TrainingRun.restore(tmp_path / CHECKPOINT, config)
    made = bundle.load(path)
    assert kept_step(run) == about["kept_step"]
    assert all(torch.equal(run.best[name], tensor) for name, tensor in made.network.state_dict().items())
    figure = made.metadata.figures["validation_recorded_linear_error_m_s"]
    assert figure == pytest.approx(about["validation"][best]["recorded_linear_error_m_s"])
    resumed = train(config, tmp_path, folder, held=against, resume=True)
    assert bundle.load(resumed).digest == made.digest


def test_patience_of_one_never_stops(held):
    points = [{"step": 10.0 * i, "recorded_linear_error_m_s": 1.0 + i} for i in range(50)]
    assert is_over(points, RecipeConfig(steps=500, patience=0.5))
    assert not is_over(points, RecipeConfig(steps=500, patience=1.0))
    assert not is_over([], RecipeConfig())


def test_the_recordings_decide_and_a_model_that_became_worse_elsewhere_is_told():
    points = [
        {"step": 0.0, "recorded_linear_error_m_s": 0.3, "simulated_linear_error_m_s": 0.08},
        {"step": 90.0, "recorded_linear_error_m_s": 0.1, "simulated_linear_error_m_s": 0.24},
    ]
    assert validation.best_of(points) == 1
    told = sentences(points, 90, RecipeConfig(steps=90), from_model=True)
    assert told == [
        "error on the held-out parts of the recordings: linear 0.1 m/s (0.3 before training)",
        "error on simulated scenes: linear 0.24 m/s (0.08 before training)",
        "warning: on simulated scenes the error is 3.0 times that of the model it began from",
    ]
    assert sentences(points, 90, RecipeConfig(steps=90), from_model=False) == [
        "error on the held-out parts of the recordings: linear 0.1 m/s",
        "error on simulated scenes: linear 0.24 m/s",
    ]
    assert "the weights are those of update 0" in sentences(points, 0, RecipeConfig(steps=90), from_model=True)[2]


def test_a_run_from_one_drive_is_validated_on_its_end_and_on_simulated_scenes(tmp_path):
    config = learning_from(tmp_path, 1.3, steps=8)
    start = replace(bundle.untrained(config=config.model, name="start"), linear_unit=bundle.PER_HEIGHT)
    pipeline.train(config, tmp_path / "out", start=start.with_digest(), calibration_sequences=0)
    about = json.loads((tmp_path / "out" / RUN_JSON).read_text())
    keys = {
        f"{name}_{part}" for name in ("recorded", "simulated") for part in ("linear_error_m_s", "angular_error_rad_s")
    }
    assert all(set(point) == {"step", *keys} for point in about["validation"])
    assert [told.split(":")[0] for told in about["validated"][:2]] == [
        "error on the held-out parts of the recordings",
        "error on simulated scenes",
    ]
    assert "before training" in about["validated"][0]


@pytest.mark.parametrize(
    ("change", "arguments", "says"),
    [
        ({}, {"calibration_sequences": 15}, "calibration_sequences=15: must be at least 16"),
        ({}, {"calibration_sequences": -1}, "calibration_sequences=-1"),
        ({}, {"ranks": Ranks(count=3)}, "devices=3: recipe.batch=4 does not split"),
        ({"cameras": {"nikon": 1.0}}, {}, "'nikon'"),
        ({"scenes": {"moon": 1.0}}, {}, "scene='moon'"),
        ({"hands": {"thrown": 1.0}}, {}, "data.hands='thrown': known motions: waved, turned, slid, spun"),
        ({"pitch_deg": (0.0, 70.0)}, {}, "pitch_deg=70.0"),
    ],
)
def test_what_can_be_wrong_is_checked_before_anything_is_simulated(tmp_path, change, arguments, says):
    config = TINY.model_copy(update={"data": DataConfig.model_validate(TINY.data.model_dump() | change)})
    with pytest.raises(InvalidField) as refused:
        pipeline.train(config, tmp_path / "out", **arguments)
    assert says in refused.value.message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("which", ["out", "data"])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_simulated(tmp_path, which):
    (tmp_path / "file").write_text("")
    reported = []
    folders = {"out": tmp_path / "a", "data": tmp_path / "b"} | {which: tmp_path / "file"}
    with pytest.raises(InvalidField, match=f"{which}=.*files cannot be written"):
        pipeline.train(TINY, folders["out"], data=folders["data"], on_progress=lambda *step: reported.append(step))
    assert reported == []


def test_segments_that_are_longer_than_a_sequence_are_refused_with_both_lengths(tmp_path):
    (tmp_path / "a.toml").write_text("[data]\nseconds = 1.0\n[recipe]\nsegment_windows = 32\n")
    with pytest.raises(InvalidField) as refused:
        configs.load(str(tmp_path / "a.toml"))
    told = (
        "data.seconds=1 has 20 windows of 50000 us, a segment of recipe.segment_windows=32 needs 64 at twice the speed"
    )
    assert told in refused.value.message


def test_the_figure_shows_the_validation(tmp_path):
    points = [{"step": point["step"], "recorded_linear_error_m_s": 3.0} for point in CURVE]
    with_it = [file.read_bytes() for file in draw_curve(CURVE, tmp_path, "model", points)]
    assert with_it != [file.read_bytes() for file in draw_curve(CURVE, tmp_path, "model")]
