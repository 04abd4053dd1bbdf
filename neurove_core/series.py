"""Series of simulated recordings: the same simulation with one seed after the other, each a task for a pool.

The name of a file has a digest of its simulation, so a file that is there is not simulated again.
"""

import hashlib
import json
import tempfile
import urllib.parse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from neurove_core.files import write_atomically
from neurove_core.io.formats.packet_log.writer import write_mcap
from neurove_core.sources import open_source
from neurove_core.tasks import HERE, Pool

FORMAT: Final = 1
"""Version of what the simulator makes of the same values; it is part of the digest."""


def file_name(scene: str, seed: int, values: Mapping[str, object]) -> str:
    """Name of the file of a simulation.

    >>> file_name("street", 7, {"seconds": 2.0})
    'street-7-93fd17c1.mcap'
    """
    kind = json.dumps([FORMAT, scene, seed, {name: str(value) for name, value in values.items()}], sort_keys=True)
    return f"{scene}-{seed}-{hashlib.sha256(kind.encode()).hexdigest()[:8]}.mcap"


def simulate(
    scene: str, seeds: range, values: Mapping[str, object], folder: Path, pool: Pool = HERE
) -> Iterator[tuple[Path, bool]]:
    """Simulate the recordings that are missing in a folder, as packet logs with their truth.

    Args:
        scene: see `sources.open_source`.
        seeds: one recording each.
        values: of the query of a source `sim://`, without its seed.
        folder: must exist.
        pool: where the simulations run.

    Yields:
        each file when it is there, and whether it was simulated now.

    Raises:
        InvalidField: the scene or a value is wrong; checked before anything is simulated.
        FailedTasks: some recordings could not be simulated; all others are there.
    """
    sources = {seed: f"sim://{scene}?{urllib.parse.urlencode({**values, 'seed': seed})}" for seed in seeds}
    for source in sources.values():
        open_source(source)
    paths = {seed: folder / file_name(scene, seed, values) for seed in seeds}
    yield from ((path, False) for path in paths.values() if path.exists())
    jobs = {f"{scene} seed {seed}": seed for seed in seeds if not paths[seed].exists()}
    for name, content in pool.run(_recorded, {name: sources[seed] for name, seed in jobs.items()}):
        path = paths[jobs[name]]
        write_atomically(path, content)
        yield path, True


def _recorded(source: str) -> bytes:
    """The content of the packet log of a simulation."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "simulated.mcap")
        write_mcap(open_source(source), path)
        return path.read_bytes()
