"""The evaluation of one recording as a task for a pool; see `tasks`."""

import functools
import sys
from typing import Literal, NamedTuple

from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import Estimates, estimate_recording
from neurove_core.io.calibration import with_lens
from neurove_core.models import bundle
from neurove_core.sources import open_source
from neurove_protocol.events import Sensor


class EvaluationJob(NamedTuple):
    """What a model and a recording are; the file of the recording must be readable where the task runs."""

    model: bytes  # of the bundle
    refine: bool
    source: str
    sensor: Sensor | None
    topic: str | None
    time_unit: Literal["s", "ms", "us", "ns"] | None
    calibration: str | None
    height_m: float | None
    inertial: bool  # use the inertial samples


def estimates_of(job: EvaluationJob) -> tuple[Estimates, list[str]]:
    """The estimates of a model for a recording, and what its reader could not read."""
    if "torch" in sys.modules:  # a worker is one core
        sys.modules["torch"].set_num_threads(1)
    recording = with_lens(open_source(job.source, job.sensor, job.topic, job.time_unit), job.calibration, job.height_m)
    estimates = estimate_recording(_estimator(job.model, job.refine), recording, inertial=job.inertial)
    return estimates, [f"{recording.name}: {fault}" for fault in recording.faults.found]


@functools.lru_cache(maxsize=1)
def _estimator(model: bytes, refine: bool) -> Estimator:
    estimator = Estimator(bundle.from_bytes(model, "of the task"), refine=refine)
    estimator.warm_up()
    return estimator
