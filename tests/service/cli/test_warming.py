import json
import subprocess
import sys

RUN_ALL = """
import sys
from itertools import islice
from neurove_core import models
from neurove_core.compiled import work
from neurove_core.estimator import Estimator
from neurove_core.sources import open_source

estimator = Estimator(models.find("default"), refine=True)
estimator.warm_up()
recording = open_source("sim://corridor?seed=20400&seconds=0.3")
print(len(list(estimator.estimates(recording))), work().compiled, work().loaded)
"""


def test_after_a_warm_up_nothing_that_a_service_or_the_simulator_runs_is_compiled():
    command = [sys.executable, "-m", "neurove_service.cli", "warm-up"]
    first = subprocess.run(command, capture_output=True, text=True, timeout=400, check=True)
    assert "simulation of a street" in first.stderr
    assert "cache: /" in first.stdout
    again = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=200, check=True)
    assert json.loads(again.stdout)["compiled"] == 0
    assert json.loads(again.stdout)["cache"]
    estimates, compiled, loaded = subprocess.run(
        [sys.executable, "-c", RUN_ALL], capture_output=True, text=True, timeout=200, check=True
    ).stdout.split()
    assert int(estimates) > 0
    assert int(compiled) == 0
    assert int(loaded) > 10


def test_an_unknown_model_is_named(run, tmp_path):
    code, _, err = run("warm-up", "--model", tmp_path / "none.safetensors")
    assert code != 0
    assert "none.safetensors" in err


def test_code_for_the_package_has_no_other_folder(run, tmp_path):
    code, _, err = run("warm-up", "--ahead", "--out", tmp_path)
    assert code != 0
    assert "--out" in err
    assert not list(tmp_path.iterdir())
