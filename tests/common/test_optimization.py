"""An optimizer step from given gradients."""

import pytest
import torch as th
from torch import nn

from sb3_reinforce.common.optimization import fuse, step


@pytest.mark.parametrize("chosen", [{"foreach": False}, {"foreach": True}, {"fused": False}, {"differentiable": True}])
def test_the_users_choice_of_an_implementation_is_kept(chosen):
    default, adam = (th.optim.Adam([nn.Parameter(th.zeros(1))], **each) for each in ({}, chosen))
    for optimizer in (default, adam):
        fuse(optimizer)
    assert default.param_groups[0]["fused"] and not adam.param_groups[0]["fused"]


@pytest.mark.parametrize("fused", [True, False])
def test_a_step_reads_a_gradient_in_the_memory_layout_of_its_parameter(fused):
    """A fused optimizer goes through both side by side."""
    rows, columns = (nn.Parameter(w) for w in (th.arange(6.0).view(2, 3), th.arange(6.0).view(2, 3).T.contiguous().T))
    gradient = th.tensor([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]])
    assert rows.stride() != columns.stride()
    for parameter in (rows, columns):
        adam = th.optim.Adam([parameter], lr=0.1, fused=fused)
        assert step(adam, [parameter], [gradient], None, "policy") == pytest.approx(6**0.5)
    th.testing.assert_close(rows.detach(), th.arange(6.0).view(2, 3) - 0.1 * gradient)
    assert th.equal(rows, columns)


def test_a_step_takes_a_gradient_of_another_precision():
    """As autocast makes it."""
    parameter = nn.Parameter(th.zeros(2))
    step(th.optim.SGD([parameter], lr=1.0), [parameter], [th.tensor([1.0, 2.0]).half()], None, "policy")
    assert parameter.tolist() == [-1, -2]


def test_a_subclass_of_an_optimizer_is_left_alone():
    own = type("Own", (th.optim.Adam,), {})([th.nn.Parameter(th.zeros(1))])
    fuse(own)
    assert own.param_groups[0]["fused"] is None


def test_without_a_gradient_nothing_moves():
    """Not by weight decay either, where a batch uses no trained parameter."""
    parameter = th.nn.Parameter(th.ones(1))
    assert step(th.optim.SGD([parameter], lr=1.0, weight_decay=1.0), [parameter], [None], None, "critic") == 0
    assert parameter.item() == 1
