"""Commands that need no network: what they print, where, and with which exit code."""

import json

import pytest

from neurove_core.experiments import firing
from neurove_core.models import bundle
from neurove_service.cli import main, running


def test_config_show_is_toml_that_serve_reads_back(run, tmp_path, monkeypatch):
    monkeypatch.setenv("NEUROVE_QUEUE_S", "2.5")
    code, out, _ = run("config", "show", "--node", "robot7", "--connect", "tcp/127.0.0.1:1,tcp/127.0.0.1:2")
    file = tmp_path / "neurove.toml"
    file.write_text(out)
    monkeypatch.delenv("NEUROVE_QUEUE_S")
    assert code == 0
    assert run("config", "show", "--config", str(file)) == (0, out, "")


def test_config_show_tells_origins(run):
    assert 'node = "x"  # flag' in run("config", "show", "--origin", "--node", "x")[1]
    told = json.loads(run("config", "show", "--json", "--node", "x")[1])
    assert told["node"] == {"value": "x", "origin": "flag"}
    assert told["queue_s"]["origin"] == "default"


def test_a_new_model_can_be_inspected(run, tmp_path):
    file = tmp_path / "fresh.safetensors"
    code, out, _ = run("model", "new", str(file), "--seed", "3")
    assert code == 0
    assert "untrained" in out
    told = json.loads(run("model", "inspect", str(file), "--json")[1])
    assert (told["name"], told["trained"], told["digest"]) == ("fresh", False, bundle.load(file).digest)
    assert told["config"]["window"]["bins"] == 5


@pytest.mark.parametrize(
    ("arguments", "telling"),
    [
        (("model", "inspect", "nowhere.safetensors"), "No such file"),
        (("model", "new", "model.pt"), "must end in .safetensors"),
        (("model", "new", "no/such/folder/m.safetensors"), "No such file"),
        (("drive", "nowhere.xyz"), "supported are"),
        (("drive", "gopher://x"), "unknown scheme"),
        (("config", "show", "--queue-s", "-1"), "queue_s='-1' (from flag): Input should be greater than 0"),
        (("health", "--connect", "nonsense"), "connect=nonsense"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(run, tmp_path, monkeypatch, arguments, telling):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("neurove: ")
    assert telling in err


@pytest.mark.parametrize(
    ("arguments", "telling"),
    [
        (("drive", "pattern://", "--speed", "0"), "give a factor above 0"),
        (("drive", "pattern://", "--speed", "fast"), "or max"),
        (("drive", "pattern://", "--sensor", "640"), "WIDTHxHEIGHT"),
        (("demo", "--duration", "-3"), "give seconds above 0"),
        (("demo", "--duration", "soon"), "give seconds above 0"),
        ((), "COMMAND"),
        (("fly",), "invalid choice"),
    ],
)
def test_a_wrong_flag_is_explained_with_exit_code_2(capsys, arguments, telling):
    with pytest.raises(SystemExit) as raised:
        main.main(arguments)
    assert raised.value.code == 2
    assert telling in capsys.readouterr().err


def test_control_c_before_a_command_took_over_is_no_traceback(run, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "load", interrupted)
    assert run("config", "show") == (130, "", "")


def test_reproduce_firing_prints_its_table_and_writes_it_beside_the_figure(run, tmp_path):
    pytest.importorskip("matplotlib")
    code, out, err = run("reproduce", "firing", "--out", str(tmp_path))
    assert code == 0
    assert out == (tmp_path / "firing.md").read_text()
    assert sorted(err.splitlines()) == sorted(f"wrote {file}" for file in tmp_path.iterdir())
    assert {file.suffix for file in tmp_path.iterdir()} == {".md", ".json", ".png", ".svg"}


def test_reproduce_firing_for_machines_is_one_json(run, monkeypatch):
    measured = firing.Results(4, {"LIF": {"ou": firing.Rate(0.1, 0.01)}})
    monkeypatch.setattr(firing, "run", lambda seed: measured._replace(seed=seed))
    code, out, err = run("reproduce", "firing", "--json", "--seed", "4")
    assert (code, out, err) == (0, firing.to_json(measured), "")
    assert json.loads(out)["seeds"] == [4, 13]


def test_reproduce_firing_refuses_a_negative_seed(run):
    code, out, err = run("reproduce", "firing", "--seed", "-4")
    assert (code, out, err) == (2, "", "neurove: reproduce firing: seed=-4: must be at least 0\n")


def test_reproduce_repriming_wants_whole_numbers(run, capsys):
    with pytest.raises(SystemExit) as ended:
        run("reproduce", "repriming", "--primed", "8,many")
    assert ended.value.code == 2
    assert "'8,many': whole numbers joined by commas" in capsys.readouterr().err


def test_reproduce_sine_prints_both_tables_and_keeps_what_is_done(run, tmp_path):
    pytest.importorskip("scipy")
    pytest.importorskip("matplotlib")
    code, out, err = run("reproduce", "sine", "--models", "ltc", "--quick", "--out", str(tmp_path))
    assert code == 0
    assert "Table I: " in out
    assert "Table II: " in out
    assert {f"wrote {file}" for file in tmp_path.iterdir()} == set(err.splitlines())
    assert json.loads((tmp_path / "sine.json").read_text())[0]["commit"]
