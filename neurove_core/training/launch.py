"""Start the processes of a distributed run on this machine, through the elastic launcher of torch.

`torchrun` is the same launcher on several machines. It starts all processes again if one ends early.
"""

import os
import sys
import tempfile
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from neurove_core.training.joining import STORE
from neurove_core.training.ranks import LostRank

RESTARTS: Final = 3
"""How often all processes are started again after one of them ended early."""

_NO_SERVER = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"  # otherwise torch opens a port on all interfaces that nobody needs


def launch(devices: int, module: str, words: Sequence[str], restarts: int = RESTARTS) -> int:
    """Run `python -m MODULE WORDS` in several processes that `joining.joined` connects.

    The processes find each other through files and exchange tensors on the loopback, so no port is open to the network.

    Args:
        devices: number of processes.
        module: to run in each process.
        words: its arguments.
        restarts: how often all processes are started again after one of them ended early.

    Returns:
        0, or the exit code of the process that failed first, which has printed its error; 128 plus the number of a
        signal that this process received.

    Raises:
        LostRank: a signal ended a process.
    """
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    try:
        with tempfile.TemporaryDirectory(prefix="neurove-") as folder:
            config = LaunchConfig(
                min_nodes=1,
                max_nodes=1,
                nproc_per_node=devices,
                run_id=uuid.uuid4().hex,
                rdzv_backend="c10d",
                rdzv_endpoint=str(Path(folder) / "launcher"),
                rdzv_configs={"store_type": "file"},
                local_addr="127.0.0.1",
                max_restarts=restarts,
            )
            os.environ |= {STORE: folder, _NO_SERVER: "1"}
            elastic_launch(config, sys.executable)("-m", module, *words)
    except SignalException as ended:
        return 128 + int(ended.sigval)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if failure.exitcode > 0:
            return int(failure.exitcode)
        raise LostRank(rank, f"was ended by signal {-failure.exitcode}") from None
    finally:
        for name in (STORE, _NO_SERVER):
            os.environ.pop(name, None)
    return 0
