"""The Zoo's ``train`` and the comparison under torchrun: one folder, one model, one row per evaluation."""

import csv
import subprocess
from pathlib import Path

import pytest
from processes import TORCHRUN

from sb3_reinforce import REINFORCE

COMPARE = Path(__file__).parents[2] / "examples/benchmarks/compare.py"


@pytest.mark.slow
def test_train_in_two_processes_writes_one_folder(tmp_path):
    train = [*TORCHRUN, "-m", "sb3_reinforce.zoo", "train", "--algo", "reinforce", "--env", "CartPole-v1"]
    train += ["-n", "2000", "--eval-freq", "500", "--seed", "-1", "-P", "-f", tmp_path / "logs"]
    done = subprocess.run(train, check=True, capture_output=True, text=True)
    assert done.stdout.count("Saving to") == 1
    assert [path.name for path in (tmp_path / "logs/reinforce").iterdir()] == ["CartPole-v1_1"]
    model = REINFORCE.load(tmp_path / "logs/reinforce/CartPole-v1_1/CartPole-v1.zip")
    # The default entry has eight environments
    assert model.num_timesteps >= 2000 and (tmp_path / "logs/reinforce/CartPole-v1_1/7.monitor.csv").exists()


@pytest.mark.slow
def test_compare_in_two_processes_writes_each_row_once(tmp_path):
    options = ["--tasks", "CartPole-v1", "--algorithms", "reinforce", "a2c", "--seeds", "0", "--timesteps", "1000"]
    compare = [*TORCHRUN, COMPARE, *options, "--final-episodes", "5", "--output", tmp_path / "rows.csv"]
    subprocess.run(compare, check=True, capture_output=True)
    rows = list(csv.DictReader((tmp_path / "rows.csv").open()))
    assert [row["algorithm"] for row in rows if row["evaluation"] == "final"] == ["reinforce", "a2c"]
    assert len({(row["algorithm"], row["evaluation"], row["steps"]) for row in rows}) == len(rows)
