"""Commands that need no network: their output and exit codes."""

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


def test_config_show_prints_origins(run):
    assert 'node = "x"  # flag' in run("config", "show", "--origin", "--node", "x")[1]
    found = json.loads(run("config", "show", "--json", "--node", "x")[1])
    assert found["node"] == {"value": "x", "origin": "flag"}
    assert found["queue_s"]["origin"] == "default"


def test_a_new_bundle_can_be_inspected(run, tmp_path):
    file = tmp_path / "fresh.safetensors"
    code, out, _ = run("bundle", "new", str(file), "--seed", "3")
    assert code == 0
    assert "untrained" in out
    found = json.loads(run("bundle", "inspect", str(file), "--json")[1])
    assert (found["name"], found["trained"], found["digest"]) == ("fresh", False, bundle.load(file).digest)
    assert found["config"]["window"]["bins"] == 5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("bundle", "inspect", "nowhere.safetensors"), "No such file"),
        (("bundle", "new", "model.pt"), "must end in .safetensors"),
        (("bundle", "new", "no/such/folder/m.safetensors"), "No such file"),
        (("drive", "nowhere.xyz"), "no such file or folder"),
        (("drive", "gopher://x"), "unknown scheme"),
        (("config", "show", "--queue-s", "-1"), "queue_s='-1' (from flag): Input should be greater than 0"),
        (("health", "--connect", "nonsense"), "connect='nonsense' (from flag): 'nonsense' is no endpoint"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(run, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("neurove: ")
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("drive", "pattern://", "--speed", "0"), "give a factor above 0"),
        (("drive", "pattern://", "--speed", "fast"), "or max"),
        (("drive", "pattern://", "--sensor", "640"), "WIDTHxHEIGHT"),
        (("demo", "--seconds", "-3"), "give seconds above 0"),
        (("demo", "--seconds", "soon"), "give seconds above 0"),
        ((), "COMMAND"),
        (("fly",), "unknown command 'fly'"),
    ],
)
def test_a_wrong_flag_is_explained_with_exit_code_2(capsys, arguments, words):
    with pytest.raises(SystemExit) as raised:
        main.main(arguments)
    assert raised.value.code == 2
    assert words in capsys.readouterr().err


def test_control_c_before_a_command_handles_signals_prints_no_traceback(run, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "load", interrupted)
    assert run("config", "show") == (130, "", "")


def test_reproduce_firing_prints_its_table_and_writes_table_and_figure(run, tmp_path):
    pytest.importorskip("matplotlib")
    code, out, err = run("reproduce", "firing", "--out", str(tmp_path))
    assert code == 0
    assert out == (tmp_path / "firing.md").read_text()
    assert sorted(err.splitlines()) == sorted(f"wrote {file}" for file in tmp_path.iterdir())
    assert {file.suffix for file in tmp_path.iterdir()} == {".md", ".json", ".png", ".svg"}


def test_reproduce_firing_prints_json(run, monkeypatch):
    measured = firing.Results(4, {"LIF": {"ou": firing.Rate(0.1, 0.01)}})
    monkeypatch.setattr(firing, "run", lambda seed: measured._replace(seed=seed))
    code, out, err = run("reproduce", "firing", "--json", "--seed", "4")
    assert (code, out, err) == (0, firing.to_json(measured), "")
    assert json.loads(out)["seeds"] == [4, 13]


def test_reproduce_firing_refuses_a_negative_seed(run):
    code, out, err = run("reproduce", "firing", "--seed", "-4")
    assert (code, out, err) == (2, "", "neurove: reproduce firing: seed=-4: must be at least 0\n")


def test_reproduce_repriming_refuses_words_for_numbers(run, capsys):
    with pytest.raises(SystemExit) as ended:
        run("reproduce", "repriming", "--primed", "8,many")
    assert ended.value.code == 2
    assert "'8,many': give whole numbers separated by commas" in capsys.readouterr().err


def test_reproduce_sine_prints_both_tables_and_writes_its_results(run, tmp_path):
    pytest.importorskip("scipy")
    pytest.importorskip("matplotlib")
    code, out, err = run("reproduce", "sine", "--models", "ltc", "--quick", "--out", str(tmp_path))
    assert code == 0
    assert "Table I: " in out
    assert "Table II: " in out
    assert {f"wrote {file}" for file in tmp_path.iterdir()} == set(err.splitlines())
    assert json.loads((tmp_path / "sine.json").read_text())[0]["commit"]


def test_a_bundle_with_a_seed_below_0_is_refused(run, tmp_path):
    with pytest.raises(SystemExit) as ended:
        run("bundle", "new", str(tmp_path / "fresh.safetensors"), "--seed", "-1")
    assert ended.value.code == 2
    assert list(tmp_path.iterdir()) == []
