"""neurove model: keys are made, models signed, checked and shown; exit code 0 is fine, 1 it does not hold, 2 usage."""

import json
import stat
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch

from neurove_core import self_test
from neurove_core.estimator import Estimator
from neurove_core.models import bundle, golden
from neurove_core.models.metadata import BundleLimits, MadeBy, Metadata
from neurove_service.cli import main
from tests.bundles import CONFIG, DATA, ORIGINAL, with_fields, with_tensors

TOLD = Metadata(
    release=3,
    figures={"heldout_re_v_l": 0.188123456},
    made_by=MadeBy(program="neurove train night", seed=5, commit="93cc177", recipe={"steps": 4400}),
    limits=BundleLimits(mean_dv_m_s=1.5),
)


@pytest.fixture
def run(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run("model", *arguments)


@pytest.fixture(scope="session")
def told_bytes():
    counts = np.random.default_rng(0).poisson(0.3, (4, 4, 8, 10)).astype(np.uint8)
    test = self_test.record(Estimator(ORIGINAL), counts)
    return replace(ORIGINAL, name="night", metadata=TOLD, golden=test).to_bytes()


@pytest.fixture
def signed(run, tmp_path, told_bytes):
    """A folder with a signed bundle, its key, and another key."""
    (tmp_path / "night.safetensors").write_bytes(told_bytes)
    assert run("keygen")[0] == run("keygen", "--name", "other")[0] == 0
    assert run("sign", "night.safetensors", "--key", "neurove.key")[0] == 0
    return tmp_path


def test_a_signed_model_is_verified_by_whoever_has_the_public_key(run, signed):
    code, out, err = run("verify", "night.safetensors", "--trust", "other.pub", "neurove.pub")
    assert (code, err) == (0, "")
    assert "night.safetensors: good: night " in out
    assert "release 3, signed by key " in out
    assert "golden test holds" in out
    told = json.loads(run("verify", "night.safetensors", "--trust", "neurove.pub", "--json")[1])
    assert (told["ok"], told["release"], told["golden"]) == (True, 3, True)


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
    (tmp_path / made["private"]).rename(tmp_path / "kept")
    assert run("keygen", "--out", "keys/mine")[0] == 2
    assert not (tmp_path / made["private"]).exists()
    assert (tmp_path / "kept").read_bytes() == before


def test_keygen_says_where_the_keys_are_and_what_they_are_for(run):
    _, out, _ = run("keygen", "--name", "operator")
    first, private, public = out.splitlines()
    assert first.startswith("key ")
    assert "operator.key: private" in private
    assert "operator.pub: public" in public


def test_a_release_is_given_at_signing_and_a_second_signature_takes_the_place_of_the_first(run, signed):
    sign = ("sign", "night.safetensors", "--key", "other.key", "--release", "8", "--allow-downgrade")
    code, out, _ = run(*sign)
    assert code == 0
    assert "night.safetensors.sig: night " in out
    assert "release 8, also after a higher one, signed by key " in out
    told = json.loads(run(*sign, "--json")[1])
    assert (told["file"], told["release"], told["allow_downgrade"]) == ("night.safetensors.sig", 8, True)
    assert run("verify", "night.safetensors", "--trust", "other.pub")[0] == 0
    assert run("verify", "night.safetensors", "--trust", "neurove.pub")[0] == 1


def flipped(path):
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("spoil", "reason", "words"),
    [
        (lambda path: path.with_name(path.name + ".sig").unlink(), "unsigned", "no night.safetensors.sig beside it"),
        (flipped, "digest", "another or changed file"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "size", "the signed file has"),
        (lambda path: path.write_bytes(b""), "size", "it has 0 bytes"),
        (lambda path: path.with_name(path.name + ".sig").write_text("{}"), "malformed", "manifest=missing"),
        (lambda path: path.with_name(path.name + ".sig").write_bytes(b" " * 99_999), "too_large", "at most 16384"),
    ],
    ids=range(6),
)
def test_a_model_that_no_trusted_key_signed_is_refused_with_its_reason_and_exit_code_1(
    run, signed, spoil, reason, words
):
    spoil(signed / "night.safetensors")
    verify = ("verify", "night.safetensors", "--trust", "neurove.pub")
    code, out, err = run(*verify)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert err.startswith("neurove: model night.safetensors: ")
    assert words in err
    code, out, _ = run(*verify, "--json")
    told = json.loads(out)
    assert (code, told["ok"], told["code"], told["reason"]) == (1, False, "untrusted", reason)


def test_a_key_that_is_not_trusted_is_named(run, signed):
    code, _, err = run("verify", "night.safetensors", "--trust", "other.pub")
    assert code == 1
    assert "is not trusted; trusted: " in err


def test_a_signed_model_that_computes_otherwise_here_is_refused(run, signed, told_bytes):
    def edit(tensors):
        tensors["golden.twists"] += 1

    (signed / "night.safetensors").write_bytes(with_tensors(edit, told_bytes))
    assert run("sign", "night.safetensors", "--key", "neurove.key")[0] == 0
    code, out, _ = run("verify", "night.safetensors", "--trust", "neurove.pub", "--json")
    assert (code, json.loads(out)["code"]) == (1, "bad_model")
    assert "golden test: window" in json.loads(out)["message"]


def test_a_model_without_a_golden_test_is_good_and_says_so(run, signed):
    (signed / "plain.safetensors").write_bytes(DATA)
    assert run("sign", "plain.safetensors", "--key", "neurove.key")[0] == 0
    assert "it has no golden test" in run("verify", "plain.safetensors", "--trust", "neurove.pub")[1]


BROKEN = {
    "empty": b"",
    "foreign": safetensors.torch.save({"weight": torch.zeros(3)}),
    "text": b"hello, I am no model at all",
    "truncated": DATA[:-100],
    "nan": with_tensors(lambda tensors: tensors["readout.bias"].fill_(float("nan"))),
    "shape": with_tensors(lambda tensors: tensors.update({"readout.bias": torch.zeros(3)})),
    "dtype": with_tensors(lambda tensors: tensors.update({"readout.bias": tensors["readout.bias"].double()})),
    "version": with_fields(lambda fields: fields.update(bundle_version=2)),
    "twice": DATA.replace(b'\\"trained\\":false', b'\\"name\\":\\"abcd\\"', 1),
}


def test_every_broken_file_is_refused_by_its_own_sentence_and_exit_code_1_and_is_not_signed(run, signed):
    sentences = set()
    for name, data in BROKEN.items():
        file = signed / "broken.safetensors"
        file.write_bytes(data)
        code, out, err = run("inspect", "broken.safetensors")
        assert (code, out, err.count("\n")) == (1, "", 1), name
        assert err.startswith("neurove: model broken.safetensors: ")
        sentences.add(err)
        assert run("sign", "broken.safetensors", "--key", "neurove.key") == (1, "", err)
        told = json.loads(run("inspect", "broken.safetensors", "--json")[1])
        assert (told["ok"], told["code"]) == (False, "bad_model")
    assert len(sentences) == len(BROKEN)
    assert not (signed / "broken.safetensors.sig").exists()


def test_a_file_over_the_cap_is_refused_without_being_read_whole(run, tmp_path, monkeypatch):
    monkeypatch.setattr(bundle, "MAX_BYTES", 1000)
    (tmp_path / "huge.safetensors").write_bytes(DATA)
    code, _, err = run("inspect", "huge.safetensors")
    assert code == 1
    assert "at most 1000 bytes" in err


def test_inspect_tells_people_what_a_bundle_holds(run, signed):
    code, out, err = run("inspect", "night.safetensors", "--trust", "neurove.pub")
    assert (code, err) == (0, "")
    rows = {line[:11].strip(): line[11:] for line in out.partition("tensors\n")[0].splitlines()}
    assert rows["name"] == "night"
    assert rows["release"] == "3"
    assert rows["figures"] == "heldout_re_v_l 0.188123"
    assert rows["made by"] == "program neurove train night, seed 5, commit 93cc177, updates 0, cpu_s 0"
    assert rows["limits"] == "mean_dv_m_s 1.5"
    assert rows["golden"] == "windows 4, tolerance 0.02"
    assert rows["trained"] == "no: its numbers mean nothing"
    assert rows["signature"].startswith("valid, release 3, signed by key ")
    assert "readout.bias" in out


def test_inspect_tells_machines_everything(run, signed, told_bytes):
    told = json.loads(run("inspect", "night.safetensors", "--json")[1])
    assert (told["name"], told["release"], told["size"]) == ("night", 3, len(told_bytes))
    assert told["digest"] == bundle.from_bytes(told_bytes, "x").digest
    assert told["made_by"]["recipe"] == {"steps": 4400}
    assert told["prime_windows"] == CONFIG.settle_windows
    assert told["golden"] == {"windows": 4, "tolerance": golden.TOLERANCE}
    assert told["tensors"]["readout.bias"] == {"dtype": "float32", "shape": [12], "bytes": 48}
    assert (told["signature"]["state"], told["signature"]["release"]) == ("unchecked", 3)


def test_inspect_tells_the_state_of_the_signature(run, signed):
    inspect = ("inspect", "night.safetensors")
    assert "not checked (say whom you trust: --trust PUB), release 3" in run(*inspect)[1]
    assert "is not trusted" in run(*inspect, "--trust", "other.pub")[1]
    code, out, _ = run(*inspect, "--trust", "other.pub", "--json")
    told = json.loads(out)["signature"]
    assert (code, told["state"], told["reason"]) == (1, "refused", "unknown_key")
    (signed / "night.safetensors.sig").unlink()
    code, out, _ = run(*inspect, "--json")
    assert (code, json.loads(out)["signature"]) == (0, {"state": "none"})
    assert "signature  none\n" in run(*inspect)[1]


@pytest.mark.parametrize(
    ("arguments", "telling"),
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
def test_wrong_usage_is_one_line_and_exit_code_2(run, signed, arguments, telling):
    (signed / "folder").mkdir()
    (signed / "odd.safetensors").write_bytes(DATA)
    (signed / "odd.safetensors.sig").mkdir()
    code, out, err = run(*arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("neurove: ")
    assert telling in err


@pytest.mark.parametrize(
    ("arguments", "telling"),
    [
        (("sign", "x", "--key", "k", "--release", "-1"), "whole number from 0"),
        (("sign", "x", "--key", "k", "--release", "two"), "whole number from 0"),
        (("sign", "x"), "--key"),
        (("verify", "x"), "--trust"),
        (("keygen", "--name", "../up"), "without folders"),
        ((), "COMMAND"),
    ],
)
def test_a_wrong_flag_is_explained_with_exit_code_2(capsys, arguments, telling):
    with pytest.raises(SystemExit) as raised:
        main.main(["model", *arguments])
    assert raised.value.code == 2
    assert telling in capsys.readouterr().err


def test_the_command_writes_a_bundle_and_says_that_it_is_not_calibrated(run, tmp_path):
    files = []
    for number in range(2):
        files.append(tmp_path / f"{number}.safetensors")
        bundle.save(replace(ORIGINAL, name=f"run {number}".replace(" ", "-")), files[-1])
    code, out, _ = run("average", *files, "--out", tmp_path / "mean.safetensors")
    assert code == 0
    assert "not calibrated" in out
    assert bundle.load(tmp_path / "mean.safetensors").provenance.startswith("neurove model average of ")
    code, out, _ = run("average", files[0], "--out", tmp_path / "one.safetensors", "--json")
    assert code == 2
    assert not (tmp_path / "one.safetensors").exists()
    code, out, _ = run("average", *files, "--out", tmp_path / "mean.safetensors", "--json")
    assert (code, json.loads(out)["ok"]) == (0, True)
