"""A driver needs this package alone: what importing it must not pull in."""

import subprocess
import sys

ASK = """
import importlib, pkgutil, sys
import neurove_protocol
modules = [f"neurove_protocol.{module.name}" for module in pkgutil.iter_modules(neurove_protocol.__path__)]
for module in modules:
    importlib.import_module(module)
print(len(modules), *sorted({name.partition(".")[0] for name in sys.modules}))
"""
FOREIGN = {
    "torch",
    "zenoh",
    "numba",
    "aedat",
    "safetensors",
    "structlog",
    "rich",
    "neurove_service",
    "neurove_core",
    "tests",
}


def test_importing_the_whole_package_pulls_in_neither_network_nor_models() -> None:
    answer = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=True, timeout=60)
    count, *loaded = answer.stdout.split()
    assert int(count) >= 7
    assert {"neurove_protocol", "numpy", "msgpack", "pydantic"} <= set(loaded)
    assert not FOREIGN & set(loaded)
