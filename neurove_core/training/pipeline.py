"""A complete training run, from a configuration to a bundle.

    from pathlib import Path

    from neurove_core.training import config, pipeline

    bundle = pipeline.train(config.load("default"), Path("runs/default"))

The run simulates sequences and splits recordings into windows, trains the network, fits its uncertainty on further
simulated sequences, and writes a bundle with a golden test. `neurove train` calls this function and prints its result.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_core.training import calibration, loop
from neurove_core.training.config import TrainingConfig
from neurove_core.training.data import Cache
from neurove_core.training.ranks import device_of
from neurove_core.training.recorded import RecordedSequences
from neurove_core.training.run import check_start

OnProgress = Callable[[str, int, int, str], None]
"""Called after each step of a task with the task's name, the steps done, the number of steps, and a detail."""


def train(
    config: TrainingConfig,
    out: Path,
    *,
    data: Path | None = None,
    start: Bundle | None = None,
    resume: bool = False,
    devices: int = 1,
    device: str = "cpu",
    workers: int = 1,
    calibration_sequences: int = calibration.SEQUENCES,
    on_progress: OnProgress = lambda *_: None,
) -> Path:
    """Make the sequences of a configuration, train its network, and fit the network's uncertainty.

    Args:
        config: of the run.
        out: folder for the bundle, the checkpoint, run.json and the learning curve.
        data: folder for the sequences; `out / "data"` by default. Sequences in it are not made again.
        start: model whose weights the run begins from; by default the recipe's seed initialises them.
        resume: continue from the checkpoint in `out`, if it exists.
        devices: number of processes that share each batch.
        device: `cpu`, `cuda` or `auto`; see `ranks.device_of`.
        workers: number of processes that simulate.
        calibration_sequences: number of sequences that the uncertainty is fitted on; 0 skips the calibration. Only a
            network of kind `neurove` has an uncertainty.
        on_progress: called after each sequence, recording and segment.

    Returns:
        the path of the bundle.

    Raises:
        BadModel: `start` or the checkpoint does not match the configuration.
        InvalidField: the batch does not split over the devices, a device is missing, a recording cannot be trained on,
            or there are too few calibration sequences.
        BrokenRecording, UnknownSource, MissingGeometry, MissingExtra: a recording cannot be read.
        LostRank: one of the processes ended early.
    """
    if start is not None:
        check_start(start, config)
    device_of(device, devices=devices)  # an error of the arguments is raised before anything is simulated
    data = data or out / "data"
    _fill(config, data, workers, on_progress)

    def trained(progress: loop.Progress) -> None:
        errors = f"{progress.linear_m_s:.3f} m/s {progress.angular_rad_s:.4f} rad/s"
        on_progress("trained", progress.step, progress.steps, errors)

    path = loop.train(
        config, out, data, resume=resume, start=start, devices=devices, device=device, on_progress=trained
    )
    if calibration_sequences and config.model.kind == "neurove":
        calibrate(bundle.load(path), config, data, path, calibration_sequences, workers, on_progress)
    return path


def calibrate(
    model: Bundle,
    config: TrainingConfig,
    data: Path,
    out: Path,
    sequences: int = calibration.SEQUENCES,
    workers: int = 1,
    on_progress: OnProgress = lambda *_: None,
) -> dict[str, Any]:
    """Simulate the missing calibration sequences, fit a model's uncertainty on them, and write the bundle.

    Args:
        model: trained; its linear part is per metre of height.
        config: configuration that trained the model.
        data: folder for the sequences.
        out: file of the bundle to write.
        sequences: how many sequences the uncertainty is fitted on.
        workers: number of processes that simulate.
        on_progress: called after each sequence.

    Returns:
        the coverage of the fitted intervals; see `calibration.Calibration.report`.

    Raises:
        BadModel, InvalidField, BrokenRecording: as `calibration.calibrate`.
    """
    for done, name in enumerate(calibration.fill(config, data, sequences, workers), 1):
        on_progress("simulated to calibrate", done, sequences, name)
    made = calibration.calibrate(model, config, data, sequences)
    bundle.save(made.bundle, out)
    return made.report


def _fill(config: TrainingConfig, folder: Path, workers: int, on_progress: OnProgress) -> None:
    """Make the sequences of the configuration that are not in the folder."""
    cache, wanted = Cache(folder, config), config.data.sequences
    for done, name in enumerate(cache.fill(workers), wanted - len(cache.missing()) + 1):
        on_progress("simulated", done, wanted, name)
    recordings = RecordedSequences(folder, config)
    missing = recordings.missing()
    for done, name in enumerate(recordings.fill(), 1):
        on_progress("split into windows", done, missing, name)
