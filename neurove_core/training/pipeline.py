"""A complete training run, from a configuration to a bundle.

    from pathlib import Path

    from neurove_core.training import config, pipeline

    bundle = pipeline.train(config.load("default"), Path("runs/default"))

The run simulates sequences and splits recordings into windows, trains the network, fits its uncertainty on further
simulated sequences, and writes a bundle with a golden test. `neurove train` calls this function and prints its result.

A run of several processes calls it in each of them; torchrun starts such a script on one machine or on several:

    from neurove_core.training import joining

    with joining.joined("auto") as ranks:
        pipeline.train(config.load("default"), Path("runs/default"), resume=True, ranks=ranks)
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from neurove_core.files import make_writable
from neurove_core.models import bundle
from neurove_core.models.bounds import UNSET, Bounds
from neurove_core.models.bundle import Bundle
from neurove_core.tasks import HERE, Pool
from neurove_core.training import calibration, loop, validation
from neurove_core.training.config import TrainingConfig
from neurove_core.training.data import Cache, check_names
from neurove_core.training.ranks import ALONE, Ranks
from neurove_core.training.recorded import RecordedSequences
from neurove_core.training.run import TrainingRun, check_split, check_start
from neurove_core.training.validation import Held
from neurove_protocol.errors import InvalidField

OnProgress = Callable[[str, int, int, str], None]
"""Called after each step of a task with the task's name, the steps done, the number of steps, and a detail."""


def train(
    config: TrainingConfig,
    out: Path,
    *,
    data: Path | None = None,
    start: Bundle | None = None,
    resume: bool = False,
    ranks: Ranks = ALONE,
    pool: Pool = HERE,
    calibration_sequences: int = calibration.SEQUENCES,
    on_progress: OnProgress = lambda *_: None,
) -> Path:
    """Make the sequences of a configuration, train its network, and fit the network's uncertainty.

    The end of each recording and a few more simulated scenes are kept for validation; see `validation`. The run stops
    early if they do not improve any more. `run.json` has the curve of both, and sentences about the result.

    Args:
        config: of the run.
        out: folder for the bundle, the checkpoint, run.json and the learning curve.
        data: folder for the sequences; `out / "data"` by default. Sequences in it are not made again.
        start: model whose weights the run begins from; by default the recipe's seed initialises them.
        resume: continue from the checkpoint in `out`, if it exists.
        ranks: this process and the others of the run, which share each batch; see `joining.joined`. The first rank
            writes the results. The machines share the simulation if they share `data`, else each makes all sequences.
        pool: where the sequences are simulated; see `tasks` and `cluster`.
        calibration_sequences: number of sequences that the uncertainty is fitted on; 0 skips the calibration. Only a
            network of kind `neurove` has an uncertainty.
        on_progress: called after each sequence, recording and segment.

    Returns:
        the path of the bundle.

    Raises:
        BadModel: `start` or the checkpoint does not match the configuration.
        InvalidField: the batch does not split over the ranks, another rank has another configuration, a recording
            cannot be trained on, there are too few calibration sequences, a name in the configuration is unknown, or a
            folder cannot be written. All of these are checked before anything is simulated.
        FailedTasks, ClusterError: sequences could not be simulated.
        BrokenRecording, UnknownSource, MissingGeometry, MissingExtra: a recording cannot be read.
        LostRank: one of the processes ended early.
    """
    data = data or out / "data"
    calibrated = calibration_sequences != 0 and config.model.kind == "neurove"
    check(
        config,
        out,
        start,
        resume=resume,
        devices=ranks.count,
        calibration_sequences=calibration_sequences,
    )
    ranks.agree("config", config.model_dump_json())
    recordings = RecordedSequences(data, config)
    for field, folder, mine in (("out", out, ranks.first), ("data", data, ranks.leads)):
        if mine:
            _check_writable(field, folder)
    validating = validation.simulated_config(config) if config.recipe.validation_sequences else None
    for machines in (ranks.machines, 1):  # first its share; then what the other machines have made elsewhere

        def make(machines: int = machines) -> None:
            if ranks.leads:
                own = (ranks.machine % machines, machines)
                _fill(config, data, recordings, pool, on_progress, own)
                if validating:
                    _simulate("simulated to validate", validating, data, pool, on_progress, own)

        ranks.together(make)
    held = None
    if ranks.first:
        simulated = Cache(data, validating).paths() if validating else []
        held = Held.read(recordings.split()[1], simulated, config.recipe, config.model)

    def trained(progress: loop.Progress) -> None:
        errors = f"{progress.linear_m_s:.3f} m/s {progress.angular_rad_s:.4f} rad/s{_validated(progress.validated)}"
        on_progress("trained", progress.step, progress.steps, errors)

    path = loop.train(
        config,
        out,
        data,
        held=None if held == (None, None) else held,
        resume=resume,
        start=start,
        ranks=ranks,
        on_progress=trained,
    )

    def fit() -> None:
        if calibrated and ranks.first:
            calibrate(bundle.load(path), config, data, path, calibration_sequences, pool, on_progress)

    ranks.together(fit)  # the launcher ends only when the first rank has written everything
    return path


def calibrate(
    model: Bundle,
    config: TrainingConfig,
    data: Path,
    out: Path,
    sequences: int = calibration.SEQUENCES,
    pool: Pool = HERE,
    on_progress: OnProgress = lambda *_: None,
    bounds: Bounds = UNSET,
    device: torch.device | None = None,
) -> dict[str, Any]:
    """Simulate the missing calibration sequences, fit a model's uncertainty on them, and write the bundle.

    Args:
        model: trained; its linear part is per metre of height.
        config: configuration that trained the model.
        data: folder for the sequences.
        out: file of the bundle to write.
        sequences: how many sequences the uncertainty is fitted on.
        pool: where the sequences are simulated.
        on_progress: called after each sequence.
        bounds: absolute bounds for the flag `uncertain`; by default those that the model has.
        device: where the network runs in torch; by default the engine runs it.

    Returns:
        the coverage of the fitted intervals; see `calibration.Calibration.report`.

    Raises:
        BadModel, InvalidField, BrokenRecording: as `calibration.calibrate`.
    """
    calibration.check(model, config, sequences)
    _check_writable("out", out.parent)
    for done, name in enumerate(calibration.fill(config, data, sequences, pool), 1):
        on_progress("simulated to calibrate", done, sequences, name)
    made = calibration.calibrate(model, config, data, sequences, bounds, device)
    bundle.save(made.bundle, out)
    return made.report


def check(
    config: TrainingConfig,
    out: Path,
    start: Bundle | None = None,
    *,
    resume: bool = False,
    devices: int = 1,
    calibration_sequences: int = calibration.SEQUENCES,
) -> None:
    """Check the arguments of a run that need no data; see `train`.

    Raises:
        BadModel, InvalidField: as `train`.
    """
    if start is not None:
        check_start(start, config)
    check_split(config, devices)
    check_names(config.data)
    if calibration_sequences != 0 and config.model.kind == "neurove":
        calibration.calibration_sets(config, calibration_sequences)
    if resume and (out / loop.CHECKPOINT).exists():
        TrainingRun.restore(out / loop.CHECKPOINT, config, Ranks(count=devices))


def _check_writable(field: str, folder: Path) -> None:
    try:
        make_writable(folder)
    except OSError as error:
        raise InvalidField(
            "training", field, str(folder), f"files cannot be written: {error.strerror or error}"
        ) from None


def _validated(point: validation.Point | None) -> str:
    """The newest validation, of the set that decides, as text."""
    for name in validation.SETS:
        errors = [(key, value) for key, value in (point or {}).items() if key.startswith(f"{name}_")]
        if errors:
            told = " ".join(
                f"{value:.3f} m/s" if key.endswith("m_s") else f"{value:.4f} rad/s" for key, value in errors
            )
            return f", validation {told}"
    return ""


def _fill(
    config: TrainingConfig,
    folder: Path,
    recordings: RecordedSequences,
    pool: Pool,
    on_progress: OnProgress,
    share: tuple[int, int],
) -> None:
    """Make the sequences of the configuration that are not in the folder; recordings first, as they may be unusable."""
    missing = recordings.missing()
    for done, name in enumerate(recordings.fill(), 1):
        on_progress("split into windows", done, missing, name)
    _simulate("simulated", config, folder, pool, on_progress, share)


def _simulate(
    task: str,
    config: TrainingConfig,
    folder: Path,
    pool: Pool,
    on_progress: OnProgress,
    share: tuple[int, int],
) -> None:
    cache, wanted = Cache(folder, config), config.data.sequences
    for done, name in enumerate(cache.fill(pool, share), wanted - len(cache.missing()) + 1):
        on_progress(task, done, wanted, name)
