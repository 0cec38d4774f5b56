"""What is trained is read from the policy at each step, also from one that was replaced, frozen or changed."""

import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Corridor
from gymnasium import spaces
from models import Experts, Normalized, Scaled, all_kinds, both_extents, make, moved_by_learning, plain
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce.diagnostics import PitfallCallback, check_gradient, compare_baselines
from sb3_reinforce.recurrent import RecurrentREINFORCE


@all_kinds
def test_a_policy_that_is_replaced_or_frozen_after_construction(kind):
    """As in A2C: what is trained is read from the policy at each step."""
    model, other = make(kind), make(kind)
    model.policy = other.policy
    names = {name for name, _ in model.policy.named_parameters()}
    assert moved_by_learning(model, 64) == {name for name in names if kind == "steps" or "value_net" not in name}
    model.policy.mlp_extractor.requires_grad_(False)
    moved = moved_by_learning(model, 64)
    assert "action_net.weight" in moved and not any("mlp_extractor" in name for name in moved)


@pytest.mark.parametrize("change", [{"n_episodes": 8}, {"baseline": "value"}], ids=str)
def test_the_current_rollout_is_trained_on_with_the_arguments_it_was_collected_with(change):
    """And what a callback sets at its end waits for the next one."""
    ends, frozen = [], {"n_episodes": 4, "normalize_by": "episodes", "max_grad_norm": None, "seed": 0}
    for values in ({}, change):
        model = make("episodes", make_vec_env(lambda: Corridor((3, 4)), 2, seed=0), **frozen)
        model.learn(1, callback=Record(lambda model, values=values: vars(model).update(values)))
        ends.append(model.policy.state_dict())
    assert plain(ends[0]) == plain(ends[1])
    assert ("value_net.weight" in moved_by_learning(model, 1)) == ("baseline" in change)


@pytest.mark.parametrize("step", ["optimizer", "natural"])
@pytest.mark.parametrize("share", [True, False])
def test_a_network_may_use_a_part_of_itself_in_each_rollout(share, step):
    kwargs = {"net_arch": [4], "features_extractor_class": Experts, "share_features_extractor": share}
    env = Corridor((2,), lambda t, action: float(action) + t)
    model = make("steps", env, n_steps=1, step=step, seed=0, policy_kwargs=kwargs)
    experts = {name for name, _ in model.policy.named_parameters() if "experts" in name}
    assert experts and experts <= moved_by_learning(model, 16)


class HeadsOnly(ActorCriticPolicy):
    """Leaves all layers but the last ones out of its optimizer, for example pretrained ones."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        heads = [{"params": head.parameters()} for head in (self.action_net, self.value_net)]
        self.optimizer = self.optimizer_class(heads, lr=lr_schedule(1), **self.optimizer_kwargs)


@pytest.mark.parametrize(
    ("kind", "kwargs"),
    [
        ("steps", {}),
        ("steps", {"step": "natural"}),
        ("episodes", {}),
        ("episodes", {"step": "natural"}),
    ],
)
def test_what_the_optimizer_does_not_hold_is_not_trained(kind, kwargs):
    """As in A2C."""
    moved = moved_by_learning(make(kind, policy=HeadsOnly, **kwargs), 64)
    heads = ("action_net", "value_net") if kind == "steps" else ("action_net",)
    assert moved == {f"{head}.{name}" for head in heads for name in ("weight", "bias")}


def test_what_the_optimizer_does_not_hold_is_not_searched():
    model = make("search", policy=HeadsOnly)
    assert model.n_parameters == sum(parameter.numel() for parameter in model.policy.action_net.parameters())
    assert moved_by_learning(model, 64) == {"action_net.weight", "action_net.bias"}


class CriticOfAll(ActorCriticPolicy):
    """V depends on all experts at each step."""

    def evaluate_actions(self, obs, actions):
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        return values + self.sum_of_all(), log_prob, entropy

    def predict_values(self, obs):
        return super().predict_values(obs) + self.sum_of_all()

    def sum_of_all(self):
        return sum(parameter.sum() for parameter in self.features_extractor.parameters())


def test_the_critics_passes_leave_a_shared_extractor_alone_whatever_part_the_actor_uses():
    kwargs = {"net_arch": [4], "features_extractor_class": Experts}
    rates = {"learning_rate": 0.0, "critic_learning_rate": 0.1}
    model = make("steps", Corridor((2,)), CriticOfAll, n_steps=1, seed=0, policy_kwargs=kwargs, **rates)
    moved = moved_by_learning(model, 8)
    assert moved and all("value_net" in name for name in moved)


class Noisy(th.nn.Linear):
    """A layer whose noise has a scale that is learned, and acts in training mode only (Fortunato et al., 2018)."""

    def __init__(self, n_in, n_out):
        super().__init__(n_in, n_out)
        self.scale = th.nn.Parameter(th.full((n_out,), 0.1))

    def forward(self, x):
        y = super().forward(x)
        return y + self.scale * th.randn_like(y) if self.training else y


class NoisyHeads(ActorCriticPolicy):
    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.action_net = Noisy(4, 2)
        self.value_net = Noisy(4, 1)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


@pytest.mark.parametrize("share", [True, False])
def test_noise_that_acts_in_training_mode_only_is_trained(share):
    """As in A2C."""
    kwargs = {"net_arch": [4], "features_extractor_class": Scaled, "share_features_extractor": share}
    model = make("steps", policy=NoisyHeads, policy_kwargs=kwargs)
    assert {"action_net.scale", "value_net.scale"} <= moved_by_learning(model, 64)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")
@pytest.mark.parametrize(
    ("part", "kwargs"),
    [
        pytest.param("mlp_extractor", {}, marks=pytest.mark.slow),
        pytest.param("mlp_extractor", {"step": "natural"}, marks=pytest.mark.slow),
        ("mlp_extractor", {"step": "natural", "baseline": "leave_one_out", "n_steps": None}),
        pytest.param("action_net", {"step": "natural"}, marks=pytest.mark.slow),
        ("evaluate_actions", {}),
        pytest.param("evaluate_actions", {"step": "natural"}, marks=pytest.mark.slow),
        pytest.param("evaluate_actions", {"baseline": "optimal", "n_steps": None}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_compiled_part_is_trained_like_the_part_itself(part, kwargs):
    # PyTorch stops compiling after a number of versions in one process
    th.compiler.reset()
    ends = []
    for is_compiled in (False, True):
        model = make("steps", seed=0, **{"n_steps": 32, **kwargs})
        if is_compiled:
            setattr(model.policy, part, th.compile(getattr(model.policy, part), backend="aot_eager"))
        ends.append([*model.learn(256).policy.parameters()])
    th.testing.assert_close(*ends)


def test_a_compiled_memory_is_trained_like_the_memory_itself():
    th.compiler.reset()
    ends = []
    for is_compiled in (False, True):
        model = RecurrentREINFORCE("MlpLstmPolicy", "CartPole-v1", n_steps=32, seed=0, policy_kwargs={"net_arch": [4]})
        if is_compiled:
            model.policy.lstm_actor = th.compile(model.policy.lstm_actor, backend="aot_eager")
        ends.append([*model.learn(64).policy.parameters()])
    th.testing.assert_close(*ends)


def test_a_batch_may_use_no_trained_parameter():
    """Those of the other expert are all that is trained."""
    kwargs = {"net_arch": [], "features_extractor_class": Experts, "share_features_extractor": False}
    model = make("steps", Corridor((2,), lambda t, action: float(action)), n_steps=1, seed=0, policy_kwargs=kwargs)
    model.policy.requires_grad_(False)
    for extractor in (model.policy.pi_features_extractor, model.policy.vf_features_extractor):
        extractor.experts[0].requires_grad_(True)
    parts = {name.split(".")[0] for name in moved_by_learning(model, 8)}
    assert parts == {"features_extractor", "vf_features_extractor"}


def test_a_baseline_that_is_set_within_a_rollout_counts_from_the_next_one():
    critics = Record(lambda model: model.rollout.values is not None)
    change = At(2, lambda model: setattr(model, "baseline", "value"))
    make("episodes", Corridor((4,)), n_episodes=1).learn(12, [change, critics])
    assert critics.records == [False, True, True]


def test_a_critic_warms_up_while_the_actor_is_frozen():
    """As A2C allows."""
    model = make("steps")
    for module in (model.policy.mlp_extractor.policy_net, model.policy.action_net):
        module.requires_grad_(False)
    moved = moved_by_learning(model, 16)
    assert "value_net.weight" in moved and all("value_net" in name for name in moved)
    assert model.logger.name_to_value["train/grad_norm"] == model.logger.name_to_value["train/kl"] == 0


def test_a_frozen_critic_has_the_loss_of_its_values():
    kwargs = {"net_arch": [4], "features_extractor_class": Normalized, "share_features_extractor": False}
    model = make("steps", policy_kwargs=kwargs)
    model.policy.requires_grad_(False)
    model.policy.action_net.requires_grad_(True)
    model.learn(16)
    errors = model.rollout.returns - model.rollout.values
    assert model.logger.name_to_value["train/value_loss"] == pytest.approx(float((errors**2).mean()), rel=1e-5)
    assert model.policy.vf_features_extractor.norm.num_batches_tracked == 0


class Exponential(th.nn.Module):
    def forward(self, x):
        return x.exp()


def parametrize_log_std(policy):
    th.nn.utils.parametrize.register_parametrization(policy, "log_std", Exponential())


def share_log_std(policy):
    policy.log_std = th.nn.Parameter(th.zeros(1))


@pytest.mark.parametrize("change", [parametrize_log_std, share_log_std])
def test_a_log_std_of_another_form(change):
    class Changed(ActorCriticPolicy):
        def _build(self, lr_schedule):
            super()._build(lr_schedule)
            change(self)
            self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    env = make_vec_env(lambda: Corridor((3, 4), lambda t, action: float(t), spaces.Box(-1, 1, (2,))), 2, seed=0)
    kwargs = {"optimizer_class": th.optim.SGD, "net_arch": [4]}
    model = make("episodes", env, Changed, n_episodes=4, baseline="optimal", seed=0, policy_kwargs=kwargs).learn(40)
    assert check_gradient(model).passed
    assert compare_baselines(model, n_episodes=10)["optimal"].variance.value > 0


class ConstantCritic(ActorCriticPolicy):
    def predict_values(self, obs):
        return th.zeros(len(obs), 1)


def test_a_critic_without_parameters():
    model = make("steps", policy=ConstantCritic).learn(32)
    assert model._n_updates == 4 and (model.rollout_buffer.values == 0).all()


@pytest.mark.parametrize(("n_critic_updates", "batch_size", "n_passes"), [(1, 64, 1), (3, 64, 3), (2, 5, 6), (2, 4, 8)])
def test_one_policy_step_per_rollout_and_the_critics_in_minibatches(n_critic_updates, batch_size, n_passes):
    model = make("steps", n_steps=16, n_critic_updates=n_critic_updates, batch_size=batch_size)
    steps = {model.policy.optimizer: [], model.critic_optimizer: []}
    for optimizer in steps:
        optimizer.register_step_pre_hook(lambda optimizer, *args: steps[optimizer].append(model.num_timesteps))
    model.learn(32)
    assert list(steps.values()) == [[16, 32], [16] * n_passes + [32] * n_passes]


def test_a_callback_finds_the_gradients_of_the_last_update():
    model = make("steps", seed=0, max_grad_norm=None)
    norms = Record(lambda model: [p.grad is not None for p in model.policy.parameters()], "rollout_start")
    model.learn(16, norms)
    assert not any(norms.records[0]) and all(norms.records[1])
    actor = [p.grad for name, p in model.policy.named_parameters() if "value_net" not in name]
    norm = float(th.cat([gradient.flatten() for gradient in actor]).norm())
    assert norm == pytest.approx(model.logger.name_to_value["train/grad_norm"], rel=1e-5)


@pytest.mark.parametrize("policy", ["MlpPolicy", HeadsOnly])
def test_the_critic_trains_a_shared_extractor_that_was_frozen_at_first(policy):
    ends = []
    for vf_coef in (0.0, 0.25):
        kwargs = {"features_extractor_class": Scaled, "net_arch": [4]}
        model = make("steps", policy=policy, vf_coef=vf_coef, max_grad_norm=None, policy_kwargs=kwargs, seed=0)
        scale = model.policy.features_extractor.scale.requires_grad_(policy is HeadsOnly)
        model.learn(8)
        if policy is HeadsOnly:
            model.policy.optimizer.add_param_group({"params": [scale]})
        scale.requires_grad_()
        model.learn(8, reset_num_timesteps=False)
        ends.append(scale.grad)
    assert not th.allclose(*ends)


@pytest.mark.parametrize(("kind", "kwargs"), [("steps", {}), ("episodes", {"step": "natural"})])
def test_an_optimizer_of_the_critic_alone_trains_no_actor(kind, kwargs):
    model = make(kind, **kwargs)
    model.policy.optimizer = th.optim.Adam(model.policy.value_net.parameters())
    assert "action_net.weight" not in moved_by_learning(model, 32)
    model.learn(32, PitfallCallback())
    with pytest.raises(ValueError, match=r"held by policy\.optimizer"):
        check_gradient(model)


def test_each_pass_of_the_critic_draws_all_steps_in_a_new_order():
    """A last minibatch of one step, which BatchNorm does not take, joins the one before."""
    model = make("steps", Corridor((41,)), n_steps=41, n_critic_updates=2, batch_size=8, seed=0)
    seen = []
    network = model.policy.mlp_extractor.value_net
    network.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0].argmax(1)))
    model.learn(41)
    minibatches = [steps for steps in seen if len(steps) in (8, 9)]
    assert [len(steps) for steps in minibatches] == [8, 8, 8, 8, 9] * 2
    first, second = (th.cat(minibatches[i : i + 5]).tolist() for i in (0, 5))
    assert sorted(first) == sorted(second) == list(range(41))
    assert first != second and list(range(41)) not in (first, second)


class MeanEntropy(ActorCriticPolicy):
    def evaluate_actions(self, obs, actions):
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        return values, log_prob, entropy.mean()


class Entropies(ActorCriticPolicy):
    def evaluate_actions(self, obs, actions):
        return super().evaluate_actions(obs, actions)


def test_a_policy_may_return_the_mean_entropy():
    norms = []
    for policy in (MeanEntropy, Entropies):
        model = make("steps", policy=policy, ent_coef=5.0, seed=0)
        # A uniform policy has no gradient of the entropy
        model.policy.action_net.bias.data[0] = 2.0
        norms.append(model.learn(8).logger.name_to_value["train/grad_norm"])
    assert norms[0] == pytest.approx(norms[1])


@both_extents
def test_environments_that_a_callback_sets_at_the_start_of_a_rollout_are_used_in_it(kind):
    env, other = (make_vec_env(lambda: Corridor((3, 9)), 2) for _ in range(2))
    switch = Record(lambda model: model.num_timesteps and model.env is env and model.set_env(other), "rollout_start")
    used = Record(lambda model: (used.locals["env"] is model.env, model.env is other), "step")
    make(kind, env).learn(100, [switch, used])
    assert all(is_own for is_own, _ in used.records) and used.records[-1] == (True, True)


@pytest.mark.parametrize("kind", ["steps", "episodes", "memory"])
def test_environments_that_a_callback_sets_within_a_rollout_are_reset_before_the_next(kind):
    """The observation of a Corridor is its timestep, so the two are equal after a reset."""
    env, other = (make_vec_env(lambda: Corridor((5,)), 2) for _ in range(2))
    other.reset()
    other.step(np.zeros(2, dtype=int))
    model = RecurrentREINFORCE("MlpLstmPolicy", env, n_steps=8, device="cpu") if kind == "memory" else make(kind, env)
    met = Record(lambda model: (model.rollout.timesteps, model.rollout.observations.argmax(-1)))
    model.learn(60, [At(3, lambda model: model.set_env(other)), met])
    assert model.env is other and len(met.records) > 2
    assert all(timesteps.equal(obs) for timesteps, obs in met.records)


def test_the_logged_loss_of_the_critic_is_the_mean_over_its_minibatches():
    """A critic that stands still has the loss of the whole rollout."""
    model = make("steps", n_steps=8, batch_size=4, critic_learning_rate=0.0, seed=0).learn(8)
    buffer = model.rollout_buffer
    loss = float(((buffer.returns - buffer.values) ** 2).mean())
    assert model.logger.name_to_value["train/value_loss"] == pytest.approx(loss, rel=1e-4)
