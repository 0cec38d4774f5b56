"""
What does comparing all baselines cost, in plain backward passes over the same episodes?

A plain pass is the loop that one would write: for each of 100 CartPole-v1 episodes a forward pass, log π, and
``backward()``. Ratios, each of two runs next to each other, as CSV; on one thread, for an MlpPolicy before training and
after, when its episodes last 500 steps.

    OMP_NUM_THREADS=1 python examples/benchmarks/comparison_cost.py > comparison_cost.csv
"""

import argparse
import csv
import sys
import time
from statistics import median

import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.diagnostics import sample
from sb3_reinforce.diagnostics.baseline_comparison import baseline_rows, compare_baselines, functions_of
from sb3_reinforce.diagnostics.tables import resample_counts
from sb3_reinforce.estimation.baselines import BASELINES
from sb3_reinforce.policies.evaluation import log_prob_of

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--timesteps", type=int, default=60_000)
parser.add_argument("--repetitions", type=int, default=11)
arguments = parser.parse_args()
th.set_num_threads(1)


def seconds(function):
    """Processor time of a call, which other programs on the machine lengthen less than the time on the clock."""
    begin = time.process_time()
    function()
    return time.process_time() - begin


def plain_passes(rollout):
    """The loop over episodes; that they lie ready is not part of its time."""
    episodes = []
    for number in rollout.used_episodes:
        steps = rollout.used & (rollout.episodes == number)
        actions = as_policy_actions(rollout.actions[steps], rollout.policy.action_space)
        episodes.append((rollout.observations[steps], actions, rollout.returns[steps].float()))

    def run():
        for obs, actions, returns in episodes:
            rollout.policy.optimizer.zero_grad()
            (log_prob_of(rollout.policy, obs, actions) * returns).sum().backward()

    return run


writer = csv.writer(sys.stdout, lineterminator="\n")
writer.writerow(["timesteps", "steps", "what", "median", "least", "greatest"])
for timesteps in (0, arguments.timesteps):
    env = make_vec_env("CartPole-v1", 8, seed=arguments.seed)
    model = REINFORCE("MlpPolicy", env, seed=arguments.seed, device="cpu")
    if timesteps:
        model.learn(timesteps)
    rollout, functions, counts = sample(model, 100), functions_of(BASELINES), resample_counts(100, 500, 0)
    ways = {
        "collecting the episodes alone": lambda model=model: sample(model, 100),
        "without collecting": lambda r=rollout, f=functions, c=counts: baseline_rows(r, f, "none", c, 0.95),
        "with collecting": lambda model=model: compare_baselines(model, 100),
    }
    plain = plain_passes(rollout)
    for name, way in ways.items():
        ratios = [seconds(way) / seconds(plain) for _ in range(arguments.repetitions)]
        figures = (f"{figure:.2f}" for figure in (median(ratios), min(ratios), max(ratios)))
        writer.writerow([timesteps, int(rollout.used.sum()), name, *figures])
