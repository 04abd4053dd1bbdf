"""One thread and bounded property tests: a run depends neither on the machine's cores nor, in CI, on chance."""

import os

import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("dev", max_examples=25, deadline=None)
settings.register_profile("ci", max_examples=50, deadline=None, derandomize=True, database=None)
settings.load_profile("ci" if os.environ.get("CI") else "dev")
