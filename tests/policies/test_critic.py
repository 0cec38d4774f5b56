"""Where V comes from, and that a features extractor is evaluated no more often than it must be."""

from functools import partial
from itertools import product

import numpy as np
import pytest
import torch as th
from callbacks import At
from environments import Corridor, Random
from gymnasium import spaces
from models import Dropping, Scaled, moved_by_learning
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor

from sb3_reinforce import REINFORCE
from sb3_reinforce.estimation.weights import training_batch
from sb3_reinforce.policies.evaluation import evaluate

N_STEPS, N_ENVS = 7, 3
IMAGES = partial(Random, spaces.Box(0, 255, (36, 36, 3), np.uint8), lengths=(10,))
MODES = [{"baseline": "value", "n_steps": 10}, {"baseline": "none", "n_steps": None, "n_episodes": N_ENVS}]


def overriding(policy_class):
    """The same policy with a ``predict_values`` of the user, which computes the same."""

    class Own(policy_class):
        def predict_values(self, obs):
            return super().predict_values(obs)

    return Own


both_policies = pytest.mark.parametrize("policy", [ActorCriticPolicy, ActorCriticCnnPolicy])


def make(policy=ActorCriticPolicy, **kwargs):
    env = make_vec_env(lambda: IMAGES() if issubclass(policy, ActorCriticCnnPolicy) else Corridor(), N_ENVS, 0)
    return REINFORCE(policy, env, **{"n_steps": N_STEPS, "seed": 0, "device": "cpu", **kwargs})


def observations(buffer):
    return th.as_tensor(buffer.observations).flatten(0, 1)


@pytest.mark.parametrize("share", [True, False])
@both_policies
def test_cached_features_give_the_same_critic(policy, share):
    """As many passes over the same data, from cached features and from the observations."""
    kwargs, ends = {"share_features_extractor": share, "optimizer_class": th.optim.SGD}, []
    for cls in (policy, overriding(policy)):
        model = make(cls, learning_rate=1e-3, n_critic_updates=3, batch_size=5, policy_kwargs=kwargs)
        assert "value_net.weight" in moved_by_learning(model, 1)
        ends.append(dict(model.policy.named_parameters()))
    th.testing.assert_close(*ends, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_how_often_a_shared_features_extractor_is_evaluated(mode):
    """For each step, the policy's and its divergence (2); with a critic for its passes and the last observations."""
    model = make(ActorCriticCnnPolicy, n_critic_updates=5, **mode).learn(1)
    calls = []
    model.policy.features_extractor.register_forward_hook(lambda *args: calls.append(1))
    model.learn(1)
    n_steps = 10  # the length of every episode
    assert len(calls) == n_steps + 3 + (1 + 2 if mode["baseline"] == "value" else 0)


class ActionZero(ActorCriticCnnPolicy):
    def get_distribution(self, obs):
        logits = super().get_distribution(obs).distribution.logits
        return self.action_dist.proba_distribution(logits + 1e3 * th.eye(logits.shape[1])[0])


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_a_policys_own_distribution_is_used_with_a_shared_features_extractor(mode):
    # Log-probabilities are computed for callbacks
    model = make(ActionZero, **mode).learn(8, callback=lambda *_: True)
    assert (model.rollout_buffer.actions == 0).all()
    np.testing.assert_allclose(model.rollout_buffer.log_probs, 0, atol=1e-6)


CHANGES = {
    "none": lambda policy: None,
    "method": lambda policy: setattr(policy, "predict_values", lambda obs: th.full((len(obs), 1), 3.0)),
    "class": lambda policy: setattr(policy, "__class__", overriding(type(policy))),
    "hook": lambda policy: policy.mlp_extractor.value_net.register_forward_hook(lambda module, x, output: output + 1),
    "parameter of the extractor": lambda policy: setattr(
        policy.features_extractor, "scale", th.nn.Parameter(th.ones(1))
    ),
}


@pytest.mark.parametrize(
    ("policy", "change"), [*product([ActorCriticPolicy], CHANGES), *product([ActorCriticCnnPolicy], ["none", "class"])]
)
def test_values_are_those_of_a_policy_as_the_user_has_changed_it(policy, change):
    """Along with the actions, or in one batch."""
    model = make(policy, learning_rate=0.0)
    CHANGES[change](model.policy)
    buffer = model.learn(1).rollout_buffer
    with th.no_grad():
        expected = model.policy.predict_values(observations(buffer)).reshape(N_STEPS, N_ENVS)
    np.testing.assert_allclose(buffer.values, expected, rtol=1e-4, atol=1e-6)
    assert change == "method" or np.std(buffer.values) > 1e-3


@pytest.mark.parametrize(
    ("kwargs", "length"),
    [({"critic_learning_rate": 2e-3}, "learning_rate"), ({"step": "natural"}, "target_kl")],
)
@both_policies
def test_the_critic_can_learn_before_the_actor(policy, kwargs, length):
    """All of the critic moves, and at rate 0 nothing that the actor depends on."""
    model = make(policy, **kwargs, **{length: 0.0})
    critic = {name for name, _ in model.policy.named_parameters() if "value_net" in name}
    for rate in (0.0, 2e-3):
        setattr(model, length, rate)
        moved = moved_by_learning(model, 1)
        assert critic <= moved and (moved == critic) == (rate == 0)


def test_a_hook_on_a_parameter_of_the_critic_is_called():
    """Users mask gradients with them."""
    model = make(n_critic_updates=3)
    before = model.policy.value_net.weight.detach().clone()
    model.policy.value_net.weight.register_hook(th.zeros_like)
    model.learn(1)
    assert th.equal(model.policy.value_net.weight, before)


@pytest.mark.parametrize("share", [True, False])
def test_only_an_extractor_that_does_not_move_is_kept(share):
    """Dropout draws other masks in each pass; an extractor that the actor shares is in evaluation mode."""
    kwargs = {"features_extractor_class": Dropping, "share_features_extractor": share}
    model, modes = make(policy_kwargs=kwargs, n_critic_updates=3, batch_size=100), []
    extractor = model.policy.vf_features_extractor
    extractor.register_forward_hook(lambda module, *args: modes.append(module.training))
    model.learn(1)
    # Three passes of the critic; or the policy's, two for its divergence and one for the critic
    assert modes[-3:] == [True] * 3 if not share else modes[-4:] == [True, False, False, False]


class CommonLayer(ActorCriticPolicy):
    """Actor and critic have a layer with batch normalization in common, behind their features."""

    def _build_mlp_extractor(self):
        super()._build_mlp_extractor()
        layers = self.mlp_extractor.policy_net
        self.mlp_extractor.value_net = layers.append(th.nn.BatchNorm1d(self.mlp_extractor.latent_dim_pi))


def test_the_critics_passes_leave_the_statistics_of_a_common_layer_alone():
    few, many = (make(CommonLayer, n_critic_updates=n).learn(1).policy.mlp_extractor for n in (1, 5))
    assert th.equal(few.policy_net[-1].running_mean, many.policy_net[-1].running_mean)
    assert few.policy_net[-1].running_mean.any()


@both_policies
def test_values_of_the_policy_step_are_those_of_predict_values(policy):
    """Also if the user overrides it and the extractor is shared."""
    own = type("Own", (policy,), {"predict_values": lambda self, obs: th.full((len(obs), 1), 3.0)})
    model = make(own).learn(1)
    obs = observations(model.rollout_buffer)
    assert (evaluate(model.policy, obs, th.zeros(len(obs)), with_values=True)[2] == 3).all()


@pytest.mark.parametrize("extractor", [FlattenExtractor, Scaled])
def test_values_are_those_of_the_policy_that_a_callback_has_set(extractor):
    """Also of the steps before it, whose values may have come along with the actions."""
    kwargs = {"net_arch": [4], "features_extractor_class": extractor}
    model, other = (make(seed=seed, learning_rate=0.0, policy_kwargs=kwargs) for seed in range(2))
    model.learn(1, At(3, lambda model: setattr(model, "policy", other.policy)))
    with th.no_grad():
        expected = other.policy.predict_values(observations(model.rollout_buffer))
    np.testing.assert_allclose(model.rollout_buffer.values.reshape(-1, 1), expected, rtol=1e-5)


def test_values_are_those_of_the_layer_that_a_callback_has_set():
    model = make(learning_rate=0.0)
    layer = th.nn.Linear(64, 1)
    model.learn(1, At(3, lambda model: setattr(model.policy, "value_net", layer)))
    with th.no_grad():
        expected = model.policy.predict_values(observations(model.rollout_buffer))
    assert model.policy.value_net is layer
    np.testing.assert_allclose(model.rollout_buffer.values.reshape(-1, 1), expected, rtol=1e-5)


def test_an_extractor_that_only_forward_would_use_is_not_used():
    """``predict`` acts without it."""
    model = make(learning_rate=0.0)
    model.policy.features_extractor = Scaled(model.observation_space)
    model.policy.features_extractor.scale.data.fill_(5.0)
    buffer = model.learn(1).rollout_buffer
    with th.no_grad():
        expected = model.policy.predict_values(observations(buffer)).reshape(N_STEPS, N_ENVS)
    np.testing.assert_allclose(buffer.values, expected, rtol=1e-4, atol=1e-6)
    assert model.logger.name_to_value["train/kl"] == pytest.approx(0, abs=1e-6)


class ValueStatistics(ActorCriticPolicy):
    """The critic has batch normalization behind the features."""

    def _build_mlp_extractor(self):
        super()._build_mlp_extractor()
        self.mlp_extractor.value_net.append(th.nn.BatchNorm1d(self.mlp_extractor.latent_dim_vf))


@pytest.mark.parametrize("step", ["optimizer", "natural"])
def test_statistics_of_the_critic_move_with_the_features_that_it_shares(step):
    """The critic's passes are in evaluation mode. V comes along with log π, which moves the statistics once."""
    model = make(ValueStatistics, step=step, policy_kwargs={"features_extractor_class": Scaled}).learn(1)
    assert model.policy.mlp_extractor.value_net[-1].num_batches_tracked == 1


class Sharpened(MlpExtractor):
    """``forward`` differs from ``forward_actor``, from which ``get_distribution`` takes its features."""

    def forward(self, features):
        actor, critic = super().forward(features)
        return 3 * actor, critic


class Inconsistent(ActorCriticPolicy):
    def _build_mlp_extractor(self):
        self.mlp_extractor = Sharpened(self.features_dim, [8], th.nn.Tanh)


@pytest.mark.parametrize("frozen", [False, True])
def test_log_prob_is_learned_by_the_method_that_acts(frozen):
    """Also where the critic has no part in the loss, since the features extractor that it shares is frozen."""
    kwargs = {"features_extractor_class": Scaled, "ortho_init": False}
    model = make(Inconsistent, learning_rate=0.0, policy_kwargs=kwargs)
    model.policy.features_extractor.requires_grad_(not frozen)
    # Log-probabilities are computed for callbacks
    model.learn(1, callback=lambda *_: True)
    weights = training_batch(model.rollout, model.rollout_buffer, model.normalize_advantage).weights
    loss = -(weights * th.as_tensor(model.rollout_buffer.log_probs).flatten()).sum() / model.rollout.denominator
    assert model.logger.name_to_value["train/policy_loss"] == pytest.approx(float(loss), rel=1e-4)


def test_with_batch_size_1_each_step_is_a_minibatch():
    model = make(n_critic_updates=1, batch_size=1)
    sizes = []
    model.policy.value_net.register_forward_hook(lambda module, inputs, output: sizes.append(len(output)))
    model.learn(1)
    assert sizes.count(1) == N_STEPS * N_ENVS
