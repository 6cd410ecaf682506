"""`python ddp_run.py FOLDER OVERRIDES`: the tiny detector in processes that Lightning starts from the command line.

With LIDARFW_TEST_FAIL_AT=n, process 1 fails at its n-th step.
"""

import os
import sys
from pathlib import Path

import training_parts
from omegaconf import OmegaConf

from lidarfw import registry
from lidarfw.config import compose
from lidarfw.training import PerceptionModule, train

fail_at = int(os.environ.get("LIDARFW_TEST_FAIL_AT", "-1"))
step = PerceptionModule.training_step


def training_step(self, batch, batch_idx):
    if self.global_rank == 1 and self.global_step == fail_at:
        Path(sys.argv[1], "failed").touch()
        raise RuntimeError("process 1 fails")
    return step(self, batch, batch_idx)


PerceptionModule.training_step = training_step
with registry.use(**training_parts.SLOTS):
    config = compose([*training_parts.OVERRIDES, *sys.argv[2:]])
    OmegaConf.set_struct(config, False)
    config.run_dir = sys.argv[1]
    train(config)
