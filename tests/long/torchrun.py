"""Two agents of torchrun with two processes each, one killed: `python -m tests.long.torchrun [--steps 600]`.

The second agent is killed (SIGKILL) after the first checkpoint and started again. The weights are compared with those
of `neurove train --devices 4`, which is not interrupted. It takes minutes and is not part of `make test`.
"""

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from neurove_core.models import bundle
from neurove_core.training.loop import CHECKPOINT
from neurove_core.training.run import checkpoint_step
from tests import tiny
from tests.live.conftest import wait_until

WAIT_S = 1200.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=600)
    args = parser.parse_args()
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = tiny.toml(sequences=4, steps=args.steps, batch=4, checkpoint_s=0, validation_sequences=0)
        (folder / "tiny.toml").write_text(text)
        words = ["-m", "neurove_service.cli", "train", str(folder / "tiny.toml"), "--data", str(folder / "data")]
        words += ["--device", "cpu", "--calibration-sequences", "0", "--out"]
        subprocess.run([sys.executable, *words, str(folder / "whole"), "--devices", "4"], check=True)
        print("uninterrupted run: done", flush=True)

        def agent(*, host: bool) -> subprocess.Popen[bytes]:
            places = ["--nnodes", "2", "--nproc-per-node", "2", "--local-addr", "127.0.0.1", "--max-restarts", "3"]
            meeting = ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-id", f"long-{port}"]
            meeting += ["--rdzv-conf", f"is_host={int(host)}"]
            command = [sys.executable, "-m", "torch.distributed.run", *places, *meeting, *words, str(folder / "parts")]
            return subprocess.Popen(command, env=os.environ | {"TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"})

        first, second = agent(host=True), agent(host=False)
        checkpoint = folder / "parts" / CHECKPOINT
        wait_until(checkpoint.exists, WAIT_S)
        second.send_signal(signal.SIGKILL)
        second.wait()
        print(f"second agent killed at update {checkpoint_step(checkpoint)} of {args.steps}", flush=True)
        again = agent(host=False)
        codes = [first.wait(), again.wait()]
        made = [bundle.load(folder / run / "tiny.safetensors").network.state_dict() for run in ("whole", "parts")]
    equal = all(torch.equal(tensor, made[1][name]) for name, tensor in made[0].items())
    print(f"exit codes of the agents: {codes}; weights {'are equal bit for bit' if equal else 'DIFFER'}")
    return 0 if equal and codes == [0, 0] else 1


if __name__ == "__main__":
    sys.exit(main())
