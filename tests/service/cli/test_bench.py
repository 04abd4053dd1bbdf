"""neurove bench: rows as text and as JSON; unknown benchmarks are refused."""

import json

import pytest

from neurove_service.cli.main import main


def test_bench_as_json_is_a_list_of_rows_and_names_the_machine(capsys):
    assert main(["bench", "ingest", "decode", "--quick", "--json"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert set(found[0]) == {"name", "ours_ms", "peer", "peer_ms", "ratio", "share_of_limit", "equal", "deviation"}
    assert all(row["equal"] for row in found)
    assert "commit" in err


def test_bench_for_people_is_a_sentence_per_row_and_a_chart(capsys, tmp_path):
    assert main(["bench", "streams", "--quick", "--plot", str(tmp_path / "speed.png")]) == 0
    out, _ = capsys.readouterr()
    assert "times as fast as one stream" in out
    assert {path.name for path in tmp_path.iterdir()} == {"speed.png", "speed.svg"}


def test_peers_that_are_not_installed_are_named(capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "faery", None)  # as if it were not installed
    assert main(["bench", "decode", "--quick", "--peers"]) == 0
    assert "faery" in capsys.readouterr().err


def test_packets_over_a_real_link_are_counted_as_numpy_counts_them(capsys):
    assert main(["bench", "wire", "--quick", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["peer"] == "receive and frombuffer"
    assert row["equal"]


def test_windows_are_the_same_with_metrics(capsys):
    assert main(["bench", "metrics", "--quick", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["peer"], row["equal"]) == ("no metrics", True)


def test_avx2_alone_gives_equal_answers(capsys):
    assert main(["bench", "narrow", "--quick", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert all(row["name"].endswith("AVX2 at most") for row in found)
    assert {row["equal"] for row in found if row["peer"] == "PyTorch, plain"} == {True}
    assert False not in {row["equal"] for row in found}  # int8 rounds by design, so it is not compared with float32


def test_a_processor_that_is_not_x86_has_no_narrow_row(capsys, monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert main(["bench", "narrow", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == []
    assert "aarch64" in err


def test_an_unknown_benchmark_is_refused(capsys):
    with pytest.raises(SystemExit) as refused:
        main(["bench", "cooking"])
    assert refused.value.code == 2
    assert "cooking" in capsys.readouterr().err


def test_the_table_of_figures_follows_the_rows_of_its_benchmarks(capsys):
    assert main(["bench", "figures", "--quick"]) == 0
    rows, _, table = capsys.readouterr().out.partition("\n\n")
    assert all(
        name in rows for name in ("ingest", "as served", "events to estimate", "training step", "wire", "streams")
    )
    found = [line for line in table.splitlines() if line.startswith("| 8 streams per core")]
    assert len(found) == 1
    assert "not measured" not in found[0]
