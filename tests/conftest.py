"""One torch thread per test process, as tests run in parallel; the same random numbers and signals in every run."""

import itertools
import multiprocessing
import signal

import pytest
import torch as th
from gymnasium.utils import seeding
from stable_baselines3.common.utils import set_random_seed

th.set_num_threads(1)
# The server of forks imports PyTorch once, and not each worker of a SubprocVecEnv
multiprocessing.set_forkserver_preload(["sb3_reinforce", "stable_baselines3.common.env_util"])


@pytest.fixture(autouse=True)
def same_random_numbers(monkeypatch):
    """Environments and spaces without a seed would take one from the system: a test could fail once in many runs."""
    set_random_seed(0)
    seeds, np_random = itertools.count(), seeding.np_random
    monkeypatch.setattr(seeding, "np_random", lambda seed=None: np_random(next(seeds) if seed is None else seed))


@pytest.fixture(autouse=True)
def as_in_a_terminal():
    """A shell that runs the tests in the background lets them ignore SIGINT."""
    sigint = signal.signal(signal.SIGINT, signal.default_int_handler)
    sigterm = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGINT, sigint)
    signal.signal(signal.SIGTERM, sigterm)
