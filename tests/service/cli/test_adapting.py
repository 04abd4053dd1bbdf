"""neurove adapt, end to end: a short drive with odometry, a tiny model, and everything that is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.models import bundle
from neurove_core.models.bundle import PER_HEIGHT
from neurove_core.sources import open_source
from tests import drives, tiny

TINY = ModelConfig(
    canonical=CanonicalConfig(width=22, height=16), network=NetworkConfig(channels=(4, 8), features=16, hidden=16)
)
MOUNT = ("--mount", f"0,{drives.PITCH_DEG},0", "--position", ",".join(map(str, drives.POSITION_M)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("adapt")
    (folder / "tiny.toml").write_text(tiny.toml(model="", batch=4, validation_sequences=1))
    scaling = {"offset": torch.tensor([0.0, 0, 8, 0, 0, 0]), "scale": torch.tensor([5.0] * 3 + [0.3] * 3)}
    start = replace(bundle.untrained(3, TINY, "start"), linear_unit=PER_HEIGHT, trained=True, **scaling).with_digest()
    bundle.save(start, folder / "start.safetensors")
    return folder


@pytest.fixture(scope="module")
def drive(folder):
    return drives.make_drive(folder, 9.0, 20_210)


@pytest.fixture
def adapt(run, folder, drive):
    """Run `neurove adapt` on the drive with a tiny model, for few updates."""

    def call(*arguments, recording=drive.bag, height=("--height", drives.HEIGHT_M), updates=24):
        usual = ("--config", folder / "tiny.toml", "--simulated", 2)
        usual += ("--learning-rate", 0.01, "--updates", updates, "--work", folder / "work", *height)
        start = () if "--start" in arguments else ("--start", folder / "start.safetensors")
        return run("adapt", recording, *usual, *start, *arguments)

    return call


def test_a_model_becomes_better_on_the_robot_whose_drive_it_learns_from(adapt, tmp_path):
    out = tmp_path / "mine.safetensors"
    code, text, _ = adapt("--out", out, "--topic", drives.ODOM, *MOUNT, "--calibration-sequences", 16, "--json")
    report = json.loads(text)
    assert (code, report["better"], report["written"]) == (0, True, str(out))
    parts = [(report["after"][part]["rmse"], report["before"][part]["rmse"]) for part in ("v_l", "v_a")]
    assert any(after < 0.97 * before for after, before in parts)
    assert all(after < 1.03 * before for after, before in parts)
    notes = "\n".join(report["notes"])
    assert "held out: " in notes
    assert "gains: vx " in notes
    assert "on the validation pieces: gains alone" in notes
    model = bundle.load(out)
    assert model.digest == report["digest"]
    assert (model.name, model.trained) == ("mine", True)
    assert model.provenance.startswith("neurove adapt: begun from start ")
    figures = model.metadata.figures
    assert figures["adapted_after_rmse_v_l_m_s"] == pytest.approx(report["after"]["v_l"]["rmse"])


def test_wheel_speed_alone_teaches_the_forward_axis(adapt, drive, tmp_path):
    wheel, out = tmp_path / "wheel.csv", tmp_path / "mine.safetensors"
    rows = np.column_stack([drive.base.t[::50] / 1e6, drive.base.twist[::50, 0]])
    np.savetxt(wheel, rows, delimiter=",", header="t,v", comments="", fmt="%.6f")
    code, text, _ = adapt("--out", out, "--truth", wheel, *MOUNT, "--calibration-sequences", 0)
    lines = {line[:12].strip(): line.split() for line in text.splitlines()}
    assert code == 0
    assert out.exists()
    assert "only vz is known and learned" in text
    assert float(lines["vz RMSE m/s"][4]) < float(lines["vz RMSE m/s"][3])
    assert lines["wy RMSE deg/"][3:6] == ["-", "-", "-"]


def test_gains_alone_make_a_model_of_the_wrong_scale_better_and_leave_a_right_one_alone(adapt, folder, tmp_path):
    """Without updates the result is the start model with its outputs scaled; after a few times nothing is gained."""
    out, again = tmp_path / "mine.safetensors", tmp_path / "again.safetensors"
    arguments = ("--topic", drives.ODOM, *MOUNT)
    code, text, _ = adapt("--out", out, *arguments, updates=0)
    assert (code, out.exists()) == (0, True)
    assert "better: on the held-out pieces the RMSE of v_l falls by" in text
    before, after = bundle.load(folder / "start.safetensors"), bundle.load(out)
    gain = after.scale / before.scale
    torch.testing.assert_close(after.offset, before.offset * gain)
    assert all((one == after.network.state_dict()[name]).all() for name, one in before.network.state_dict().items())
    for _ in range(6):  # one run takes nine tenths of the way, within bounds
        code, text, _ = adapt("--out", again, *arguments, "--start", out, updates=0)
        if code:
            break
        again.replace(out)
    assert code == 1
    assert "not better: on the held-out pieces" in text
    assert "nothing is written; --accept-worse" in text
    assert not again.exists()
    code, _, _ = adapt("--out", again, *arguments, "--start", out, "--force", updates=0)
    assert (code, again.exists()) == (1, False)  # --force only replaces
    code, _, _ = adapt("--out", again, *arguments, "--start", out, "--accept-worse", updates=0)
    assert (code, again.exists()) == (0, True)
    code, _, error = adapt("--out", again, *arguments, updates=0)
    assert code == 2
    assert "the file exists; --force replaces it" in error


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"height": ()}, "does not say the height of its camera"),
        ({"recording": "sim://street?seed=3"}, "never ends: add ?seconds=S"),
        ({"recording": "none.bag"}, "none.bag"),
    ],
)
def test_a_recording_that_cannot_be_learned_from_is_refused(adapt, tmp_path, changes, words):
    code, _, error = adapt("--out", tmp_path / "mine.safetensors", **changes)
    assert code == 2
    assert words in error


def test_what_is_wrong_with_the_truth_is_said_before_anything_is_learned(adapt, drive, folder, tmp_path):
    out, wheel = tmp_path / "mine.safetensors", tmp_path / "wheel.csv"
    t, v = drive.base.t[::50] / 1e6, drive.base.twist[::50, 0]

    def refused(*arguments, **changes):
        code, _, error = adapt("--out", out, *arguments, **changes)
        assert code == 2
        assert not out.exists()
        return error

    def with_rows(*columns):
        np.savetxt(wheel, np.column_stack(columns), delimiter=",", fmt="%.6f")
        return refused("--truth", wheel, *MOUNT)

    assert "--truth-unit ms" in with_rows(t * 1000, v)
    assert "--offset SECONDS" in with_rows(t + 1e6, v)
    assert "s with events and truth are needed" in with_rows(t[:30], v[:30])
    assert "choose the topic" in refused()
    (tmp_path / "extrinsics.yaml").write_text("T_base_camera: [[1, 0, 0, 0], [0, 1, 0, 0]]\n")
    assert "16 numbers" in refused("--topic", drives.ODOM, "--extrinsics", tmp_path / "extrinsics.yaml")
    assert "not both" in refused("--topic", drives.ODOM, "--extrinsics", tmp_path / "extrinsics.yaml", *MOUNT)
    (tmp_path / "file").write_text("")
    code, _, error = adapt("--out", tmp_path / "file" / "mine.safetensors", "--topic", drives.ODOM)
    assert code == 2
    assert "files cannot be written" in error
    events = tmp_path / "events.txt"
    events.write_text("0.0 1 1 1\n0.1 2 2 0\n")
    code, _, error = adapt("--out", out, "--sensor", "24x18", recording=events)
    assert code == 2
    assert "give --calibration FILE" in error
    assert "must end in .safetensors" in adapt("--out", tmp_path / "mine.bin")[2]


def test_a_truth_of_the_opposite_direction_is_refused(run, tmp_path):
    source = "sim://street?seed=20211&seconds=4&camera=pinhole:86x65:75&height=1"
    truth = open_source(source).twists()
    t, position, orientation = drives.poses_of(truth, 20)
    turned = orientation[:, [3, 2, 1, 0]] * [1, 1, -1, -1]  # half a turn about the vertical axis of the camera
    np.savetxt(tmp_path / "poses.txt", np.column_stack([t / 1e6, position, turned]))
    code, _, error = run("adapt", source, "--truth", tmp_path / "poses.txt", "--out", tmp_path / "mine.safetensors")
    assert code == 2
    assert "is the truth in another frame?" in error
