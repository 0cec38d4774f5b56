"""Arguments that may be schedules are checked at each value."""

import numpy as np
import pytest
import torch as th
from models import both, make


@both
@pytest.mark.parametrize("form", [float, np.float32, np.array, lambda rate: np.array([rate]), th.tensor])
def test_forms_that_stand_for_the_value_of_a_schedule(form, kind):
    model = make(kind, learning_rate=lambda progress: form(1e-3), seed=2**32 - 1).learn(8)
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3)


@pytest.mark.parametrize(("kind", "name"), [("steps", "temperature"), ("search", "delta_std")])
def test_a_schedule_may_fall_to_an_excluded_bound_but_not_start_there(kind, name):
    for schedule in (lambda progress: 0.0, lambda progress: 1 - progress):
        with pytest.raises(ValueError, match=rf"{name} \(at progress_remaining=1\) must be (in \(0|finite and > 0)"):
            make(kind, **{name: schedule})
    with pytest.raises(ValueError, match=rf"{name} \(at progress_remaining=0\) must be (in \[0|finite and >= 0)"):
        make(kind, **{name: lambda progress: 2 * progress - 1})
    make(kind, **{name: lambda progress: progress}).learn(8)


def test_a_schedule_that_goes_wrong_later_stops_training_before_a_step():
    model = make("steps", learning_rate=lambda progress: np.nan if 0 < progress < 0.6 else 1e-3)
    with pytest.raises(ValueError, match="learning_rate"):
        model.learn(16)
    assert model._n_updates == 0


def test_a_schedule_is_called_once_where_its_value_is_needed_once():
    seen = []
    model = make("steps", ent_coef=lambda progress: seen.append(progress) or 0.0)
    n_before = len(seen)
    model.learn(80)
    assert len(seen) - n_before == model._n_updates == 10
    # At construction it is checked at both ends
    assert set(seen[:n_before]) == {0.0, 1.0}
