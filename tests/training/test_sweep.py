"""`lidarfw train -m`, with jobs in processes of their own."""

import subprocess
import sys

import pytest

pytest.importorskip("submitit")


def test_a_job_that_fails_in_another_process_fails_the_sweep(tmp_path):
    overrides = ["dataset=synthetic", "init={from: nope.ckpt}", "hydra/launcher=submitit_local", "hydra.sweep.dir=out"]
    command = [sys.executable, "-m", "lidarfw", "train", "-m", *overrides]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "there is no checkpoint nope.ckpt" in done.stderr
    (log,) = tmp_path.glob("out/.submitit/*/*_log.err")
    assert f"{tmp_path}/out/0: there is no checkpoint nope.ckpt" in log.read_text()
