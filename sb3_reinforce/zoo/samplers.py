"""
What Optuna tries, as arguments of the algorithms.

A trial stores the suggested values, such as a power of two; ``train --trial-id`` converts them again.
"""

import optuna
from rl_zoo3.hyperparams_opt import convert_onpolicy_params

from sb3_reinforce.policies.memories import MEMORIES
from sb3_reinforce.zoo.settings import Settings


def sample_reinforce(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Settings) -> Settings:
    """
    Suggest a baseline, a kind of rollout, a kind of step and their settings.

    Configured ``policy_kwargs``, ``reward_to_go`` and ``episodes_per_start`` are replaced.
    """
    return convert_reinforce(suggest_reinforce(trial, n_actions, n_envs))


def sample_reinforce_lstm(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Settings) -> Settings:
    """As ``sample_reinforce``, with a memory."""
    sampled = suggest_reinforce(trial, n_actions, n_envs)
    sampled["memory"] = trial.suggest_categorical("memory", [*MEMORIES])
    sampled["lstm_hidden_size_pow"] = trial.suggest_int("lstm_hidden_size_pow", 4, 8)
    if sampled["baseline"] == "value":
        sampled["enable_critic_lstm"] = trial.suggest_categorical("enable_critic_lstm", [False, True])
    return convert_reinforce_lstm(sampled)


def suggest_reinforce(trial: optuna.Trial, n_actions: int, n_envs: int) -> Settings:
    """The values of a trial of REINFORCE; ``n_actions`` is 0 unless the actions are a Box."""
    sampled: Settings = {
        "baseline": trial.suggest_categorical("baseline", ["value", "leave_one_out", "time_mean", "optimal"]),
        "step": trial.suggest_categorical("step", ["optimizer", "natural"]),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-4, 0.1, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True),
        "ent_coef": trial.suggest_float("ent_coef", 1e-8, 0.1, log=True),
        "net_arch": trial.suggest_categorical("net_arch", ["tiny", "small", "medium"]),
        "activation_fn": trial.suggest_categorical("activation_fn", ["tanh", "relu"]),
    }
    if n_actions > 0:
        sampled["log_std_init"] = trial.suggest_float("log_std_init", -2.0, 1.0)
    if sampled["step"] == "natural":
        sampled["target_kl"] = trial.suggest_float("target_kl", 1e-3, 0.05, log=True)
    else:
        sampled["max_grad_norm"] = trial.suggest_float("max_grad_norm", 0.3, 2.0)
    # Without a critic, an episode that fixed rollouts cut is left out
    if sampled["baseline"] != "value" or trial.suggest_categorical("whole_episodes", [False, True]):
        # Environments without an episode would be stepped, and their steps not used
        low = max(2, (n_envs - 1).bit_length())
        sampled["n_episodes_pow"] = trial.suggest_int("n_episodes_pow", low, low + 4)
    else:
        low, high = (7, 11) if sampled["step"] == "natural" else (3, 9)
        sampled["n_steps_pow"] = trial.suggest_int("n_steps_pow", low, high)
    if sampled["baseline"] == "value":
        sampled["one_minus_gae_lambda"] = trial.suggest_float("one_minus_gae_lambda", 1e-3, 0.2, log=True)
        sampled["batch_size_pow"] = trial.suggest_int("batch_size_pow", 5, 9)
        sampled["n_critic_updates"] = trial.suggest_int("n_critic_updates", 1, 20, log=True)
    return sampled


def convert_reinforce(sampled_params: Settings) -> Settings:
    """Convert the values of a trial to arguments of REINFORCE."""
    arguments: Settings = convert_onpolicy_params({"one_minus_gae_lambda": 0.0, **sampled_params})
    arguments.pop("whole_episodes", None)
    # Set in any case, since a configured value may not go with the sampled ones
    for name in ("n_steps", "n_episodes", "target_kl"):
        arguments.setdefault(name, None)
    arguments |= {"reward_to_go": True, "episodes_per_start": 1}
    if "log_std_init" in arguments:
        arguments["policy_kwargs"]["log_std_init"] = arguments.pop("log_std_init")
    if "n_episodes_pow" in arguments:
        arguments["n_episodes"] = 2 ** arguments.pop("n_episodes_pow")
    return arguments


def convert_reinforce_lstm(sampled_params: Settings) -> Settings:
    """Convert the values of a trial to arguments of RecurrentREINFORCE."""
    values = dict(sampled_params)
    memory: Settings = {name: values.pop(name) for name in ("memory", "enable_critic_lstm") if name in values}
    memory["lstm_hidden_size"] = 2 ** values.pop("lstm_hidden_size_pow")
    arguments = convert_reinforce(values)
    arguments["policy_kwargs"] |= memory
    return arguments


def sample_finite_difference(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Settings) -> Settings:
    """Suggest arguments of FiniteDifference for the configured policy."""
    return convert_finite_difference(
        {
            "estimator": trial.suggest_categorical("estimator", ["central", "forward", "regression"]),
            "n_delta_pow": trial.suggest_int("n_delta_pow", 1, 6),
            "top_fraction": trial.suggest_float("top_fraction", 0.1, 1.0),
            "learning_rate": trial.suggest_float("learning_rate", 1e-3, 0.3, log=True),
            "delta_std": trial.suggest_float("delta_std", 0.01, 0.3, log=True),
            "n_eval_episodes": trial.suggest_int("n_eval_episodes", 1, 4),
        }
    )


def convert_finite_difference(sampled_params: Settings) -> Settings:
    """Convert the values of a trial to arguments of FiniteDifference."""
    arguments = dict(sampled_params)
    arguments["n_delta"] = 2 ** arguments.pop("n_delta_pow")
    best = max(1, round(arguments.pop("top_fraction") * arguments["n_delta"]))
    # Set in any case, since a configured n_top may not go with the sampled estimator
    arguments["n_top"] = best if arguments["estimator"] == "central" else None
    return arguments
