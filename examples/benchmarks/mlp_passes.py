"""
What does it save to write the chain rule of a plain MLP out?

The critic's loss and gradient, by PyTorch's modules and autograd, and by ``backpropagation``: two layers of 64 units, 4
inputs, one thread. The two take turns; medians of their ratios.

    python examples/benchmarks/mlp_passes.py
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch as th
from torch.nn import functional as F

from sb3_reinforce.policies.backpropagation import squared_error


def seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def ratio(n: int, activation: type[th.nn.Module], rounds: int) -> float:
    """Time of modules and autograd over that of the written-out chain rule, for n observations."""
    net = th.nn.Sequential(
        th.nn.Linear(4, 64), activation(), th.nn.Linear(64, 64), activation(), th.nn.Linear(64, 1)
    )  # fmt: skip
    layers, parameters, obs, returns = list(net), list(net.parameters()), th.randn(n, 4), th.randn(n)

    def by_autograd() -> object:
        return th.autograd.grad(F.mse_loss(net(obs).flatten(), returns), parameters)

    def written_out() -> object:
        return squared_error(layers, parameters, obs, returns)

    return statistics.median(seconds(by_autograd) / seconds(written_out) for _ in range(rounds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-obs", type=int, nargs="+", default=[64, 256, 2048])
    parser.add_argument("--rounds", type=int, default=500)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    for n in arguments.n_obs:
        for activation in (th.nn.Tanh, th.nn.ReLU):
            print(f"{n:5d} observations, {activation.__name__}: {ratio(n, activation, arguments.rounds):.2f}")


if __name__ == "__main__":
    main()
