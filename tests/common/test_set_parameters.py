"""Parameters and states of optimizers are taken all or none."""

import warnings
from contextlib import nullcontext

import pytest
import torch as th
from environments import Corridor
from models import KINDS, both, make, plain
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_reinforce.recurrent import RecurrentREINFORCE

NAN = float("nan")


def optimizer_with(parameters, **changes):
    return {**parameters, "policy.optimizer": {**parameters["policy.optimizer"], **changes}}


def groups_with(parameters, **changes):
    groups = parameters["policy.optimizer"]["param_groups"]
    return optimizer_with(parameters, param_groups=[{**group, **changes} for group in groups])


def moments_with(parameters, change):
    state = parameters["policy.optimizer"]["state"]
    return optimizer_with(parameters, state={i: change(moments) for i, moments in state.items()})


def not_finite(state):
    return {key: value * NAN for key, value in state.items()}


WRONG = {
    "nothing": lambda p: {},
    "an unknown name": lambda p: {**p, "foo": {}},
    "a method's name": lambda p: {**p, "learn": {}},
    "no optimizer": lambda p: {"policy": p["policy"]},
    "no dict": lambda p: {**p, "policy.optimizer": 3},
    "another shape": lambda p: {**p, "policy": {**p["policy"], "action_net.bias": th.zeros(77)}},
    "a key less": lambda p: {**p, "policy": {k: v for k, v in p["policy"].items() if k != "action_net.bias"}},
    "a key more": lambda p: {**p, "policy": {**p["policy"], "third.bias": th.zeros(2)}},
    "other keys": lambda p: {**p, "policy": {"third.bias": th.zeros(2)}},
    "not finite": lambda p: {**p, "policy": not_finite(p["policy"])},
    "no finite optimizer": lambda p: moments_with(p, not_finite),
    "no finite learning rate": lambda p: groups_with(p, lr=float("inf")),
    "another optimizer's groups": lambda p: optimizer_with(p, param_groups=[{"params": [0]}] * 2),
    "another optimizer's parameter": lambda p: optimizer_with(p, state={99: {"exp_avg": th.zeros(3)}}),
    "another optimizer's moments": lambda p: moments_with(p, lambda moments: {**moments, "exp_avg": th.zeros(3, 77)}),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("exact_match", [True, False])
def test_wrong_parameters_change_nothing_at_all(exact_match, wrong):
    model, other = (make("steps", Corridor(), seed=seed).learn(8) for seed in (0, 1))
    before = plain(model.get_parameters())
    states = WRONG[wrong](other.get_parameters())
    is_partial = wrong in ("no optimizer", "a key less", "a key more")
    if not exact_match and (is_partial or "another optimizer" in wrong):
        message = r"has no (action_net|third)\.bias" if is_partial else r"'policy.optimizer'.*It is left out"
        with nullcontext() if wrong == "no optimizer" else pytest.warns(UserWarning, match=message):
            model.set_parameters(states, exact_match=False)
        after = model.get_parameters()
        taken = states["policy"].keys() & after["policy"].keys()
        assert all(th.equal(after["policy"][name], states["policy"][name]) for name in taken)
        assert ("policy.optimizer", plain(after["policy.optimizer"])) in before
        return
    with pytest.raises((ValueError, TypeError, RuntimeError)):
        model.set_parameters(states, exact_match=exact_match)
    assert plain(model.get_parameters()) == before
    model.learn(8, reset_num_timesteps=False)


class ScaledAdam(th.optim.Adam):
    """Keeps a setting outside its groups, which copies of an optimizer lack."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.scale = 0.5

    def step(self, closure=None):
        for parameter in self.param_groups[0]["params"]:
            if parameter.grad is not None:
                parameter.grad *= self.scale
        return super().step(closure)


@both
@pytest.mark.parametrize("optimizer", [RMSpropTFLike, th.optim.Adafactor, th.optim.SGD, th.optim.AdamW, ScaledAdam])
def test_the_states_of_other_optimizers_are_loaded(optimizer, kind, tmp_path):
    model = make(kind, Corridor(), policy_kwargs={"net_arch": [4], "optimizer_class": optimizer}).learn(32)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=Corridor())
    assert plain(loaded.get_parameters()) == plain(model.get_parameters())
    loaded.learn(32)


@both
def test_the_state_of_another_kind_of_optimizer_is_left_out(kind):
    states = make(kind, Corridor()).learn(32).get_parameters()
    model = make(kind, Corridor(), policy_kwargs={"net_arch": [4], "optimizer_class": th.optim.SGD})
    with pytest.raises(ValueError, match=r"another optimizer.* To leave this state out, .*exact_match=False"):
        model.set_parameters(states)
    with pytest.warns(UserWarning, match="It is left out"):
        model.set_parameters(states, exact_match=False)
    model.learn(32)


@both
def test_a_replaced_optimizer_is_replaced_again_before_its_state_is_loaded(kind, tmp_path):
    def make_with_own():
        model = make(kind, Corridor(), policy_kwargs={"net_arch": [4]})
        model.policy.optimizer = th.optim.Adam(model.policy.action_net.parameters(), lr=1e-3)
        return model

    model = make_with_own().learn(32)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="make a model, give it that optimizer, and call set_parameters"):
        type(model).load(tmp_path / "model", env=Corridor())
    again = make_with_own()
    again.set_parameters(tmp_path / "model")
    assert plain(again.get_parameters()) == plain(model.get_parameters())


@both
def test_a_state_may_lack_flags_that_a_newer_pytorch_has(kind):
    model = make(kind, Corridor()).learn(32)
    states = groups_with(model.get_parameters())
    for group in states["policy.optimizer"]["param_groups"]:
        del group["decoupled_weight_decay"]
    other = make(kind, Corridor())
    other.set_parameters(states)
    assert plain(other.get_parameters()) == plain(model.get_parameters())
    other.learn(32)


@both
def test_parameters_of_another_model_are_copied(kind):
    """Also the moments of its optimizers, which PyTorch takes as they are."""
    first = make(kind, Corridor()).learn(32)
    second = make(kind, Corridor())
    second.set_parameters(first.get_parameters())
    before = plain(first.get_parameters())
    second.learn(64)
    assert plain(first.get_parameters()) == before


@both
def test_moments_of_another_shape_are_refused_before_the_first_step_too(kind):
    states = WRONG["another optimizer's moments"](make(kind, Corridor()).learn(32).get_parameters())
    with pytest.raises(ValueError, match=r"exp_avg of parameter 0 must have shape .* got \(3, 77\)"):
        make(kind, Corridor()).set_parameters(states)


@both
@pytest.mark.parametrize(("other", "same_optimizer"), [(A2C, False), (PPO, True)])
def test_parameters_of_other_algorithms(kind, other, same_optimizer, tmp_path):
    """The policy's in any case, an optimizer's where it is of the same kind, from a file and from a dictionary."""
    arguments = {"n_steps": 16} if other is A2C else {"n_steps": 16, "batch_size": 16}
    trained = other("MlpPolicy", Corridor(), device="cpu", **arguments).learn(16)
    trained.save(tmp_path / "other")
    for states in (trained.get_parameters(), tmp_path / "other"):
        model = make(kind, Corridor(), policy_kwargs={})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.set_parameters(states, exact_match=False)
        assert plain(model.policy.state_dict()) == plain(trained.policy.state_dict())
        assert bool(model.policy.optimizer.state_dict()["state"]) == same_optimizer
        assert len(caught) == (0 if same_optimizer else 1)
        model.learn(32)
    trained.set_parameters({"policy": model.get_parameters()["policy"]}, exact_match=False)
    assert plain(trained.policy.state_dict()) == plain(model.policy.state_dict())


def test_parameters_of_recurrent_ppo(tmp_path):
    arguments = {"policy_kwargs": {"lstm_hidden_size": 4}, "device": "cpu"}
    trained = RecurrentPPO("MlpLstmPolicy", Corridor(), n_steps=16, batch_size=16, **arguments).learn(16)
    trained.save(tmp_path / "other")
    for states in (trained.get_parameters(), tmp_path / "other"):
        model = RecurrentREINFORCE("MlpLstmPolicy", Corridor(), **arguments)
        model.set_parameters(states, exact_match=False)
        assert plain(model.policy.state_dict()) == plain(trained.policy.state_dict())
        moments = (each.policy.optimizer.state_dict()["state"] for each in (model, trained))
        assert len({str(plain(each)) for each in moments}) == 1
        model.learn(32)


class Masked(FlattenExtractor):
    """Holds an infinite mask, as a buffer and as a frozen parameter; shared by actor and critic, it has three names."""

    def __init__(self, space):
        super().__init__(space)
        self.register_buffer("mask", th.tensor([0.0, -float("inf")]))
        self.frozen = th.nn.Parameter(self.mask.clone(), requires_grad=False)


@both
def test_a_mask_may_be_infinite(kind, tmp_path):
    model = make(kind, Corridor(), policy_kwargs={"features_extractor_class": Masked, "net_arch": [4]})
    model.save(tmp_path / "model")
    loaded = KINDS[kind][0].load(tmp_path / "model", device="cpu").policy.features_extractor
    assert loaded.mask[1] == loaded.frozen[1] == -float("inf")
    own = "features_extractor"
    for name, number in ((f"{own}.mask", NAN), (f"{own}.frozen", NAN), ("action_net.bias", float("inf"))):
        states = model.get_parameters()
        states["policy"][name] = th.tensor([0.0, number])
        with pytest.raises(ValueError, match="finite"):
            model.set_parameters(states)


@both
def test_a_subclass_may_save_a_network_of_its_own(kind, tmp_path):
    class Curious(KINDS[kind][0]):
        def _setup_model(self):
            super()._setup_model()
            self.predictor = th.nn.Linear(2, 3)

        def _excluded_save_params(self):
            return [*super()._excluded_save_params(), "predictor"]

        def _get_torch_save_params(self):
            states, tensors = super()._get_torch_save_params()
            return [*states, "predictor"], tensors

    model, other = (Curious("MlpPolicy", Corridor(), device="cpu") for _ in range(2))
    model.save(tmp_path / "model")
    assert th.equal(Curious.load(tmp_path / "model", device="cpu").predictor.weight, model.predictor.weight)
    wrong = {**model.get_parameters(), "predictor": {"weight": th.ones(3, 2)}}
    before = plain(other.get_parameters())
    with pytest.raises(RuntimeError, match="bias"):
        other.set_parameters(wrong)
    assert plain(other.get_parameters()) == before
    other.set_parameters(wrong, exact_match=False)
    assert th.equal(other.predictor.weight, th.ones(3, 2))


def test_a_search_leaves_out_the_critics_optimizer():
    other, model = make("steps", Corridor()).learn(8), make("search", Corridor())
    with pytest.raises(ValueError, match="nothing else"):
        model.set_parameters(other.get_parameters())
    model.set_parameters(other.get_parameters(), exact_match=False)
    assert plain(model.policy.state_dict()) == plain(other.policy.state_dict())
