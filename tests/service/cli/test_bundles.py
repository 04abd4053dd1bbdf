"""neurove bundle: make keys, sign, verify and show bundles; exit code 1: not valid, 2: wrong usage."""

import json
import stat
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch

from neurove_core import models, self_test
from neurove_core.estimator import Estimator
from neurove_core.models import bundle, golden
from neurove_core.models.metadata import BundleLimits, MadeBy, Metadata
from neurove_service.cli import main
from tests.bundles import CONFIG, DATA, ORIGINAL, with_fields, with_tensors

METADATA = Metadata(
    release=3,
    figures={"heldout_re_v_l": 0.188123456},
    made_by=MadeBy(program="neurove train night", seed=5, commit="93cc177", recipe={"steps": 4400}),
    limits=BundleLimits(mean_dv_m_s=1.5),
)


@pytest.fixture
def run(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run("bundle", *arguments)


@pytest.fixture(scope="session")
def bundle_bytes():
    counts = np.random.default_rng(0).poisson(0.3, (4, 4, 8, 10)).astype(np.uint8)
    test = self_test.record(Estimator(ORIGINAL), counts)
    return replace(ORIGINAL, name="night", metadata=METADATA, golden=test).to_bytes()


@pytest.fixture
def signed(run, tmp_path, bundle_bytes):
    """A folder with a signed bundle, its key, and another key."""
    (tmp_path / "night.safetensors").write_bytes(bundle_bytes)
    assert run("keygen")[0] == run("keygen", "--name", "other")[0] == 0
    assert run("sign", "night.safetensors", "--key", "neurove.key")[0] == 0
    return tmp_path


def test_a_public_key_verifies_a_signed_bundle(run, signed):
    code, out, err = run("verify", "night.safetensors", "--trust", "other.pub", "neurove.pub")
    assert (code, err) == (0, "")
    assert "night.safetensors: good: night " in out
    assert "release 3, signed by key " in out
    assert "golden test holds" in out
    found = json.loads(run("verify", "night.safetensors", "--trust", "neurove.pub", "--json")[1])
    assert (found["ok"], found["release"], found["golden"]) == (True, 3, True)


def test_keys_are_private_and_never_overwritten(run, tmp_path):
    code, out, _ = run("keygen", "--out", "keys/mine", "--json")
    made = json.loads(out)
    assert code == 0
    assert stat.S_IMODE((tmp_path / made["private"]).stat().st_mode) == 0o600
    assert "PRIVATE" in (tmp_path / made["private"]).read_text()
    assert "PRIVATE" not in (tmp_path / made["public"]).read_text()
    before = (tmp_path / made["private"]).read_bytes()
    code, _, err = run("keygen", "--out", "keys/mine")
    assert (code, err.count("\n")) == (2, 1)
    assert "never overwritten" in err
    (tmp_path / made["private"]).rename(tmp_path / "elsewhere")
    assert run("keygen", "--out", "keys/mine")[0] == 2
    assert not (tmp_path / made["private"]).exists()
    assert (tmp_path / "elsewhere").read_bytes() == before


def test_keygen_prints_where_the_keys_are_and_their_use(run):
    _, out, _ = run("keygen", "--name", "operator")
    first, private, public = out.splitlines()
    assert first.startswith("key ")
    assert "operator.key: private" in private
    assert "operator.pub: public" in public


def test_signing_sets_the_release_and_replaces_an_earlier_signature(run, signed):
    sign = ("sign", "night.safetensors", "--key", "other.key", "--release", "8", "--allow-downgrade", "--force")
    code, out, _ = run(*sign)
    assert code == 0
    assert "night.safetensors.sig: night " in out
    assert "release 8, downgrade allowed, signed by key " in out
    found = json.loads(run(*sign, "--json")[1])
    assert (found["file"], found["release"], found["allow_downgrade"]) == ("night.safetensors.sig", 8, True)
    assert run("verify", "night.safetensors", "--trust", "other.pub")[0] == 0
    assert run("verify", "night.safetensors", "--trust", "neurove.pub")[0] == 1


def flipped(path):
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("spoil", "reason", "words"),
    [
        (lambda path: path.with_name(path.name + ".sig").unlink(), "unsigned", "no night.safetensors.sig next to it"),
        (flipped, "digest", "another or changed file"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "size", "the signed file has"),
        (lambda path: path.write_bytes(b""), "size", "it has 0 bytes"),
        (lambda path: path.with_name(path.name + ".sig").write_text("{}"), "malformed", "manifest=missing"),
        (lambda path: path.with_name(path.name + ".sig").write_bytes(b" " * 99_999), "too_large", "at most 16384"),
    ],
    ids=range(6),
)
def test_a_bundle_that_no_trusted_key_signed_is_refused_with_a_reason_and_exit_code_1(
    run, signed, spoil, reason, words
):
    spoil(signed / "night.safetensors")
    verify = ("verify", "night.safetensors", "--trust", "neurove.pub")
    code, out, err = run(*verify)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert err.startswith("neurove: model night.safetensors: ")
    assert words in err
    code, out, _ = run(*verify, "--json")
    found = json.loads(out)
    assert (code, found["ok"], found["code"], found["reason"]) == (1, False, "untrusted", reason)


def test_a_key_that_is_not_trusted_is_named(run, signed):
    code, _, err = run("verify", "night.safetensors", "--trust", "other.pub")
    assert code == 1
    assert "is not trusted; trusted: " in err


def test_a_signed_bundle_that_fails_its_golden_test_is_refused(run, signed, bundle_bytes):
    def edit(tensors):
        tensors["golden.twists"] += 1

    (signed / "night.safetensors").write_bytes(with_tensors(edit, bundle_bytes))
    assert run("sign", "night.safetensors", "--key", "neurove.key", "--force")[0] == 0
    code, out, _ = run("verify", "night.safetensors", "--trust", "neurove.pub", "--json")
    assert (code, json.loads(out)["code"]) == (1, "bad_model")
    assert "golden test: window" in json.loads(out)["message"]


def test_a_bundle_without_a_golden_test_is_good_and_the_output_says_so(run, signed):
    (signed / "plain.safetensors").write_bytes(DATA)
    assert run("sign", "plain.safetensors", "--key", "neurove.key")[0] == 0
    assert "it has no golden test" in run("verify", "plain.safetensors", "--trust", "neurove.pub")[1]


BROKEN = {
    "empty": b"",
    "foreign": safetensors.torch.save({"weight": torch.zeros(3)}),
    "text": b"hello, I am no bundle",
    "truncated": DATA[:-100],
    "nan": with_tensors(lambda tensors: tensors["readout.bias"].fill_(float("nan"))),
    "shape": with_tensors(lambda tensors: tensors.update({"readout.bias": torch.zeros(3)})),
    "dtype": with_tensors(lambda tensors: tensors.update({"readout.bias": tensors["readout.bias"].double()})),
    "version": with_fields(lambda fields: fields.update(bundle_version=2)),
    "twice": DATA.replace(b'\\"trained\\":false', b'\\"name\\":\\"abcd\\"', 1),
}


def test_every_broken_file_is_refused_with_its_own_reason_and_is_not_signed(run, signed):
    sentences = set()
    for name, data in BROKEN.items():
        file = signed / "broken.safetensors"
        file.write_bytes(data)
        code, out, err = run("inspect", "broken.safetensors")
        assert (code, out, err.count("\n")) == (1, "", 1), name
        assert err.startswith("neurove: model broken.safetensors: ")
        sentences.add(err)
        assert run("sign", "broken.safetensors", "--key", "neurove.key") == (1, "", err)
        found = json.loads(run("inspect", "broken.safetensors", "--json")[1])
        assert (found["ok"], found["code"]) == (False, "bad_model")
    assert len(sentences) == len(BROKEN)
    assert not (signed / "broken.safetensors.sig").exists()


def test_a_file_above_the_size_cap_is_refused_after_a_partial_read(run, tmp_path, monkeypatch):
    monkeypatch.setattr(bundle, "MAX_BYTES", 1000)
    (tmp_path / "huge.safetensors").write_bytes(DATA)
    code, _, err = run("inspect", "huge.safetensors")
    assert code == 1
    assert "at most 1000 bytes" in err


def test_inspect_prints_the_fields_of_a_bundle(run, signed):
    code, out, err = run("inspect", "night.safetensors", "--trust", "neurove.pub")
    assert (code, err) == (0, "")
    rows = {line[:11].strip(): line[11:] for line in out.partition("tensors\n")[0].splitlines()}
    assert rows["name"] == "night"
    assert rows["release"] == "3"
    assert rows["figures"] == "heldout_re_v_l 0.188123"
    assert rows["made by"] == "program neurove train night, seed 5, commit 93cc177, updates 0, cpu_s 0"
    assert rows["limits"] == "mean_dv_m_s 1.5"
    assert rows["golden"] == "windows 4, tolerance 0.02"
    assert rows["trained"] == "no: its estimates have no meaning"
    assert rows["signature"].startswith("valid, release 3, signed by key ")
    assert "readout.bias" in out


def test_inspect_as_json_has_every_field(run, signed, bundle_bytes):
    found = json.loads(run("inspect", "night.safetensors", "--json")[1])
    assert (found["name"], found["release"], found["size"]) == ("night", 3, len(bundle_bytes))
    assert found["digest"] == bundle.from_bytes(bundle_bytes, "x").digest
    assert found["made_by"]["recipe"] == {"steps": 4400}
    assert found["prime_windows"] == CONFIG.settle_windows
    assert found["golden"] == {"windows": 4, "tolerance": golden.TOLERANCE}
    assert found["tensors"]["readout.bias"] == {"dtype": "float32", "shape": [12], "bytes": 48}
    assert (found["signature"]["state"], found["signature"]["release"]) == ("unchecked", 3)


def test_inspect_shows_the_state_of_the_signature(run, signed):
    inspect = ("inspect", "night.safetensors")
    assert "not checked (give the keys that you trust: --trust PUB), release 3" in run(*inspect)[1]
    assert "is not trusted" in run(*inspect, "--trust", "other.pub")[1]
    code, out, _ = run(*inspect, "--trust", "other.pub", "--json")
    found = json.loads(out)["signature"]
    assert (code, found["state"], found["reason"]) == (1, "refused", "unknown_key")
    (signed / "night.safetensors.sig").unlink()
    code, out, _ = run(*inspect, "--json")
    assert (code, json.loads(out)["signature"]) == (0, {"state": "none"})
    assert "signature  none\n" in run(*inspect)[1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("sign", "gone.safetensors", "--key", "neurove.key"), "gone.safetensors'"),
        (("sign", "night.safetensors", "--key", "gone.key"), "gone.key"),
        (("sign", "night.safetensors", "--key", "neurove.pub"), "it is a public key"),
        (("sign", "night.safetensors", "--key", "night.safetensors"), "not a private key in PEM"),
        (("verify", "gone.safetensors", "--trust", "neurove.pub"), "No such file"),
        (("verify", "night.safetensors", "--trust", "gone.pub"), "gone.pub"),
        (("verify", "night.safetensors", "--trust", "neurove.key"), "it is a private key"),
        (("verify", "folder", "--trust", "neurove.pub"), "Is a directory"),
        (("inspect", "odd.safetensors"), "odd.safetensors.sig"),
        (("sign", "odd.safetensors", "--key", "neurove.key"), "odd.safetensors.sig"),
        (("keygen", "--out", "neurove.key/below"), "Not a directory"),
    ],
    ids=range(11),
)
def test_wrong_usage_is_one_line_and_exit_code_2(run, signed, arguments, words):
    (signed / "folder").mkdir()
    (signed / "odd.safetensors").write_bytes(DATA)
    (signed / "odd.safetensors.sig").mkdir()
    code, out, err = run(*arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("neurove: ")
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("sign", "x", "--key", "k", "--release", "-1"), "whole number from 0"),
        (("sign", "x", "--key", "k", "--release", "two"), "whole number from 0"),
        (("sign", "x"), "--key"),
        (("verify", "x"), "--trust"),
        (("keygen", "--name", "../up"), "without folders"),
        ((), "COMMAND"),
    ],
)
def test_a_wrong_flag_is_explained_with_exit_code_2(capsys, arguments, words):
    with pytest.raises(SystemExit) as raised:
        main.main(["bundle", *arguments])
    assert raised.value.code == 2
    assert words in capsys.readouterr().err


def test_average_writes_a_bundle_and_says_that_it_is_not_calibrated(run, tmp_path):
    files = []
    for number in range(2):
        files.append(tmp_path / f"{number}.safetensors")
        bundle.save(replace(ORIGINAL, name=f"run {number}".replace(" ", "-")), files[-1])
    code, out, _ = run("average", *files, "--out", tmp_path / "mean.safetensors")
    assert code == 0
    assert "not calibrated" in out
    assert bundle.load(tmp_path / "mean.safetensors").provenance.startswith("neurove bundle average of ")
    code, out, _ = run("average", files[0], "--out", tmp_path / "one.safetensors", "--json")
    assert code == 2
    assert not (tmp_path / "one.safetensors").exists()
    code, _, err = run("average", *files, "--out", tmp_path / "mean.safetensors")
    assert (code, "--force replaces it" in err) == (2, True)
    code, out, _ = run("average", *files, "--out", tmp_path / "mean.safetensors", "--json", "--force")
    assert (code, json.loads(out)["ok"]) == (0, True)


def test_scale_writes_a_bundle_with_longer_windows_and_the_same_weights(run, bundle_bytes, tmp_path):
    (tmp_path / "night.safetensors").write_bytes(bundle_bytes)
    code, out, _ = run("scale", "night.safetensors", "--scales", 2, 3, "--bounds", 3, 0.5, "--out", "s.safetensors")
    assert code == 0
    assert "scales 2 3" in out
    made, before = bundle.load(tmp_path / "s.safetensors"), bundle.from_bytes(bundle_bytes, "x")
    assert (made.config.scales, made.config.scale_bounds) == ((2, 3), (3.0, 0.5))
    for name, tensor in before.network.state_dict().items():
        assert torch.equal(made.network.state_dict()[name], tensor)
    assert made.golden is not None
    self_test.check(Estimator(made))
    code, _, _ = run("scale", "s.safetensors", "--scales", "--bounds", 4, 0.5, "--out", "back.safetensors")
    assert code == 0
    assert bundle.load(tmp_path / "back.safetensors").digest == before.digest
    code, _, err = run("scale", "night.safetensors", "--scales", 4, 2, "--out", "no.safetensors")
    assert code == 2
    assert "scales" in err
    assert not (tmp_path / "no.safetensors").exists()


def test_a_built_in_model_is_given_by_its_name(run, tmp_path):
    code, out, _ = run("inspect", "default", "--json")
    assert code == 0
    assert json.loads(out)["digest"] == models.find("default").digest
    assert run("scale", "default", "--scales", 2, "--out", "s.safetensors")[0] == 0
    assert bundle.load(tmp_path / "s.safetensors").config.scales == (2,)
    assert "for slow motion also 2 windows at once" in run("inspect", "s.safetensors")[1]
    code, _, err = run("inspect", "defualt")
    assert code == 2
    assert "defualt" in err


def test_every_built_in_model_has_the_name_of_its_file():
    assert [models.file_of(found.name).stem for found in models.shipped()] == [found.name for found in models.shipped()]
