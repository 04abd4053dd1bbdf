"""Processes in which some packages cannot be imported, as if they were not installed."""

import os
import sys

_HOOK = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Refuse())
"""


def environment(folder, names):
    """The environment of such a process.

    Args:
        folder: an empty one, which must stay while the process runs.
        names: of the top-level packages.
    """
    (folder / "sitecustomize.py").write_text(_HOOK.format(names=set(names)))
    return {"PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}
