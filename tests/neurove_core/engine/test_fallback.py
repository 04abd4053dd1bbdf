"""Without numba's private modules, or with changed ones, the dense forms give the same answers with one warning."""

import json
import subprocess
import sys

import numpy as np
import pytest

ANSWER = '''
import builtins, json, logging, sys, types

how = sys.argv[1]
import_module = builtins.__import__

def changed_import(name, globals=None, *rest):
    """Import for the product alone: numba itself keeps what it needs."""
    if not (globals or {}).get("__name__", "").startswith("neurove_core"):
        return import_module(name, globals, *rest)
    if how == "hidden" and name.startswith(("numba.core", "llvmlite")):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    if how == "changed" and name == "numba.core.datamodel":
        return types.SimpleNamespace(models=types.SimpleNamespace())
    return import_module(name, globals, *rest)

builtins.__import__ = changed_import
records = []

class Collect(logging.Handler):
    def emit(self, record):
        records.append(record.getMessage())

logging.getLogger("neurove_core").addHandler(Collect())

from neurove_core import models
from neurove_core.config import ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from tests.builders import SENSOR, make_events

int8 = bundle.untrained(0, ModelConfig(network=NetworkConfig(v_th=0.4, precision="int8")))
answers = []
for model in (models.find("default"), int8):
    for _ in range(2):  # a warning is logged once, however many models are loaded
        estimator = Estimator(model)
    events = make_events(20_000, seed=0, duration_us=300_000)
    result = estimator.push(events, estimator.initial_state(SENSOR), 300_000)
    answers.append([estimate.twists.tolist() for estimate in result.estimates])
print(json.dumps({"answers": answers, "warnings": [one for one in records if "vector code" in one]}))
'''


def answer(how: str) -> dict:
    """Answers of the default model and of an int8 model in a fresh process, and the warnings about vector code."""
    run = subprocess.run([sys.executable, "-c", ANSWER, how], capture_output=True, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def normal() -> dict:
    return answer("normal")


def test_this_numba_compiles_the_vector_code(normal):
    assert normal["warnings"] == []


@pytest.mark.parametrize("how", ["hidden", "changed"])
def test_without_the_private_modules_of_numba_an_estimator_answers_the_same_with_one_warning(how, normal):
    found = answer(how)
    assert len(found["warnings"]) == 1
    assert "fast form off, using the plain form: form=vector code" in found["warnings"][0]
    for got, want in zip(found["answers"], normal["answers"], strict=True):
        assert len(want) == 6
        np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-4)
